"""People are found in a panorama, and nothing else is taken for one."""

from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pano_mvs.algorithms.faces.layout import upright_rotation
from pano_mvs.algorithms.masks import person_views
from pano_mvs.algorithms.masks.areas import dilated, pixel_weights, share_of_sphere
from pano_mvs.algorithms.masks.people import people
from pano_mvs.algorithms.masks.person_views import (
    SIDE_PX,
    SeenPanorama,
    person_in_middle,
    person_probability,
    rolled,
    stereographic_look,
)
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import PinholeView, Rigid3, pixel_solid_angle, ray_grid
from pano_mvs.testing.room import default_room, render
from tests.synthetic.persons import Drawn, draw_people, person

SIZE_HW = (512, 1024)
SAMPLE = Path(__file__).parents[2] / "workflows" / "samples" / "classroom" / "images" / "003.png"
AREA = np.broadcast_to(pixel_solid_angle(SIZE_HW)[:, None], SIZE_HW)


@pytest.fixture(scope="module")
def room() -> Picture:
    """A classroom without people."""
    return np.array(Image.open(SAMPLE).convert("RGB"))


@pytest.fixture(scope="module")
def portrait() -> tuple[Picture, Mask]:
    """Rear Admiral Grace Hopper in half-length, a photograph in the public domain, and which pixels show her."""
    file = Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg"
    picture = np.array(Image.open(file).convert("RGB"))
    height, width = picture.shape[:2]
    outline = np.array([(0.0, 1.0), (0.04, 0.75), (0.32, 0.58), (0.3, 0.1), (0.45, 0.03), (0.7, 0.1), (0.72, 0.5),
                        (0.95, 0.68), (1.0, 1.0)]) * (width, height)  # fmt: skip  # one polygon
    person = cv2.fillPoly(np.zeros((height, width), np.uint8), [np.rint(outline).astype(np.int32)], (1,))
    return picture, person > 0


