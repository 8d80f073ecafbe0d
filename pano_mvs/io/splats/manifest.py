"""The manifest of a splat bundle: one JSON file that describes all files of the folder, and how to read them.

The schema of version 1 is documented in docs/exports.md. Fields may be added to a version; none changes its meaning.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pano_mvs.geometry import Rigid3
from pano_mvs.io.nerfstudio.frames import NerfstudioFrame, Variant
from pano_mvs.io.nerfstudio.transforms import CAMERA_MODELS, open_mask
from pano_mvs.scene.photographs import Photographs

ROOT = "splat_bundle"
"""Folder of the bundle in the output folder."""

MANIFEST_VERSION = 1

_DEPTHS = {"equirectangular": "range along the ray", "faces": "z-depth"}
_CONVENTIONS = {
    "camera": "x right, y down, z forward (as in OpenCV and COLMAP); transforms.json has OpenGL's axes instead",
    "cam_from_world": "x_in_cam = R x_in_world + t, as the rows [R | t]",
    "pixel": "(0, 0) is the upper left corner of the first pixel, whose centre is (0.5, 0.5)",
    "ray": {
        "PINHOLE": "((x - cx) / fx, (y - cy) / fy, 1)",
        "EQUIRECTANGULAR": "(cos(v) sin(u), -sin(v), cos(v) cos(u)) with u = 2 pi (x / width - 1/2) and "
        "v = pi (1/2 - y / height)",
    },
    "depth": {
        "z-depth": "a point is z-depth times the PINHOLE ray, which has z = 1",
        "range along the ray": "a point is range times the EQUIRECTANGULAR ray, which has length 1",
    },
}


@dataclass(frozen=True, slots=True)
class BundleView:
    """One image of a bundle.

    Attributes:
        panorama: name of its panorama in the capture.
        group: number of the group of poses.
        frame: its files and its camera.
        cam_from_world: its pose.
    """

    panorama: str
    group: int
    frame: NerfstudioFrame
    cam_from_world: Rigid3


def manifest_document(
    views: Sequence[BundleView],
    groups: Sequence[Mapping[str, Any]],
    *,
    depth_unit: float,
    photographs: Photographs | None = None,
) -> dict[str, Any]:
    """Return the contents of manifest.json.

    Args:
        views: all images.
        groups: by number: frame and unit of the world, and the files of each variant.
        depth_unit: scene units per step of the depths.
        photographs: photographs without distortion beside the faces, in the world of group 0.
    """
    masked = {view.frame.variant for view in views if view.frame.mask}
    document = {
        "schema": MANIFEST_VERSION,
        "program": "pano_mvs",
        "conventions": _CONVENTIONS,
        "layers": _layers(depth_unit),
        "groups": list(groups),
        "views": [_entry(view, masked) for view in views],
    }
    if photographs is not None:
        document["photographs"] = [
            _photograph(photographs, idx, masked="faces" in masked) for idx in range(len(photographs))
        ]
    return document


def _layers(depth_unit: float) -> dict[str, dict[str, Any]]:
    return {
        "depth": {"format": "16-bit PNG", "unit": depth_unit, "of": "scene units per step", "unknown": 0},
        "normal": {
            "format": "16-bit PNG, RGB",
            "value": "(step - 1) / 65534 * 2 - 1 for x, y, z in the axes of the camera; towards the camera",
            "unknown": [0, 0, 0],
        },
        "confidence": {
            "format": "8-bit PNG",
            "value": "1-63 filled in, 64-127 seen but not confirmed, 128-255 consistent with other views",
            "unknown": 0,
        },
        "mask": {"format": "8-bit PNG", "used": 255, "ignored": 0},
    }


def _entry(view: BundleView, masked: Iterable[Variant]) -> dict[str, Any]:
    """Return the entry of one image. Files are relative to the manifest's folder; null if there is no such file."""
    frame, pose = view.frame, view.cam_from_world
    mask = frame.mask or (open_mask(frame.size_wh) if frame.variant in masked else "")
    files = {
        "image": frame.image,
        "mask": mask,
        "depth": frame.depth,
        "normal": frame.normal,
        "confidence": frame.confidence,
    }
    camera: dict[str, Any] = {"model": CAMERA_MODELS[frame.variant], "width": frame.size_wh[0]}
    camera["height"] = frame.size_wh[1]
    if frame.variant == "faces":
        camera |= {"fx": frame.focal_xy[0], "fy": frame.focal_xy[1]}
        camera |= {"cx": frame.size_wh[0] / 2, "cy": frame.size_wh[1] / 2}
    placed = {
        key: f"{frame.variant}/{path.replace('{name}', view.panorama)}" if path else None for key, path in files.items()
    }
    return {
        "variant": frame.variant,
        "panorama": view.panorama,
        "group": view.group,
        **placed,
        "depth_semantics": _DEPTHS[frame.variant] if frame.depth else None,
        "camera": camera,
        "cam_from_world": np.column_stack([pose.rotation, pose.translation]).tolist(),
    }


def _photograph(photographs: Photographs, idx: int, *, masked: bool) -> dict[str, Any]:
    """Return the entry of a photograph, which has no layers."""
    height, width = photographs.sizes_hw[idx].tolist()
    focal, pose = float(photographs.focals_px[idx]), photographs.cam_from_world(idx)
    size = {"width": width, "height": height}
    return {
        "variant": "faces",
        "group": 0,
        "image": f"faces/images/{photographs.names[idx]}",
        "mask": f"faces/{open_mask((width, height))}" if masked else None,
        "camera": {"model": "PINHOLE", **size, "fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2},
        "cam_from_world": np.column_stack([pose.rotation, pose.translation]).tolist(),
    }
