"""Photographs localised among panoramas with true poses, scored against the truth.

Run it with `python -m tools benchmarks poses.photographs [DATA_DIR…] --scratch DIR`.

The photographs of synthetic places are rendered from the place itself by cameras with random positions between the
panoramas, fields of view, distortions and exposures. Those of a DATA_DIR (see captures_with_truth) are cut from
panoramas that are left out, and as soft as these. Ranges are the true ones, or with `--ranges WORKFLOW` those that the
dense stages of a workflow find. For each place, once without and once with a focal length that is 5 % too long, it
prints how many photographs are localised, the medians of the errors (rotation in degrees, position in per cent of the
median range, focal length in per cent), the largest rotation error, and how many photographs of the next place are
localised here, which is always wrong.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pano_mvs_photographs.camera import PhotographCamera
from pano_mvs_photographs.colors import PhotographColors, PhotographColorSettings
from pano_mvs_photographs.localise_stage import LocaliseParams, localise

from pano_mvs.algorithms.faces.render import face_image
from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.fusion.view import FusionView
from pano_mvs.engine.stages.context import Context
from pano_mvs.geometry import PinholeView, Rigid3, geodesic_angle, rotation_from_rotvec
from pano_mvs.scene import Features, Poses, RangeMap
from pano_mvs.scene.photographs import Photographs
from tests.algorithms.fusion.whole import fuse_views
from tests.stored import write_npz
from tests.synthetic.colors import colors_along
from tests.synthetic.photograph import render_photograph
from tests.synthetic.scenes import SCENES, Scene
from tools.benchmarks.captures import Capture, read_capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain

PHOTO_WH = (800, 600)
SOFT_WH = (480, 360)
EXIF_ERROR = 1.05
TOWARDS = 12  # the photographers look at something, not at the ceiling: degrees of pitch and roll


@dataclass(frozen=True)
class Taken:
    """A photograph and the truth about it."""

    name: str
    picture: NDArray[np.uint8]
    pose: Rigid3
    focal_px: float


@dataclass(frozen=True)
class Place:
    """What photographs are localised among, and the photographs."""

    capture: Capture
    features: Mapping[str, Features]
    ranges: Mapping[str, RangeMap]
    photographs: Sequence[Taken]

    @property
    def scale(self) -> float:
        """The median range."""
        return float(np.nanmedian(np.stack(list(self.capture.ranges.values()))))


def rendered_photographs(scene: Scene, *, count: int, seed: int, distorted: bool = True) -> list[Taken]:
    """Return photographs of a synthetic place, from between its cameras."""
    width = PHOTO_WH[0]
    rng = np.random.default_rng([seed, 0xF0])
    centers = np.stack([pose.center for pose in scene.poses])
    taken = []
    for number in range(count):
        center = rng.dirichlet(np.ones(len(centers))) @ centers + rng.normal(0, 0.1, 3)
        tilt = rotation_from_rotvec(np.radians(rng.normal(0, TOWARDS, 3)) * (1, 0, 1))
        heading = rotation_from_rotvec(np.array([0.0, rng.uniform(-np.pi, np.pi), 0.0]))
        pose = Rigid3.from_center(tilt @ heading, center)
        size_hw = (width * 3 // 4, width) if number % 3 else (width, width * 3 // 4)
        focal_px = width / 2 / float(np.tan(np.radians(rng.uniform(50, 78)) / 2))
        picture = render_photograph(
            scene.room, pose, size_hw, focal_px=focal_px, radial=distorted * rng.uniform(-0.08, 0.04), supersample=1
        )
        levels = 255 * (picture / 255) ** np.exp(rng.normal(0, 0.15)) * np.exp(rng.normal(0, 0.1, 3))
        noisy = np.clip(np.rint(levels + rng.normal(0, 2, picture.shape)), 0, 255).astype(np.uint8)
        taken.append(Taken(f"{number}.png", noisy, pose, focal_px))
    return taken


def cut_photographs(capture: Capture, names: Sequence[str], *, count: int) -> list[Taken]:
    """Return photographs that are cut from panoramas, as soft as these."""
    rng = np.random.default_rng(7)
    taken = []
    for number in range(count):
        name = names[number % len(names)]
        tilt = rotation_from_rotvec(np.radians(rng.normal(0, TOWARDS, 3)) * (1, 0, 1))
        turn = tilt @ rotation_from_rotvec(np.array([0.0, rng.uniform(-np.pi, np.pi), 0.0]))
        focal_px = SOFT_WH[0] / 2 / float(np.tan(np.radians(62) / 2))
        view = PinholeView(turn, focal_px, np.array(SOFT_WH) / 2, SOFT_WH[::-1])
        pose = Rigid3(turn, np.zeros(3)) @ capture.poses[name]
        taken.append(Taken(f"{number}.png", face_image(capture.panoramas[name].load(), view), pose, focal_px))
    return taken


def place_of(capture: Capture, photographs: Sequence[Taken], *, workflow: str, scratch: Path) -> Place:
    """Return a place with key points and ranges; ranges of a workflow are stored in the scratch folder."""
    features = {name: _features(image.load()) for name, image in capture.panoramas.items()}
    true = {
        name: RangeMap(ranges, np.where(np.isfinite(ranges), 255, 0).astype(np.uint8))
        for name, ranges in capture.ranges.items()
    }
    ranges = true if workflow == "true" else _measured(capture, workflow, scratch)
    return Place(capture, features, ranges, photographs)


def _features(picture: NDArray[np.uint8]) -> Features:
    return extract_sift(picture, np.ones(picture.shape[:2], np.bool_))


def _measured(capture: Capture, workflow: str, scratch: Path) -> dict[str, RangeMap]:
    folder = scratch / f"{capture.name}-{next(iter(capture.panoramas.values())).size_hw[1]}-{Path(workflow).stem}"
    if not folder.is_dir():
        maps = list(DenseChain(workflow).run(capture).range_maps.values())[-1]
        folder.mkdir()
        for name, found in maps.items():
            np.savez(folder / f"{name}.npz", range=found.range, confidence=found.confidence)
    stored = {}
    for name in capture.panoramas:
        with np.load(folder / f"{name}.npz") as arrays:
            stored[name] = RangeMap(arrays["range"], arrays["confidence"])
    return stored


def localised(place: Place, photographs: Sequence[Taken], *, exif: bool, scratch: Path) -> Photographs:
    """Run the stage on a folder of photographs."""
    folder = scratch / "photographs"
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    for taken in photographs:
        wide = EXIF_ERROR * taken.focal_px / max(taken.picture.shape) * 36
        data = cv2.imencode(".png", taken.picture[..., ::-1])[1].tobytes()
        (folder / taken.name).write_bytes(with_focal(data, wide) if exif else data)
    poses = Poses.without_points(dict(place.capture.poses), frame="the truth's", scale="the truth's", metric=True)
    ctx = Context(np.random.default_rng(0), scratch)
    return localise(
        poses=poses,
        features=dict(place.features),
        ranges=dict(place.ranges),
        images=dict(place.capture.panoramas),
        params=LocaliseParams(path=folder),
        ctx=ctx,
    )


def with_focal(png: bytes, focal_35mm: float) -> bytes:
    """Return a PNG with EXIF's FocalLengthIn35mmFilm (a whole number, as phones write it)."""
    import io

    from PIL import Image

    picture = Image.open(io.BytesIO(png))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = round(focal_35mm)
    out = io.BytesIO()
    picture.save(out, "PNG", exif=exif)
    return out.getvalue()


