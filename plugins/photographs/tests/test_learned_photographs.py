"""Photographs are matched by the networks that match panoramas, also by networks of COLMAP's files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pano_mvs_photographs.learned_matches import match_photograph, view_of_photograph

from pano_mvs.algorithms.faces.sampling import sample_view
from pano_mvs.algorithms.learned import aliked
from pano_mvs.algorithms.learned.aliked import extract_aliked, level_tiles
from pano_mvs.algorithms.learned.networks import TILE_PX, Networks
from pano_mvs.geometry import PinholeView, rotation_from_rotvec
from pano_mvs.scene import Features
from tests.algorithms.learned.test_networks import SIZE, UP, by_torch, colmap, panorama

__all__ = ["by_torch", "colmap", "panorama"]  # fixtures


@pytest.fixture(scope="module")
def found(panorama: NDArray[np.uint8]) -> Features:
    return extract_aliked(panorama, np.ones(SIZE, np.bool_), ups=[UP], max_keypoints=1500)


@pytest.mark.slow
def test_a_photograph_matches_where_the_panorama_shows_the_same(panorama: NDArray[np.uint8], found: Features) -> None:
    """A portrait picture of 300 × 400 pixels, 10° off level, across the seam."""
    turn = rotation_from_rotvec([0.1, 0.0, 0.17]) @ rotation_from_rotvec([0.0, 3.0, 0.0])
    view = PinholeView(turn, 300.0, np.array([150.0, 200.0]), (400, 300))
    photograph = view_of_photograph(sample_view(panorama, view))
    matches = match_photograph(photograph, found)
    expected = view.pixels_from_rays(found.bearings[matches[:, 1]])
    off_px = np.linalg.norm(photograph.pixels_px[matches[:, 0]] - expected, axis=1)
    assert len(matches) > 50
    assert np.mean(off_px < 3) > 0.9
    blank = view_of_photograph(np.zeros((30, 40, 3), np.uint8))
    assert len(match_photograph(blank, found)) == 0


@pytest.mark.slow
def test_networks_of_colmap_match_photographs(
    panorama: NDArray[np.uint8], colmap: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ahead = np.array([0.0, 0.0, 1.0])
    monkeypatch.setattr(
        aliked, "level_tiles", lambda up: [tile for tile in level_tiles(up) if tile.view_from_cam[2] @ ahead > 0.5]
    )
    theirs = Networks(models=colmap)
    features = extract_aliked(panorama, np.ones(SIZE, np.bool_), ups=[UP], max_keypoints=1500, networks=theirs)
    view = PinholeView(np.eye(3), 256.0, np.array([256.0, 256.0]), (TILE_PX, TILE_PX))
    photograph = view_of_photograph(sample_view(panorama, view), networks=theirs)
    assert len(match_photograph(photograph, features, networks=theirs)) > 20
