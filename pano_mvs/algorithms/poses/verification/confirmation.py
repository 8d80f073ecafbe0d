"""Check poses against the images: how much of what one image sees do others see where its pose puts it?"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.consistency import consistent_pixels
from pano_mvs.algorithms.panoramas import reduced_mask, reduced_panorama
from pano_mvs.algorithms.sweep.hypotheses import range_limits
from pano_mvs.algorithms.sweep.limits import textured_pixels
from pano_mvs.algorithms.sweep.settings import SURFACE_SETTINGS
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.geometry import Rigid3, geodesic_angle, pixel_solid_angle, ray_grid
from pano_mvs.scene import RangeMap

Picture = tuple[NDArray[np.uint8], NDArray[np.bool_]]
"""A panorama (H, W, 3) uint8 RGB with its mask (H, W); False is ignored."""

WIDTH_PX = 256
_SETTINGS = SURFACE_SETTINGS.replace(planes=64, spacing="inverse")
SOURCES = 4
"""Maximum number of cameras against which one is swept."""
SHARED_FROM = 8
"""With this number of cameras or more, a model is judged by sweeps that its cameras share."""
# With less textured area than this share of the sphere, nothing can be concluded about a pose.
MIN_TEXTURED = 0.05
_PARALLAX_EDGES_DEG = np.array([2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 65.0, 180.0])
_CLASSES = len(_PARALLAX_EDGES_DEG)
_WIDE = slice(5, _CLASSES - 1)  # the classes of more than 30°
_MIN_WIDE_SR = 0.1
# Weight, as solid angle, of the overall share in each class.
_PRIOR = 0.05
_MAX_COLORS = 256  # pictures whose colours in Lab are kept, of .4 MB each


@dataclass(frozen=True, eq=False)
class _Small:
    """A panorama at 256 columns."""

    image: NDArray[np.uint8]  # (128, 256, 3) uint8
    mask: NDArray[np.bool_]  # (128, 256) bool, False is ignored
    textured: NDArray[np.bool_]  # (128, 256) bool, True where there is texture to match


@dataclass(frozen=True, eq=False)
class Evidence:
    """How much of what an image sees other images confirm, by parallax."""

    textured: NDArray[np.float64]  # (B,) solid angle of the textured pixels in each parallax class
    confirmed: NDArray[np.float64]  # (B,) solid angle of the pixels that other images confirm

    @property
    def share(self) -> float:
        """The confirmed share of the textured pixels; NaN if too little of the sphere is textured."""
        if self.textured.sum() < MIN_TEXTURED * 4 * np.pi:
            return float("nan")
        return float(self.confirmed.sum() / self.textured.sum())

    @property
    def parallax_share(self) -> float:
        """The confirmed share of what is textured and seen under a parallax; NaN if that is too little."""
        seen = self.textured[:-1].sum()
        return float(self.confirmed[:-1].sum() / seen) if seen >= MIN_TEXTURED * 4 * np.pi else float("nan")

    @property
    def wide_share(self) -> float:
        """The confirmed share of what is textured and seen under more than 30°; NaN if that is too little.

        Cameras of bays that look alike, put into one bay, are confirmed under small parallaxes only.
        """
        seen = self.textured[_WIDE].sum()
        return float(self.confirmed[_WIDE].sum() / seen) if seen > _MIN_WIDE_SR else float("nan")

    def expected_share(self, others: Sequence[Evidence]) -> float:
        """Return the share that the evidence of other cameras suggests, class by class; NaN without other cameras.

        A camera far from its neighbours sees everything under a large parallax, of which little is confirmed at any
        pose. The expectation is therefore the confirmed share of the same classes in other cameras.
        """
        known = [other for other in others if np.isfinite(other.share)]
        if not known or not np.isfinite(self.share):
            return float("nan")
        textured = np.sum([other.textured for other in known], axis=0)
        confirmed = np.sum([other.confirmed for other in known], axis=0)
        overall = confirmed.sum() / textured.sum()
        rates = (confirmed + _PRIOR * overall) / (textured + _PRIOR)
        return float(self.textured @ rates / self.textured.sum())


class Confirmation:
    """Small sweeps of panoramas with given poses, to measure how well the images confirm one another.

    Each panorama is swept against its nearest neighbours at 256×128 (about 0.05 s), and the ranges are compared with
    the neighbours' own. Wrong poses, even those that repeated structure suggests, confirm much less, since everything
    that does not repeat is then in the wrong place.

    Args:
        load: returns a panorama and its mask by its position in the capture. It is called once per panorama; only a
            small copy is kept.
    """

    def __init__(self, load: Callable[[int], Picture], *, width_px: int = WIDTH_PX) -> None:
        self._load = load
        self._width_px = width_px
        self._small: dict[int, _Small] = {}
        self._colors_lab: dict[int, NDArray[np.float32]] = {}
        self._maps: OrderedDict[tuple[int, ...], list[tuple[list[Rigid3], RangeMap]]] = OrderedDict()
        self._evidence_of: dict[tuple[tuple[int, ...], ...], list[tuple[list[Rigid3], Evidence]]] = {}

    def at_width(self, width_px: int) -> Confirmation:
        """Return one of the same capture with smaller or larger sweeps."""
        return Confirmation(self._load, width_px=width_px)

    def shares(self, cameras: Mapping[int, Rigid3], *, independent: bool = False) -> dict[int, float]:
        """Return the share of every camera of a model, by default with one sweep for each; see `evidence`.

        What two models have in common is computed once.
        """
        return {
            image: self.evidence(image, pose, cameras, independent=independent).share
            for image, pose in sorted(cameras.items())
        }

    def parallax_shares(self, cameras: Mapping[int, Rigid3]) -> dict[int, float]:
        """Return the confirmed share of what every camera of a model sees under a parallax, with one sweep for each."""
        return {
            image: self.evidence(image, pose, cameras, independent=False).parallax_share
            for image, pose in sorted(cameras.items())
        }

    def share(self, image: int, pose: Rigid3, cameras: Mapping[int, Rigid3]) -> float:
        """Return the share of an image's textured pixels, by solid angle, that other images confirm; see `evidence`."""
        return self.evidence(image, pose, cameras).share

    def evidence(
        self, image: int, pose: Rigid3, cameras: Mapping[int, Rigid3], *, independent: bool = True
    ) -> Evidence:
        """Return how much of what an image sees its nearest neighbours confirm.

        Args:
            image: position of the image.
            pose: the cam_from_world to judge.
            cameras: cam_from_world of other images, which stay fixed.
            independent: whether the neighbours are swept without this image. If False, all images of a capture share
                their maps, one sweep each, and a wrong pose slightly degrades its neighbours' maps.
        """
        with _one_thread():
            return self._evidence(image, pose, cameras, independent=independent)

    def _evidence(self, image: int, pose: Rigid3, cameras: Mapping[int, Rigid3], *, independent: bool) -> Evidence:
        others = {idx: camera for idx, camera in cameras.items() if idx != image}
        sources = nearest_cameras(pose, others)
        if not sources:
            return Evidence(np.zeros(_CLASSES), np.zeros(_CLASSES))
        seen_by = []
        for source in sources:
            around = {idx: camera for idx, camera in others.items() if idx != source}
            # With two images, each can only be checked against the other.
            seen_by.append(
                nearest_cameras(others[source], around if independent else {**around, image: pose}) or [image]
            )
        compared = (image, *sources), *map(tuple, seen_by)
        everybody = {**others, image: pose}
        relative = [everybody[idx] @ pose.inverse() for idx in dict.fromkeys(idx for one in compared for idx in one)]
        known = self._evidence_of.setdefault(compared, [])
        for before, evidence in known:
            if _nearly_equal(relative, before):
                return evidence
        evidence = self._compared(image, sources, seen_by, cameras=everybody)
        known.append((relative, evidence))
        del known[:-3]
        return evidence

    def _compared(
        self, image: int, sources: Sequence[int], seen_by: Sequence[Sequence[int]], *, cameras: Mapping[int, Rigid3]
    ) -> Evidence:
        """Return how much of what an image sees its sources confirm, whose maps are swept against other images."""
        small = self.small(image)
        solid_angle = np.broadcast_to(pixel_solid_angle(small.mask.shape)[:, None], small.mask.shape)
        textured = small.textured & small.mask
        own, confirmed = self._map_of(image, sources, seen_by, cameras=cameras)
        confirmed &= textured
        classes = _parallax_classes(own.range, cameras[image], [cameras[source] for source in sources])
        return Evidence(
            *(
                np.histogram(classes[which], _CLASSES, (-0.5, _CLASSES - 0.5), weights=solid_angle[which])[0]
                for which in (textured, confirmed)
            )
        )

    def _map_of(
        self, image: int, sources: Sequence[int], seen_by: Sequence[Sequence[int]], *, cameras: Mapping[int, Rigid3]
    ) -> tuple[RangeMap, NDArray[np.bool_]]:
        """Return the small map of an image, and which of its pixels its sources confirm."""
        own = self._swept(image, sources, cameras=cameras)
        maps = [self._swept(source, seeing, cameras=cameras) for source, seeing in zip(sources, seen_by, strict=True)]
        return own, _confirmed(own, cameras[image], maps, source_poses=[cameras[source] for source in sources])

    def ranges(self, image: int, cameras: Mapping[int, Rigid3]) -> NDArray[np.float32]:
        """Return the ranges of a camera of a model that its nearest neighbours confirm, (H, W), NaN elsewhere."""

        def nearest(camera: int) -> list[int]:
            return nearest_cameras(cameras[camera], {idx: pose for idx, pose in cameras.items() if idx != camera})

        sources = nearest(image)
        with _one_thread():
            own, confirmed = self._map_of(image, sources, [nearest(source) for source in sources], cameras=cameras)
        return np.where(confirmed, own.range, np.float32(np.nan))

    def small(self, image: int) -> _Small:
        """Return a panorama at 256 columns."""
        if image not in self._small:
            picture, mask = self._load(image)
            reduced = reduced_panorama(picture, self._width_px)
            self._small[image] = _Small(reduced, reduced_mask(mask, self._width_px), textured_pixels(reduced))
        return self._small[image]

    def colors_lab(self, image: int) -> NDArray[np.float32]:
        """Return the colours of a small picture in Lab, (H, W, 3), slightly blurred."""
        if image not in self._colors_lab:
            if len(self._colors_lab) >= _MAX_COLORS:
                del self._colors_lab[next(iter(self._colors_lab))]
            lab = cv2.cvtColor(self.small(image).image, cv2.COLOR_RGB2LAB).astype(np.float32)
            self._colors_lab[image] = np.asarray(cv2.GaussianBlur(lab, (3, 3), 0.8), np.float32)
        return self._colors_lab[image]

    def _swept(self, image: int, sources: Sequence[int], *, cameras: Mapping[int, Rigid3]) -> RangeMap:
        """Return the small range map of an image against its sources.

        A map with nearly the same relative poses is reused: an adjustment moves all cameras slightly.
        """
        relative = [cameras[idx] @ cameras[image].inverse() for idx in sources]
        known = self._maps.setdefault((image, *sources), [])
        self._maps.move_to_end((image, *sources))
        for before, ranges in known:
            if _nearly_equal(relative, before):
                scale = np.float32(_usual_distance(relative) / _usual_distance(before))
                return RangeMap(ranges.range * scale, ranges.confidence)
        ranges = self._sweep(image, sources, relative)
        known.append((relative, ranges))
        del known[:-3]
        # Each camera needs its own map and those of its neighbours, in every pass over all cameras.
        if len(self._maps) > max(400, 2 * len(self._small)):
            self._maps.popitem(last=False)
        return ranges

    def _sweep(self, image: int, sources: Sequence[int], relative: Sequence[Rigid3]) -> RangeMap:
        small = self.small(image)
        baselines = [float(np.linalg.norm(to.translation)) for to in relative]
        # In units of the median baseline. A near limit from the longest one would lose the foreground if one source is
        # far away.
        return sweep_range(
            small.image,
            [self.small(idx).image for idx in sources],
            relative,
            near=0.15 * float(np.median(baselines)),
            far=range_limits(baselines, width=4 * self._width_px)[1],
            settings=_SETTINGS,
            reference_mask=small.mask,
            source_masks=[self.small(idx).mask for idx in sources],
        )