def show(place: Place, others: Sequence[Taken], *, exif: bool, scratch: Path) -> NDArray[np.float64]:
    """Print the row of one place, and return the errors (N, 3): degrees, per cent, per cent."""
    started = time.process_time()
    found = localised(place, place.photographs, exif=exif, scratch=scratch)
    seconds = (time.process_time() - started) / len(place.photographs)
    wrong = len(localised(place, others, exif=exif, scratch=scratch)) if others else 0
    truth = {f"photographs/{taken.name}": taken for taken in place.photographs}
    errors = np.array([_errors(found, idx, truth[name], place.scale) for idx, name in enumerate(found.names)])
    errors = errors.reshape(-1, 3)
    medians = np.median(errors, axis=0) if len(errors) else np.full(3, np.nan)
    worst = errors.max(axis=0, initial=0)
    print(
        f"{place.capture.name:14s} {'EXIF' if exif else '-':5s} {len(found):2d}/{len(place.photographs):<2d} "
        f"{medians[0]:6.3f}° {medians[1]:6.2f}% {medians[2]:6.2f}%   {worst[0]:6.3f}° {worst[1]:6.2f}% "
        f"{wrong:2d}/{len(others)}  {seconds:5.1f} s",
        flush=True,
    )
    for name, reason in found.rejected.items():
        print(f"    {Path(name).name}: {reason}")
    return errors


def _errors(found: Photographs, idx: int, truth: Taken, scale: float) -> tuple[float, float, float]:
    pose = found.cam_from_world(idx)
    return (
        float(np.degrees(geodesic_angle(pose.rotation, truth.pose.rotation))),
        100 * float(np.linalg.norm(pose.center - truth.pose.center)) / scale,
        100 * abs(found.focals_px[idx] / truth.focal_px - 1),
    )


