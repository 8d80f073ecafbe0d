"""The output of a run as objects: from the cache, or from exported files where that is gone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.ranges import write_confidence_png, write_range_tiff
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import summary_of
from tests.viewer.scenes import box_cloud, write_output


@pytest.fixture
def run(tmp_path: Path, tiny: TinyCapture, results: StoredValues) -> RunOutput:
    return RunOutput(tmp_path / "out", RunSummary.from_json(summary_of(tiny)), results)


def test_values_come_from_the_cache(run: RunOutput, tiny: TinyCapture) -> None:
    name = tiny.names[1]
    view = run.views[name]
    assert list(run.views) == list(tiny.names)
    assert len(run.views) == 4
    assert view.range_map is not None
    assert view.range_map.shape == (32, 64)
    assert view.confidence is not None
    assert np.array_equal(view.confidence > 0, np.isfinite(view.range_map))
    assert view.image is not None
    assert view.image.shape == (32, 64, 3)
    assert view.summary.consistent == 0.5
    assert view.preview is None
    assert run.poses is not None
    assert view.cam_from_world is not None
    assert view.cam_from_world.translation == pytest.approx(run.poses.translations[1])
    assert run.cloud is not None
    assert len(run.cloud) == 240
    with pytest.raises(KeyError, match=r"nothing\.png"):
        run.views["nothing.png"]


def test_a_notebook_shows_the_verdict_pictures_and_stages(run: RunOutput) -> None:
    text = run._repr_html_()
    assert run.verdict.judgement in text
    assert text.count("data:image/jpeg;base64,") == 2 * len(run.views)
    assert "depth.sweep" in text
    assert "http" not in text
    assert repr(run).startswith("RunOutput(")
    assert repr(run.views) == "<4 views: 000.png, 001.png, 002.png, …>"


def test_a_notebook_shows_names_as_text() -> None:
    evil = "<script>"
    summary = RunSummary.from_json(
        {
            "workflow": {"name": evil},
            "stopped": evil,
            "stages": [{"name": evil, "use": evil}],
            "exit_code": 4,
        }
    )
    assert evil not in RunOutput(Path(evil), summary, StoredValues())._repr_html_()


def test_exported_files_stand_in_for_a_cache_that_is_gone(tmp_path: Path) -> None:
    out = write_output(tmp_path, {"a.png": Rigid3.identity(), "b.jpg.png": Rigid3.identity()}, points=200)
    views = [{"name": "a.png"}, {"name": "b.jpg.png"}]
    RunSummary.read(out).model_copy(update={"views": RunSummary.from_json({"views": views}).views}).write(out)
    for folder in ("range", "confidence", "uncertainty"):
        (out / folder).mkdir()
    ranges = np.arange(1, 9, dtype=np.float32).reshape(2, 4)
    write_range_tiff(out / "range" / "a.tiff", ranges)
    write_confidence_png(out / "confidence" / "a.png.png", np.full((2, 4), 200, np.uint8))
    write_range_tiff(out / "uncertainty" / "a.tiff", ranges / np.float32(100))
    run = load(out)
    view = run.views["a.png"]
    assert view.range_map is not None
    assert np.array_equal(view.range_map, ranges)
    assert view.confidence is not None
    assert view.confidence.min() == 200
    assert view.uncertainty is not None
    assert np.array_equal(view.uncertainty, ranges / np.float32(100))
    assert run.views["b.jpg.png"].range_map is None
    assert view.image is not None
    assert view.image.shape[2] == 3
    assert run.poses is not None
    assert run.poses.names == ("a.png", "b.jpg.png")
    assert view.cam_from_world is not None
    assert view.cam_from_world.translation == pytest.approx(np.zeros(3))
    assert run.cloud is not None
    # The file has z up; the cloud is in the world of the poses.
    np.testing.assert_array_equal(run.cloud.points_in_world, box_cloud(200, quality=False).points_in_world)
    np.testing.assert_array_equal(run.cloud.normals_in_world, box_cloud(200, quality=False).normals_in_world)
    with pytest.raises(InputError, match="is not a cache"):
        load(out, cache=tmp_path)


def test_what_a_run_does_not_have_is_none(tmp_path: Path) -> None:
    run = RunOutput(tmp_path, RunSummary.from_json({"views": [{"name": "a.png"}]}), StoredValues())
    assert (run.poses, run.cloud) == (None, None)
    view = run.views["a.png"]
    assert (view.range_map, view.confidence, view.image, view.cam_from_world) == (None, None, None, None)
    assert view.uncertainty is None
