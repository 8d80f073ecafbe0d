"""Families of generated captures, small enough to solve several hundred of them, some with wrong cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from pano_mvs.geometry import Rigid3, rotate_panorama, rotation_from_rotvec
from tests.synthetic import scenes
from tests.synthetic.places import large_plain_room
from tests.synthetic.scenes import Scene
from tools.benchmarks.poses.captures_with_truth import Cameras, Pictures
from tools.benchmarks.poses.house_of_rooms import House
from tools.benchmarks.poses.house_walk import walk_poses, walk_view
from tools.benchmarks.poses.suite_of_rooms import suite_poses, suite_view
from tools.benchmarks.poses.tours.plan import Style, build
from tools.benchmarks.poses.tours.rendering import lit, panorama
from tools.benchmarks.repeating.places import REPEATS, draw_sizes
from tools.benchmarks.repeating.walks import LAYOUTS

WIDTH = 384
SIZE_HW = (WIDTH // 2, WIDTH)
LARGE, LEARNED = "/large", "/learned"
"""Ends of the names of families of 12 to 20 views, and of those with learned matches where SIFT is weak."""
_LEARNED_HW = (512, 1024)  # the networks see level views, of which smaller pictures leave too little


@dataclass(frozen=True)
class Capture:
    """A drawn capture.

    Attributes:
        family: name of its family; what comes before a slash is the kind of place.
        seed: of the draw.
        pictures: panoramas by image name.
        truth: true cam_from_world by image name; without copies and cropped images, which have no true pose.
        note: what was drawn.
    """

    family: str
    seed: int
    pictures: Pictures
    truth: Cameras
    note: str


def draw(family: str, seed: int) -> Capture:
    """Return the capture of a family with a seed."""
    rng = np.random.default_rng([seed, sum(map(ord, family))])
    pictures, truth, note = FAMILIES[family](seed, rng)
    return Capture(family, seed, pictures, truth, note)


Drawn = tuple[Pictures, Cameras, str]
Views = Callable[[np.random.Generator], int]


def _few(rng: np.random.Generator) -> int:
    """Return a number of views: mostly few, because more small captures say more than few large ones."""
    return int(rng.choice([3, 4, 4, 5, 5, 6, 7, 9]))


def _many(rng: np.random.Generator) -> int:
    return int(rng.integers(12, 21))


def _some(rng: np.random.Generator) -> int:
    return int(rng.integers(8, 13))


def _of_scene(scene: Scene, note: str = "") -> Drawn:
    pictures = {f"{idx:03d}.png": scene.view(idx, SIZE_HW, supersample=1)[0] for idx in range(len(scene.poses))}
    return pictures, dict(zip(pictures, scene.poses, strict=True)), note or scene.name


def _repeating(place: str, number: Views = _few) -> Callable[[int, np.random.Generator], Drawn]:
    def drawn(seed: int, rng: np.random.Generator) -> Drawn:
        views = number(rng)
        visit = {
            "seed": seed,
            "views": views,
            "unique": 0.0 if rng.random() < 0.2 else round(float(rng.uniform(0.1, 1.0)), 2),
            "layout": LAYOUTS[rng.integers(len(LAYOUTS))] if views > 4 else "unordered",
            "turned": bool(rng.random() < 0.3),
        }
        return _of_scene(REPEATS[place](**visit, **draw_sizes(place, rng, views)), f"unique {visit['unique']}")

    return drawn


def _plain(seed: int, rng: np.random.Generator) -> Drawn:
    place = (scenes.white_room, scenes.weak_room, large_plain_room)[rng.integers(3)]
    return _of_scene(place(seed=seed, views=_few(rng), turned=bool(rng.random() < 0.3)))


def _textured(seed: int, rng: np.random.Generator) -> Drawn:
    place = (scenes.poles, scenes.desk, scenes.corridor)[rng.integers(3)]
    return _of_scene(place(seed=seed, views=_few(rng), turned=bool(rng.random() < 0.3)))


def _outdoor(seed: int, rng: np.random.Generator, *, views: Views = _few) -> Drawn:
    return _of_scene(scenes.courtyard(seed=seed, views=views(rng), exposure=0.1 * rng.random()))


def _three(seed: int, rng: np.random.Generator) -> Drawn:
    if rng.random() < 0.5:
        place = (scenes.white_room, scenes.courtyard, scenes.weak_room, scenes.desk)[rng.integers(4)]
        return _of_scene(place(seed=seed, views=3))
    name = list(REPEATS)[rng.integers(len(REPEATS))]
    arguments = draw_sizes(name, rng, 3)
    return _of_scene(
        REPEATS[name](seed=seed, views=3, unique=float(rng.uniform(0, 1)), layout="unordered", **arguments)
    )


def _house(
    twins: bool, *, rooms: tuple[int, int] = (2, 3), size_hw: tuple[int, int] = SIZE_HW
) -> Callable[[int, np.random.Generator], Drawn]:
    def drawn(seed: int, rng: np.random.Generator) -> Drawn:
        per_room = int(rng.integers(2, 4))
        house = House(seed=seed, twins=twins, per_room=per_room, rooms=int(rng.integers(*rooms)))
        truth = {f"{idx:03d}.png": pose for idx, pose in enumerate(house.poses())}
        return {name: house.view(idx, size_hw) for idx, name in enumerate(truth)}, truth, f"{house.rooms} rooms"

    return drawn


def _walk(seed: int, rng: np.random.Generator, *, views: Views = _few) -> Drawn:
    twins = bool(rng.random() < 0.5)
    first, count, step = int(rng.integers(0, 150)), views(rng), int(rng.integers(1, 4))
    poses = walk_poses(300, seed=seed)[first : first + step * count : step]
    truth = {f"{idx:03d}.png": pose for idx, pose in enumerate(poses)}
    pictures = {name: walk_view(pose, SIZE_HW, twins=twins, seed=seed) for name, pose in truth.items()}
    return pictures, truth, f"step {step}"


def _suite(seed: int, rng: np.random.Generator, *, number: Views = _few) -> Drawn:
    views, step = 20, int(rng.integers(1, 4 if number is _few else 2))
    poses = suite_poses(views, seed=seed)[::step][: number(rng)]
    truth = {f"{idx:03d}.png": pose for idx, pose in enumerate(poses)}
    return (
        {name: suite_view(pose, SIZE_HW, views=views, seed=seed) for name, pose in truth.items()},
        truth,
        f"step {step}",
    )


def _tour(seed: int, rng: np.random.Generator, *, views: Views = _few, size_hw: tuple[int, int] = SIZE_HW) -> Drawn:
    small = size_hw == SIZE_HW
    equal = bool(rng.random() < (0.5 if small else 0.3))
    style = Style(
        float(rng.uniform(6, 10)),
        equal=equal,
        empty=0.0 if equal else float(rng.choice([0.0, 0.4])),
        spacing=float(rng.uniform(1.4, 2.4)),
    )
    boxes, cameras = build(style, seed=1000 + seed)
    first = int(rng.integers(0, max(1, len(cameras) - (8 if views is _few else 12))))
    house = lit(boxes, seed=seed)
    chosen = cameras[first : first + views(rng)]
    truth = {f"{idx:03d}.png": camera.pose for idx, camera in enumerate(chosen)}
    pictures = {
        name: panorama(house, pose, size_hw=size_hw, rng=rng, tripod=True, fine=small) for name, pose in truth.items()
    }
    return pictures, truth, "equal desks" if equal else "rooms"


def _any(seed: int, rng: np.random.Generator) -> Drawn:
    """Return a capture of a family in which nothing was done to the pictures."""
    kind = ("hall", "colonnade", "plain", "textured", "outdoor", "suite")[rng.integers(6)]
    return FAMILIES[kind](seed + 5000, rng)


def _copies(seed: int, rng: np.random.Generator) -> Drawn:
    """Return a capture with copies of one or two pictures, some of them rolled."""
    pictures, truth, note = _any(seed, rng)
    for number, name in enumerate(list(pictures)[: int(rng.integers(1, 3))]):
        yaw = float(rng.uniform(-np.pi, np.pi)) if rng.random() < 0.5 else 0.0
        turn = rotation_from_rotvec((0.0, yaw, 0.0))
        copy = f"copy{number}.png"
        pictures[copy] = rotate_panorama(pictures[name], turn) if yaw else pictures[name]
        truth[copy] = Rigid3(turn, np.zeros(3)) @ truth[name]
    return pictures, truth, f"copies of {note}"


def _cropped(seed: int, rng: np.random.Generator) -> Drawn:
    """Return a capture whose pictures were cropped above and below, and stretched to twice as wide as high."""
    pictures, truth, note = _any(seed, rng)
    rows = round(SIZE_HW[0] * float(rng.uniform(0.03, 0.12)))
    squeezed = {
        name: cv2.resize(image[rows : SIZE_HW[0] - rows], SIZE_HW[::-1], interpolation=cv2.INTER_AREA)
        for name, image in pictures.items()
    }
    return squeezed, truth, f"{rows} rows cropped from {note}"


FAMILIES: dict[str, Callable[[int, np.random.Generator], Drawn]] = {
    "hall": _repeating("tiled_hall"),
    "colonnade": _repeating("colonnade"),
    "street": _repeating("facade_row"),
    "corridor": _repeating("doors"),
    "twin_rooms": _repeating("twin_rooms"),
    "stairs": _repeating("stairs"),
    "plain": _plain,
    "textured": _textured,
    "outdoor": _outdoor,
    "three": _three,
    "house": _house(False),
    "twin_house": _house(True),
    "walk": _walk,
    "suite": _suite,
    "tour": _tour,
    "copies": _copies,
    "cropped": _cropped,
    f"hall{LARGE}": _repeating("tiled_hall", _many),
    f"colonnade{LARGE}": _repeating("colonnade", _many),
    f"corridor{LARGE}": _repeating("doors", _many),
    f"street{LARGE}": _repeating("facade_row", _many),
    f"outdoor{LARGE}": partial(_outdoor, views=_many),
    f"house{LARGE}": _house(False, rooms=(6, 7)),
    f"walk{LARGE}": partial(_walk, views=_many),
    f"suite{LARGE}": partial(_suite, number=_many),
    f"tour{LEARNED}": partial(_tour, views=_some, size_hw=_LEARNED_HW),
    f"house{LEARNED}": _house(False, rooms=(3, 6), size_hw=_LEARNED_HW),
    f"twin_house{LEARNED}": _house(True, rooms=(3, 6), size_hw=_LEARNED_HW),
}
