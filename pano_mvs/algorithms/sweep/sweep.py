"""The sphere sweep: find the range of every pixel of a panorama by testing depth hypotheses.

For a hypothesis r, a reference pixel u is looked up in source k at F⁻¹(r R F(u) + t), (R, t) = source_from_reference
and F the ray of a pixel; the range at which reference and sources agree best wins.
S. Yang, K. Kim, Y. Lee, "Dense Depth Estimation from Multiple 360-degree Images Using Virtual Depth", section 3.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends.registry import backend_for, helper_backend
from pano_mvs.algorithms.sweep.exposure import match_all, shrink
from pano_mvs.algorithms.sweep.hypotheses import mean_baseline_of, virtual_ranges
from pano_mvs.algorithms.sweep.preparation import (
    SweepInput,
    derotated,
    has_match,
    pixels_with_valid_window,
    prepare_colors,
    prepare_picture,
    sees_winner,
)
from pano_mvs.algorithms.sweep.settings import SURFACE_SETTINGS, SweepSettings
from pano_mvs.algorithms.sweep.winner import range_map_from_winners
from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene.masking import placed_mask
from pano_mvs.scene.range_map import RangeMap

__all__ = ["SweepSettings", "sweep_range"]


_ROUGH_ROWS = 128
"""Rows of the rough sweep behind the match of exposures."""


def sweep_range(
    reference: Picture,
    sources: Sequence[Picture],
    source_from_reference: Sequence[Rigid3],
    *,
    near: float,
    far: float,
    settings: SweepSettings | None = None,
    backend: str = "numba",
    device: str = "auto",
    reference_mask: Mask | None = None,
    source_masks: Sequence[Mask | None] | None = None,
    planes: FloatArray | None = None,
) -> RangeMap:
    """Return the range of every pixel of a reference panorama.

    `reference`: (H, W, 3) uint8 RGB, the full sphere, W even, H and W at least 16. `sources`: one or more (Hs, Ws, 3)
    uint8 RGB, each of its own size. `source_from_reference`: the pose of each source: x_in_source = R x_in_reference +
    t, t in scene units. `near`: the nearest depth hypothesis, in scene units. `far`: the farthest one. `settings`: how
    to sample, compare and decide. `backend`: "numba", compiled; "numpy", the readable reference (the whole volume in
    memory); "opencv"; or the name of a plugin's. `device`: where a backend that can choose computes: "auto", "cpu",
    "cuda", "cuda:1". `reference_mask`: (H, W) False where the reference is to be ignored: NaN in the result.
    `source_masks`: for each source (Hs, Ws), False where it is not valid, or None. `planes`: (K, 3) vectors p
    in the reference's frame, 1/range = p · ray, of planes that it may show; numba matches windows that lie on them too,
    in semi-global matching, and prefers ranges that are not beyond them.

    Returns:
        Ranges in scene units and confidence 64–127 ("seen but weak": a sweep alone cannot say that other views
        agree); NaN and 0 where the reference is masked, no source sees the winning range, or nothing was found (see
        `has_match`).

    Raises:
        UsageError: if shapes, types or numbers do not fit together, or near and far are not valid limits.
    """
    settings = settings or SweepSettings()
    compute = backend_for(backend, settings).find_winners
    work = sweep_input(
        reference,
        sources,
        source_from_reference,
        near=near,
        far=far,
        settings=settings,
        backend=backend,
        device=device,
        reference_mask=reference_mask,
        source_masks=source_masks,
    )
    winners = compute(replace(work, planes=planes))
    seen = np.ones(reference.shape[:2], np.bool_) if reference_mask is None else reference_mask
    seen = seen & sees_winner(winners, work)
    if settings.no_match == "invalid":
        seen &= has_match(winners, work)
    return range_map_from_winners(winners, range_at=work.range_at, settings=settings, seen=seen)


def sweep_input(
    reference: Picture,
    sources: Sequence[Picture],
    source_from_reference: Sequence[Rigid3],
    *,
    near: float,
    far: float,
    settings: SweepSettings,
    backend: str = "numba",
    device: str = "auto",
    reference_mask: Mask | None = None,
    source_masks: Sequence[Mask | None] | None = None,
) -> SweepInput:
    """Return what a backend is given for a sweep, checked and prepared; arguments and errors of `sweep_range`."""
    _check_picture("reference", reference, reference_mask)
    masks = _checked_sources(sources, source_from_reference, source_masks)
    ranges = virtual_ranges(
        near, far, planes=settings.planes, spacing=settings.spacing, baseline=mean_baseline_of(source_from_reference)
    )
    if settings.exposure and settings.matching_cost.minds_exposure:
        rough = _rough_range(
            reference,
            sources,
            source_from_reference,
            near=near,
            far=far,
            backend=backend,
            device=device,
            masks=(reference_mask, masks),
        )
        sources = match_all(reference, sources, source_from_reference, ranges=rough, masks=masks)
    poses = tuple(source_from_reference)
    follows_colors = settings.edges == "colors" and settings.aggregation == "sgm"
    if settings.derotate:
        sources, poses, masks = derotated(sources, poses, masks)
    return SweepInput(
        reference=prepare_picture(reference, settings),
        sources=tuple(prepare_picture(source, settings) for source in sources),
        source_from_reference=poses,
        source_valid=_voting(masks, settings, rows=reference.shape[0]),
        ranges=ranges,
        settings=settings,
        device=device,
        colors=prepare_colors(reference, settings) if follows_colors else None,
    )


def _rough_range(
    reference: Picture,
    sources: Sequence[Picture],
    source_from_reference: Sequence[Rigid3],
    *,
    near: float,
    far: float,
    backend: str,
    device: str,
    masks: tuple[Mask | None, Sequence[Mask] | None],
) -> NDArray[np.float32]:
    """Return ranges at low resolution by census, which exposure does not disturb; the surer half of them.

    `masks` are those of the reference and of the sources.
    """
    settings = SURFACE_SETTINGS.replace(planes=48, spacing="inverse", window=5, aggregation="box")
    small = [shrink(source, _ROUGH_ROWS) for source in sources]
    small_reference = shrink(reference, _ROUGH_ROWS)
    sources_valid = None if masks[1] is None else [_shrunk(m, like=s) for m, s in zip(masks[1], small, strict=True)]
    found = sweep_range(
        small_reference,
        small,
        source_from_reference,
        near=near,
        far=far,
        settings=settings,
        backend=helper_backend(backend),
        device=device,
        reference_mask=None if masks[0] is None else _shrunk(masks[0], like=small_reference),
        source_masks=sources_valid,
    )
    if not found.valid.any():
        return found.range
    sure = found.confidence >= np.median(found.confidence[found.valid])
    return np.where(sure, found.range, np.nan).astype(np.float32)


def _shrunk(mask: Mask, *, like: Picture) -> Mask:
    height, width = mask.shape
    return placed_mask(mask, (like.shape[0], like.shape[1]), of=(0, 0, width, height), whole_hw=(height, width))


def _voting(masks: tuple[Mask, ...] | None, settings: SweepSettings, *, rows: int) -> tuple[Mask, ...] | None:
    """Return where each source is valid: a window's radius in pixels of the reference away from what is masked."""
    if masks is None:
        return None
    radius = settings.compare_radius + settings.box_radius
    return tuple(pixels_with_valid_window(mask, ceil(radius * mask.shape[0] / rows)) for mask in masks)