def with_person(
    room: Picture, portrait: tuple[Picture, Mask], *, azimuth_deg: float, elevation_deg: float, height_deg: float
) -> tuple[Picture, Mask]:
    """Return a panorama with the portrait in a direction, and which pixels show it."""
    picture, person = portrait
    height, width = person.shape
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    axis = np.array([np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    focal_px = height / 2 / float(np.tan(np.radians(height_deg) / 2))
    view = PinholeView(upright_rotation(axis), focal_px, np.array([width / 2, height / 2]), (height, width))
    x, y = np.moveaxis(np.nan_to_num(view.pixels_from_rays(ray_grid(SIZE_HW)), nan=-1e3).astype(np.float32), -1, 0)
    shown = cv2.remap(person.astype(np.uint8), x - 0.5, y - 0.5, cv2.INTER_NEAREST) > 0
    reduced = cv2.GaussianBlur(picture, (0, 0), 1.5)
    return np.where(shown[..., None], cv2.remap(reduced, x - 0.5, y - 0.5, cv2.INTER_LINEAR), room), shown


def share(pixels: Mask, of: Mask) -> float:
    return float(AREA[pixels & of].sum() / AREA[of].sum())


PLACES = {"beside": (30, -38, 60), "across the seam": (178, -5, 30), "at a distance": (-100, -5, 25)}


@pytest.fixture(scope="module")
def crowd(room: Picture, portrait: tuple[Picture, Mask]) -> tuple[Picture, dict[str, Mask]]:
    """The classroom with a person in each of the places, and which pixels show each."""
    picture, shown = room, {}
    for name, (azimuth_deg, elevation_deg, height_deg) in PLACES.items():
        picture, shown[name] = with_person(
            picture, portrait, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, height_deg=height_deg
        )
    return picture, shown


@pytest.mark.slow
def test_people_are_found_and_nothing_else(crowd: tuple[Picture, dict[str, Mask]]) -> None:
    picture, shown = crowd
    found = people(picture)
    for name, pixels in shown.items():
        assert share(found, pixels) > 0.9, name
    around = cv2.dilate(np.any(list(shown.values()), axis=0).astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    assert share(found, ~around) < 0.01


@pytest.mark.slow
def test_passers_by_and_small_people_can_be_left_in(crowd: tuple[Picture, dict[str, Mask]]) -> None:
    picture, shown = crowd
    area_deg2 = float(AREA[shown["at a distance"]].sum()) * np.degrees(1) ** 2
    found = people(picture, passers_by=False, min_area_deg2=2 * area_deg2)
    assert share(found, shown["beside"]) > 0.9
    assert share(found, shown["at a distance"]) == 0


def test_nobody_is_found_in_an_empty_room(room: Picture) -> None:
    assert share(people(room), np.ones(SIZE_HW, np.bool_)) < 0.003


def test_the_networks_know_a_person(portrait: tuple[Picture, Mask]) -> None:
    picture = np.asarray(cv2.resize(portrait[0], (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA), np.uint8)
    person = cv2.resize(portrait[1].astype(np.uint8), (SIDE_PX, SIDE_PX)) > 0
    probability = person_probability(picture)
    assert probability[person].mean() > 0.8
    assert probability[~person].mean() < 0.2
    assert person_in_middle(picture)[0] > 0.6
    assert person_in_middle(np.full((SIDE_PX, SIDE_PX, 3), 128, np.uint8))[0] < 0.2


@pytest.mark.parametrize("wrong", [np.zeros((8, 16), np.uint8), np.zeros((8, 16, 3), np.float32)])
def test_wrong_arrays_are_refused(wrong: NDArray[np.uint8]) -> None:
    with pytest.raises(UsageError, match="a panorama is"):
        people(wrong)


def test_a_damaged_network_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(person_views, "_POSE", (person_views._POSE[0], "another digest"))
    with pytest.raises(UsageError, match=r"pose_landmark_lite.*Install pano-mvs again"):
        person_in_middle(np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8))


def test_a_network_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(person_views, "_POSE", ("nothing.onnx", person_views._POSE[1]))
    with pytest.raises(UsageError, match=r"nothing\.onnx: this network is missing\. Install pano-mvs again"):
        person_in_middle(np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8))


def with_somebody(pose: str, *, reach: float) -> Drawn:
    camera = Rigid3.from_center(np.eye(3), np.zeros(3))
    picture, ranges = render(default_room(0, "weak"), camera, (256, 512), supersample=1)
    body = person(pose, "jacket", at_xz=(0.2 * reach, -reach), ground_y=1.3, heading=2.0)
    return draw_people(picture, ranges, camera, people=[body])


def test_a_network_outlines_what_is_in_the_middle() -> None:
    drawn = with_somebody("standing", reach=1.5)
    view = stereographic_look(upright_rotation(np.array([0.2, 0.3, -1.0])), 90.0)
    outline = view.on_map(SeenPanorama(drawn.picture).middle(view)[1])
    assert outline[drawn.people].mean() > 0.8
    assert outline[~drawn.people & (view.weight > 0)].mean() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("pose", "reach"), [("crouching", 0.2), ("sitting", 0.1), ("standing", 0.7)])
def test_operators_are_found(pose: str, reach: float) -> None:
    """Below the camera and beside it, where they reach from below it to above the horizon."""
    drawn = with_somebody(pose, reach=reach)
    found = people(drawn.picture)
    weights = pixel_weights((256, 512))
    assert weights[found & drawn.people].sum() > 0.9 * weights[drawn.people].sum()
    assert share_of_sphere(found & ~dilated(drawn.people | drawn.shadow, 4)) < 0.005


def test_stereographic_views_invert_their_rays() -> None:
    view = stereographic_look(rolled(upright_rotation(np.array([0.3, 0.5, -0.8])), 0.2), 150.0).view
    rays = view.rays()
    offsets = np.arange(SIDE_PX) + 0.5
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(view.pixels_from_rays(rays), np.stack(np.meshgrid(offsets, offsets), axis=-1), atol=1e-6)
    edge = view.pixels_from_rays(rays[128:129, :1]) - SIDE_PX / 2
    angle = np.degrees(np.arccos(rays[128, 0] @ view.view_from_cam[2]))
    assert angle == pytest.approx(75, abs=0.6)
    assert np.linalg.norm(edge) == pytest.approx(127.5, abs=0.6)
