"""`plugin new`: for each kind a plugin that keeps its contract, is clean, and runs in a workflow, with its test."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pano_mvs.cli.plugins.new import KINDS, rendered
from pano_mvs.testing import conformance
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.cli.conftest import Command, deliverables

ROOT = Path(__file__).parent.parent.parent
WORKFLOW = """\
pano_mvs: 1
name: mine
plugins: [{files}]
stages:
  images:   {{use: source.new_source, path: {images}, nadir_deg: 20}}
  masked:   {{use: mask.new_mask}}
  features: {{use: features.new_features}}
  pairs:    {{use: pairs.new_pairs}}
  matches:  {{use: matches.new_matches}}
  poses:    {{use: poses.new_poses, step: 0.3}}
  views:    {{use: views.new_views}}
  depth:    {{use: depth.new_depth}}
  swept:    {{use: depth.sweep, planes: 8, near: 0.5, far: 6, backend: numpy, cost: new_sweep_cost, aggregation: box}}
  again:    {{use: depth.sweep, planes: 8, near: 0.5, far: 6, backend: new_sweep_backend, cost: sad, aggregation: box}}
  filtered: {{use: filters.new_filter, far: 5, in: {{range_map: depth}}}}
  cloud:    {{use: fusion.new_fusion, min_confidence: 1, in: {{ranges: filtered}}}}
  written:  {{use: export.new_export, in: {{range_map: filtered}}}}
  ply:      {{use: export.ply}}
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("new")
    for kind in KINDS:
        for name, text in zip((f"new_{kind}.py", f"test_new_{kind}.py"), rendered(kind, f"new_{kind}"), strict=True):
            (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_plugin_keeps_its_contract(written: Path, kind: str) -> None:
    contract_tests = getattr(conformance, KINDS[kind].contract_tests)(written / f"new_{kind}.py")
    assert len(contract_tests) >= 2
    for contract_test in contract_tests:
        contract_test.check()


@pytest.mark.slow
def test_new_plugins_run_in_a_workflow(pano_mvs: Command, written: Path) -> None:
    files = ", ".join(str(written / f"new_{kind}.py") for kind in KINDS)
    images = tiny_capture(Variant((32, 64))).folder / "images"
    Path("mine.yaml").write_text(WORKFLOW.format(files=files, images=images))
    result = pano_mvs("run", "mine.yaml")
    assert result.code == 0, result.text
    found = deliverables(Path("out/mine"))
    assert len([name for name in found if name.startswith("new_export/")]) == 4
    assert len(found["cloud.ply"]) > 40_000


def test_new_plugins_are_clean(written: Path) -> None:
    for command in (["check"], ["format", "--check"]):
        ruff = [sys.executable, "-m", "ruff", *command, "--config", str(ROOT / "pyproject.toml"), str(written)]
        result = subprocess.run(ruff, capture_output=True, text=True)
        assert result.returncode == 0, result.stdout


@pytest.mark.slow
def test_new_plugins_are_typed_and_their_tests_pass(written: Path, tmp_path: Path) -> None:
    mypy = [sys.executable, "-m", "mypy", "--strict", "--config-file=", *map(str, written.glob("new_*.py"))]
    own = [sys.executable, "-m", "pytest", "-q", "-W", "error", "--basetemp", str(tmp_path / "own"), str(written)]
    for command in (mypy, own):
        result = subprocess.run(command, cwd=written, capture_output=True, text=True)
        assert result.returncode == 0, result.stdout + result.stderr


def test_the_command_writes_both_files_and_overwrites_none(pano_mvs: Command) -> None:
    result = pano_mvs("plugin", "new", "filter", "mine", "--dir", "plugins/here")
    assert result.code == 0, result.text
    assert "filtered: {use: filters.mine}" in result.flat
    assert Path("plugins/here/mine.py").read_text() == rendered("filter", "mine")[0]
    Path("plugins/here/mine.py").unlink()
    result = pano_mvs("plugin", "new", "filter", "mine", "--dir", "plugins/here")
    assert result.code == 2
    assert "test_mine.py already exists" in result.flat
    assert not Path("plugins/here/mine.py").exists()


@pytest.mark.parametrize(
    ("kind", "name", "what"),
    [
        ("filters", "mine", "unknown kind of plugin 'filters'; known kinds: source, mask"),
        ("filter", "../mine", "cannot be called '../mine'"),
        ("filter", "Mine", "cannot be called 'Mine'"),
        ("filter", "class", "cannot be called 'class'"),
        ("filter", "json", "would hide the Python package"),
        ("filter", "numpy", "would hide the Python package"),
    ],
)
def test_what_cannot_be_written_is_refused(pano_mvs: Command, kind: str, name: str, what: str) -> None:
    result = pano_mvs("plugin", "new", kind, name)
    assert result.code == 2
    assert what in result.flat


def test_kinds_are_listed(pano_mvs: Command) -> None:
    result = pano_mvs("plugin", "kinds")
    assert result.code == 0
    assert all(kind in result.text for kind in KINDS)
