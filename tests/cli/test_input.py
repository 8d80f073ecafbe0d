"""Input of other kinds and in other places, and input that changes between runs."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image

import pano_mvs as installed
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.cli.conftest import Command, run_json
from tests.io.images.pictures import app1, exif
from tests.synthetic.video_files import counted, write_video

LOOK = "pano_mvs: 1\nstages: {images: {use: source.folder, path: photos}}\n"


def test_pictures_of_every_kind_are_one_capture(pano_mvs: Command, tmp_path: Path) -> None:
    photos = tmp_path / "photos" / "day 1 – außen"
    photos.mkdir(parents=True)
    rng = np.random.default_rng(3)
    pictures = [Image.fromarray(rng.integers(0, 255, (64, 128, 3)).astype(np.uint8)) for _ in range(8)]
    kinds = (("JPG", "JPEG"), ("png", "PNG"), ("Tif", "TIFF"), ("webp", "WEBP"), ("AVIF", "AVIF"))
    for (suffix, kind), picture in zip(kinds, pictures, strict=False):
        picture.save(photos / f"{kind}.{suffix}", kind)
    stream = io.BytesIO()
    pillow_heif.from_pillow(pictures[5]).save(stream)
    (photos / "phone.HEIC").write_bytes(stream.getvalue())
    sixteen = np.asarray(pictures[6]).astype(np.uint16) * 257
    (photos / "deep.png").write_bytes(bytes(cv2.imencode(".png", sixteen)[1]))
    stream = io.BytesIO()
    pictures[7].save(stream, "JPEG")
    data = stream.getvalue()
    turned = data[:2] + app1(b"Exif\0\0" + exif(orientation=6)) + data[2:]
    (photos / "turned.jpg").write_bytes(turned)
    (tmp_path / "look.yaml").write_text(LOOK)
    result = pano_mvs("run", tmp_path / "look.yaml", "--out", "out")
    assert result.code == 0, result.text
    assert run_json(Path("out"))["stages"][0]["run"] == 8
    assert "EXIF orientation that rotates or mirrors them, which was ignored" in result.flat


def test_two_fisheyes_among_panoramas_are_told(pano_mvs: Command, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    raw = np.zeros((64, 128, 3), np.uint8)
    for left in (32, 96):
        cv2.circle(raw, (left, 32), 30, (150, 120, 90), -1)
    for name, picture in (("a", counted(1)), ("b", raw), ("c", counted(2))):
        cv2.imwrite(str(tmp_path / "photos" / f"{name}.png"), picture)
    (tmp_path / "look.yaml").write_text(LOOK)
    result = pano_mvs("run", tmp_path / "look.yaml", "--out", "out")
    assert result.code == 3
    assert "b.png: two fisheye images side by side" in result.flat
    assert "if the calibration of the lenses is known, use source.dual_fisheye (docs/rigs.md)" in result.flat


def test_a_folder_of_videos_is_pointed_to_the_other_source(pano_mvs: Command, tmp_path: Path) -> None:
    (tmp_path / "films").mkdir()
    write_video(tmp_path / "films" / "walk.avi", 60)
    result = pano_mvs("run", "quickstart", "--images", tmp_path / "films")
    assert result.code == 2
    assert "walk.avi. Use source.video: --set images.use=source.video --set pairs.use=pairs.sequential" in result.flat


def test_where_pictures_and_masks_lie_does_not_count(pano_mvs: Command, tmp_path: Path) -> None:
    """The path of the masks was once part of the key."""
    for folder in ("photos", "masks"):
        (tmp_path / folder).mkdir()
    for name in ("a", "b"):
        cv2.imwrite(str(tmp_path / "photos" / f"{name}.png"), counted(ord(name)))
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), np.full((64, 128), 255, np.uint8))
    workflow = tmp_path / "look.yaml"
    workflow.write_text(LOOK)
    run = ("run", workflow, "--out", "out", "--cache", "cache")
    assert pano_mvs(*run, "--set", f"images.masks={tmp_path / 'masks'}").code == 0
    (tmp_path / "masks").rename(tmp_path / "elsewhere")
    (tmp_path / "photos").rename(tmp_path / "pictures")
    moved = ("--set", f"images.masks={tmp_path / 'elsewhere'}", "--set", f"images.path={tmp_path / 'pictures'}")
    again = pano_mvs(*run, *moved)
    assert again.code == 0, again.text
    assert "0 units computed" in again.text


WORKFLOW = """\
pano_mvs: 1
name: tiny
stages:
  images: {use: source.folder, path: CAPTURE/images}
  poses: {use: poses.from_model, path: CAPTURE/truth/poses.json}
  views: {use: views.nearest, sources: 2}
  depth: {use: depth.sweep, backend: numpy, planes: 8, near: 0.5, far: 6, aggregation: box}
  filled: {use: filters.fill, in: {range_map: depth}}
  gaussian: {use: filters.gaussian, in: {range_map: depth}}
"""
KERNEL = "algorithms/filters/kernels_fill.py"


def edit(path: Path, change: Callable[[str], str]) -> None:
    text = path.read_text(encoding="utf-8")
    assert change(text) != text, f"{path} is not changed"
    path.write_text(change(text), encoding="utf-8")


@pytest.mark.slow
def test_an_edit_of_a_kernel_costs_the_units_that_depend_on_it_and_a_comment_none(tmp_path: Path) -> None:
    package = tmp_path / "copy" / "pano_mvs"
    shutil.copytree(Path(installed.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "tiny.yaml").write_text(
        WORKFLOW.replace("CAPTURE", str(tiny_capture(Variant((16, 32))).folder)), encoding="utf-8"
    )
    environment = {**os.environ, "PYTHONPATH": str(package.parent), "NUMBA_DISABLE_JIT": "1"}

    def pano_mvs(command: str, *options: str) -> str:
        arguments = [command, "tiny.yaml", "--cache", "cache", "--out", "out", *options]
        if command == "run":
            arguments += ["--executor", "serial"]
        line = [sys.executable, "-m", "pano_mvs", *arguments]
        done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def computed() -> dict[str, int]:
        pano_mvs("run")
        stages = json.loads((tmp_path / "out" / "run.json").read_bytes())["stages"]
        return {stage["name"]: stage["run"] for stage in stages if stage["run"]}

    every = {"images": 4, "poses": 1, "views": 1, "depth": 4, "filled": 4, "gaussian": 4}
    assert computed() == every

    edit(package / KERNEL, lambda text: text.replace('"""', '"""In other words: ', 1) + "\n# a comment\n")
    edit(package / "report" / "page.py", lambda text: text + "\nONE_MORE = 1\n")
    assert computed() == {}

    edit(package / KERNEL, lambda text: text.replace("1 / steps[idx]", "1.001 / steps[idx]"))
    plan = pano_mvs("plan")
    assert "code of poses.from_model changed" in plan
    assert "nothing to compute" in pano_mvs("plan", "--accept-code")
    independent = {"images", "views"}  # whose code does not fill
    assert computed() == {name: units for name, units in every.items() if name not in independent}
