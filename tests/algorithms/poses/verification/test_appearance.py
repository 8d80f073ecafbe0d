"""What other cameras expect of an image is what it shows at its pose, and not elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.verification.appearance import Appearance, Surroundings
from pano_mvs.algorithms.poses.verification.arrangements import place_score
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from tests.algorithms.room_pictures import WHOLE, room_capture

POSES, PICTURES = room_capture()
IMAGE = 2
BLOCK = {idx: pose for idx, pose in enumerate(POSES) if idx != IMAGE}


@pytest.fixture(scope="module")
def surroundings() -> Surroundings:
    confirmation = Confirmation(lambda image: (PICTURES[image], WHOLE), width_px=128)
    return Surroundings(confirmation, BLOCK, lambda idx: confirmation.ranges(idx, BLOCK))


def moved(offset: tuple[float, float, float], turn_deg: float = 0.0) -> Rigid3:
    turn = rotation_from_rotvec((0.0, np.deg2rad(turn_deg), 0.0))
    return Rigid3.from_center(turn @ POSES[IMAGE].rotation, POSES[IMAGE].center + np.array(offset))


@pytest.mark.slow
def test_an_image_shows_what_is_expected_where_it_was_taken(surroundings: Surroundings) -> None:
    there = surroundings.appearance(IMAGE, POSES[IMAGE])
    assert there.agreement > 0.6
    assert there.correlation > 0.6
    assert 0.3 < there.cover <= 1


@pytest.mark.parametrize(("offset", "turn_deg"), [((0.9, 0.0, -0.6), 0.0), ((0.0, 0.0, 0.0), 25.0)])
def test_elsewhere_it_shows_something_else(
    surroundings: Surroundings, offset: tuple[float, float, float], turn_deg: float
) -> None:
    there, elsewhere = (surroundings.appearance(IMAGE, pose) for pose in (POSES[IMAGE], moved(offset, turn_deg)))
    assert elsewhere.agreement < 0.6 * there.agreement
    assert elsewhere.unlike > 0.1 + there.unlike
    assert place_score(0.0, elsewhere) < place_score(0.0, there)


def test_without_ranges_nothing_is_expected() -> None:
    confirmation = Confirmation(lambda image: (PICTURES[image], WHOLE), width_px=128)
    unknown = np.full((64, 128), np.nan, np.float32)
    assert Surroundings(confirmation, BLOCK, lambda _: unknown).appearance(IMAGE, POSES[IMAGE]) == Appearance()
    assert Surroundings(confirmation, BLOCK, lambda _: None).appearance(IMAGE, POSES[IMAGE]) == Appearance()


def test_nearer_points_hide_farther_ones() -> None:
    """Every point of a far wall is known as well, so that a picture of the far wall would agree without this."""
    confirmation = Confirmation(lambda image: (PICTURES[image], WHOLE), width_px=128)
    ranges = {idx: confirmation.ranges(idx, BLOCK) for idx in BLOCK}
    before = Surroundings(confirmation, BLOCK, ranges.get).appearance(IMAGE, POSES[IMAGE])
    near = {idx: np.where(np.isfinite(own), np.float32(0.05), own) for idx, own in ranges.items()}
    both = Surroundings(confirmation, BLOCK, near.get).appearance(IMAGE, POSES[IMAGE])
    assert both.agreement < before.agreement


def test_confirmed_shares_and_agreement_speak_for_a_place_and_cover_against_it() -> None:
    base = place_score(0.2, Appearance(0.3, 0.3, 0.5))
    assert place_score(0.3, Appearance(0.3, 0.3, 0.5)) > base
    assert place_score(0.2, Appearance(0.4, 0.3, 0.5)) > base
    assert place_score(0.2, Appearance(0.3, 0.4, 0.5)) > base
    assert place_score(0.2, Appearance(0.3, 0.3, 0.6)) < base
