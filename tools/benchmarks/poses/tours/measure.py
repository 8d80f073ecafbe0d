"""Tours beside COLMAP.

Each DIR is a capture: images/ and, if the truth is known, truth.json as `poses.tours.houses` writes it. Where
truth.json has no rotations (`camera_from_world`) it was drawn by hand: cameras count as right within 5° and 5 % of the
extent of the cameras, others within 1° and 2 %, after the alignment that makes most of a group right.

Four programs place the same images on this machine, one after the other: the workflow up to its last pose stage;
COLMAP's incremental and global mapper on their own features (SIFT); and both on the key points and verified matches of
the workflow (`poses.colmap`). The table shows the placed cameras, those of each group, which are right and wrong, how
many of either are reported as doubtful, and CPU seconds from images to poses.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

import pano_mvs
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import split_groups
from tools.benchmarks.poses.captures_with_truth import MAPPERS
from tools.benchmarks.poses.placements import Placements, judge_placements
from tools.benchmarks.poses.tours.plan import level_rotation
from tools.benchmarks.real_captures import colmap

HEADER = (
    "| capture | program | placed | groups | right | wrong | right, doubted | wrong, not doubted | CPU-s |\n"
    + "|---" * 9
    + "|"
)
_EXACT, _DRAWN = (1.0, 0.02), (5.0, 0.05)


def read_truth(capture: Path) -> tuple[dict[str, Rigid3], tuple[float, float]] | None:
    """Return the true poses of a capture, with the limits in degrees and shares of the extent; None if unknown."""
    file = capture / "truth.json"
    known = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    if not known or any("yaw_deg" not in each for each in known.values()):
        return None
    exact = all("camera_from_world" in each for each in known.values())
    poses = {
        name: Rigid3.from_center(
            np.array(each["camera_from_world"]) if exact else level_rotation(each["yaw_deg"], np.zeros(2)),
            np.array(each["position_m"]),
        )
        for name, each in known.items()
    }
    return poses, _EXACT if exact else _DRAWN


def workflow_poses(
    capture: Path, out: Path, workflow: str, *, overrides: list[str], until: str
) -> tuple[list[Poses], float]:
    """Return the groups that a workflow places, and its CPU seconds; the cache is beside `out`."""
    cache = out.parent / "cache"
    command = [sys.executable, "-m", "pano_mvs", "run", workflow, "--images", str(capture / "images")]
    command += ["--out", str(out), "--cache", str(cache), "--until", until]
    for override in overrides:
        command += ["--set", override]
    before = os.times()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    after = os.times()
    if done.returncode not in (0, 3):  # 3: some images were left out
        print(done.stderr[-2000:], file=sys.stderr)
        return [], float("nan")
    poses = pano_mvs.load(out, cache=cache).poses
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    return ([] if poses is None else list(split_groups(poses))), cpu_s


def line(capture: str, program: str, groups: list[Poses], judged: list[Placements], cpu_s: float) -> str:
    """Return one row of the table."""
    sizes = sorted((len(group.names) for group in groups), reverse=True)
    cells = [capture, program, str(sum(sizes)), " + ".join(map(str, sizes[:6])) + (" + …" if len(sizes) > 6 else "")]
    if judged:
        right = np.concatenate([each.right for each in judged])
        doubted = np.concatenate([each.doubted for each in judged])
        counts = (right, ~right, right & doubted, ~right & ~doubted)
        cells += [str(int(count.sum())) for count in counts]
    else:
        cells += ["–", "–", str(sum(len(group.doubts) for group in groups)), "–"]
    return "| " + " | ".join([*cells, f"{cpu_s:.0f}"]) + " |"


def measure(capture: Path, out: Path, options: argparse.Namespace) -> None:
    """Print the rows of one capture."""
    out.mkdir(parents=True, exist_ok=True)
    truth = read_truth(capture)

    def show(program: str, groups: list[Poses], cpu_s: float) -> None:
        print(line(capture.name, program, groups, _judged(groups, truth), cpu_s), flush=True)

    groups, own_s = workflow_poses(capture, out / "run", options.workflow, overrides=options.set, until=options.until)
    show(f"`{options.workflow}`", groups, own_s)
    if options.without_colmap:
        return
    for mapper in MAPPERS:
        row = colmap(capture / "images", mapper, out / "native.db")
        show(f"COLMAP {mapper}, its SIFT", list(row.models), row.cpu_s)
    for mapper in MAPPERS:
        workflow = out / f"{mapper}.yaml"
        stage = f"{{use: poses.colmap, mapper: {mapper}}}"
        workflow.write_text(f"pano_mvs: 1\nextends: {options.workflow}\nstages:\n  {options.poses}: {stage}\n")
        groups, cpu_s = workflow_poses(capture, out / mapper, str(workflow), overrides=options.set, until=options.poses)
        # Features and matches come from the cache, so that this is the time of the mapper alone.
        show(f"COLMAP {mapper}, our matches", groups, cpu_s)


def _judged(groups: list[Poses], truth: tuple[Mapping[str, Rigid3], tuple[float, float]] | None) -> list[Placements]:
    """Return the judgement of each group; a camera that is alone in its group counts as placed but not judged."""
    if truth is None:
        return []
    known, (rotation_deg, share) = truth
    return [judge_placements(group, known, rotation_limit_deg=rotation_deg, center_limit=share) for group in groups]


def main() -> None:
    """Measure the captures that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, help="an empty or new folder")
    parser.add_argument("--workflow", default="quality")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.PARAM=VALUE")
    parser.add_argument("--until", default="levelled", help="name of the last pose stage; default levelled")
    parser.add_argument("--poses", default="poses", help="name of the stage that solves poses; default poses")
    parser.add_argument("--without-colmap", action="store_true")
    options = parser.parse_args()
    print(HEADER, flush=True)
    for capture in options.captures:
        measure(capture, options.out / capture.name, options)
