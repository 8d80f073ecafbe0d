"""Render a cloud with PyVista in a separate process, so that a crashing graphics driver does not end the run.

`python -m pano_mvs.report.cloud_renderer FOLDER` reads the files of `write_scene` and writes the images.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.rendering import Viewpoint, facing

_PAPER = (238, 241, 244)
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
    """Render the scene that `write_scene` wrote."""
    import pyvista

    scene = json.loads((folder / "scene.json").read_bytes())
    height, width = scene["size_hw"]
    points, normals, colors = (np.load(folder / f"{name}.npy", allow_pickle=False) for name in _ARRAYS)
    for number, view in enumerate(scene["views"]):
        eye, target, up = (np.array(view[name]) for name in ("eye", "target", "up"))
        seen_from = Viewpoint("", eye, target, up, view["fov_deg"], view["height"])
        shown = facing(points, normals, seen_from)
        plotter: Any = pyvista.Plotter(off_screen=True, window_size=[width, height], lighting="none")
        plotter.set_background(_PAPER)
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
