"""Pair selectors: which pictures to match."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.matching.neighbours import (
    east_north_m,
    loop_closing_pairs,
    position_pairs,
    retrieval_pairs,
)
from pano_mvs.algorithms.matching.pairs import exhaustive_pairs
from pano_mvs.algorithms.matching.vlad import vlad_descriptor
from pano_mvs.api import (
    All,
    Context,
    Each,
    Features,
    GlobalDescriptor,
    InputError,
    InputPath,
    Names,
    Pairs,
    Panorama,
    Params,
    UsageError,
    stage,
)
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.files import read_poses


@stage("pairs.exhaustive")
def exhaustive(images: Names[Features]) -> Pairs:
    """Every picture with every other; for up to some hundred pictures."""
    return exhaustive_pairs(images)


class SequentialParams(Params):
    """Settings of pairs.sequential."""

    window: int = Field(default=5, ge=1, description="each picture with so many that follow")
    loop: bool = Field(default=False, description="the first picture follows the last")
    loop_closure: int = Field(
        default=0, ge=0, description="each picture also with so many that look like it; needs global.vlad before"
    )


@stage("pairs.sequential")
def sequential(
    images: Names[Features], descriptors: All[GlobalDescriptor] | None, params: SequentialParams, ctx: Context
) -> Pairs:
    """Each picture with those that follow it, in the order of the file names; for walks and video.

    With `loop_closure`, also with those beyond the window that look most like it, where the walk comes back.
    """
    if params.loop_closure and descriptors is None:
        raise UsageError(
            "loop_closure needs global descriptors: put a stage {use: global.vlad} before pairs.sequential"
        )
    pairs = loop_closing_pairs(
        images, descriptors or {}, window=params.window, loop=params.loop, loop_closure=params.loop_closure
    )
    ctx.metric("pairs", len(pairs.pairs))
    return pairs


class VladParams(Params):
    """Settings of global.vlad."""

    strongest: int = Field(default=4000, ge=8, description="number of the strongest key points in the vector")
    sample: int = Field(
        default=200,
        ge=0,
        le=2000,
        description="number of key points of the coarsest scales that pairs.retrieval matches with one another",
    )


@stage("global.vlad")
def vlad(features: Each[Features], params: VladParams) -> GlobalDescriptor:
    """A global descriptor of each panorama, for pairs.retrieval and loop closure."""
    return vlad_descriptor(features, strongest=params.strongest, sample=params.sample)


class RetrievalParams(Params):
    """Settings of pairs.retrieval."""

    neighbours: int = Field(default=20, ge=1, description="number of most similar panoramas to match each one with")


@stage("pairs.retrieval")
def retrieval(
    images: Names[Features], descriptors: All[GlobalDescriptor], params: RetrievalParams, ctx: Context
) -> Pairs:
    """Each picture with those that look most like it; for hundreds of pictures in no order."""
    pairs = retrieval_pairs(images, descriptors, neighbours=params.neighbours)
    ctx.metric("pairs", len(pairs.pairs))
    return pairs


class PositionParams(Params):
    """Settings of pairs.position."""

    neighbours: int = Field(default=10, ge=1, description="each picture with so many nearest ones")
    window: int = Field(default=3, ge=1, description="a picture without position with so many before and after it")
    path: InputPath | None = Field(
        default=None, description="positions from a COLMAP model, poses.json, transforms.json or CSV instead of GPS"
    )


@stage("pairs.position")
def position(images: All[Panorama], params: PositionParams, ctx: Context) -> Pairs:
    """Each picture with those taken nearest to it, by GPS or by poses that are known roughly."""
    if params.path is not None:
        model = read_poses(params.path)
        place = dict(zip(model.names, model.centers, strict=True))
        positions = {name: place[known] for name, known in match_image_names(images, model.names).items()}
    else:
        located = {name: image.position_lla for name, image in images.items() if image.position_lla is not None}
        positions = dict(zip(located, east_north_m(list(located.values())), strict=True))
    if not positions:
        raise InputError(
            "no picture has a position: their files hold no GPS fix. Use pairs.sequential, pairs.retrieval or "
            "pairs.exhaustive, or give positions by `path`"
            if params.path is None
            else f"{params.path}: none of its images is one of this capture"
        )
    ctx.metric("located", len(positions) / len(images))
    pairs = position_pairs(tuple(images), positions, neighbours=params.neighbours, window=params.window)
    ctx.metric("pairs", len(pairs.pairs))
    return pairs
