"""Groups of cameras and single panoramas become one house."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from made_tours import MadeTour, made_tour
from numpy.typing import NDArray
from pano_mvs_tours.house_of_links import house_of_links

from pano_mvs.algorithms.poses.frame.vertical_lines import Picture, find_segments, wall_azimuth
from pano_mvs.geometry import Similarity3, rotate_panorama, rotation_from_rotvec
from pano_mvs.scene import House, PlacedBy, Poses, SceneLink, WorldAxes
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.pose_groups import join_groups

IMAGES = Path(__file__).parents[3] / "workflows" / "samples" / "classroom" / "images"
ALL = ("0", "1", "2", "3", "4", "5")
WORLD_FROM_LEVEL = Similarity3(1.0, rotation_from_rotvec((0.0, 0.7, 0.0)), np.array([3.0, 0.4, -1.0]))


def blank() -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    return np.full((32, 64, 3), 128, np.uint8), np.ones((32, 64), np.bool_)


BLANK: dict[str, Picture] = dict.fromkeys(ALL, blank)


def poses_of(tour: MadeTour, numbers: tuple[int, ...], unit: float = 1.0) -> Poses:
    cameras = {str(number): WORLD_FROM_LEVEL.move_camera(tour.level_camera(number, unit)) for number in numbers}
    return Poses.without_points(cameras, frame="", scale="", metric=False, axes=WorldAxes.LEVEL)


def offsets(house: House, name: str, tour: MadeTour) -> float:
    """Return how far a panorama is from its true place relative to the first one, in camera heights."""
    assert house.camera_height is not None
    true = WORLD_FROM_LEVEL.apply(tour.level_camera(int(name)).center)
    own = house.cam_from_house(house.names.index(name)).center
    first = house.cam_from_house(0).center
    there = WORLD_FROM_LEVEL.apply(tour.level_camera(0).center)
    return float(np.linalg.norm((own - first) / house.camera_height - (true - there)))


def test_single_panoramas_and_another_group_stand_in_the_frame_of_the_largest_group() -> None:
    tour = made_tour()
    poses = join_groups([poses_of(tour, (0, 1, 2)), poses_of(tour, (3, 5), unit=5.0)], order=ALL)
    house = house_of_links(poses, tour.links, BLANK)
    house.check()
    assert house.names == ALL
    assert house.placed_by == ("matches", "matches", "matches", "links", "links", "links")
    assert house.groups.tolist() == [0, 0, 0, 1, -1, 1]
    for name in ("0", "1", "2"):
        pose = house.cam_from_house(ALL.index(name))
        assert np.allclose(pose.center, poses.cameras[name].center)
        assert np.allclose(pose.rotation, poses.cameras[name].rotation)
    assert max(offsets(house, name, tour) for name in ("3", "4", "5")) < 0.3
    # What is in the second group stands in the house where its cameras do.
    from_world = house.house_from_world("3", poses.cameras["3"])
    assert np.allclose(from_world.apply(poses.cameras["5"].center), house.cam_from_house(5).center)
    assert from_world.scale == pytest.approx(house.scales[3])


@pytest.mark.slow
def test_doubtful_cameras_stand_where_links_say() -> None:
    tour = made_tour()
    poses = poses_of(tour, (0, 1, 2, 3))
    poses.translations[3] += (3.0, 0.0, 0.0)
    poses.doubts["3"] = "rooms look alike"
    house = house_of_links(poses, tour.links, BLANK)
    assert house.placed_by[3] == PlacedBy.LINKS
    assert house.groups[3] == -1
    assert offsets(house, "3", tour) < 0.3


def test_what_no_link_joins_stands_beside_the_house() -> None:
    tour = made_tour()
    links = {name: [link for link in own if "5" not in (name, link.name)] for name, own in tour.links.items()}
    house = house_of_links(poses_of(tour, (0, 1)), links, BLANK)
    assert house.placed_by[5] == PlacedBy.NOTHING
    assert house.center_stds[5] == np.inf
    centers = np.array([house.cam_from_house(idx).center for idx in range(6)])
    assert np.linalg.norm(centers[:5] - centers[5], axis=1).min() > 1.5 * (house.camera_height or 0)


def test_a_capture_without_links_loads_no_picture() -> None:
    def fail() -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        raise AssertionError

    tour = made_tour()
    house = house_of_links(poses_of(tour, (0, 1)), {}, dict.fromkeys(ALL, fail))
    assert PlacedBy.LINKS not in house.placed_by


def test_without_links_doubtful_cameras_make_no_house() -> None:
    """A page of such a capture lost its cloud, because its first panorama counted as placed by links."""
    tour = made_tour()
    poses = poses_of(tour, (0, 1))
    poses.doubts.update({"0": "", "1": ""})
    house = house_of_links(poses, {}, BLANK)
    assert PlacedBy.LINKS not in house.placed_by
    assert house.camera_height is None


@pytest.mark.slow
def test_copies_at_one_position_have_a_house() -> None:
    tour = made_tour()
    poses = poses_of(tour, (0, 0, 2))
    twin = Poses.without_points(
        {"0": poses.cameras["0"], "1": poses.cameras["0"]}, frame="", scale="", metric=False, axes=WorldAxes.LEVEL
    )
    house = house_of_links(twin, tour.links, BLANK)
    house.check()
    assert np.isfinite(house.translations).all()


@pytest.mark.slow
@pytest.mark.parametrize("far", [pytest.param(0.0, marks=pytest.mark.slow), 300.0])
def test_deviations_do_not_depend_on_the_origin_of_the_world(far: float) -> None:
    tour = made_tour()
    near = poses_of(tour, (0, 1, 2))
    shift = Similarity3(1.0, np.eye(3), np.array([far, 0.0, 0.0]))
    poses = Poses.without_points(
        {name: shift.move_camera(pose) for name, pose in near.cameras.items()},
        frame="",
        scale="",
        metric=False,
        axes=WorldAxes.LEVEL,
    )
    stds = house_of_links(poses, tour.links, BLANK).center_stds
    assert np.allclose(stds, house_of_links(near, tour.links, BLANK).center_stds, rtol=0.05, atol=0.01)
    assert stds[0] == 0
    assert np.isfinite(stds).all()


def test_a_tour_of_which_nothing_is_matched_is_a_house_by_its_links() -> None:
    tour = made_tour()
    nothing = Poses.without_points({}, frame="", scale="", metric=False)
    house = house_of_links(nothing, tour.links, BLANK)
    assert house.placed_by == ("links",) * 6
    apart = [np.linalg.norm(house.cam_from_house(idx).center - house.cam_from_house(0).center) for idx in range(6)]
    assert np.allclose(apart, np.linalg.norm(tour.positions - tour.positions[0], axis=1), atol=0.05)


def test_links_to_itself_and_to_unknown_names_are_ignored() -> None:
    tour = made_tour()
    tour.links["0"] += [SceneLink("gone", (10.0, -20.0)), SceneLink("0", (0.0, -20.0))]
    assert len(house_of_links(poses_of(tour, (0, 1)), tour.links, BLANK).names) == 6


def walls_deg(picture: NDArray[np.uint8]) -> float:
    valid = np.ones(picture.shape[:2], np.bool_)
    return float(np.rad2deg(wall_azimuth(find_segments({"": lambda: (picture, valid)}, {"": np.eye(3)}))))


def test_the_walls_of_a_turned_room_have_its_turn() -> None:
    picture = cv2.resize(decode_image(sorted(IMAGES.glob("*.png"))[0]), (1024, 512), interpolation=cv2.INTER_AREA)
    turned = rotate_panorama(np.asarray(picture, np.uint8), rotation_from_rotvec((0.0, np.deg2rad(20.0), 0.0)))
    off = walls_deg(turned) - walls_deg(np.asarray(picture, np.uint8)) - 20.0
    assert abs((off + 45) % 90 - 45) < 0.5


def test_a_picture_without_lines_has_no_walls() -> None:
    assert np.isnan(wall_azimuth(find_segments({"a": blank}, {"a": np.eye(3)})))
