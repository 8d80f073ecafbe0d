"""What each dense stage of a workflow takes in memory.

The stages run in this process on a rendered room, at two sizes. Before each unit the peak that Linux keeps of the
resident memory is reset; what the unit adds to what was there before is its own. The difference between the two sizes
gives bytes for each pixel of a panorama, the rest is what a stage takes whatever the size. Linux alone.
"""

from __future__ import annotations

import gc
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pano_mvs.scene import Record
from tests.synthetic.scenes import SCENES
from tools.benchmarks.captures import scene_capture
from tools.benchmarks.dense_chain import DenseChain, Overrides
from tools.benchmarks.table import print_table

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


def main(
    workflow: str = "quality", overrides: Overrides = None, widths: tuple[int, int] = (1024, 2048), views: int = 4
) -> None:
    """Print the table; one of the views is the reference, the others its sources."""
    found = []
    for width in (64, *widths):  # the first loads and compiles
        with tempfile.TemporaryDirectory() as folder:
            scene = next(iter(SCENES.values()))(seed=0, exposure=0.0)
            chain = MeasuredChain(workflow, overrides=overrides or ())
            chain.run(scene_capture(scene, Path(folder), width=width).first(views))
            found.append(chain.peaks)
    small, large = (width * width // 2 for width in widths)

    def rows() -> Iterator[list[str]]:
        for name, most in found[2].items():
            per_pixel = (most - found[1][name]) / (large - small)
            yield [name, f"{per_pixel:.0f}", f"{(most - per_pixel * large) / 1e6:.0f}", f"{most / 1e6:.0f}"]

    print_table(["stage", "bytes per pixel", "MB beside", f"MB at {widths[1]} columns"], rows())
