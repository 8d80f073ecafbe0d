"""A run by an edited copy of the package computes the units whose stages import what was edited."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import pano_mvs as installed
from pano_mvs.testing.tiny_capture import tiny_capture

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
    (tmp_path / "tiny.yaml").write_text(WORKFLOW.replace("CAPTURE", str(tiny_capture().folder)), encoding="utf-8")
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
    assert computed() == {name: units for name, units in every.items() if name != "images"}
