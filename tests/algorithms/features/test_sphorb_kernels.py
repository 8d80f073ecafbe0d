"""The compiled parts of SPHORB equal the obvious ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.features import kernels_sphorb as kernels
from pano_mvs.algorithms.features.sphorb import NEIGHBOURS, GeodesicGrid, binary_tests, hexagon_ring, lattice_disc
from tests.oracles import features as oracle

STEPS, MARGIN = 12, 9
SIDE = STEPS + 1 + 2 * MARGIN
GRID = GeodesicGrid(STEPS, MARGIN)
# Tangent steps to lattice steps, with the shear that a face has near its corners.
TURN = np.array([[0.9, -0.4], [0.1, 1.1]])

pytestmark = pytest.mark.kernel("features.kernels_sphorb")


@pytest.fixture(scope="module")
def pictures() -> NDArray[np.uint8]:
    """Two faces of smooth noise, with plain areas that make ties."""
    noise = np.random.default_rng(5).integers(0, 256, size=(2, SIDE, SIDE)).astype(np.uint8)
    smooth = np.stack([cv2.GaussianBlur(face, (0, 0), 1.2) for face in noise])
    smooth[:, 12:15, 10:14] = 90
    return smooth


def owned_cells(reach: int) -> list[tuple[int, int]]:
    return [(v, u) for v in range(-reach, STEPS + reach + 1) for u in range(-reach, STEPS + reach - v + 1)]


def test_ring_of_the_kernel_is_that_of_the_oracle() -> None:
    assert hexagon_ring(3)[:, ::-1].tolist() == [list(cell) for cell in oracle.ring_of_three()]
    assert [[c, r] for r, c in oracle.STEPS] == NEIGHBOURS.tolist()


@pytest.mark.slow
def test_segment_test_equals_the_plain_one(pictures: NDArray[np.uint8]) -> None:
    threshold = 3
    scores = np.zeros_like(pictures)
    kernels.score_corners(pictures, GRID.ring_offsets, MARGIN, 2, threshold, scores)
    expected = np.zeros_like(scores)
    for face in range(2):
        for v, u in owned_cells(2):
            at = (v + MARGIN, u + MARGIN)
            expected[face][at] = oracle.segment_score(pictures[face], *at, threshold)
    assert np.count_nonzero(expected) > 10
    np.testing.assert_array_equal(scores, expected)


def test_local_maxima_equal_the_plain_ones() -> None:
    """With few different scores, so that many are equal: exactly the first of equals stays."""
    scores = np.random.default_rng(6).integers(0, 4, size=(2, SIDE, SIDE)).astype(np.uint8)
    cells = np.empty((scores.size, 3), np.int64)
    cells = cells[: kernels.local_maxima(scores, GRID.flat_offsets(NEIGHBOURS), MARGIN, 1, cells)]
    expected = []
    for face in range(2):
        for v, u in owned_cells(1):
            row, column = v + MARGIN, u + MARGIN
            others = {(dr, dc): scores[face, row + dr, column + dc] for dr, dc in oracle.STEPS}
            own = scores[face, row, column]
            earlier = max(value for step, value in others.items() if step < (0, 0))
            later = max(value for step, value in others.items() if step > (0, 0))
            if own > 0 and own > earlier and own >= later:
                expected.append([face, v, u])
    assert cells.tolist() == expected


@pytest.mark.slow
def test_refinement_equals_climbing_the_plain_response(pictures: NDArray[np.uint8]) -> None:
    cells = np.array([[f, v, u] for f in range(2) for v, u in owned_cells(0)][::6], np.int64)
    window = np.concatenate([np.zeros((1, 2), np.int64), hexagon_ring(1), hexagon_ring(2)])
    plane = window @ np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
    weights = np.exp(-0.5 * np.sum(plane**2, axis=1) / 1.1**2) / 255**2
    places, responses = np.empty((len(cells), 2)), np.empty(len(cells))
    neighbours = GRID.flat_offsets(NEIGHBOURS)
    kernels.refine_corners(pictures, cells, GRID.flat_offsets(window), weights, neighbours, MARGIN, places, responses)
    moved = 0
    for (face, v, u), place, response in zip(cells, places, responses, strict=True):

        def plain(cell: tuple[int, int], face: np.int64 = face) -> float:
            return oracle.harris_response(pictures[face], cell[0] + MARGIN, cell[1] + MARGIN, radius=2, sigma=1.1)

        cell = (int(v), int(u))
        for _ in range(2):
            around = {(cell[0] + r, cell[1] + c): plain((cell[0] + r, cell[1] + c)) for r, c in oracle.STEPS}
            best = max(around, key=lambda key: around[key])
            if around[best] <= plain(cell):
                break
            cell, moved = best, moved + 1
        assert response == pytest.approx(plain(cell), rel=1e-9, abs=1e-9)
        values = np.array([plain((cell[0] + r, cell[1] + c)) for r, c in oracle.STEPS])
        offset = kernels.hexagon_peak(plain(cell), values)
        np.testing.assert_allclose(place, [cell[1] + offset[0], cell[0] + offset[1]], atol=1e-6)
    assert moved > 20


def test_peak_of_a_paraboloid_is_found_exactly() -> None:
    rng = np.random.default_rng(7)
    steps = NEIGHBOURS @ np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
    for _ in range(200):
        root = rng.normal(size=(2, 2))
        curvature = root @ root.T + 0.1 * np.eye(2)
        top_uv = rng.uniform(-0.4, 0.4, size=2)
        top = top_uv @ np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])

        def value(
            place: NDArray[np.float64], top: NDArray[np.float64] = top, curvature: NDArray[np.float64] = curvature
        ) -> float:
            return float(3.0 - (place - top) @ curvature @ (place - top))

        around = np.array([value(step) for step in steps])
        np.testing.assert_allclose(kernels.hexagon_peak(value(np.zeros(2)), around), top_uv, atol=1e-9)


def test_a_saddle_or_a_far_peak_moves_nothing() -> None:
    assert kernels.hexagon_peak(0.0, np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])) == (0.0, 0.0)
    assert kernels.hexagon_peak(0.0, np.array([1.0, 0.5, -0.6, -1.1, -0.6, 0.5])) == (0.0, 0.0)


def test_descriptors_equal_the_plain_ones(pictures: NDArray[np.uint8]) -> None:
    rng = np.random.default_rng(8)
    faces = np.array([0, 1, 1, 0], np.int64)
    places = rng.uniform(3, 5, size=(4, 2))
    turns = np.repeat(TURN[None], 4, axis=0)
    tests = binary_tests()[:64] * (5 / 15)
    angles, bits = np.empty(4), np.empty((4, 8), np.uint8)
    kernels.describe_corners(pictures, faces, places, turns, lattice_disc(5), tests, MARGIN, angles, bits)
    for n in range(4):
        u, v = places[n] + MARGIN
        angle = oracle.orientation(pictures[faces[n]], u, v, TURN, radius=5)
        assert angles[n] == pytest.approx(angle, abs=1e-9)
        brighter = oracle.descriptor(pictures[faces[n]], u, v, TURN, tests=tests, angle=angle)
        clear = np.abs(brighter) > 1e-9
        unpacked = np.unpackbits(bits[n], bitorder="little").astype(bool)
        np.testing.assert_array_equal(unpacked[clear], (brighter > 0)[clear])
        assert 10 < np.sum(brighter > 0) < 54


def test_clear_discs_equal_the_plain_ones() -> None:
    rng = np.random.default_rng(9)
    valid = (rng.random((2, SIDE, SIDE)) > 0.01).astype(np.uint8)
    faces, places = rng.integers(0, 2, 60), rng.uniform(0, 8, size=(60, 2))
    clear = np.empty(60, np.bool_)
    kernels.disc_is_clear(valid, faces, places, np.repeat(TURN[None], 60, axis=0), lattice_disc(4), MARGIN, clear)
    for n in range(60):
        cells = np.floor(places[n] + MARGIN + oracle.disc_steps(4) @ TURN.T + 0.5).astype(int)
        assert clear[n] == all(valid[faces[n], row, column] for column, row in cells)
    assert 0 < clear.sum() < 60
