"""A band of rows looked up in a source: packed, projected and blended by any path, equals exact sampling."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.arguments import pack_colors, pack_plane, pack_sources, pack_votes
from pano_mvs.algorithms.sweep.numba.kernels_cost import add_differences, census_row, count_census_row, interleave_rows
from pano_mvs.algorithms.sweep.numba.kernels_lookup import knot_rows, vote_row, warp_band
from pano_mvs.algorithms.sweep.numba.kernels_records import Lookup, Sources
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR, _lanes_of_this_machine
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_from_ray, ray_grid, rotation_from_rotvec, sample_panorama
from tests.oracles import sweep as oracle

SIZE = 16, 32
ROTATION = rotation_from_rotvec((0.4, -1.9, 0.7))
needs_vector = pytest.mark.skipif(not HAS_VECTOR, reason="no vector instructions, or numba compiles nothing")
TRANSLATIONS = [(0.0, 0.0, 0.0), (0.3, -0.2, 0.5), (0.0, 0.9, 0.0), (0.0, 0.0, -0.99)]


def _picture(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def _warped(
    source: NDArray[np.uint8],
    translation: tuple[float, float, float],
    size_hw: tuple[int, int],
    *,
    vector: bool,
    halo: int = 3,
    pad: int = 4,
    first: int = 0,
    rows: int | None = None,
    against: NDArray[Any] | None = None,
) -> NDArray[Any]:
    height, width = size_hw
    rows = rows or height
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    sin_cos = np.stack([np.sin(azimuth), np.cos(azimuth)]).astype(np.float32)
    packed, colors, starts = pack_sources([source], vector=vector)
    warped = np.zeros((source.shape[2], rows + 2 * halo, width + 2 * pad), np.uint8)
    votes = np.zeros((rows + 2 * halo, width), np.uint8)
    knots = np.zeros((2, knot_rows(rows + 2 * halo), width), np.float32)
    valid = np.ones((source.shape[0] + 1) * (source.shape[1] + 2), np.uint8)
    against = np.zeros((0, width), np.uint32) if against is None else against
    pixel_costs = np.zeros((rows + 2 * halo, width + 2 * pad), np.uint16)
    shapes, poses = np.array([source.shape[:2]]), np.column_stack([ROTATION, translation])[None]
    masked = np.array([[0, valid.size]])  # none is, but all are asked
    sources = Sources(poses, packed, colors, starts, shapes, valid, np.zeros(1, np.int64), masked, vector)
    found = Lookup(knots, warped, votes, against, pixel_costs)
    warp_band(first - halo, height, sin_cos, sources, 0, True, 1.3, pad, found)
    assert votes.all()
    return pixel_costs if len(against) else warped


@pytest.mark.kernel("sweep.numba.kernels_lookup")
@pytest.mark.parametrize("source_hw", [(16, 32), (24, 48), (16, 64)])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("translation", TRANSLATIONS)
@pytest.mark.parametrize("vector", [False, pytest.param(True, marks=needs_vector)])
def test_a_warped_band_equals_exact_sampling_even_beyond_the_poles(
    source_hw: tuple[int, int], channels: int, translation: tuple[float, float, float], vector: bool
) -> None:
    source = _picture(1, (*source_hw, channels))
    warped = _warped(source, translation, SIZE, vector=vector)
    exact = sample_panorama(source, pixel_from_ray(ray_grid(SIZE) * 1.3 @ ROTATION.T + translation, source_hw))
    for color in range(channels):
        expected = np.pad(pad_panorama(exact[..., color], 3)[:, 3:-3], ((0, 0), (4, 4)), mode="wrap")
        # Half a level is rounding; the rest is what 1e-4 px of float32 projection makes of white noise.
        assert np.abs(warped[color] - expected).max() < 0.6


@pytest.mark.kernel("sweep.numba.kernels_lookup")
def test_rows_vote_as_their_patches_do_wherever_the_mask_is() -> None:
    """Rows that are looked up above or below the masked rows are not looked up one by one."""
    masks = [np.ones(SIZE, np.bool_) for _ in range(3)]
    masks[1][9:11, 4:20] = False
    masks[2][0, 0] = masks[2][15, 31] = False
    valid, starts, masked = pack_votes(_masked_input(tuple(masks)))
    stride = SIZE[1] + 2
    patches = [(valid[start : start + 17 * stride] == 0).reshape(17, stride) for start in starts]
    assert masked[0, 0] == masked[0, 1] == 0
    assert not patches[0].any()
    assert np.argwhere(patches[1])[[0, -1]].tolist() == [[9, 4], [11, 20]]
    for source in range(3):
        for row in range(17):
            index = np.arange(row * stride, row * stride + SIZE[1] + 1, dtype=np.int32)
            votes = np.full((2, len(index)), 7, np.uint8)
            vote_row(valid, starts[source], *masked[source], index, votes, 1)
            expected = 7 if source == 0 else ~patches[source][row, :-1]
            np.testing.assert_array_equal(votes[1], np.broadcast_to(expected, len(index)))
            assert (votes[0] == 7).all()


def _masked_input(masks: tuple[NDArray[np.bool_], ...]) -> SweepInput:
    grey, settings = _picture(1, (*SIZE, 1)), SweepSettings()
    poses = tuple(Rigid3(ROTATION, np.ones(3)) for _ in masks)
    return SweepInput(grey, (grey,) * len(masks), poses, masks, np.array([1.0, 2.0, 3.0]), settings)


@pytest.mark.parametrize("translation", TRANSLATIONS)
def test_interpolated_positions_miss_by_little(translation: tuple[float, float, float]) -> None:
    height, width = 256, 16  # positions are interpolated along columns
    ramp = (np.arange(height)[:, None] % 32 * 4 + np.abs(np.arange(512) % 64 - 32) * 3).astype(np.uint8)[..., None]
    warped = _warped(ramp, translation, (height, width), vector=HAS_VECTOR)
    pixels = pixel_from_ray(ray_grid((height, width)) * 1.3 @ ROTATION.T + translation, ramp.shape[:2])
    difference = np.abs(warped[0, 3:-3, 4:-4] - sample_panorama(ramp, pixels)[..., 0])
    assert np.mean(difference < 0.75) > 0.99
    assert difference.max() < 124 * 0.08 + 0.5  # 0.08 px over the steepest step


@pytest.mark.parametrize(
    ("features", "lanes"), [("", 0), ("+sse2", 0), ("+ssse3,-avx2", 1), ("+avx2, +ssse3", 2), ("+avx512bw,+avx2", 4)]
)
def test_instructions_that_numba_must_not_use_are_left_unused(
    features: str, lanes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NUMBA_CPU_NAME=generic once ended the process: the instructions of the processor could not be compiled."""
    monkeypatch.setattr(numba.config, "CPU_FEATURES", features)
    assert _lanes_of_this_machine() == lanes


