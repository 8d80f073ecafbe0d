"""No border exists: with poses given and turned with the pictures, rolled inputs give rolled results."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from pano_mvs.geometry import roll_panorama
from pano_mvs.io.ranges import read_range_tiff
from tests.cli.conftest import SMALL, Command
from tests.stored import read_picture

KNOWN_RANGES = """\
pano_mvs: 1
stages:
  images: {use: source.folder, path: images}
  poses:  {use: poses.from_model, path: poses.json}
  views:  {use: views.nearest}
  depth:  {use: depth.sweep}
  checked: {use: filters.consistency}
  smooth: {use: filters.fast_bilateral_solver}
  ranges: {use: export.ranges}
"""


def rolled_capture(capture: Path, folder: Path, columns: int) -> Path:
    """Write the capture with all pictures rolled to the right and all cameras turned with them."""
    (folder / "images").mkdir(parents=True)
    truth = json.loads((capture / "truth" / "poses.json").read_text())
    for view in truth["views"]:
        name = Path(view["image"]).name
        image, new_from_old = roll_panorama(read_picture(capture / "images" / name), columns)
        cv2.imwrite(str(folder / "images" / name), image)
        view.pop("sha256", None)  # the rolled picture is another one
        view["R"] = (new_from_old @ np.array(view["R"])).tolist()
        view["t"] = (new_from_old @ np.array(view["t"])).tolist()
    (folder / "poses.json").write_text(json.dumps(truth))
    workflow = folder / "known.yaml"
    workflow.write_text(KNOWN_RANGES)
    return workflow


@pytest.mark.slow
def test_rolled_pictures_give_rolled_range_maps(pano_mvs: Command, capture: Path, tmp_path: Path) -> None:
    quarter = 320 // 4
    straight = rolled_capture(capture, tmp_path / "straight", 0)
    rolled = rolled_capture(capture, tmp_path / "rolled", quarter)
    for workflow in (straight, rolled):
        result = pano_mvs("run", workflow, "--out", workflow.parent / "out", *SMALL[:2])
        assert result.code == 0, result.text
    for name in ("000", "001", "002", "003"):
        first = read_range_tiff(straight.parent / f"out/range/{name}.tiff")
        second = np.roll(read_range_tiff(rolled.parent / f"out/range/{name}.tiff"), -quarter, axis=1)
        difference = np.abs(first / second - 1)
        assert np.isfinite(first).all()
        assert np.isfinite(second).all()
        assert np.median(difference) < 1e-4
        assert (difference > 0.01).mean() < 0.01
