"""Whole captures by the preset `quality`, from pictures to range maps, beside the best figures that were measured.

Each capture is run with default settings and a cache of its own: the classroom of the samples, a colonnade of 24 views
along a path, a hall with a tiled floor (9), a street (14) and two furnished houses (12 and 9), rendered at 1024×512.
The row of a capture shows

- the cameras that are right (within 1° and 2 % of the extent of the capture), wrong and not doubted, and right but
  doubted, and the median over the pairs of registered images of the larger of rotation and direction error,
- of what is nearer than 10 m: the share of the ranges within 5 % of the truth and the PSNR of the pixels that have a
  range, and the share without one, by solid angle, except for PSNR; means of the views; the scale is that of the
  centres of the right cameras,
- CPU seconds from pictures to poses, divided by those of COLMAP's incremental mapper with its own features on the same
  pictures, one after the other on this machine,
- CPU and wall seconds of the whole run, which are not compared.

Below the table is every figure that is worse than that of `whole.json` by more than its tolerance; if there is one, or
a run fails, the exit code is 1. The first run of the code on a machine compiles kernels, which counts as CPU time.
Pictures that `--out` has are not rendered again: remove its folder `captures` after a change of a renderer.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from pano_mvs_evaluation.poses import evaluate_poses
from pano_mvs_evaluation.ranges.evaluate import evaluate_depth
from pano_mvs_evaluation.ranges.view_scores import ScoreSettings

import pano_mvs
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import split_groups
from tests.synthetic.scenes import Scene, write_scene
from tools.benchmarks.captures import SCRATCH, Capture, read_capture
from tools.benchmarks.depth.houses import read_house
from tools.benchmarks.end_to_end import run_once
from tools.benchmarks.poses.placements import judge_placements
from tools.benchmarks.poses.tours.houses import write_house
from tools.benchmarks.real_captures import colmap
from tools.benchmarks.repeating.places import colonnade, facade_row, tiled_hall
from tools.benchmarks.table import print_table
from tools.benchmarks.tables import SAMPLE

BEST = Path(__file__).with_suffix(".json")
"""The best figures that were measured, by capture and name."""
WIDTH = 1024
_PEAK_M = 10.0  # of PSNR, as in the paper
SCENES: dict[str, Callable[[], Scene]] = {
    "colonnade": partial(colonnade, rows=3, columns=8, seed=1, views=24, layout="path", turned=False),
    "hall": partial(tiled_hall, seed=1, views=9, turned=False),
    "street": partial(facade_row, bays=10, seed=1, views=14, layout="path", turned=False),
}
CAPTURES = (SAMPLE.name, *SCENES, "house_01", "house_10")

Figures = dict[str, float]


@dataclass(frozen=True)
class Rule:
    """How a figure is shown and compared.

    Attributes:
        label: of its column.
        form: of its numbers.
        sign: 1 if more is better, -1 if less is.
        tolerance: by how much it may be worse.
        relative: whether the tolerance is a share of the best figure.
    """

    label: str
    form: str
    sign: int
    tolerance: float = 0.0
    relative: bool = False

    def is_worse(self, value: float | None, best: float) -> bool:
        """Return whether a figure, None where there is none, is worse than the best one."""
        limit = self.tolerance * (abs(best) if self.relative else 1.0)
        return value is None or not self.sign * (best - value) <= limit + 1e-9


RULES = {
    "right": Rule("right", ".0f", 1),
    "silent": Rule("wrong, not doubted", ".0f", -1),
    "false": Rule("right, doubted", ".0f", -1),
    "pair_deg": Rule("median pair error °", ".4f", -1, 0.15, relative=True),
    "within_5": Rule("within 5 %", ".4f", 1, 0.005),
    "psnr_db": Rule("PSNR dB", ".2f", 1, 0.2),
    "missing": Rule("without a range", ".4f", -1, 0.002),
    "cpu_ratio": Rule("CPU-s of the poses / COLMAP", ".2f", -1, 0.1, relative=True),
}


def prepared(name: str, captures: Path) -> tuple[Path, Capture]:
    """Return a capture with its truth, and its folder, in which `images` has its pictures; render what is missing."""
    folder = captures / name
    if name == SAMPLE.name:
        return SAMPLE, read_capture(SAMPLE)
    if name not in SCENES:
        write_house(folder, name, width=WIDTH)
        return folder, read_house(folder, width=WIDTH).capture
    if not folder.is_dir():
        part = captures / f"{name}.part"
        shutil.rmtree(part, ignore_errors=True)
        write_scene(part, SCENES[name](), (WIDTH // 2, WIDTH))
        part.rename(folder)
    return folder, read_capture(folder)


def figures(poses: Poses | None, ranges: Path | Mapping[str, NDArray[np.float32]], capture: Capture) -> Figures:
    """Return the figures of poses and range maps; without two registered images there are no errors.

    Args:
        poses: of a run.
        ranges: its output folder, or its range maps by image name.
        capture: with the truth.
    """
    if poses is None or len(poses.names) < 2:
        return {"right": 0, "silent": 0, "false": 0}
    placed = judge_placements(poses, capture.poses)
    right = {name for name, is_right in zip(placed.names, placed.right, strict=True) if is_right}
    # One camera in a wrong place would change the scale of all ranges.
    scaling = right if len(right.intersection(split_groups(poses)[0].names)) > 1 else capture.poses.keys()
    near = {name: np.where(true < _PEAK_M, true, np.float32(np.nan)) for name, true in capture.ranges.items()}
    depth = evaluate_depth(
        ranges,
        near,
        settings=ScoreSettings(peak=_PEAK_M),
        poses=poses,
        true_poses={name: capture.poses[name] for name in scaling},
    ).mean
    return {
        "right": int(placed.right.sum()),
        "silent": len(placed.unreported),
        "false": int((placed.right & placed.doubted).sum()),
        "pair_deg": evaluate_poses(poses, capture.poses).registered_pairs.median_pair_deg,
        "within_5": depth["valid_w_delta_105"],
        "psnr_db": depth["valid_psnr_db"],
        "missing": 1 - depth["w_completeness"],
    }


def worse_figures(found: Mapping[str, float], best: Mapping[str, float]) -> list[str]:
    """Return each figure that is worse than the best one by more than its tolerance, in words."""
    return [
        f"{rule.label} {shown(name, found)}, best {shown(name, best)}"
        for name, rule in RULES.items()
        if name in best and rule.is_worse(found.get(name), best[name])
    ]


def shown(name: str, found: Mapping[str, float]) -> str:
    """Return a figure as text, or a dash."""
    return f"{found[name]:{RULES[name].form}}" if name in found else "–"


def measured(name: str, out: Path) -> tuple[Figures, float, float]:
    """Run a capture, and return its figures, and CPU and wall seconds of the run.

    Raises:
        SystemExit: with the output of the run, if it fails.
    """
    folder, capture = prepared(name, out / "captures")
    work, arguments = out / "runs" / name, ["quality", "--images", str(folder / "images")]
    shutil.rmtree(work, ignore_errors=True)
    (work / "colmap").mkdir(parents=True)
    # The second run finds the poses of the first in the cache, so that their time is known and they are solved once.
    poses_wall_s, poses_s, _ = run_once([*arguments, "--until", "colmap"], work / "run")
    wall_s, rest_s, _ = run_once(arguments, work / "run")
    run = pano_mvs.load(work / "run", cache=work / "run" / "store")
    found = figures(run.poses, work / "run", capture)
    found["cpu_ratio"] = poses_s / colmap(folder / "images", "incremental", work / "colmap" / "native.db").cpu_s
    return found, poses_s + rest_s, poses_wall_s + wall_s


def main(
    captures: Annotated[
        list[str] | None, typer.Argument(metavar="CAPTURE", help=f"{', '.join(CAPTURES)}; default all")
    ] = None,
    out: Path = SCRATCH / "whole",
    write: bool = False,
) -> int:
    """Measure captures and compare them.

    Args:
        captures: some of the captures.
        out: folder for what is rendered, and for the results of the runs, which are replaced.
        write: replace the best figures of the captures that are run.
    """
    if unknown := {*(captures or ())} - {*CAPTURES}:
        raise SystemExit(f"there is no capture {', '.join(sorted(unknown))}; there are {', '.join(CAPTURES)}")
    best: dict[str, Figures] = json.loads(BEST.read_text(encoding="utf-8"))
    notes, failed = [], False

    def rows() -> Iterator[list[str]]:
        nonlocal failed
        for name in captures or CAPTURES:
            try:
                found, cpu_s, wall_s = measured(name, out)
            except SystemExit as error:  # of one run; the others are still measured
                failed = True
                notes.append(f"{name}: the run failed.\n\n{error}")
                yield [name, *["failed"] * (len(RULES) + 2)]
                continue
            worse = worse_figures(found, best.get(name, {}))
            failed |= bool(worse)
            notes.extend(f"worse: {name}: {each}" for each in worse)
            if write:
                best[name] = {key: float(shown(key, found)) for key in found}
            elif name not in best:
                notes.append(f"{name} has no best figures yet; `--write` stores these")
            yield [name, *(shown(key, found) for key in RULES), f"{cpu_s:.0f}", f"{wall_s:.0f}"]

    print_table(["capture", *(rule.label for rule in RULES.values()), "CPU-s of all", "seconds"], rows())
    print("\n" + "\n".join(notes or ["Nothing is worse."]))
    if write:
        BEST.write_text(json.dumps(best, indent=1) + "\n", encoding="utf-8")
    return int(failed)
