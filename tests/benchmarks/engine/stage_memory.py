"""What each dense stage of a workflow takes in memory.

Run it with `python -m tests.benchmarks.engine.stage_memory [--workflow quality]`.

The stages run in this process on a rendered room, at two sizes. Before each unit the peak that Linux keeps of the
resident memory is reset; what the unit adds to what was there before is its own. The difference between the two sizes
gives bytes for each pixel of a panorama, the rest is what a stage takes whatever the size. Linux alone.
"""

from __future__ import annotations

import argparse
import gc
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pano_mvs.scene import Record
from pano_mvs.testing.scenes import SCENES
from tests.benchmarks.captures import Capture, scene_capture
from tests.benchmarks.dense_chain import DenseChain

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class MeasuredChain(DenseChain):
    """A chain that remembers the largest peak of each stage, in bytes."""

    def __init__(self, workflow: str, *, overrides: Sequence[str] = ()) -> None:
        super().__init__(workflow, overrides=overrides)
        self.peaks: dict[str, int] = defaultdict(int)

    def run_one(self, name: str, *rest: Any) -> Record:
        gc.collect()
        _CLEAR.write_text("5")
        before = _memory("VmRSS")
        result = super().run_one(name, *rest)
        self.peaks[name] = max(self.peaks[name], _memory("VmHWM") - before)
        return result


def _memory(field: str) -> int:
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(field))
    return int(line.split()[1]) * 1024


def peaks(workflow: str, capture: Capture, overrides: Sequence[str]) -> Mapping[str, int]:
    """Return the peak of each stage, in bytes; the kernels are loaded."""
    chain = MeasuredChain(workflow, overrides=overrides)
    chain.run(capture)
    return dict(chain.peaks)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workflow", default="quality", help="preset or file")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.PARAM=VALUE", help="as in run")
    parser.add_argument("--widths", type=int, nargs=2, default=[1024, 2048], help="of the panoramas")
    parser.add_argument("--views", type=int, default=4, help="one of them the reference, the others its sources")
    options = parser.parse_args()
    found = []
    for width in (64, *options.widths):  # the first loads and compiles
        with tempfile.TemporaryDirectory() as folder:
            capture = scene_capture(next(iter(SCENES.values()))(seed=0, exposure=0.0), Path(folder), width=width).first(
                4
            )
            found.append(peaks(options.workflow, capture, options.set))
    small, large = (width * width // 2 for width in options.widths)
    print(f"| stage | bytes per pixel | MB beside | MB at {options.widths[1]} columns |\n|---|---|---|---|")
    for name, most in found[2].items():
        per_pixel = (most - found[1][name]) / (large - small)
        print(f"| {name} | {per_pixel:.0f} | {(most - per_pixel * large) / 1e6:.0f} | {most / 1e6:.0f} |")


if __name__ == "__main__":
    main()
