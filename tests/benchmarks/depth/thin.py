"""Where thin objects are lost: `python -m tests.benchmarks.depth.thin [--setting "depth.levels=2"] [--kind poles]`.

Runs the dense stages of a workflow with true poses on rooms with thin objects, cameras turned at random, and prints
after each stage the share of thin pixels within 5 % of the truth, that of the pixels within three pixels of them
("beside"), and that of all pixels.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.testing.scenes import Scene, poles
from tests.benchmarks.captures import scene_capture
from tests.benchmarks.depth.stored_chain import StoredChain
from tests.synthetic.thin import THIN_KINDS, thin_pixels, thin_scene

KINDS = ("poles", *THIN_KINDS)
_RIGHT, _BESIDE_PX = 0.05, 3


def thin_place(kind: str, *, width: int, seed: int, views: int) -> Scene:
    """Return a place; the thickness of poles refers to 1024 columns, that of all else to the given ones."""
    if kind == "poles":
        return poles(seed=seed, views=views)
    return thin_scene(kind, width=width, seed=seed, views=views)


def measure(chain: StoredChain, scene: Scene, *, width: int, scratch: Path, references: int) -> dict[str, list[float]]:
    """Return the shares of right pixels, thin ones, beside them and all, after each stage."""
    label = f"{scene.name}-{scene.room.seed}-{len(scene.poses)}-{width}-{len(scene.room.surfaces)}"
    capture = scene_capture(scene, scratch / label, width=width)
    names = list(capture.panoramas)[:references]
    run = chain.run(capture, label=label, references=names)
    shares: dict[str, list[float]] = {}
    for stage, maps in run.range_maps.items():
        rows = []
        for idx, name in enumerate(names):
            truth = capture.ranges[name]
            path = scratch / label / f"{idx:03d}-thin.npy"
            if not path.is_file():
                np.save(path, thin_pixels(scene, idx, truth))
            rows.append(_shares(maps[name].range, truth, np.load(path)))
        shares[stage] = np.mean(rows, axis=0).tolist()
    shares["CPU s"] = [sum(run.cpu_s.values())]
    return shares


def _shares(ranges: NDArray[np.float32], truth: NDArray[np.float32], thin: NDArray[np.bool_]) -> list[float]:
    with np.errstate(invalid="ignore"):
        right = np.abs(ranges - truth) <= _RIGHT * truth
    window = np.ones((2 * _BESIDE_PX + 1, 2 * _BESIDE_PX + 1), np.uint8)
    beside = (cv2.dilate(thin.astype(np.uint8), window) > 0) & ~thin
    return [100 * float(right[part].mean()) for part in (thin, beside, np.isfinite(truth))]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workflow", default="quality")
    parser.add_argument("--setting", action="append", metavar="'STAGE.PARAM=VALUE …'", help="repeatable; '' is none")
    parser.add_argument("--kind", action="append", choices=KINDS)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--references", type=int, default=1, help="number of views that are scored")
    parser.add_argument("--scratch", type=Path, default=Path(tempfile.gettempdir()) / "pano_mvs_thin")
    given = parser.parse_args(arguments)
    for setting in given.setting or [""]:
        chain = StoredChain(given.workflow, overrides=setting.split(), store=given.scratch / "maps")
        tables = []
        for kind in given.kind or KINDS:
            scene = thin_place(kind, width=given.width, seed=given.seed, views=given.views)
            shares = measure(chain, scene, width=given.width, scratch=given.scratch, references=given.references)
            took = shares.pop("CPU s")[0]
            tables.append(list(shares.values()))
            if len(tables) == 1:
                print(f"{setting or 'defaults'}: thin / beside / all\n| place | " + " | ".join(shares) + " |")
            print(_row(kind, tables[-1]), f"{took:.1f} CPU-s", flush=True)
        print(_row("mean", np.mean(tables, axis=0).tolist()), flush=True)


def _row(name: str, table: Sequence[Sequence[float]]) -> str:
    return f"| {name} | " + " | ".join(" / ".join(f"{share:.1f}" for share in cell) for cell in table) + " |"


if __name__ == "__main__":
    main()
