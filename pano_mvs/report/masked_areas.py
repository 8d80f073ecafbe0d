"""What is masked in the panoramas and why: counts, shares of the sphere, and pictures with tinted areas."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pano_mvs.algorithms.masks.areas import share_of_sphere
from pano_mvs.algorithms.panoramas import nearest_resized
from pano_mvs.core.arrays import Mask
from pano_mvs.core.errors import InputError
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.pictures import Picture, evenly_spaced, picture, resized
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import Panorama
from pano_mvs.scene.masking import inside_crop
from pano_mvs.scene.panorama import StaticMasks, camera_of

VERSION = 1  # raise it when the pictures or the kinds change: earlier pages' are then drawn again
MAX_PICTURES = 12
MAX_BYTES = 50_000
_WIDTH = 640


@dataclass(frozen=True)
class MaskKind:
    """A reason for masking."""

    name: str
    label: str
    color_rgb: tuple[int, int, int]


# A pixel that is masked for several reasons counts for the first.
KINDS = (
    MaskKind("outside", "outside of the image file", (90, 90, 90)),
    MaskKind("nadir", "cap around the nadir, straight down", (255, 150, 0)),
    MaskKind("zenith", "cap around the zenith, straight up", (255, 215, 0)),
    MaskKind("static", "moves with the camera: tripod, rig, hand", (230, 40, 40)),
    MaskKind("other", "mask files, people and what else moves, other masking stages", (200, 0, 200)),
    MaskKind("sky", "sky: has no range", (40, 120, 255)),
)


@dataclass(frozen=True)
class MaskedCount:
    """How much is masked for one reason."""

    kind: MaskKind
    panoramas: int
    mean_share: float


@dataclass(frozen=True)
class MaskedAreas:
    """What is masked in a capture."""

    counts: tuple[MaskedCount, ...] = ()  # one for each reason that occurs
    examined: int = 0  # number of panoramas that were examined, at most 100, evenly spaced
    total: int = 0
    # (image, reason to share of the sphere, picture), at most twelve, with at least one for each reason
    pictures: tuple[tuple[str, Mapping[str, float], Picture], ...] = ()


def masked_areas(values: StoredValues, kept: EarlierPage) -> MaskedAreas:
    """Return what is masked in the panoramas of a run; without their values, nothing."""
    names = list(values.refs.get("images", {}))
    shares: dict[str, Mapping[str, float]] = {}
    masks = values.static_masks if names else None
    for name in evenly_spaced(names, 100):
        found = _shares(values, kept, name, masks=masks)
        if found is not None:
            shares[name] = found
    counts = []
    for kind in KINDS:
        own = [found[kind.name] for found in shares.values() if kind.name in found]
        if own:
            counts.append(MaskedCount(kind, len(own), sum(own) / len(own)))
    shown = []
    for name in chosen_pictures(shares):
        drawn = _picture(values, kept, name, masks=masks)
        if drawn is not None:
            shown.append((name, shares[name], drawn))
    return MaskedAreas(tuple(counts), len(shares), len(names), tuple(shown))


def chosen_pictures(shares: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return the images to show: for each reason that with the largest share, then evenly spaced others."""
    masked = [name for name, found in shares.items() if found]
    first = [
        max(masked, key=lambda name: shares[name].get(kind.name, 0.0))
        for kind in KINDS
        if any(kind.name in shares[name] for name in masked)
    ]
    chosen = dict.fromkeys(first[:MAX_PICTURES])
    rest = [name for name in masked if name not in chosen]
    chosen |= dict.fromkeys(evenly_spaced(rest, MAX_PICTURES - len(chosen)))
    return [name for name in masked if name in chosen]


