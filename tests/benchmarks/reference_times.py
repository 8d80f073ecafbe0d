"""Measure the times with which a run estimates stages that no earlier run with its cache has computed.

    python -m tests.benchmarks.reference_times [PRESET ...]     # default: quickstart quality

Each preset runs on its samples, serially, with one thread, into a new cache that the presets share. Times are CPU
seconds, so that they hold for an idle machine whatever else runs. Stages that the presets do not have keep the times
that they had. The result is `pano_mvs/session/reference_times.json`; runs scale it by the size of the capture, and by
how long their own units take.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import pano_mvs
from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.engine.cache.unit_times import FILE_NAME
from pano_mvs.session import forecasting

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
    rounded = {
        stage: [[round(value, 4) if isinstance(value, float) else value for value in sample] for sample in found]
        for stage, found in measured.items()
    }
    return dict(sorted({**kept, **{stage: found[-_MAX_SAMPLES:] for stage, found in rounded.items()}}.items()))


def measure(presets: list[str]) -> dict[str, list[list[object]]]:
    """Run presets on their samples, and return what their units took."""
    time.perf_counter = time.process_time
    with TemporaryDirectory() as folder:
        cache = Path(folder) / "cache"
        for preset in presets:
            run = pano_mvs.run(preset, out=Path(folder) / preset, cache=cache, executor="serial")
            print(f"{preset}: {run.summary.units.run} units, {run.summary.seconds:.0f} CPU-s", file=sys.stderr)
        return samples_in(cache / FILE_NAME)


def main() -> None:
    """Measure, and write the file."""
    body = json.dumps(merged(samples_in(TARGET), measure(sys.argv[1:] or ["quickstart", "quality"])), indent=0)
    TARGET.write_text(f"{digest_from_bytes(body.encode())}\n{body}", encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
