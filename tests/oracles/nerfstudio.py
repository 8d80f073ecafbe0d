"""A transforms.json read as nerfstudio documents it; and by nerfstudio itself, to see whether it means the same.

    python -m tests.oracles.nerfstudio OUT/nerfstudio/faces

needs nerfstudio (which is no dependency) and prints how far its points lie from those of the documented reading, and
the seed points from those of the file. Nerfstudio 1.1.5, on the CPU: 4e-6 scene units in a room, both variants.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def documented_rays(document: dict[str, Any], frame: dict[str, Any], size_wh: tuple[int, int]) -> np.ndarray:
    """Return world rays (h, w, 3) of the pixels of a depth picture, by the camera that the file describes.

    Nerfstudio's cameras: image coordinates of pixel centres are x + 0.5, y + 0.5; OpenGL's axes; a PINHOLE ray is
    (x, y, −1), whose depth is z; an EQUIRECTANGULAR one has θ from −π to π and φ from 0 at the zenith, length 1.
    """
    said = document | frame
    scale_x, scale_y = said["w"] / size_wh[0], said["h"] / size_wh[1]
    x = ((np.arange(size_wh[0]) + 0.5) * scale_x - said["cx"]) / said["fl_x"]
    y = -((np.arange(size_wh[1]) + 0.5) * scale_y - said["cy"]) / said["fl_y"]
    x, y = np.meshgrid(x, y)
    if said["camera_model"] == "EQUIRECTANGULAR":
        theta, phi = -np.pi * x, np.pi * (0.5 - y)
        rays = np.stack([-np.sin(theta) * np.sin(phi), np.cos(phi), -np.cos(theta) * np.sin(phi)], axis=-1)
    else:
        assert said["camera_model"] == "PINHOLE"
        rays = np.stack([x, y, -np.ones_like(x)], axis=-1)
    result: np.ndarray = rays @ np.array(frame["transform_matrix"])[:3, :3].T
    return result


def world_points(folder: Path, document: dict[str, Any], frame: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a frame's known depths, (N, 3), and which pixels they are of, (h, w)."""
    steps = cv2.imread(str(folder / frame["depth_file_path"]), cv2.IMREAD_ANYDEPTH)
    assert steps is not None
    assert steps.dtype == np.uint16
    depths = steps * document["depth_unit_scale_factor"]
    rays = documented_rays(document, frame, steps.shape[::-1])
    origin = np.array(frame["transform_matrix"])[:3, 3]
    known: NDArray[np.bool_] = steps > 0
    return (origin + rays * depths[..., None])[known], known


def nerfstudio_points(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (N, 3) of all known depths, and the seed points, by nerfstudio's own parser and cameras.

    Its trainers take a depth for z times the length of the ray before it was normalised (`directions_norm`).
    """
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
    from nerfstudio.data.utils.data_utils import get_depth_image_from_path

    parser = NerfstudioDataParserConfig(data=folder, eval_mode="all", load_3D_points=True)  # as splatfacto has it
    parsed = parser.setup().get_dataparser_outputs(split="train")
    cameras, scale = parsed.cameras, parsed.dataparser_scale
    found = []
    for idx, path in enumerate(parsed.metadata["depth_filenames"]):
        size = {"height": int(cameras.height[idx]), "width": int(cameras.width[idx])}
        factor = parsed.metadata["depth_unit_scale_factor"] * scale
        depths = get_depth_image_from_path(filepath=path, scale_factor=factor, **size).numpy()
        rays = cameras.generate_rays(camera_indices=idx)
        lengths = depths * rays.metadata["directions_norm"].numpy()
        found.append((rays.origins.numpy() + rays.directions.numpy() * lengths)[depths[..., 0] > 0])
    turn, shift = np.split(parsed.dataparser_transform.numpy(), [3], axis=1)
    seed = parsed.metadata["points3D_xyz"].numpy()
    return (np.concatenate(found) / scale - shift.T) @ turn, (seed / scale - shift.T) @ turn


def main() -> None:
    """Compare both readings of a folder."""
    folder = Path(sys.argv[1])
    document = json.loads((folder / "transforms.json").read_text())
    frames = sorted(document["frames"], key=lambda frame: str(frame["file_path"]))
    documented = np.concatenate([world_points(folder, document, frame)[0] for frame in frames])
    points, seed = nerfstudio_points(folder)
    own_seed = np.fromfile(folder / document["ply_file_path"], np.uint8)
    head = own_seed.tobytes().index(b"end_header\n") + 11
    given = own_seed[head:].reshape(-1, 27)[:, :12].copy().view("<f4")
    print(f"{len(points)} points: {np.linalg.norm(points - documented, axis=1).max():.2g} apart at most")
    print(f"{len(seed)} seed points: {np.linalg.norm(seed - given, axis=1).max():.2g} apart at most")


if __name__ == "__main__":
    main()
