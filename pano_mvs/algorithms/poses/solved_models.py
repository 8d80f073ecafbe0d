"""Solve the models of all groups of a capture from its pairs."""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

from pano_mvs.algorithms.poses.growth import grown_model, settle
from pano_mvs.algorithms.poses.joining.join_groups import join_models
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import connected_groups
from pano_mvs.geometry import Rigid3


class Grow(Protocol):
    """A way to grow models."""

    def __call__(self, pairs: Pairs, images: Collection[int], *, adjust: bool) -> tuple[PlacedModel, dict[int, str]]:
        """Return the model of a connected group of images, and why images of the group could not be added to it."""


def solved_models(
    pairs: Pairs, *, adjust: bool = True, grow: Grow = grown_model
) -> tuple[list[PlacedModel], dict[int, str]]:
    """Return the models of all groups, the largest first, and the reasons for images that were refused at least once.

    Images that could not be added to any model are tried as models of one camera when models are joined.

    Args:
        pairs: all pairs of the capture.
        adjust: whether all cameras are adjusted as models grow.
        grow: returns the model of a connected group of images, and why images could not be added to it.
    """
    grown: list[PlacedModel] = []
    reasons: dict[int, str] = {}
    waiting = [group for group in connected_groups(pairs.geometries, len(pairs.names)) if len(group) > 1]
    while waiting:
        model, refused = grow(pairs, waiting.pop(0), adjust=adjust)
        grown.append(model)
        reasons |= refused
        left = {edge for edge in pairs.geometries if edge[0] in refused and edge[1] in refused}
        waiting += [group for group in connected_groups(left, len(pairs.names)) if len(group) > 1]
    placed = {image for model in grown for image in model.cameras}
    alone = [PlacedModel(pairs, {image: Rigid3.identity()}) for image in range(len(pairs.names)) if image not in placed]
    found: list[PlacedModel] = []
    for model, numbers in join_models([*grown, *alone]) if grown else []:
        if len(numbers) > 1:
            settle(model, adjust=adjust)
        if len(model.cameras) > 1:
            found.append(model)
    return sorted(found, key=lambda model: (-len(model.cameras), min(model.cameras))), reasons