def _checked_sources(
    sources: Sequence[Picture], poses: Sequence[Rigid3], masks: Sequence[Mask | None] | None
) -> tuple[Mask, ...] | None:
    """Return the masks of all sources, or None if nothing is masked."""
    if len(sources) == 0 or len(poses) != len(sources) or (masks is not None and len(masks) != len(sources)):
        raise UsageError(
            f"a sweep needs one pose (and one mask, if any) for each of one or more sources, got "
            f"{len(sources)} sources, {len(poses)} poses"
        )
    given = masks if masks is not None else [None] * len(sources)
    for idx, (source, mask) in enumerate(zip(sources, given, strict=True)):
        _check_picture(f"source {idx}", source, mask)
    if all(mask is None or mask.all() for mask in given):
        return None
    pairs = zip(sources, given, strict=True)
    return tuple(np.ones(source.shape[:2], np.bool_) if mask is None else mask for source, mask in pairs)


def _check_picture(name: str, picture: Picture, mask: Mask | None) -> None:
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise UsageError(f"{name}: a sweep needs (H, W, 3) uint8 RGB, got {picture.shape} {picture.dtype}")
    height, width = picture.shape[:2]
    if width % 2 or min(height, width) < 16:
        raise UsageError(f"{name}: a sweep needs an even width and at least 16×16 pixels, got {width}×{height}")
    if mask is not None and (mask.shape != (height, width) or mask.dtype != np.bool_):
        raise UsageError(f"{name}: its mask must be ({height}, {width}) bool, got {mask.shape} {mask.dtype}")