def _nearly_equal(relative: Sequence[Rigid3], before: Sequence[Rigid3]) -> bool:
    """Return whether relative poses differ by nothing but scale and what a sweep at 256 columns hardly notices."""
    scale, before_scale = _usual_distance(relative), _usual_distance(before)
    return all(
        np.linalg.norm(a.translation / scale - b.translation / before_scale) < 0.005
        and geodesic_angle(a.rotation, b.rotation) < np.deg2rad(0.1)
        for a, b in zip(relative, before, strict=True)
    )


def _usual_distance(relative: Sequence[Rigid3]) -> float:
    return float(np.median([np.linalg.norm(to.translation) for to in relative]))


def _confirmed(
    own: RangeMap, pose: Rigid3, maps: Sequence[RangeMap], *, source_poses: Sequence[Rigid3]
) -> NDArray[np.bool_]:
    """Return the pixels of a small map that the maps of its sources confirm."""
    px_rad = 2 * np.pi / own.range.shape[1]
    # When other maps confirm a pixel; the last one is in pixels.
    return consistent_pixels(
        own,
        pose,
        maps,
        source_poses=source_poses,
        max_relative_error=0.05,
        max_angle_rad=px_rad,
        min_support=0.5,
        min_motion_rad=0.05 * px_rad,
    )[0]


