"""How near to the surfaces COLMAP's own fusion gets.

Writes the dense workspace of a synthetic scene (`export.colmap_faces`, `points.*`, `export.colmap_dense`), lets
`pycolmap.stereo_fusion` fuse it on the CPU, and prints the distances of the fused points from the true surfaces: with
true ranges, and with those of a workflow (`--workflow`, true poses). Distances are along the ray of whichever camera
gives the least, and scaled to a point 3 units away from the nearest camera: not less than the distance to the surface.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from pano_mvs.core.arrays import FloatArray
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import Names
from pano_mvs.geometry import Rigid3
from pano_mvs.io.ply import read_ply_points
from pano_mvs.scene import Files, Panorama, Poses, RangeMap
from pano_mvs.scene.files import item_stems
from pano_mvs.stages.exports.colmap import DenseParams, FacesParams, colmap_dense, colmap_faces
from pano_mvs.stages.points import surface, tracked
from pano_mvs.testing.room import Room, capture_poses, default_room, range_along
from tests.synthetic.scenes import SCENES, Scene
from tools.benchmarks.captures import Capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain, context, true_poses
from tools.benchmarks.table import print_table

SurfaceParams = Registry.installed().stages["points.surface"].params_type
TrackedParams = Registry.installed().stages["points.tracked"].params_type

_AT = 3.0


def write_workspace(
    out: Path,
    panoramas: Mapping[str, Panorama],
    poses: Poses,
    ranges: Mapping[str, RangeMap],
    *,
    points: int = 20_000,
    **faces: Any,
) -> Path:
    """Write colmap_dense/ into a folder by the stages themselves, and return it."""
    scratch = out / "scratch"
    cuts, samples, stems = {}, {}, item_stems(panoramas)
    for name, image in panoramas.items():
        ctx = context(scratch / stems[name])
        cuts[name] = colmap_faces(image=image, range_map=ranges[name], params=FacesParams(**faces), ctx=ctx)
        deliver(cuts[name], out, stems[name])
        samples[name] = surface(image=image, range_map=ranges[name], params=SurfaceParams(), ctx=ctx)
    ctx = context(scratch / "model")
    found = tracked(
        poses=poses, samples=samples, ranges=ranges, params=TrackedParams.model_validate({"count": points}), ctx=ctx
    )
    names: Names[Panorama] = Names(panoramas)
    model = colmap_dense(poses=poses, faces=cuts, images=names, points=found, params=DenseParams(), ctx=ctx)
    deliver(model, out, "")
    shutil.rmtree(scratch)
    return out / "colmap_dense"


def deliver(files: Files, out: Path, item: str) -> None:
    """Copy a stage's files to where a run would put them."""
    files.check()
    for target, path in files.files.items():
        place = out / target.replace("{item}", item)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, place)


def fused_points(workspace: Path, *, min_num_pixels: int = 3, masks: bool = False) -> FloatArray:
    """Return the points, (N, 3), that COLMAP's fusion makes of a workspace."""
    pycolmap.logging.minloglevel = 2
    options: dict[str, Any] = {"num_threads": 1, "min_num_pixels": min_num_pixels}
    if masks:
        options["mask_path"] = str(workspace / "masks")
    target = workspace / "fused.ply"
    pycolmap.stereo_fusion(
        target, workspace, input_type="geometric", output_type="PLY", options=pycolmap.StereoFusionOptions(options)
    )
    return np.asarray(read_ply_points(target), np.float64).reshape(-1, 3)


def wall_distances(points: FloatArray, room: Room, poses: Sequence[Rigid3]) -> FloatArray:
    """Return how far each point (N, 3) is from the surfaces, in thousandths of a unit at 3 units' distance, (N,)."""
    errors = np.full(len(points), np.inf)
    for pose in poses:
        offset = points - pose.center
        distance = np.linalg.norm(offset, axis=1)
        hit = range_along(room, pose.center, offset / distance[:, None])
        errors = np.minimum(errors, np.abs(hit - distance))
    nearest = cKDTree([pose.center for pose in poses]).query(points)[0]
    return np.asarray(1000 * errors / nearest * _AT)


def true_maps(capture: Capture) -> dict[str, RangeMap]:
    """Return the true ranges as range maps, all of them consistent."""
    return {
        name: RangeMap(ranges, np.where(np.isfinite(ranges), 200, 0).astype(np.uint8))
        for name, ranges in capture.ranges.items()
    }


def room_scene(views: int = 4) -> Scene:
    """Return the furnished room as a scene."""
    none = ((1.0, 1.0, 1.0),) * views, ((0.0, 0.0, 0.0),) * views
    return Scene("room", default_room(), tuple(capture_poses(views)), *none)


def row(name: str, errors: FloatArray, pixels: int) -> list[object]:
    """Return one row of the table."""
    if not len(errors):
        return [name, 0, "–", "–", "–"]
    median, high = np.percentile(errors, [50, 95])
    return [name, len(errors), f"{100 * len(errors) / pixels:.0f}", f"{median:.3f}", f"{high:.2f}"]


def main(
    scene: list[str] | None = None,
    width: int = 1024,
    size: int = 300,
    workflow: str = "known_poses",
    min_confidence: list[int] | None = None,
    min_num_pixels: int = 3,
) -> None:
    """Print the table; `size` is that of a face in pixels, and a scene "room" or one of `tests.synthetic.scenes`."""

    def rows() -> Iterator[list[object]]:
        for made in (room_scene() if name == "room" else SCENES[name]() for name in scene or ["room"]):
            with tempfile.TemporaryDirectory() as folder:
                capture = scene_capture(made, Path(folder) / "capture", width=width)
                estimated = list(DenseChain(workflow).run(capture).range_maps.values())[-1]
                cases = [("true", true_maps(capture), 64)]
                cases += [(f"{workflow} {least}", estimated, least) for least in min_confidence or [64]]
                for what, maps, least in cases:
                    place, poses = Path(folder) / what, true_poses(capture)
                    workspace = write_workspace(
                        place, capture.panoramas, poses, maps, size_px=size, min_confidence=least
                    )
                    points = fused_points(workspace, min_num_pixels=min_num_pixels)
                    errors = wall_distances(points, made.room, made.poses)
                    yield row(f"{made.name}, {what}", errors, len(maps) * 6 * size**2)

    print_table(["scene, ranges", "fused points", "% of pixels", "median mm at 3 m", "p95 mm at 3 m"], rows())
