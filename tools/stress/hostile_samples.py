"""One good file, or folder, of every kind that the product reads, and what reads it."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from pano_mvs_viewer.shown_scene import has_faces

from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.workflow import load_workflow
from pano_mvs.io.colmap.workspace import read_colmap_map, write_depth_map
from pano_mvs.io.colmap.writer import write_colmap_model
from pano_mvs.io.images.captures import describe_picture
from pano_mvs.io.ply import open_ply_points, read_ply, read_ply_mesh, write_ply, write_ply_mesh
from pano_mvs.io.poses.files import read_groups, recorded_pictures
from pano_mvs.io.ranges import read_normals
from pano_mvs.io.truth import find_ranges, read_truth
from pano_mvs.scene import PointCloud
from pano_mvs.scene.exr import has_exr, write_exr
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.masking import decode_mask
from pano_mvs.session.session import presets_folder
from pano_mvs.testing.room import capture_poses
from tests.io.colmap.test_model import SIZES, noisy_poses
from tests.io.images.pictures import full_sphere, png_chunk, xmp
from tests.stored import write_npz

HEIGHT, WIDTH = 64, 128


@dataclass(frozen=True)
class Sample:
    """Good input.

    Attributes:
        files: name in a folder of its own to bytes; those that are mutated come first.
        read: what the product does with the folder.
        mutated: how many of the files are mutated.
    """

    files: Mapping[str, bytes]
    read: Callable[[Path], object]
    mutated: int = 1


def samples(scratch: Path) -> dict[str, Sample]:
    """Return all samples by the name of their kind; `scratch` is a folder to write into."""
    found = _pictures() | _ranges(scratch) | _models(scratch) | _poses() | _clouds(scratch)
    found["workflow"] = Sample({"workflow.yaml": (presets_folder() / "quickstart.yaml").read_bytes()}, _read_workflow)
    return found


def picture() -> np.ndarray:
    """Return a smooth picture."""
    noise = np.random.default_rng(0).integers(0, 256, (8, 16, 3)).astype(np.uint8)
    result: np.ndarray = cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return result


def _pictures() -> dict[str, Sample]:
    eight, sixteen = picture(), picture().astype(np.uint16) * 257
    packet = b"XML:com.adobe.xmp\0\0\0\0\0" + xmp(full_sphere(HEIGHT, WIDTH))
    png = _encoded(".png", eight)
    kinds = {
        "jpeg": _encoded(".jpg", eight),
        "jpeg_progressive": _encoded(".jpg", eight, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        "jpeg_restarts": _encoded(".jpg", eight, cv2.IMWRITE_JPEG_RST_INTERVAL, 4),
        "png": png[:33] + png_chunk(b"iTXt", packet) + png[33:],
        "png16": _encoded(".png", sixteen),
        "tiff": _encoded(".tiff", eight),
        "tiff16": _encoded(".tiff", sixteen, cv2.IMWRITE_TIFF_COMPRESSION, 1),
        "webp": _encoded(".webp", eight),
        "webp_lossless": _encoded(".webp", eight, cv2.IMWRITE_WEBP_QUALITY, 101),
    }
    found = {kind: Sample({"picture.img": data}, _read_picture) for kind, data in kinds.items()}
    mask = np.where(eight[..., 0] > 100, 255, 0).astype(np.uint8)
    found["mask_png"] = Sample({"mask.png": _encoded(".png", mask)}, lambda folder: decode_mask(folder / "mask.png"))
    found["mask_jpeg"] = Sample({"mask.jpg": _encoded(".jpg", mask)}, lambda folder: decode_mask(folder / "mask.jpg"))
    return found


def _ranges(scratch: Path) -> dict[str, Sample]:
    ranges = (1 + picture()[..., 0] / np.float32(64)).astype(np.float32)
    npy, npz = io.BytesIO(), io.BytesIO()
    np.save(npy, ranges)
    np.savez_compressed(npz, range=ranges)
    files = {
        "range.tiff": _encoded(".tiff", ranges),
        "range.png": _encoded(".png", (ranges * 1000).astype(np.uint16)),
        "range.npy": npy.getvalue(),
        "range.npz": npz.getvalue(),
    }
    if has_exr():
        write_exr(scratch / "range.exr", {"range": ranges, "confidence": ranges})
        files["range.exr"] = (scratch / "range.exr").read_bytes()
    found = {f"range_{name[6:]}": Sample({name: data}, _read_ranges) for name, data in files.items()}
    normals = np.dstack([ranges, -ranges, ranges]).astype(np.float32)
    found["normals"] = Sample({"n.tiff": _encoded(".tiff", normals)}, lambda folder: read_normals(folder / "n.tiff"))
    write_depth_map(scratch / "map.bin", ranges)
    data = (scratch / "map.bin").read_bytes()
    found["colmap_map"] = Sample({"map.bin": data}, lambda folder: read_colmap_map(folder / "map.bin"))
    depth = io.BytesIO()
    write_npz(depth, {f"{number:03d}": ranges for number in range(3)})
    found["truth"] = Sample({"depth.npz": depth.getvalue(), "poses.json": _poses_json()}, _read_truth, mutated=2)
    return found


def _models(scratch: Path) -> dict[str, Sample]:
    write_colmap_model(scratch / "model", noisy_poses(points=20), SIZES, form="both")
    found = {}
    for form in ("bin", "txt"):
        names = [f"{name}.{form}" for name in ("points3D", "images", "cameras")]
        files = {name: (scratch / "model" / name).read_bytes() for name in names}
        found[f"colmap_{form}"] = Sample(files, _read_poses, mutated=3)
    sphere = struct.pack("<QIiQQ3d", 1, 1, 11, 1024, 512, 1.0, 512.0, 256.0)
    files = dict(found["colmap_bin"].files) | {"cameras.bin": sphere}
    files = {name: files[name] for name in ("cameras.bin", "images.bin", "points3D.bin")}
    found["sphere_bin"] = Sample(files, _read_poses, mutated=2)
    return found


def _poses() -> dict[str, Sample]:
    transforms, shots, rows = [], {}, ["name,tx,ty,tz,qw,qx,qy,qz"]
    for number, pose in enumerate(capture_poses(3)):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.inverse().rotation @ np.diag([1, -1, -1]), pose.center
        transforms.append({"file_path": f"{number:03d}.png", "transform_matrix": matrix.tolist()})
        shots[f"{number:03d}.png"] = {"camera": "c", "rotation": [0.1, 0.2, number], "translation": [1.0, 2.0, number]}
        rows.append(f"{number:03d}.png,1,2,{number},1,0,0,0")
    nerf = {"camera_model": "EQUIRECTANGULAR", "frames": transforms}
    sfm = [{"cameras": {"c": {"projection_type": "spherical"}}, "shots": shots, "reference_lla": {"latitude": 1.0}}]
    files = {
        "poses.json": _poses_json(),
        "transforms.json": json.dumps(nerf).encode(),
        "reconstruction.json": json.dumps(sfm).encode(),
        "poses.csv": "\n".join(rows).encode(),
    }
    return {name.replace(".", "_"): Sample({name: data}, _read_poses) for name, data in files.items()}


def _poses_json() -> bytes:
    views = [
        {"id": number, "image": f"images/{number:03d}.png", "R": pose.rotation.tolist(), "t": pose.translation.tolist()}
        for number, pose in enumerate(capture_poses(3))
    ]
    return json.dumps({"metric": True, "views": views}).encode()


def _clouds(scratch: Path) -> dict[str, Sample]:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (50, 3)).astype(np.uint8)
    cloud = PointCloud(points, points / np.linalg.norm(points, axis=1, keepdims=True), colors, colors[:, 0].copy())
    write_ply(scratch / "cloud.ply", cloud)
    write_ply_mesh(scratch / "mesh.ply", (points, colors, rng.integers(0, 50, (20, 3)).astype(np.int32)))
    head = "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 50\n"
    head += "".join(f"property float {name}\n" for name in ("x", "y", "z")) + "end_header\n"
    text = head + "\n".join(" ".join(f"{value:.4f}" for value in point) for point in points) + "\n"
    files = {
        "ply": (scratch / "cloud.ply").read_bytes(),
        "ply_text": text.encode(),
        "ply_mesh": (scratch / "mesh.ply").read_bytes(),
    }
    return {kind: Sample({"cloud.ply": data}, _read_cloud(kind)) for kind, data in files.items()}


def _read_picture(folder: Path) -> None:
    path = folder / "picture.img"
    describe_picture(path)
    decode_image(path)


def _read_ranges(folder: Path) -> None:
    for file in find_ranges(folder, unit=0.001).values():
        file.read()


def _read_truth(folder: Path) -> None:
    truth = read_truth(folder)
    for view in truth.views.values():
        truth.range_map(view)


def _read_poses(folder: Path) -> None:
    for group in read_groups(folder):
        group.check()
    recorded_pictures(folder)


def _read_cloud(kind: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        path = folder / "cloud.ply"
        has_faces(path)
        if kind == "ply_mesh":
            read_ply_mesh(path)
        elif kind == "ply":
            read_ply(path)
        points = open_ply_points(path)
        points.some(3)
        for _ in points.chunks():
            pass

    return read


@cache
def _registry() -> Registry:
    return Registry.installed()


def _read_workflow(folder: Path) -> None:
    load_workflow(folder / "workflow.yaml", _registry(), images=folder, presets=presets_folder())


def _encoded(suffix: str, array: np.ndarray, *options: int) -> bytes:
    return bytes(cv2.imencode(suffix, array, list(options))[1])
