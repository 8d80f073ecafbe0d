"""The places of an ablation: synthetic ones of every kind, captures with truth, and real captures with known poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.io.poses.files import read_poses
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.scene.panorama import StaticMasks
from tests.stored import read_picture
from tests.synthetic.places import large_plain_room, yard
from tests.synthetic.rig import RIGS, with_rig
from tests.synthetic.scenes import SCENES
from tools.benchmarks.captures import Capture, read_capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain, extras

SCENE_MAKERS = {**SCENES, "yard": yard, "large_plain_room": large_plain_room}
# What "soft" images look like: as if enlarged, with the noise and the compression of a consumer camera.
_BLUR_PX, _NOISE, _JPEG_QUALITY = 2.0, 2.0, 85
MASKS = ("static", "masked", "people")
"""Names of the stages that mask panoramas; they run where something moves with the camera."""


@dataclass(frozen=True)
class Place:
    """A capture on which mechanisms are compared.

    Attributes:
        place: name of a synthetic place, or of the folder.
        width: of the panoramas, in pixels.
        views: number of views, all of which are scored.
        folder: of a capture with truth, or with `images/` and a COLMAP model in `colmap/`.
        arguments: of the synthetic place.
        soft: whether its images are blurred, noisy and compressed.
        rig: what moves with the camera, one of `RIGS`; "real" in photographs.
    """

    place: str
    width: int
    views: int
    folder: Path | None = None
    arguments: tuple[tuple[str, Any], ...] = ()
    soft: bool = False
    rig: str = ""

    @property
    def name(self) -> str:
        """Name of the place with what was done to it."""
        parts = self.place.replace("_", " "), "soft" if self.soft else "", self.rig if self.rig in RIGS else ""
        return " ".join(part for part in parts if part)

    @property
    def key(self) -> str:
        """The name with all that decides what its images show."""
        arguments = (f"{key}={value}" for key, value in self.arguments)
        return "-".join([self.name, str(self.width), str(self.views), *arguments])

    @property
    def has_rig(self) -> bool:
        """Whether something moves with the camera."""
        return bool(self.rig)

    def is_for(self, needs: str) -> bool:
        """Return whether a mechanism that needs "rig", "soft" or nothing is measured here.

        Soft images are large, since only images of 1024 columns and more are reduced. Nothing else is measured on them.
        """
        return self.soft if needs == "soft" else not self.soft and (not needs or self.has_rig)

    def capture(self, scratch: Path) -> Capture:
        """Return the capture; what is rendered or changed is stored in sub-folders of `scratch`."""
        if self.folder is None:
            scene = SCENE_MAKERS[self.place](views=self.views, **dict(self.arguments))
            plain = f"{self.place}-{self.width}-{self.views}-{self.arguments}"
            capture = scene_capture(scene, scratch / plain, width=self.width)
        elif (self.folder / "colmap").is_dir():
            capture = real_capture(self.folder, width=self.width, views=self.views)
        else:
            capture = read_capture(self.folder, width=self.width).first(self.views)
        if self.soft:
            capture = changed(capture, scratch / self.key, softened)
        if self.rig in RIGS:
            colors, pixels = RIGS[self.rig]((self.width // 2, self.width))
            capture = changed(
                capture, scratch / self.key, lambda picture, rng: with_rig(picture, (colors, pixels), rng=rng)
            )
            ranges = {name: np.where(pixels, np.float32(np.nan), true) for name, true in capture.ranges.items()}
            capture = replace(capture, ranges=ranges)
        return capture


SYNTHETIC = (
    Place("desk", 384, 4, arguments=(("seed", 0), ("reach", 1.6), ("top", "weak"))),
    Place("white_room", 384, 3, arguments=(("seed", 12),)),
    Place("poles", 384, 4, arguments=(("seed", 13),)),
    Place("corridor", 384, 4, arguments=(("seed", 14), ("exposure", 0.03))),
    Place("courtyard", 384, 4, arguments=(("seed", 11), ("exposure", 0.1))),
    Place("yard", 384, 3, arguments=(("seed", 21), ("sky", "overcast"))),
    Place("weak_room", 384, 3, arguments=(("seed", 15),)),
    Place("desk", 1024, 3, arguments=(("seed", 5),), soft=True),
    Place("corridor", 2048, 3, arguments=(("seed", 14),), soft=True),
    Place("desk", 384, 4, arguments=(("seed", 5),), rig="tripod"),
)


def places_of(folders: Sequence[Path], *, width: int) -> tuple[Place, ...]:
    """Return the synthetic places, and the captures in folders; of real ones, five views."""
    given = [
        Place(folder.resolve().name, width, 5 if is_real else 4, folder, rig="real" if is_real else "")
        for folder in folders
        for is_real in [(folder / "colmap").is_dir()]
    ]
    return (*SYNTHETIC, *given)


def real_capture(folder: Path, *, width: int, views: int) -> Capture:
    """Return the first photographs of `images/` with their poses in `colmap/`; their true ranges are unknown."""
    numbered = folder / "colmap" / "0"
    poses = read_poses(numbered if numbered.is_dir() else folder / "colmap")
    names = sorted(poses.names)[:views]
    panoramas = {}
    for name in names:
        path = folder / "images" / name
        height, own_width = read_picture(path).shape[:2]
        panoramas[name] = Panorama(FilePart(path), (width // 2, width), (height, own_width))
    own = {name: poses.cam_from_world(poses.names.index(name)) for name in names}
    unknown = np.full((width // 2, width), np.nan, np.float32)
    return Capture(folder.resolve().name, panoramas, own, dict.fromkeys(names, unknown))


def softened(picture: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return an RGB image as a camera with soft optics stores it; the blur wraps around the seam."""
    wide = np.concatenate([picture[:, -16:], picture, picture[:, :16]], axis=1)
    blurred = cv2.GaussianBlur(wide, (0, 0), _BLUR_PX)[:, 16:-16].astype(np.float64)
    noisy = np.clip(np.rint(blurred + rng.normal(0, _NOISE, blurred.shape)), 0, 255).astype(np.uint8)
    data = cv2.imencode(".jpg", noisy[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    decoded: NDArray[np.uint8] | None = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.ascontiguousarray(decoded[..., ::-1])


def changed(
    capture: Capture, folder: Path, change: Callable[[NDArray[np.uint8], np.random.Generator], NDArray[np.uint8]]
) -> Capture:
    """Return a capture with other images of the same views, which are written once."""
    folder.mkdir(parents=True, exist_ok=True)
    panoramas = {}
    for idx, (name, panorama) in enumerate(capture.panoramas.items()):
        path = folder / f"{Path(name).stem}.png"
        if not path.is_file():
            cv2.imwrite(str(path), change(panorama.load(), np.random.default_rng(idx))[..., ::-1])
        panoramas[name] = Panorama(FilePart(path), panorama.size_hw, panorama.size_hw)
    return replace(capture, panoramas=panoramas)


def masked(capture: Capture, chain: DenseChain, *, folder: Path) -> Capture:
    """Return a capture with the masks that the stages `MASKS` of a workflow give its images.

    Args:
        capture: images without masks.
        chain: of the workflow.
        folder: for the mask files.
    """
    panoramas, static = dict(capture.panoramas), None
    for stage in (name for name in chain.stages if name in MASKS):
        entry = chain.stages[stage]
        more = extras(entry, folder / stage)
        if entry.spec.output is StaticMasks:
            static = entry.spec.function(images=panoramas, **more)
            continue
        more |= {"static_masks": static} if any(port.kind is StaticMasks for port in entry.spec.ports) else {}
        function: Any = entry.spec.function
        panoramas = {name: function(image=image, **more) for name, image in panoramas.items()}
    return replace(capture, panoramas=panoramas)
