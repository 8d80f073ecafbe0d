"""Real captures without ground truth.

Each DIR is a folder of panoramas. `pano-mvs run` (the preset `quality`; `--workflow` chooses another) and COLMAP on its
own (EQUIRECTANGULAR cameras, its SIFT, all pairs, its defaults, incremental and global) process the same images in the
same run. For each, the table shows

- the registered images, in the largest model and in all, and the cameras that the program itself doubts,
- the number of points and the median and 95 % quantile of their angular residuals,
- the confirmed share: how much of the textured sphere other images confirm in small sweeps with these poses (median
  and least camera). It uses images alone, needs no ground truth, and treats all models equally,
- CPU seconds of the poses, and of the whole run for ours.

Below it are the share of each range map that other views confirm, the points of the cloud, and how far our poses and
COLMAP's differ: the median and maximum over all common pairs of the larger of rotation and direction difference.
Images are reduced to `--width` columns first, for all programs alike; `--without-colmap` leaves COLMAP out. In `--out`
are our output folders and three pictures of each cloud.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

import pano_mvs
from pano_mvs.algorithms.poses.colmap.mapping import quiet_colmap
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation
from pano_mvs.algorithms.rendering import draw_cloud, inside_camera, viewpoints
from pano_mvs.geometry.pose_errors import relative_pose_errors
from pano_mvs.io.poses.files import read_poses
from pano_mvs.results.residuals import reprojection_residuals
from pano_mvs.results.run_output import RunOutput
from pano_mvs.scene import Poses
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.pose_groups import split_groups
from tools.benchmarks.dense_chain import Overrides
from tools.benchmarks.poses.captures_with_truth import MAPPERS, SEED, native_features, native_matches
from tools.benchmarks.table import print_table

_IMAGES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp"}
_POSE_STAGES = ("masks.", "features.", "global.", "pairs.", "matches.", "poses.", "source.")
_PICTURE_HW = (600, 960)


@dataclass(frozen=True)
class Row:
    """One program's model of a capture.

    Attributes:
        label: of the program.
        models: its models, the largest first.
        cpu_s: CPU seconds from images to refined poses.
    """

    label: str
    models: tuple[Poses, ...]
    cpu_s: float


def reduced(folder: Path, out: Path, width: int) -> int:
    """Link the images of a folder that have at most `width` columns, write the others reduced, and return their number.

    Reduced images have no metadata.
    """
    out.mkdir(parents=True)
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in _IMAGES)
    for path in files:
        picture = decode_image(path)
        if picture.shape[1] <= width:
            (out / path.name).symlink_to(path.resolve())
            continue
        small = cv2.resize(picture, (width, width * picture.shape[0] // picture.shape[1]), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str((out / path.name).with_suffix(".png")), small[..., ::-1])
    return len(files)


def ours(images: Path, out: Path, workflow: str, overrides: Sequence[str]) -> tuple[RunOutput, float, float]:
    """Return our run, CPU seconds of all of it, and those of the stages up to the poses."""
    command = [sys.executable, "-m", "pano_mvs", "run", workflow, "--images", str(images), "--out", str(out)]
    command += ["--cache", str(out.with_name(out.name + "_cache"))]
    for override in overrides:
        command += ["--set", override]
    before = _children_s()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 3):  # 3: finished, some images were left out
        raise SystemExit(done.stdout + done.stderr)
    whole = _children_s() - before
    run = pano_mvs.load(out, cache=out.with_name(out.name + "_cache"))
    stages = json.loads((out / "run.json").read_text(encoding="utf-8"))["stages"]
    busy = {stage["name"]: stage["units"] * stage["unit_seconds"] for stage in stages}
    poses = sum(busy[stage["name"]] for stage in stages if stage["use"].startswith(_POSE_STAGES))
    # Seconds of units are wall time. Their proportion divides the CPU time, which other programs do not lengthen.
    return run, whole, whole * poses / max(sum(busy.values()), 1e-9)


def colmap(images: Path, mapper: str, database: Path) -> Row:
    """Return COLMAP's models; features and matches of an earlier mapper are kept, and their time is counted again."""
    import pycolmap

    spent = database.with_suffix(".seconds")
    if not database.exists():
        start = time.process_time()
        native_features(database, images)
        native_matches(database)
        spent.write_text(str(time.process_time() - start))
    options = pycolmap.IncrementalPipelineOptions() if mapper == "incremental" else pycolmap.GlobalPipelineOptions()
    options.random_seed, options.num_threads = SEED, 1
    run = pycolmap.incremental_mapping if mapper == "incremental" else pycolmap.global_mapping
    out = database.with_name(mapper)
    out.mkdir()
    start = time.process_time()
    with quiet_colmap():
        found = run(database, images, out, options)
    cpu_s = time.process_time() - start + float(spent.read_text())
    models = []
    for idx, model in found.items():
        folder = out / f"model_{idx}"
        folder.mkdir()
        model.write(folder)
        models.append(read_poses(folder))
    models.sort(key=lambda poses: -len(poses.names))
    return Row(f"COLMAP, {mapper}", tuple(models), cpu_s)


COLUMNS = (
    "",
    "registered: largest model",
    "… all models",
    "doubted",
    "points",
    "residual °: median / 95 %",
    "confirmed %: median / least",
    "CPU-s of the poses",
)


