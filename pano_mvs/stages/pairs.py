"""Pair selectors: which pictures to match."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.matching.pairs import exhaustive_pairs, sequential_pairs
from pano_mvs.api import Features, Names, Pairs, Params, stage


@stage("pairs.exhaustive")
def exhaustive(images: Names[Features]) -> Pairs:
    """Every picture with every other; for up to some hundred pictures."""
    return exhaustive_pairs(images)


class SequentialParams(Params):
    """Settings of pairs.sequential."""

    window: int = Field(default=5, ge=1, description="each picture with so many that follow")
    loop: bool = Field(default=False, description="the first picture follows the last")


@stage("pairs.sequential")
def sequential(images: Names[Features], params: SequentialParams) -> Pairs:
    """Each picture with those that follow it, in the order of the file names; for walks and video."""
    return sequential_pairs(images, window=params.window, loop=params.loop)
