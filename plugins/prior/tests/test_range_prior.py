"""Ranges of a network: aligned to measured ones piece by piece, used only where nothing was seen, refused if wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pano_mvs_prior.range_prior import fill_from_prior, network_values

from pano_mvs.algorithms.learned.networks import open_network
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import MIRROR_CONFIDENCE, WINDOW_CONFIDENCE
from tests.algorithms.learned.grey_network import GREY_NETWORK
from tests.algorithms.range_scenes import SEEN, TRUSTED, as_map, box_range

SIZE = (128, 256)
TRUTH, NORMALS = box_range(SIZE)
WALL = np.argmax(np.abs(NORMALS), axis=-1) * 2 + (NORMALS.sum(axis=-1) > 0)
GUIDE = np.repeat((40 * WALL + 20)[..., None], 3, axis=-1).astype(np.uint8)
HOLE = ray_grid(SIZE) @ np.array([0.6, 0.0, 0.8]) > np.cos(np.deg2rad(15))
FILLED = 20


def measured(confidence: int = TRUSTED) -> RangeMap:
    """The box with a hole that was filled with ranges a third too large, and every second other pixel unconfirmed."""
    seen = np.where(np.indices(SIZE).sum(axis=0) % 2 == 0, confidence, SEEN)
    return as_map(np.where(HOLE, 1.33 * TRUTH, TRUTH), np.where(HOLE, FILLED, seen))


def relative_errors(ranges: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.abs(np.asarray(ranges / TRUTH, np.float64) - 1)


@pytest.mark.parametrize("output", ["range", "inverse_range"])
def test_values_of_any_scale_and_zero_give_the_ranges(output: str) -> None:
    prior = 7.0 * TRUTH if output == "range" else 0.4 - 3.0 / TRUTH
    found, error = fill_from_prior(measured(), GUIDE, prior.astype(np.float32), output=output)  # type: ignore[arg-type]
    assert error < 0.002
    assert np.nanmax(relative_errors(found.range)[HOLE]) < 0.01
    assert np.isfinite(found.range[HOLE]).mean() > 0.99
    assert (found.confidence[HOLE] < SEEN).all()
    np.testing.assert_array_equal(found.range[~HOLE], TRUTH[~HOLE])


def test_each_surface_gets_its_own_correction() -> None:
    """The network's walls are wrong by up to 20 %, each by another share."""
    wrong = np.array([0.8, 1.2, 0.9, 1.1, 1.15, 0.95])[WALL]
    found, error = fill_from_prior(measured(), GUIDE, (wrong * TRUTH).astype(np.float32), output="range")
    before = np.median(np.abs(wrong[HOLE] - 1))
    assert np.nanmedian(relative_errors(found.range)[HOLE]) < before / 4
    assert error < 0.05


def test_a_network_that_knows_nothing_changes_nothing() -> None:
    noise = np.random.default_rng(0).uniform(1, 5, SIZE).astype(np.float32)
    given = measured()
    found, error = fill_from_prior(given, GUIDE, noise, output="range")
    assert error == np.inf
    assert found is given


def test_without_confirmed_ranges_nothing_changes() -> None:
    given = measured(SEEN)
    found, error = fill_from_prior(given, GUIDE, TRUTH, output="range")
    assert error == np.inf
    assert found is given


def test_no_range_is_extrapolated() -> None:
    """In the hole, the network sees a window through which everything is farther than all measured ranges."""
    prior = np.where(HOLE, 100.0, TRUTH).astype(np.float32)
    found, _ = fill_from_prior(measured(), GUIDE, prior, output="range")
    np.testing.assert_array_equal(found.range, measured().range)


@pytest.mark.parametrize("pane", [MIRROR_CONFIDENCE, WINDOW_CONFIDENCE])
def test_mirrors_and_windows_keep_the_range_of_their_pane(pane: int) -> None:
    given = measured()
    given = replace(given, confidence=np.where(HOLE, np.uint8(pane), given.confidence))
    found, _ = fill_from_prior(given, GUIDE, TRUTH, output="range")
    np.testing.assert_array_equal(found.range, given.range)
    np.testing.assert_array_equal(found.confidence, given.confidence)


def test_masked_pixels_and_the_sky_get_no_range() -> None:
    given = measured()
    sky = HOLE & (np.arange(SIZE[1]) % 2 == 0)
    given = replace(
        given,
        range=np.where(HOLE, np.float32(np.nan), given.range),
        confidence=np.where(HOLE, np.uint8(0), given.confidence),
        sky=sky,
    )
    valid = np.ones(SIZE, np.bool_)
    valid[: SIZE[0] // 2] = False
    found, _ = fill_from_prior(given, GUIDE, TRUTH, output="range", valid=valid)
    assert not found.valid[HOLE & (sky | ~valid)].any()
    assert found.valid[HOLE & ~sky & valid].mean() > 0.99


def test_the_uncertainty_is_the_error_that_was_measured() -> None:
    given = replace(measured(), uncertainty=np.full(SIZE, 0.15, np.float16))
    noisy = TRUTH * np.exp(np.random.default_rng(1).normal(0, 0.03, SIZE))
    found, error = fill_from_prior(given, GUIDE, noisy.astype(np.float32), output="range")
    assert 0.025 < error < 0.04
    assert found.uncertainty is not None
    assert given.uncertainty is not None
    np.testing.assert_allclose(found.uncertainty[HOLE & (found.range != given.range)], error, rtol=1e-3)
    np.testing.assert_array_equal(found.uncertainty[~HOLE], given.uncertainty[~HOLE])


@pytest.mark.parametrize("width", [64, 256, 600])
def test_a_network_sees_the_panorama_at_its_own_size_without_a_seam(width: int) -> None:
    """Its values come back at the size of the picture; turning the camera turns them."""
    smooth = (100 + 90 * ray_grid(SIZE)[..., 0])[..., None].repeat(3, axis=-1).astype(np.uint8)
    network = open_network(GREY_NETWORK)
    settings = {"mean": (0.5, 0.5, 0.5), "std": (0.25, 0.25, 0.25)}
    values = network_values(network, smooth, width=width, **settings)
    assert values.shape == SIZE
    np.testing.assert_allclose(values, (smooth[..., 0] / 255 - 0.5) / 0.25, atol=0.08)
    turned = network_values(network, np.roll(smooth, 64, axis=1), width=width, **settings)
    np.testing.assert_allclose(turned, np.roll(values, 64, axis=1), atol=0.02)


def test_what_is_no_network_of_this_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there is no such file"):
        open_network(tmp_path / "none.onnx")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(GREY_NETWORK.read_bytes()[:50])
    with pytest.raises(UsageError, match="may be damaged"):
        open_network(broken)
    with pytest.raises(UsageError, match="one input of float32"):
        open_network(GREY_NETWORK.with_name("two_inputs.onnx")).picture_input()
    with pytest.raises(UsageError, match="std must be positive"):
        network_values(open_network(GREY_NETWORK), GUIDE, std=(1.0, 0.0, 1.0))
