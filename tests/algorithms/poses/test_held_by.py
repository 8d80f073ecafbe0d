"""A camera that only a removed one connects to the rest has no place any more, whatever it looks like there."""

from __future__ import annotations

import pytest

from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel


@pytest.mark.parametrize(
    ("removed", "held"), [([], []), ([3], [4]), ([2], [3, 4]), ([0], []), ([1, 3], [4]), ([2, 3], [4])]
)
def test_images_that_hang_on_removed_ones_are_found(removed: list[int], held: list[int]) -> None:
    """In a drawn house, the camera that one pair had placed stayed in the wrong room after its partner was removed."""
    model = PlacedModel(Pairs.without("abcde"))
    model.chosen = dict.fromkeys([(0, 1), (1, 2), (0, 2), (2, 3), (3, 4)], 0)
    assert model.held_by(removed) == held
