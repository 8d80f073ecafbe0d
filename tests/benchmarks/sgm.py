"""How long semi-global matching takes: `python -m tests.benchmarks.sgm [--small]`.

CPU time of one process, one thread, the best of several rounds, on a volume of noise; beside it, as a yardstick, the
sum of the same volume by numpy.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial

import numba
import numpy as np

from pano_mvs.algorithms.sweep.backends.numba_backend import winners_by_paths
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.settings import SweepSettings
from tests.benchmarks.sampling import cpu_seconds


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="128 rows, 16 planes, one round")
    options = parser.parse_args(arguments)
    numba.set_num_threads(1)
    sizes = [(128, 16)] if options.small else [(256, 128), (512, 64), (512, 128)]
    print("| rows × columns × planes | CPU-s | ns a voxel | sum of the volume by numpy, CPU-s |\n|---|---|---|---|")
    for rows, planes in sizes:
        rng = np.random.default_rng(0)
        volume = rng.integers(0, 256, (rows, planes, 2 * rows), dtype=np.uint8)
        picture = rng.integers(0, 256, (rows, 2 * rows, 1), dtype=np.uint8)
        work = SweepInput(picture, (), (), None, np.linspace(1, 2, planes), SweepSettings(planes=planes))
        times: dict[str, list[float]] = {"sgm": [], "sum": []}
        for _ in range(2 if options.small else 4):
            times["sgm"].append(cpu_seconds(partial(winners_by_paths, work, volume)))
            times["sum"].append(cpu_seconds(partial(np.sum, volume, dtype=np.int64)))
        sgm, control = (min(values[1:]) for values in times.values())  # the first call compiles
        print(f"| {rows}×{2 * rows}×{planes} | {sgm:.3f} | {1e9 * sgm / volume.size:.2f} | {control:.3f} |")


if __name__ == "__main__":
    main()