@needs_vector
@pytest.mark.kernel("sweep.numba.kernels_lookup", "sweep.numba.x86.kernels_vector")
@pytest.mark.parametrize("channels", [1, 3])
def test_vector_instructions_give_what_loops_give(channels: int) -> None:
    source = _picture(2, (64, 128, channels))
    loops = _warped(source, TRANSLATIONS[1], (48, 100), vector=False, first=5, rows=8)
    instructions = _warped(source, TRANSLATIONS[1], (48, 100), vector=True, first=5, rows=8)
    assert loops.tobytes() == instructions.tobytes()
    assert loops.std() > 30


@needs_vector
@pytest.mark.kernel("sweep.numba.kernels_lookup", "sweep.numba.x86.kernels_vector")
def test_differences_added_while_sampling_are_those_of_what_is_sampled() -> None:
    reference, source = _picture(4, (3, 56, 72)), _picture(5, (64, 128, 3))
    warped = _warped(source, TRANSLATIONS[1], (48, 64), vector=True, first=5, rows=8)
    expected = np.zeros(warped.shape[1:], np.uint16)
    add_differences(reference, 20, warped, 4, expected)
    added = _warped(
        source, TRANSLATIONS[1], (48, 64), vector=True, first=5, rows=8, against=interleave_rows(reference, 20, 14, 4)
    )
    assert added[:, 4:-4].tolist() == expected[:, 4:-4].tolist()
    whole = np.abs(reference[:, 20:34, 4:-4].astype(int) - warped[..., 4:-4]).sum(axis=0)
    assert added[:, 4:-4].tolist() == whole.tolist()


def test_packed_patches_hold_the_four_neighbours_over_seam_and_poles() -> None:
    source = _picture(2, (*SIZE, 3))
    packed, colors = pack_plane(source[..., 1]), pack_colors(source)
    assert packed.shape == colors.shape == (SIZE[0] + 1, SIZE[1] + 2)
    for row, column in [(0, 0), (0, 32), (16, 0), (16, 32), (7, 32), (5, 9)]:
        corners = [oracle.pixel_at(source[..., 1], row - 1 + j, column - 1 + i) for i in (0, 1) for j in (0, 1)]
        assert list(packed[row, column : column + 1].view(np.uint8) ^ 128) == corners
        both = colors[row, column : column + 2].view(np.uint8).reshape(2, 4, 2) ^ 128
        assert both[:, 1].ravel().tolist() == corners


@pytest.mark.kernel("sweep.numba.kernels_cost")
@pytest.mark.parametrize("side", [3, 7, 15])
@pytest.mark.parametrize("width", [20, 64, 100])
def test_census_by_vector_instructions_counts_what_loops_count(side: int, width: int) -> None:
    pad = 40
    reference, warped = _picture(3, (side + 2, width + 2 * pad)) // 16, _picture(4, (side, width + 2 * pad)) // 16
    offsets = np.rint(np.linspace(-30, 30, side)).astype(np.int64)
    expected, counted = np.zeros(width, np.uint8), np.zeros(width, np.uint8)
    census_row(reference, side // 2 + 2, warped, side // 2, offsets, pad, expected)
    count_census_row(reference, side // 2 + 2, warped, side // 2, offsets, pad, counted)
    assert counted.tolist() == expected.tolist()
    assert len(set(expected)) > 3
