"""Laws of whole runs: what turns, names or executors change, and what they do not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from pano_mvs.cli import inspect_command as inspect_text
from pano_mvs.evaluation.ranges import tables as depth_tables
from pano_mvs.geometry import roll_panorama
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.results.figures import figure
from tests.cli.conftest import SMALL, Command, deliverables
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


WAYS = {
    "serial": ("--executor", "serial", "--threads-per-worker", "2"),
    "two": ("--executor", "processes", "--workers", "2", "--threads-per-worker", "1"),
    "dask": ("--executor", "dask", "--workers", "2"),
}


def stored(folder: Path) -> dict[str, object]:
    """Return the records of a store without their times."""
    found = {}
    for path in (folder / "records").rglob("*.json"):
        found[path.name] = json.loads(path.read_bytes().partition(b"\n")[2]) | {"seconds": 0}
    return found


@pytest.mark.slow
def test_all_executors_give_the_same_bytes(rendered: Path, tmp_path: Path) -> None:
    # Nothing is bound from outside: what bounds the libraries is ours.
    unbound = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    for name, options in WAYS.items():
        command = [
            sys.executable,
            *f"-m pano_mvs run quickstart --images {rendered}".split(),
            *SMALL,
            *["--set", "depth.planes=16", "--set", "views.sources=2"],
            *options,
            *f"--out {tmp_path / f'out-{name}'} --cache {tmp_path / f'cache-{name}'}".split(),
        ]
        done = subprocess.run(command, env=unbound, capture_output=True, text=True, check=False, timeout=600)
        assert done.returncode == 0, done.stdout + done.stderr
        assert deliverables(tmp_path / f"out-{name}") == deliverables(tmp_path / "out-serial"), name
        assert stored(tmp_path / f"cache-{name}") == stored(tmp_path / "cache-serial"), name
    assert len(deliverables(tmp_path / "out-serial")) > 10


@pytest.mark.parametrize(
    "shown",
    [
        figure(-0.0),
        figure([-0.0, 1.0]),
        depth_tables._shown("psnr_db", {"psnr_db": -0.0}),
        inspect_text._vector(np.array([-1e-9, 0.0, 1.0])),
    ],
)
def test_zero_has_no_sign(shown: str) -> None:
    assert "-" not in shown
    assert "0" in shown
