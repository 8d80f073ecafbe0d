"""The scores that are kept with a run: names that stay, constants beside them, truth of another size."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pano_mvs_evaluation.capture import KEPT, KEPT_OF_CONFIDENCE, score_capture
from pano_mvs_evaluation.ranges.view_scores import score_view

from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Scores
from tests.algorithms.range_scenes import box_range

POSES = {name: Rigid3(np.eye(3), np.array([x, 0.0, 0.0])) for name, x in (("a", 0.0), ("b", 1.0))}
HALF = {name: Rigid3(pose.rotation, pose.translation / 2) for name, pose in POSES.items()}


def scored(
    estimated: NDArray[Any],
    truth: NDArray[np.float32],
    confidence: NDArray[np.uint8] | None = None,
    poses: dict[str, Rigid3] = POSES,
) -> Scores:
    confidences = {"a": confidence} if confidence is not None else {}
    return score_capture(
        poses, POSES, estimated_ranges={"a": estimated}, true_ranges={"a": lambda: truth}, confidences=confidences
    )


def test_each_score_stands_beside_what_constants_score() -> None:
    truth, _ = box_range((16, 32))
    estimated = np.float32(1.1) * truth
    confidence = np.random.default_rng(0).integers(1, 255, truth.shape).astype(np.uint8)
    found = scored(estimated, truth, confidence).views["a"]
    expected = score_view(estimated, truth, confidence=confidence)
    names = set(KEPT) | set(KEPT_OF_CONFIDENCE)
    beside = (set(KEPT) | {"ause"}) - {"completeness"}
    assert set(found) == names | {f"{kind}{name}" for kind in ("constant_", "best_constant_") for name in beside}
    for name in names:
        assert found[name] == pytest.approx(expected.scores[name])
    for name in beside:
        assert found[f"constant_{name}"] == pytest.approx(expected.constants["median"][name])
        assert found[f"best_constant_{name}"] == pytest.approx(expected.constants["best"][name])
    assert found["best_constant_psnr_db"] >= found["constant_psnr_db"]


def test_ranges_are_scaled_by_the_cameras_and_read_at_the_true_pixels() -> None:
    truth, _ = box_range((64, 128))
    estimated, _ = box_range((32, 64))
    confidence = np.full((32, 64), 200, np.uint8)
    found = scored(estimated / 2, truth, confidence, poses=HALF)
    assert found.views["a"]["median_relative_error"] < 2e-3
    assert found.views["a"]["ause"] >= 0
    assert not found.notes


def test_what_is_masked_is_not_judged() -> None:
    truth, _ = box_range((32, 64))
    estimated, mask = truth.copy(), np.ones((16, 32), bool)
    estimated[16:], mask[8:] = np.nan, False
    views: dict[str, Any] = {"estimated_ranges": {"a": estimated}, "true_ranges": {"a": lambda: truth}}
    assert score_capture(POSES, POSES, **views, masks={"a": mask}).views["a"]["completeness"] == 1
    assert score_capture(POSES, POSES, **views).views["a"]["completeness"] == 0.5


def test_a_pair_with_an_unregistered_camera_has_no_error() -> None:
    """Where most pairs had one, the report gave 180° as the median pose error."""
    true = {
        name: Rigid3(np.eye(3), np.array(place))
        for name, place in (("a", (0.0, 0, 0)), ("b", (1.0, 0, 0)), ("c", (0.0, 1, 0)), ("d", (0.0, 0, 1)))
    }
    found = score_capture({name: true[name] for name in "ab"}, true).poses
    assert [found[f"median_{kind}_error_deg"] for kind in ("pair", "rotation", "direction")] == [0, 0, 0]
    assert found["auc_5_deg"] == pytest.approx(1 / 6)
    apart = score_capture({name: true[name] for name in "ab"}, true, groups={"a": 0, "b": 1}).poses
    assert (apart["registered"], apart["auc_5_deg"]) == (2, 0)
    assert not any("median" in name for name in apart)


def test_what_cannot_be_judged_has_no_score() -> None:
    nothing = np.full((8, 16), np.nan, np.float32)
    found = scored(nothing, box_range((8, 16))[0], np.zeros((8, 16), np.uint8)).views["a"]
    assert found["completeness"] == 0
    assert not {"ause", "median_relative_error", "best_constant_median_relative_error"} & set(found)
    assert all(np.isfinite(value) for value in found.values())
    missing = score_capture(POSES, POSES, estimated_ranges={"a": nothing}, true_ranges={"a": lambda: None})
    assert (missing.views, missing.notes) == ({}, ("a: no true range map",))
    flat = np.full((8, 16), 2.0, np.float32)
    perfect = scored(flat, flat)
    assert "constant_psnr_db" not in perfect.views["a"]  # it would be infinite
    json.dumps(perfect.views, allow_nan=False)
