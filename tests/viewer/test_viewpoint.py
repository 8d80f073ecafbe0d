from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.viewer.viewpoint import Viewpoint, looking_along, outside_view

UP, AHEAD = np.array([0.0, -1, 0]), np.array([0.0, 0, 1])
SIZE = (900, 600)
angles = st.floats(-80, 80)


def test_the_windows_axes_are_those_of_a_camera() -> None:
    np.testing.assert_allclose(looking_along([1, 2, 3], AHEAD, UP).axes, np.eye(3), atol=1e-12)


def test_the_middle_of_the_window_is_the_target_and_its_edges_are_at_the_angle() -> None:
    view = Viewpoint(np.zeros(3), np.array([0.0, 0, 5]), UP, 60.0)
    np.testing.assert_allclose(view.ray(450, 300, SIZE)[1], AHEAD, atol=1e-12)
    upper = view.ray(450, 0, SIZE)[1]
    assert np.rad2deg(np.arcsin(-upper[1])) == pytest.approx(30)
    right = view.ray(900, 300, SIZE)[1]
    assert right[0] / right[2] == pytest.approx(1.5 * np.tan(np.deg2rad(30)))


@given(angles, angles, st.floats(-40, 40), st.floats(-40, 40))
def test_what_was_under_the_pointer_stays_there(azimuth: float, elevation: float, dx: float, dy: float) -> None:
    theta, phi = np.deg2rad([azimuth, elevation * 0.5])
    along = np.array([np.cos(phi) * np.sin(theta), -np.sin(phi), np.cos(phi) * np.cos(theta)])
    view = looking_along([1, 2, 3], along, UP)
    turned = view.turned(dx, dy, window_height=600)
    np.testing.assert_allclose(turned.eye, view.eye)
    seen = turned.ray(450 + dx, 300 + dy, SIZE)[1]
    # Exact for the direction, nearly for the amount: a window is flat, and turning is not.
    assert np.rad2deg(np.arccos(min(1.0, float(seen @ along)))) < 2.6
    if abs(dx) > 5:
        right = view.axes[0]
        assert np.sign(turned.axes[2] @ right) == -np.sign(dx)
    if abs(dy) > 5:
        assert np.sign(turned.axes[2] @ UP - along @ UP) == np.sign(dy)


def test_one_never_looks_over_the_pole() -> None:
    view = looking_along([0, 0, 0], AHEAD, UP)
    for _ in range(40):
        view = view.turned(0, 300, window_height=600)
    assert 0.99 < view.axes[2] @ UP < 1
    np.testing.assert_allclose(view.axes[0], [1, 0, 0], atol=1e-6)


def test_zooming_keeps_within_reason() -> None:
    view = looking_along([0, 0, 0], AHEAD, UP)
    assert view.zoomed(1).angle_deg < view.angle_deg < view.zoomed(-1).angle_deg
    assert view.zoomed(99).angle_deg == 15
    assert view.zoomed(-99).angle_deg == 110


@pytest.mark.parametrize("name", ["overview", "top", "front"])
@pytest.mark.parametrize("aspect", [0.6, 1.0, 2.0])
def test_all_of_the_scene_is_in_the_window(name: str, aspect: float) -> None:
    rng = np.random.default_rng(3)
    box = np.sort(rng.normal(size=(2, 3)) * [4, 1, 9], axis=0)
    view = outside_view(name, box, UP, ahead=AHEAD, aspect=aspect)
    right, down, forward = view.axes
    for corner in np.array(np.meshgrid(*box.T)).reshape(3, -1).T - view.eye:
        depth = view.height / 2 if view.height else (corner @ forward) * np.tan(np.deg2rad(view.angle_deg) / 2)
        assert corner @ forward > 0
        assert abs(corner @ down) <= depth
        assert abs(corner @ right) <= depth * aspect
    if name == "top":
        np.testing.assert_allclose([right, down, forward], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
