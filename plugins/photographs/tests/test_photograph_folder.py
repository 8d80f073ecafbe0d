"""Folders of photographs that cannot be used, and code by which what is made of them is known."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from pano_mvs.engine.stages import stage_code
from pano_mvs.engine.stages.registry import Registry
from tests.cli.conftest import Command


@pytest.mark.parametrize("command", ["check", "plan", "run"])
def test_a_folder_without_photographs_is_refused_before_anything_is_computed(
    pano_mvs: Command, tmp_path: Path, capture: Path, command: str
) -> None:
    path = tmp_path / "photographs.yaml"
    path.write_text("pano_mvs: 1\nextends: quality\nstages:\n  photographs: {use: poses.localise, path: phone}\n")
    (tmp_path / "phone").mkdir()
    arguments = ("check", path) if command == "check" else (command, path, "--images", capture / "images")
    result = pano_mvs(*arguments)
    assert result.code == 2
    assert "photographs.yaml:4:" in result.flat
    assert "no photographs here" in result.flat


def test_the_kernel_that_the_stage_calls_counts_towards_its_key() -> None:
    module = Path(str(sys.modules[Registry.installed().stages["poses.localise"].function.__module__].__file__))
    imported = stage_code._local_code(module).outer
    assert "pano_mvs.algorithms.poses.adjustment.kernels_patch_alignment" in imported
