"""Rooms of single panoramas, as stages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.api import Context, FilePart, Panorama, RoomLines, SceneLink
from pano_mvs.scene.image_file import write_png
from pano_mvs.stages.features_rooms import RoomParams, ceilings, room_lines, rooms
from tests.synthetic.drawn_rooms import SIZE_HW, box, true_distances


@pytest.fixture
def ctx(tmp_path: Path) -> Context:
    return Context(np.random.default_rng(0), tmp_path, 1)


@pytest.fixture
def image(tmp_path: Path) -> Panorama:
    write_png(tmp_path / "room.png", box())
    return Panorama(FilePart(tmp_path / "room.png"), SIZE_HW, SIZE_HW)


@pytest.mark.slow
def test_from_a_picture_to_its_room(image: Panorama, ctx: Context) -> None:
    lines = room_lines(image, RoomParams(), ctx)
    found = rooms(image, lines, ceilings({"room.png": lines}), ctx)
    assert np.median(np.abs(found.distances / true_distances() - 1)) < 0.01
    assert ctx.metrics["ceiling"] == pytest.approx(0.7, rel=0.02)
    assert not ctx.notes


def test_only_scenes_of_a_tour_are_looked_at_if_so_wanted(image: Panorama, ctx: Context) -> None:
    wanted = RoomParams(only_linked=True)
    for links in ((), (SceneLink("b"),)):
        lines = room_lines(replace(image, links=links), wanted, ctx)
        assert lines.wall_rad is None
        assert rooms(image, lines, ceilings({"room.png": lines}), ctx).ceiling is None
    assert room_lines(replace(image, links=(SceneLink("b", (30.0, -10.0)),)), wanted, ctx).wall_rad is not None
    assert not ctx.notes


def test_a_picture_without_walls_is_noted(tmp_path: Path, ctx: Context) -> None:
    write_png(tmp_path / "sky.png", np.full((*SIZE_HW, 3), 200, np.uint8))
    blank = Panorama(FilePart(tmp_path / "sky.png"), SIZE_HW, SIZE_HW)
    assert room_lines(blank, RoomParams(), ctx).wall_rad is None
    assert ctx.notes == ["{count} panoramas show no walls at right angles, so that their rooms are not known"]
    assert not ceilings({"sky.png": RoomLines.unknown()}).clarity.any()
