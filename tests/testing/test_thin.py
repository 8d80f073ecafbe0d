"""The rooms with thin objects."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.testing.scenes import poles
from pano_mvs.testing.surfaces import Rod
from tests.synthetic.thin import THIN_KINDS, thin_pixels, thin_scene


@pytest.mark.parametrize("kind", THIN_KINDS)
def test_thin_pixels_are_few_narrow_and_nearer_than_the_room(kind: str) -> None:
    scene = thin_scene(kind, width=256, seed=3, turned=False)
    _, truth = scene.view(0, (64, 128), supersample=1)
    thin = thin_pixels(scene, 0, truth)
    assert 0.01 < thin.mean() < 0.15
    assert truth[thin].mean() < truth[~thin].mean()
    # Most pixels that are thin have one near them that is not.
    alone = ~(np.roll(thin, 2, 0) & np.roll(thin, -2, 0) & np.roll(thin, 2, 1) & np.roll(thin, -2, 1))
    assert alone[thin].mean() > 0.5


def test_the_thickness_refers_to_the_given_width() -> None:
    wide, narrow = (thin_scene("wires", width=width, seed=1).room.surfaces[-1] for width in (256, 512))
    assert isinstance(wide, Rod)
    assert isinstance(narrow, Rod)
    assert wide.radius == pytest.approx(2 * narrow.radius)


def test_poles_are_thin_too() -> None:
    scene = poles(seed=3)
    _, truth = scene.view(0, (32, 64), supersample=1)
    assert 0 < thin_pixels(scene, 0, truth).mean() < 0.1