@contextmanager
def _one_thread() -> Iterator[None]:
    """Run sweeps in the calling thread: maps this small take less time than starting other threads."""
    import numba

    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(threads)


def _parallax_classes(ranges: NDArray[np.float32], pose: Rigid3, sources: Sequence[Rigid3]) -> NDArray[np.intp]:
    """Return the class of each pixel, (H, W): the smallest angle under which a source and the image see its point.

    Angles below 2° are ignored, since they carry little information. Pixels without such a source are in the last
    class.
    """
    rays, smallest = ray_grid(ranges.shape), np.full(ranges.shape, np.inf)
    for source in sources:
        offset = (source @ pose.inverse()).center
        along = rays @ offset
        across = np.sqrt(np.maximum(offset @ offset - along**2, 0.0))
        angles = np.rad2deg(np.arctan2(across, ranges - along))
        smallest = np.where((angles > _PARALLAX_EDGES_DEG[0]) & (angles < smallest), angles, smallest)
    smallest[np.isnan(ranges)] = np.inf
    classes: NDArray[np.intp] = np.searchsorted(_PARALLAX_EDGES_DEG[1:], smallest)
    return classes


def nearest_cameras(pose: Rigid3, cameras: Mapping[int, Rigid3], *, count: int = SOURCES) -> list[int]:
    """Return the cameras nearest to a pose, nearest first; cameras at the same position are left out."""
    distances = {idx: float(np.linalg.norm(camera.center - pose.center)) for idx, camera in cameras.items()}
    farthest = max(distances.values(), default=0.0)
    apart = [idx for idx, distance in distances.items() if distance > 1e-6 * farthest]
    return sorted(apart, key=lambda idx: (distances[idx], idx))[:count]
