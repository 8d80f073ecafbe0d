"""Write nerfstudio's transforms.json for its data parser `nerfstudio-data`.

Camera frames are OpenGL's (x right, y up, z backwards), and `transform_matrix` is world_from_cam. The centre of the
first pixel is (0.5, 0.5), as ours. An EQUIRECTANGULAR camera has fl_x = w / 2 and fl_y = h. Its rays have unit length,
so that depth is the distance along the ray. The depth of a PINHOLE camera is z, unless the trainer has the option
`is-euclidean-depth`. Depths are 16-bit numbers times `depth_unit_scale_factor`, an option of the data parser (0.001 by
default), in the unit of the camera positions; 0 is unknown. Masks are 0 where a pixel is ignored. Either all frames or
none have masks; the same holds for depths. `applied_transform` is the identity. It must be stated, because nerfstudio
assumes another one if a COLMAP model is in the same folder. The rotation from our world, if there is one, is
`file_from_world` instead: some versions of nerfstudio also apply `applied_transform` to the initial points, others do
not, so that only the identity means the same to all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.io.nerfstudio.frames import NerfstudioFrame, Variant
from pano_mvs.scene.image_files.header import PNG_START
from pano_mvs.scene.image_files.jpeg import JPEG_FRAMES, JPEG_START, jpeg_segments

CAMERA_MODELS = {"equirectangular": "EQUIRECTANGULAR", "faces": "PINHOLE"}
_DISTORTED = "OPENCV"
_DEPTHS = {"equirectangular": "distance along the ray", "faces": "z, along the camera's axis"}
_OPENGL_FROM_CAM = np.diag([1.0, -1.0, -1.0])
_PNG_RGB_8_BIT = bytes([8, 2])


def transforms_document(
    variant: Variant,
    frames: Sequence[tuple[str, Rigid3, NerfstudioFrame]],
    *,
    depth_unit: float,
    about: Mapping[str, Any],
    file_from_world: NDArray[np.float64] | None = None,
    seed: str = "",
) -> dict[str, Any]:
    """Return the contents of a transforms.json.

    Intrinsics are stated once if all frames share them, otherwise per frame. If some frames have masks, the others have
    the mask of `open_mask`. `panorama` is the name of the image in the capture, which our own reader uses.

    Args:
        variant: the camera model; a file has only one.
        frames: frames with their panorama's name and cam_from_world.
        depth_unit: scene units per step of the depths.
        about: further entries for readers, which nerfstudio ignores.
        file_from_world: rotation (3, 3) of the cameras; None: they stay in the world frame.
        seed: path of the initial points relative to the file; empty without points.
    """
    if file_from_world is not None:
        world_from_file = Rigid3(file_from_world.T, np.zeros(3))
        frames = [(name, cam_from_world @ world_from_file, frame) for name, cam_from_world, frame in frames]
    masked = any(frame.mask for _, _, frame in frames)
    with_depth = all(frame.depth for _, _, frame in frames)
    listed = [_listed(*each, masked=masked, with_depth=with_depth) for each in frames]
    each_intrinsics = [_intrinsics(frame) for _, _, frame in frames]
    if all(intrinsics == each_intrinsics[0] for intrinsics in each_intrinsics):
        common = each_intrinsics[0]
    else:
        common = {}
        listed = [intrinsics | entry for intrinsics, entry in zip(each_intrinsics, listed, strict=True)]
    model = _DISTORTED if any(frame.radial for _, _, frame in frames) else CAMERA_MODELS[variant]
    document = {"camera_model": model, **common, "applied_transform": np.eye(4)[:3].tolist(), **about}
    if with_depth:
        document |= {"depth_unit_scale_factor": depth_unit, "depth": _DEPTHS[variant]}
    return document | ({"ply_file_path": seed} if seed else {}) | {"frames": listed}


def open_mask(size_wh: tuple[int, int]) -> str:
    """Return the path, relative to a transforms.json, of the mask of frames of a size without masked pixels."""
    return f"masks/none_{size_wh[0]}x{size_wh[1]}.png"


def is_common_picture(path: Path) -> bool:
    """Return whether a file is a JPEG or an 8-bit PNG with three channels, which every trainer can read.

    A JPEG with four channels is CMYK, which trainers would read as red, green, blue and alpha.
    """
    with path.open("rb") as stream:
        start = stream.read(26)
        if start[:2] == JPEG_START:
            return _jpeg_channels(start + stream.read()) == 3
    return start[:8] == PNG_START and start[24:26] == _PNG_RGB_8_BIT


def _jpeg_channels(data: bytes) -> int:
    """Return the number of channels in a JPEG's first start of frame (ITU-T T.81, B.2.2); 0 without one."""
    for marker, start, _ in jpeg_segments(data):
        if marker in JPEG_FRAMES:
            return data[start + 5]
    return 0


def _listed(
    name: str, cam_from_world: Rigid3, frame: NerfstudioFrame, *, masked: bool, with_depth: bool
) -> dict[str, Any]:
    world_from_frame = frame.cam_from_world(cam_from_world).inverse()
    matrix = np.eye(4)
    matrix[:3, :3] = world_from_frame.rotation @ _OPENGL_FROM_CAM
    matrix[:3, 3] = world_from_frame.translation
    entry: dict[str, Any] = {"file_path": frame.image.replace("{name}", name)}
    if masked:
        entry["mask_path"] = frame.mask.replace("{name}", name) or open_mask(frame.size_wh)
    if with_depth:
        entry["depth_file_path"] = frame.depth.replace("{name}", name)
    return entry | {"panorama": name, "transform_matrix": matrix.tolist()}


def _intrinsics(frame: NerfstudioFrame) -> dict[str, Any]:
    width, height = frame.size_wh
    return {
        "w": width,
        "h": height,
        "fl_x": frame.focal_xy[0],
        "fl_y": frame.focal_xy[1],
        "cx": width / 2,
        "cy": height / 2,
    } | ({"k1": frame.radial} if frame.radial else {})
