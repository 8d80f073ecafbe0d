"""Two rooms that nothing connects, and one truth."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pano_mvs_evaluation.stages import TruthParams, truth

from pano_mvs.testing.tiny_capture import TinyCapture, tiny_capture
from tests.stored import write_npz
from tests.synthetic.two_rooms import ORDER, SMALL, Rooms


def test_each_room_is_aligned_with_the_truth_on_its_own(tmp_path: Path) -> None:
    tiny = tiny_capture()
    rooms = Rooms(tiny)
    folder = _truth_of_rooms(tiny, tmp_path / "truth")
    scores = truth(images=rooms.images, poses=rooms.poses, ranges=rooms.ranges, params=TruthParams(truth=folder))
    assert scores.poses["registered"] == 5
    assert scores.poses["registered_in_one_frame"] == 3
    assert scores.poses["scale_ratio_error_max"] < 1e-6
    assert 0 < scores.poses["auc_1_deg"] == pytest.approx(4 / 10)  # three pairs of the large room, one of the small one
    assert all(view["median_relative_error"] < 0.01 for view in scores.views.values())
    assert len(scores.views) == 5
    assert "in 2 groups" in scores.notes[0]


def _truth_of_rooms(tiny: TinyCapture, folder: Path) -> Path:
    folder.mkdir()
    of_image = {name: tiny.names.index(SMALL.get(name, name)) for name in ORDER}
    views = [
        {"image": name, "R": tiny.poses[idx].rotation.tolist(), "t": tiny.poses[idx].translation.tolist()}
        for name, idx in of_image.items()
    ]
    (folder / "poses.json").write_text(json.dumps({"width": 64, "height": 32, "metric": True, "views": views}))
    write_npz(folder / "depth.npz", {Path(name).stem: tiny.ranges[idx] for name, idx in of_image.items()})
    return folder