def cells(row: Row, confirmed: Callable[[Poses], np.ndarray], total: int) -> list[object]:
    """Return a row of the table of one capture."""
    if not row.models:
        return [row.label, f"0 of {total}", 0, "–", "–", "–", "–", f"{row.cpu_s:.0f}"]
    model, found, shares = row.models[0], reprojection_residuals(row.models[0]), confirmed(row.models[0])
    known = np.isfinite(shares).any()
    return [
        row.label,
        f"{len(model.names)} of {total}",
        " + ".join(str(len(other.names)) for other in row.models),
        sum(len(other.doubts) for other in row.models) or "–",
        f"{len(model.points_in_world):,}",
        "–" if found is None else f"{found.overall.median_deg:.3f} / {found.overall.p95_deg:.3f}",
        f"{100 * np.nanmedian(shares):.0f} / {100 * np.nanmin(shares):.0f}" if known else "–",
        f"{row.cpu_s:.0f}",
    ]


def confirmation(run: RunOutput, images: Path) -> Callable[[Poses], np.ndarray]:
    """Return a function from poses to the confirmed share of each camera, (N,)."""
    files = {path.name: path for path in sorted(images.iterdir())}
    position = {name: idx for idx, name in enumerate(files)}

    def load(idx: int) -> tuple[np.ndarray, np.ndarray]:
        name = list(files)[idx]
        panorama = run.values.panorama(name)
        if panorama is None:
            picture = decode_image(files[name])
            return picture, np.ones(picture.shape[:2], np.bool_)
        return panorama.load(), panorama.load_mask()

    judge = Confirmation(load)

    def shares(poses: Poses) -> np.ndarray:
        cameras = {position[name]: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}
        return np.array([judge.share(image, pose, cameras) for image, pose in cameras.items()])

    return shares


def difference(first: Poses, second: Poses) -> str:
    """Return how far two models differ over the pairs of their common cameras, in words."""
    a = {name: first.cam_from_world(idx) for idx, name in enumerate(first.names)}
    b = {name: second.cam_from_world(idx) for idx, name in enumerate(second.names) if name in a}
    if len(b) < 2:
        return f"{len(b)} common cameras"
    errors = relative_pose_errors(a, b)
    return f"{len(b)} common cameras, {errors.median_pair_deg:.3f}° in the median, at most {errors.pair_deg.max():.2f}°"


def write_pictures(run: RunOutput, poses: Poses, out: Path) -> None:
    """Write three pictures of the cloud of the largest group."""
    cloud = None if run.cloud is None else run.cloud.groups()[0]
    if cloud is None or not len(cloud.points_in_world):
        return
    up = np.asarray(run.summary.poses.up or (0.0, 0.0, 1.0), float)
    arrays = cloud.points_in_world, cloud.normals_in_world, cloud.colors_rgb
    place = poses.names[inside_camera(poses.centers)]
    aspect = _PICTURE_HW[1] / _PICTURE_HW[0]
    views = viewpoints(cloud.points_in_world, poses.centers, up, aspect=aspect, place=place)
    for name, view in zip(("above", "outside", "inside"), views, strict=True):
        image = draw_cloud(*arrays, viewpoint=view, size_hw=_PICTURE_HW)
        cv2.imwrite(str(out / f"cloud_{name}.png"), image[..., ::-1])


def measure(folder: Path, out: Path, *, workflow: str, width: int, overrides: Sequence[str], beside: bool) -> None:
    """Print the table of one capture and what is below it, and write pictures of its cloud."""
    total = reduced(folder, out / "images", width)
    run, whole_s, poses_s = ours(out / "images", out / "run", workflow, overrides)
    groups = () if run.poses is None else tuple(split_groups(run.poses))
    rows = [Row(f"pano_mvs, `{workflow}`", groups, poses_s)]
    if beside:
        with tempfile.TemporaryDirectory() as scratch:
            rows += [colmap(out / "images", mapper, Path(scratch) / "native.db") for mapper in MAPPERS]
    print(f"### {folder.name}: {total} images, at most {width} columns\n")
    confirmed = confirmation(run, out / "images")
    print_table(COLUMNS, (cells(row, confirmed, total) for row in rows))
    shares = [100 * view.consistent for view in run.summary.views if view.consistent is not None]
    print(f"\nThe whole run took {whole_s:.0f} CPU-s.")
    if shares:
        low, middle, high = np.quantile(shares, [0, 0.5, 1])
        spread = f"{middle:.0f} % in the median of the views ({low:.0f} to {high:.0f} %)"
        print(f"Confirmed pixels of the range maps: {spread}; cloud: {run.summary.cloud.points:,} points.")
    for row in rows[1:]:
        if groups and row.models:
            print(f"{row.label} and ours: {difference(groups[0], row.models[0])}.")
    for name, why in {**run.summary.poses.rejected, **run.summary.poses.doubts}.items():
        print(f"- {name}: {why}")
    if groups:
        write_pictures(run, groups[0], out)
    print(flush=True)


def _children_s() -> float:
    times = os.times()
    return times.children_user + times.children_system


def main(
    folders: list[Path],
    out: Annotated[Path, typer.Option()],
    workflow: str = "quality",
    width: int = 2048,
    overrides: Overrides = None,
    without_colmap: bool = False,
) -> None:
    """Measure captures; `out` is an empty or new folder."""
    for folder in folders:
        place = out / folder.name
        measure(folder, place, workflow=workflow, width=width, overrides=overrides or (), beside=not without_colmap)
