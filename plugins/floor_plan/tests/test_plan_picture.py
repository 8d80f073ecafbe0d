"""The picture of a plan."""

from __future__ import annotations

import numpy as np
from pano_mvs_floor_plan.plan_drawings import COLORS, DrawnRoom, PlanDrawing, draw_plan


def test_the_picture_shows_the_plan_and_a_bar_of_its_length() -> None:
    room = DrawnRoom(np.zeros((0, 2)), ["6.0 m²", "3.00 × 2.00 m"], np.array([1.0, 1.0]))
    plan = PlanDrawing(
        "plan",
        np.array([[[0.5, 0.5], [3.5, 0.5]]]),
        [np.array([[0.5, 1.8], [1.5, 1.8], [1.5, 1.6], [0.5, 1.6]])],
        [("door", np.array([[2.5, 1.0], [3.0, 1.0]]))],
        [room, DrawnRoom(np.zeros((0, 2)), ["1.0 m²"], np.array([3.2, 1.6]))],
        {"a.jpg": (2.0, 1.5)},
        ((0.0, 0.0), (4.0, 2.0)),
        1.0,
        "m",
        is_metric=True,
    )
    blank = np.zeros((200, 400, 3), np.uint8), np.zeros((200, 400), np.bool_)
    picture = draw_plan(*blank, plan)
    assert picture.shape == (236, 400, 3)
    dark = picture.max(axis=-1) < 100
    assert dark[149:151, 60:340].all(axis=1).any()
    assert dark[25:35, 60:140].all()
    assert picture[50, 200].tolist() == list(COLORS["camera"])
    assert picture[100, 275].tolist() == list(COLORS["door"])
    for rows in (slice(74, 86), slice(88, 100)):  # the area, and below it the size
        assert (picture[rows, 60:140].max(axis=-1) < 200).any()
    assert (picture[10:40, 290:350].max(axis=-1) < 200).any()  # the area of the other room
    bar = np.flatnonzero(dark[200 + 18])
    longest = max(np.split(bar, np.flatnonzero(np.diff(bar) > 1) + 1), key=len)
    assert abs(len(longest) - 100) <= 3  # 1 m