def show_colors(name: str, *, seed: int, width: int) -> None:
    """Print how far the colours of a cloud are from the truth, without and with photographs, where these look.

    Cameras and ranges are the true ones. The truth is the colour of the surface for a pixel of the photograph.
    """
    scene = SCENES[name](seed=seed, views=4)
    views = []
    for idx, pose in enumerate(scene.poses):
        picture, true = scene.view(idx, (width // 2, width), supersample=2)
        known = RangeMap(true, np.where(np.isfinite(true), 255, 0).astype(np.uint8))
        views.append(FusionView(known, pose, picture))
    cloud = fuse_views(views)
    taken = rendered_photographs(scene, count=2, seed=seed, distorted=False)
    colors = PhotographColors(cloud, PhotographColorSettings())
    for photograph in taken:
        colors.add(photograph.picture, PhotographCamera(photograph.pose, photograph.focal_px, 0.0))
    changed = np.flatnonzero((colors.colors_rgb() != cloud.colors_rgb).any(axis=1))
    rays = cloud.points_in_world[changed].astype(np.float64) - taken[0].pose.center
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    true_colors = 255 * colors_along(scene.room, taken[0].pose.center, rays, pixel_rad=1 / taken[0].focal_px)
    errors = [np.abs(rgb[changed] - true_colors).mean() for rgb in (cloud.colors_rgb, colors.colors_rgb())]
    print(
        f"{name}: {len(changed)} points coloured, mean error {errors[0]:.1f} -> {errors[1]:.1f} grey levels", flush=True
    )


def main() -> None:
    """Measure the synthetic places and the captures that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path, help="captures with truth")
    parser.add_argument("--scratch", type=Path, required=True, help="folder for what is rendered and measured")
    parser.add_argument("--width", type=int, default=1024, help="of the panoramas")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--ranges", default="true", help="true, or a workflow that measures the ranges")
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument("--count", type=int, default=8, help="photographs of each place")
    parser.add_argument("--exif", nargs="*", type=int, default=[0, 1], choices=[0, 1])
    parser.add_argument("--colors", action="store_true", help="measure the colours of clouds instead")
    options = parser.parse_args()
    if options.colors:
        for name in options.scenes:
            show_colors(name, seed=options.seed, width=options.width)
        return
    options.scratch.mkdir(parents=True, exist_ok=True)
    places = []
    for name in options.scenes:
        scene = SCENES[name](seed=options.seed, views=5, exposure=0.05)
        capture = scene_capture(scene, options.scratch / f"{name}-{options.width}-{options.seed}", width=options.width)
        taken = _stored_photographs(scene, options.scratch / f"{name}-{options.seed}-photos", options)
        places.append(place_of(capture, taken, workflow=options.ranges, scratch=options.scratch))
    for folder in options.folders:
        whole = read_capture(folder, width=options.width)
        names = list(whole.panoramas)
        kept = Capture(
            whole.name,
            {name: image for name, image in whole.panoramas.items() if name != names[4]},
            {name: pose for name, pose in whole.poses.items() if name != names[4]},
            {name: ranges for name, ranges in whole.ranges.items() if name != names[4]},
        )
        taken = cut_photographs(whole, [names[4]], count=options.count)
        places.append(place_of(kept, taken, workflow=options.ranges, scratch=options.scratch))
    print(f"{'place':14s} {'':5s} found  medians: rotation, position, focal   largest   of elsewhere")
    for exif in options.exif:
        errors = []
        for idx, place in enumerate(places):
            others = places[(idx + 1) % len(places)].photographs if len(places) > 1 else []
            errors.append(show(place, others, exif=bool(exif), scratch=options.scratch))
        every = np.concatenate(errors)
        print(f"all: {len(every)} localised, medians " + " ".join(f"{value:.3f}" for value in np.median(every, axis=0)))


def _stored_photographs(scene: Scene, folder: Path, options: argparse.Namespace) -> list[Taken]:
    file = folder.with_suffix(".npz")
    if not file.is_file():
        taken = rendered_photographs(scene, count=options.count, seed=options.seed)
        write_npz(file, {item.name: item.picture for item in taken})
        values = np.array([[*item.pose.rotation.ravel(), *item.pose.translation, item.focal_px] for item in taken])
        np.save(folder.with_suffix(".npy"), values)
    values = np.load(folder.with_suffix(".npy"))
    with np.load(file) as pictures:
        return [
            Taken(name, pictures[name], Rigid3(row[:9].reshape(3, 3), row[9:12]), float(row[12]))
            for name, row in zip(pictures.files, values, strict=True)
        ][: options.count]
