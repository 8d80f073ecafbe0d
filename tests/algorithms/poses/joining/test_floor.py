"""The floor that two images see determines the length of their pair, and joins groups that one pair connects."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.joining.floor import Floors
from pano_mvs.algorithms.poses.joining.join_groups import join_models
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import Features
from pano_mvs.testing.room import default_room, render
from tests.algorithms.poses.joining.two_rooms import CENTERS, matched, room_features, room_poses

SIZE_HW = (256, 512)
HEADINGS_DEG = (0.0, 130.0, 250.0)
PLACES = ((-0.5, 0.0, -0.2), (0.35, 0.0, 0.4), (0.5, 0.0, -0.5))
DEPTH = 1.3  # of the floor of the default room below its origin


def _poses() -> list[Rigid3]:
    return [
        Rigid3.from_center(rotation_from_rotvec((0.0, np.deg2rad(heading), 0.0)), np.array(place))
        for heading, place in zip(HEADINGS_DEG, PLACES, strict=True)
    ]


@pytest.fixture(scope="module")
def floors() -> Floors:
    pictures = [render(default_room(), pose, SIZE_HW, supersample=1)[0] for pose in _poses()]

    def load(image: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        return pictures[image], np.ones(SIZE_HW, np.bool_)

    return Floors(load)


def _unit(pose: Rigid3) -> tuple[Rigid3, float]:
    length = float(np.linalg.norm(pose.translation))
    return Rigid3(pose.rotation, pose.translation / length), length


@pytest.mark.parametrize(("first", "second"), [(0, 1), (1, 0), (0, 2), (2, 1)])
def test_the_length_is_found_in_camera_heights(floors: Floors, first: int, second: int) -> None:
    poses = _poses()
    direction, length = _unit(poses[second] @ poses[first].inverse())
    assert floors.length(first, second, direction) == pytest.approx(length / DEPTH, rel=0.08)


def test_a_wrong_heading_has_no_length(floors: Floors) -> None:
    direction, _ = _unit(_poses()[1])
    turned = Rigid3(rotation_from_rotvec((0.0, 1.0, 0.0)) @ direction.rotation, direction.translation)
    assert np.isnan(floors.length(0, 1, turned))


class _TrueFloors(Floors):
    """Cameras one metre above a floor that all of them see."""

    def __init__(self) -> None:
        """No pictures are needed."""

    def length(self, first: int, second: int, second_from_first: Rigid3) -> float:
        centers = list(CENTERS.values())
        return float(np.linalg.norm(np.subtract(centers[first], centers[second])))

    def camera_height(self, model: PlacedModel) -> float:
        first, second = sorted(model.cameras)
        between = np.linalg.norm(model.cameras[first].center - model.cameras[second].center)
        return float(between) / self.length(first, second, Rigid3.identity())


def _without_door(features: Features, own: int) -> Features:
    per_point = {one.name: getattr(features, one.name) for one in fields(features)}
    return replace(
        features, **{name: part[:own] for name, part in per_point.items() if np.shape(part)[:1] == (len(features),)}
    )


def _rooms() -> tuple[list[PlacedModel], dict[str, Rigid3]]:
    """Return models of two rooms; only one image of each sees the other room."""
    truth, own = room_poses(), 220
    features = room_features(truth, door=40, own=own)
    features |= {name: _without_door(features[name], own) for name in ("a1", "b1")}
    pairs = pairs_of(features, matched(features))
    models = []
    for edge in ((0, 1), (2, 3)):
        models.append(PlacedModel(pairs))
        models[-1].seed(edge, 0)
    return models, truth


def test_one_pair_joins_two_rooms_if_floors_determine_its_length() -> None:
    models, truth = _rooms()
    ((joined, parts),) = join_models(models, _TrueFloors())
    assert parts == (0, 1)
    names = list(truth)
    first = truth["a1"]
    unit = np.linalg.norm(np.subtract(CENTERS["a1"], CENTERS["a2"]))
    for image, camera in joined.cameras.items():
        expected = first.apply(truth[names[image]].center[None])[0] / unit
        assert np.linalg.norm(camera.center - expected) < 0.1


def test_without_floors_the_rooms_stay_apart() -> None:
    models, _ = _rooms()
    assert len(join_models(models)) == 2
