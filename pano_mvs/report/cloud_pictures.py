"""Images of the fused cloud from three viewpoints, by PyVista or, without a graphics driver, by our own renderer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.rendering import Viewpoint, draw_cloud, facing, inside_camera, viewpoints
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.pictures import Picture, picture
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene.pose_groups import split_groups

RENDERER_VARIABLE = "PANO_MVS_RENDERER"
"""`software` draws without PyVista; anything else, or nothing, tries PyVista first."""

VERSION = 2  # raise it when the pictures change: earlier pages' are then drawn again
_SIZE_HW = (600, 960)
MAX_BYTES = 300_000
_COMMAND = (sys.executable, "-m", "pano_mvs.report.cloud_pictures")

Arrays = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]


@dataclass(frozen=True)
class CloudPictures:
    """The pictures of a cloud."""

    shown: tuple[tuple[str, Picture], ...] = ()
    note: str = ""


def cloud_pictures(
    results: StoredValues, kept: EarlierPage, *, up: NDArray[np.float64], command: Sequence[str] = _COMMAND
) -> CloudPictures:
    """Return images of the cloud, reusing those of an earlier page if they show the same cloud.

    If there are several groups of poses, the largest is shown.
    """
    digest = results.digest("cloud")
    if not digest:
        return CloudPictures()
    software = os.environ.get(RENDERER_VARIABLE, "") == "software"
    stem = f"{digest[:24]}.{results.digest('poses')[:16]}.{'s' if software else 'g'}{VERSION}"
    known = kept.fact(stem)
    earlier = [kept.picture(f"{stem}.{number}") for number in range(3)]
    if isinstance(known, dict) and all(earlier) and len(known.get("titles", ())) == 3:
        titles = [str(title) for title in known["titles"]]
        pairs = tuple((title, found) for title, found in zip(titles, earlier, strict=True) if found is not None)
        return CloudPictures(pairs, str(known.get("note", "")))
    whole, all_poses = results.cloud, results.poses
    if whole is None or not len(whole.groups()[0]):
        return CloudPictures()
    cloud, poses = whole.groups()[0], None if all_poses is None else split_groups(all_poses)[0]
    centers = poses.centers if poses is not None else np.zeros((0, 3))
    place = poses.names[inside_camera(centers)] if poses is not None and len(centers) else ""
    step = -(-len(cloud) // 800_000)
    arrays = (
        np.ascontiguousarray(cloud.points_in_world[::step]),
        np.ascontiguousarray(cloud.normals_in_world[::step]),
        np.ascontiguousarray(cloud.colors_rgb[::step]),
    )
    seen_from = viewpoints(arrays[0], centers, up, aspect=_SIZE_HW[1] / _SIZE_HW[0], place=place)
    images, note = _drawn(arrays, seen_from, software=software, command=command)
    if whole.group_sizes:
        note = "; ".join(
            [
                *filter(None, [note]),
                "this is group 0 of the poses, the largest; the clouds of the others "
                "are cloud_1.ply … (pano-mvs view OUT --group 1)",
            ]
        )
    titles = [view.title for view in seen_from]
    kept.keep(stem, {"titles": titles, "note": note})
    return CloudPictures(
        tuple(
            (title, picture(image, width=_SIZE_HW[1], most_bytes=MAX_BYTES, key=f"{stem}.{number}"))
            for number, (title, image) in enumerate(zip(titles, images, strict=True))
        ),
        note,
    )


def _drawn(
    arrays: Arrays, seen_from: Sequence[Viewpoint], *, software: bool, command: Sequence[str]
) -> tuple[list[NDArray[np.uint8]], str]:
    if not software:
        images = _drawn_apart(arrays, seen_from, command)
        if images:
            return images, ""
    note = "" if software else "PyVista could not render (no graphics driver), so these images are simpler"
    return [draw_cloud(*arrays, viewpoint=view, size_hw=_SIZE_HW) for view in seen_from], note


def _drawn_apart(arrays: Arrays, seen_from: Sequence[Viewpoint], command: Sequence[str]) -> list[NDArray[np.uint8]]:
    """Return images rendered in another process; nothing if it fails, crashes or takes too long."""
    with TemporaryDirectory(prefix="pano-mvs-report-") as name:
        folder = Path(name)
        write_scene(folder, arrays, seen_from, size_hw=_SIZE_HW)
        try:
            done = subprocess.run(  # noqa: S603  # our own interpreter and module
                [*command, name], stdin=subprocess.DEVNULL, capture_output=True, timeout=120.0, check=False
            )
        except (OSError, subprocess.TimeoutExpired):
            return []
        return read_pictures(folder, len(seen_from), size_hw=_SIZE_HW) if done.returncode == 0 else []


_ARRAYS = ("points", "normals", "colors")


def write_scene(
    folder: Path,
    arrays: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]],
    seen_from: Sequence[Viewpoint],
    *,
    size_hw: tuple[int, int],
) -> None:
    """Write the scene to render."""
    for idx, name in enumerate(_ARRAYS):
        np.save(folder / f"{name}.npy", arrays[idx])
    views = [
        {
            "eye": view.eye.tolist(),
            "target": view.target.tolist(),
            "up": view.up.tolist(),
            "fov_deg": view.fov_deg,
            "height": view.height,
        }
        for view in seen_from
    ]
    (folder / "scene.json").write_text(json.dumps({"views": views, "size_hw": size_hw}), encoding="utf-8")


def read_pictures(folder: Path, count: int, *, size_hw: tuple[int, int]) -> list[NDArray[np.uint8]]:
    """Return the rendered images; nothing if one is missing, empty or of another size."""
    found: list[NDArray[np.uint8]] = []
    for number in range(count):
        try:
            image = np.load(folder / f"picture{number}.npy", allow_pickle=False)
        except (OSError, ValueError):
            return []
        if image.shape != (*size_hw, 3) or image.dtype != np.uint8 or not np.ptp(image):
            return []
        found.append(image)
    return found


def draw(folder: Path) -> None:
    """Render the scene that `write_scene` wrote, in a process of its own: a graphics driver may crash it."""
    import pyvista

    scene = json.loads((folder / "scene.json").read_bytes())
    height, width = scene["size_hw"]
    points, normals, colors = (np.load(folder / f"{name}.npy", allow_pickle=False) for name in _ARRAYS)
    for number, view in enumerate(scene["views"]):
        eye, target, up = (np.array(view[name]) for name in ("eye", "target", "up"))
        seen_from = Viewpoint("", eye, target, up, view["fov_deg"], view["height"])
        shown = facing(points, normals, seen_from)
        plotter: Any = pyvista.Plotter(off_screen=True, window_size=[width, height], lighting="none")
        plotter.set_background((238, 241, 244))
        if shown.any():
            mesh = pyvista.PolyData(points[shown])
            mesh["rgb"] = colors[shown]
            plotter.add_points(
                mesh, scalars="rgb", rgb=True, point_size=_point_size(int(shown.sum()), width * height), lighting=False
            )
        plotter.camera_position = [view["eye"], view["target"], view["up"]]
        if seen_from.height:
            plotter.enable_parallel_projection()
            plotter.camera.parallel_scale = seen_from.height / 2
        else:
            plotter.camera.view_angle = seen_from.fov_deg
        plotter.reset_camera_clipping_range()
        image = plotter.screenshot(return_img=True)
        plotter.close()
        np.save(folder / f"picture{number}.npy", np.asarray(image, np.uint8)[..., :3])


def _point_size(points: int, pixels: int) -> float:
    return float(np.clip(2.5 * np.sqrt(pixels / max(1, points)), 3.0, 6.0))


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
