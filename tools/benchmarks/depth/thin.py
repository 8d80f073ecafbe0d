"""Where thin objects are lost.

Runs the dense stages of a workflow with true poses on rooms with thin objects, cameras turned at random, and prints
after each stage the share of thin pixels within 5 % of the truth, that of the pixels within three pixels of them
("beside"), and that of all pixels. `--setting "depth.levels=2"` (repeatable) changes the workflow; '' does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene import RangeMap
from tests.synthetic.scenes import Scene, poles
from tools.benchmarks.captures import SCRATCH, scene_capture
from tools.benchmarks.dense_chain import DenseChain
from tools.benchmarks.depth.thin_rooms import THIN_KINDS, thin_pixels, thin_scene
from tools.benchmarks.table import print_table

KINDS = ("poles", *THIN_KINDS)
_RIGHT, _BESIDE_PX = 0.05, 3


def measure(chain: DenseChain, scene: Scene, folder: Path, *, width: int, references: int) -> dict[str, list[float]]:
    """Return the shares of right pixels, thin ones, beside them and all, after each stage."""
    capture = scene_capture(scene, folder, width=width)
    names = list(capture.panoramas)[:references]
    thin = [thin_pixels(scene, idx, capture.ranges[name]) for idx, name in enumerate(names)]
    return {
        stage: np.mean(
            [_shares(maps[name].range, capture.ranges[name], pixels) for name, pixels in zip(names, thin, strict=True)],
            axis=0,
        ).tolist()
        for stage, maps in chain.run(capture, references=names).range_maps.items()
    }


def _shares(ranges: NDArray[np.float32], truth: NDArray[np.float32], thin: NDArray[np.bool_]) -> list[float]:
    with np.errstate(invalid="ignore"):
        right = np.abs(ranges - truth) <= _RIGHT * truth
    window = np.ones((2 * _BESIDE_PX + 1, 2 * _BESIDE_PX + 1), np.uint8)
    beside = (cv2.dilate(thin.astype(np.uint8), window) > 0) & ~thin
    return [100 * float(right[part].mean()) for part in (thin, beside, np.isfinite(truth))]


def main(
    workflow: str = "quality",
    setting: list[str] | None = None,
    kind: list[str] | None = None,
    width: int = 512,
    views: int = 4,
    seed: int = 3,
    references: int = 1,
    scratch: Path = SCRATCH / "thin",
) -> None:
    """Print a table for each setting; the thickness of poles refers to 1024 columns, that of all else to the width."""
    cv2.setNumThreads(1)
    for overrides in setting or [""]:
        chain = DenseChain(workflow, overrides=overrides.split())

        def rows(chain: DenseChain = chain) -> Iterator[Sequence[str]]:
            tables = []
            for name in kind or KINDS:
                is_thick = name == "poles"
                scene = (
                    poles(seed=seed, views=views) if is_thick else thin_scene(name, width=width, seed=seed, views=views)
                )
                folder = scratch / f"{name}-{width}-{seed}-{views}"
                tables.append(list(measure(chain, scene, folder, width=width, references=references).values()))
                yield name, *_cells(tables[-1])
            yield "mean", *_cells(np.mean(tables, axis=0).tolist())

        print(f"{overrides or 'defaults'}: thin / beside / all")
        print_table(["place", *(name for name in chain.dense if chain.stages[name].spec.output is RangeMap)], rows())


def _cells(table: Sequence[Sequence[float]]) -> list[str]:
    return [" / ".join(f"{share:.1f}" for share in cell) for cell in table]