def masked_kinds(panorama: Panorama, *, static: StaticMasks | None = None, sky: Mask | None = None) -> dict[str, Mask]:
    """Return the masked pixels by reason, (h, w) each; reasons without a pixel are left out.

    Args:
        panorama: of at most 256 rows, or its mask is reduced to that.
        static: what moves with the cameras.
        sky: (H, W) of the panorama's range map, of any size.
    """
    size_hw = min(panorama.size_hw, (256, 512))
    height = size_hw[0]
    outside = np.ones(size_hw, np.bool_)
    outside[inside_crop(size_hw, panorama.covers_ltwh, panorama.source_size_hw)] = False
    edges_deg = np.broadcast_to((np.arange(height + 1) * 180 / height)[:, None], (height + 1, size_hw[1]))
    masked = ~replace(panorama, size_hw=size_hw).load_mask()
    candidates = {
        "outside": outside,
        "nadir": edges_deg[1:] > 180 - panorama.nadir_deg,
        "zenith": edges_deg[:-1] < panorama.zenith_deg,
        "static": _static(panorama, static, size_hw) & masked,
        "other": masked,
        "sky": np.zeros(size_hw, np.bool_) if sky is None else nearest_resized(sky, size_hw),
    }
    # Masks are enlarged by up to a pixel: what is left at the borders of other reasons is not one of its own.
    free = np.ones(size_hw, np.bool_)
    found: dict[str, Mask] = {}
    for name, pixels in candidates.items():
        own = pixels & free
        if name == "other" and found:
            own &= cv2.morphologyEx(own.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)) > 0
        if own.any():
            found[name] = own
        free &= ~pixels
    return found


def _static(panorama: Panorama, static: StaticMasks | None, size_hw: tuple[int, int]) -> Mask:
    """Return what moves with the camera, as `StaticMasks.of`, but at a small size."""
    camera = camera_of(panorama)
    if static is None or camera not in static.cameras:
        return np.zeros(size_hw, np.bool_)
    pixels = static.pixels[static.cameras.index(camera)].astype(np.float32)
    return np.asarray(cv2.resize(pixels, size_hw[::-1], interpolation=cv2.INTER_LINEAR) >= 0.5)


def _key(values: StoredValues, name: str, what: str) -> str:
    """Return the key of what is derived from the masks of an image."""
    sources = (values.digest("images", name), values.digest("static"), values.digest("ranges", name))
    return f"{sources[0][:24]}.{zlib.crc32('.'.join(sources).encode()):08x}.{what}{VERSION}"


def _kinds_of(values: StoredValues, name: str, masks: StaticMasks | None) -> tuple[Panorama, dict[str, Mask]] | None:
    panorama = values.panorama(name)
    if panorama is None:
        return None
    try:
        return panorama, masked_kinds(panorama, static=masks, sky=values.sky(name))
    except InputError as error:
        values.notes.append(str(error))
        return None


def _shares(
    values: StoredValues, kept: EarlierPage, name: str, *, masks: StaticMasks | None
) -> Mapping[str, float] | None:
    """Return the share of the sphere that is masked for each reason, or None if the image cannot be examined."""
    key = _key(values, name, "k")
    fact = kept.fact(key)
    if fact is not None:
        return dict(fact)
    found = _kinds_of(values, name, masks)
    if found is None:
        return None
    shares = {kind: round(share_of_sphere(pixels), 6) for kind, pixels in found[1].items()}
    kept.keep(key, shares)
    return shares


def _picture(values: StoredValues, kept: EarlierPage, name: str, *, masks: StaticMasks | None) -> Picture | None:
    key = _key(values, name, "m")
    earlier = kept.picture(key)
    if earlier is not None:
        return earlier
    found = _kinds_of(values, name, masks)
    if found is None:
        return None
    panorama, kinds = found
    try:
        image = resized(panorama.load_unmasked(), _WIDTH).astype(np.float32)
    except InputError as error:
        values.notes.append(str(error))
        return None
    for kind in KINDS:
        if kind.name in kinds:
            pixels = nearest_resized(kinds[kind.name], (image.shape[0], image.shape[1]))
            image[pixels] = 0.5 * image[pixels] + 0.5 * np.array(kind.color_rgb, np.float32)
    return picture(image.astype(np.uint8), width=_WIDTH, most_bytes=MAX_BYTES, key=key)
