"""Measure the times with which a run estimates stages that no earlier run with its cache has computed.

Each preset runs on its samples, serially, into a new cache that the presets share. Times are CPU seconds, those of
child processes included, so that they hold for one thread of an idle machine, whatever else runs. Stages that the
presets do not have keep the times that they had. The result is `pano_mvs/session/reference_times.json`; runs scale it
by the size of the capture, and by how long their own units take.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

import pano_mvs
from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.engine.cache.unit_times import FILE_NAME
from pano_mvs.session import planning as forecasting

TARGET = Path(forecasting.__file__).with_name("reference_times.json")
_MAX_SAMPLES = 2


def samples_in(path: Path) -> dict[str, list[list[object]]]:
    """Return the samples in a file; none if it does not exist."""
    found: dict[str, list[list[object]]] = json.loads(path.read_bytes().partition(b"\n")[2]) if path.is_file() else {}
    return found


def merged(
    kept: dict[str, list[list[object]]], measured: dict[str, list[list[object]]]
) -> dict[str, list[list[object]]]:
    """Return the samples of each stage: what was measured, else what was kept."""
    rounded = {stage: [_rounded(sample) for sample in found[-_MAX_SAMPLES:]] for stage, found in measured.items()}
    return dict(sorted({**kept, **rounded}.items()))


def _rounded(sample: list[object]) -> list[object]:
    """Return a sample for one thread, since its time is CPU time, with rounded numbers."""
    settings, _threads, *numbers = sample
    return [settings, 1, *(round(number, 4) if isinstance(number, float) else number for number in numbers)]


def cpu_seconds() -> float:
    """Return the CPU time of this process and of the children that have ended."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def measure(presets: list[str]) -> dict[str, list[list[object]]]:
    """Run presets on their samples, and return what their units took."""
    time.perf_counter = cpu_seconds
    with TemporaryDirectory() as folder:
        cache = Path(folder) / "cache"
        for preset in presets:
            run = pano_mvs.run(preset, out=Path(folder) / preset, cache=cache, executor="serial")
            print(f"{preset}: {run.summary.units.run} units, {run.summary.seconds:.0f} CPU-s", file=sys.stderr)
        return samples_in(cache / FILE_NAME)


def main(presets: Annotated[list[str] | None, typer.Argument()] = None) -> None:
    """Measure presets, by default quickstart and quality, and write the file."""
    body = json.dumps(merged(samples_in(TARGET), measure(presets or ["quickstart", "quality"])), indent=0)
    TARGET.write_text(f"{digest_from_bytes(body.encode())}\n{body}", encoding="utf-8", newline="\n")
