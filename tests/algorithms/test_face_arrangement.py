"""Faces of a cube are put in the order in which the picture continues across their edges."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import arranged_faces
from pano_mvs.algorithms.faces.sampling import CUBE
from tests.io.images.tours import face_of

Faces = dict[str, NDArray[np.uint8]]


def rendered() -> Faces:
    return {name: face_of(name) for name in CUBE}


def test_a_cube_in_order_stays() -> None:
    faces, rearranged = arranged_faces(rendered())
    assert not rearranged
    assert all(np.array_equal(faces[name], face) for name, face in rendered().items())


@pytest.mark.parametrize("seed", range(12))
def test_any_order_and_quarter_turns_are_undone(seed: int) -> None:
    """The face in front stays, as it says where the middle of the panorama is."""
    rng = np.random.default_rng(seed)
    names = list(CUBE)
    order = ["f", *rng.permutation(names[1:]).tolist()]
    mixed = {name: rendered()[other] for name, other in zip(names, order, strict=True)}
    turned = {name: np.rot90(face, 0 if name == "f" else int(rng.integers(4))) for name, face in mixed.items()}
    faces, rearranged = arranged_faces(turned)
    assert rearranged
    for name, face in rendered().items():
        assert np.array_equal(faces[name], face), name


def test_faces_that_fit_nowhere_stay() -> None:
    rng = np.random.default_rng(5)
    noise = {name: rng.integers(0, 255, (64, 64, 3)).astype(np.uint8) for name in CUBE}
    faces, rearranged = arranged_faces(noise)
    assert not rearranged
    assert all(np.array_equal(faces[name], face) for name, face in noise.items())


def test_faces_of_one_colour_stay() -> None:
    plain = {name: np.full((8, 8, 3), 200, np.uint8) for name in CUBE}
    assert not arranged_faces(plain)[1]
