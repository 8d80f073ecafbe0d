"""Pair selectors: choose which images to match."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.learned.similar_pairs import learned_pairs
from pano_mvs.algorithms.matching.pair_selection import (
    automatic_pairs,
    east_north_m,
    exhaustive_pairs,
    loop_closing_pairs,
    most_pairs,
    position_pairs,
    retrieval_pairs,
)
from pano_mvs.api import (
    All,
    Context,
    Features,
    GlobalDescriptor,
    InputError,
    Names,
    One,
    Pairs,
    Panorama,
    Params,
    Poses,
    TwoView,
    UsageError,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.io.poses.files import matched_positions
from pano_mvs.stages.pose_paths import PosesPath


def _memory_of_auto(params: Params, count: int) -> int:
    """Return the memory for pairs of this number of images."""
    # `automatic_pairs` and its parts hold at most eight matrices of float64 at a time.
    return 64 * count**2 if most_pairs(count, _candidates(params)) < count * (count - 1) // 2 else 0


def _candidates(params: Params) -> int:
    return int(arguments_from(automatic_pairs, params)["candidates"])


@stage(
    "pairs.auto",
    settings=automatic_pairs,
    memory=lambda params, inputs: _memory_of_auto(params, len(inputs["descriptors"])),
    expected_units=lambda params, images: most_pairs(images, _candidates(params)),
    expected_memory=lambda params, images, _: _memory_of_auto(params, images),
)
def automatic(
    descriptors: All[GlobalDescriptor],
    images: All[Panorama],
    poses: One[Poses] | None,
    params: Params,
    ctx: Context,
) -> Pairs:
    """Match all pairs of up to 57 images; in larger captures, match each image with at most 28 others.

    These are chosen by the links of a virtual tour, by the order of the capture if consecutive images are similar, by
    the positions of GPS or of an earlier stage that returns poses, and by similarity.
    """
    settings = arguments_from(automatic_pairs, params)
    if most_pairs(len(descriptors), settings["candidates"]) < len(descriptors) * (len(descriptors) - 1) // 2:
        positions = gps_positions(images) if poses is None else dict(zip(poses.names, poses.centers, strict=True))
    else:
        positions = {}
    links = {name: [link.name for link in image.links] for name, image in images.items() if image.links}
    pairs, reason = automatic_pairs(descriptors, positions, links, **settings)
    ctx.metric("pairs", len(pairs.pairs))
    if reason:
        count = len(descriptors)
        ctx.note(
            f"{len(pairs.pairs):,} of the {count * (count - 1) // 2:,} pairs of {count} images are matched, at most "
            f"{settings['candidates']} for each (candidates of pairs.auto): {reason}"
        )
    return pairs


def gps_positions(images: Mapping[str, Panorama]) -> dict[str, NDArray[np.float64]]:
    """Return the positions of the images that have a GPS fix, (2,) metres east and north of their mean."""
    located = {name: image.position_lla for name, image in images.items() if image.position_lla is not None}
    return dict(zip(located, east_north_m(list(located.values())), strict=True))


@stage("pairs.exhaustive", expected_units=lambda _, images: images * (images - 1) // 2)
def exhaustive(images: Names[Features]) -> Pairs:
    """Match every image with every other one; for up to about 60 images."""
    return exhaustive_pairs(images)


@stage("pairs.sequential", settings=loop_closing_pairs)
def sequential(
    images: Names[Features], descriptors: All[GlobalDescriptor] | None, params: Params, ctx: Context
) -> Pairs:
    """Match each image with the next ones in the order of the file names; for walks and video.

    With `loop_closure`, also match it with the most similar images beyond the window, where the path returns.
    """
    settings = arguments_from(loop_closing_pairs, params)
    if settings["loop_closure"] and descriptors is None:
        raise UsageError(
            "loop_closure needs global descriptors: add a stage {use: global.vlad} before pairs.sequential"
        )
    pairs = loop_closing_pairs(images, descriptors or {}, **settings)
    ctx.metric("pairs", len(pairs.pairs))
    return pairs


@stage("pairs.retrieval", settings=retrieval_pairs)
def retrieval(images: Names[Features], descriptors: All[GlobalDescriptor], params: Params, ctx: Context) -> Pairs:
    """Match each image with the most similar ones; for hundreds of images without order."""
    pairs = retrieval_pairs(images, descriptors, **arguments_from(retrieval_pairs, params))
    ctx.metric("pairs", len(pairs.pairs))
    return pairs


@stage("pairs.learned", settings=learned_pairs, memory="600MB")
def learned(features: All[Features], matches: All[TwoView] | None, params: Params, ctx: Context) -> Pairs:
    """Match each image that has key points of features.aliked with those whose learned key points are most similar.

    Pairs of such images that an earlier matcher has verified are matched again, too.
    """
    pairs = learned_pairs(features, matches, **arguments_from(learned_pairs, params))
    ctx.metric("pairs", len(pairs.pairs))
    return pairs


@params_from(position_pairs, own_last=True)
class PositionParams(Params):
    """Settings of pairs.position."""

    path: PosesPath | None = Field(
        default=None,
        description="positions in a table with name, x, y, z, or in any input of poses.from_model, instead of GPS",
    )


@stage("pairs.position")
def position(images: All[Panorama], params: PositionParams, ctx: Context) -> Pairs:
    """Match each image with the nearest ones, by GPS or by approximately known poses."""
    if params.path is not None:
        positions, notes = matched_positions(tuple(images), params.path)
        for note in notes:
            ctx.note(note)
    else:
        positions = gps_positions(images)
    if not positions:
        raise InputError(
            "no image has a position: the files contain no GPS fix. Use pairs.sequential, pairs.retrieval or "
            "pairs.exhaustive, or give positions by `path`"
            if params.path is None
            else f"{params.path}: none of its images is one of this capture"
        )
    ctx.metric("located", len(positions) / len(images))
    pairs = position_pairs(tuple(images), positions, **arguments_from(position_pairs, params))
    ctx.metric("pairs", len(pairs.pairs))
    return pairs
