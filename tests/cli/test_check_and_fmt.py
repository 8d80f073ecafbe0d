"""`check` and `fmt` print for programs what they print for people, and can be called from Python."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import pano_mvs as product
from tests.cli.conftest import Command

TEXT = 'stages:\n  images: {path: "photos", use: source.folder}\n'
LAID_OUT = "stages:\n  images: {use: source.folder, path: photos}\n"


def test_check_prints_what_is_wrong_as_json(pano_mvs: Command) -> None:
    good = pano_mvs("check", "quality", "--json")
    found = json.loads(good.text)
    assert (good.code, found["ok"], found["problems"], found["stages"] > 30) == (0, True, [], True)
    bad = pano_mvs("check", "quality", "--set", "depth.plane=64", "--set", "nothing.at=1", "--json")
    found = json.loads(bad.text)
    assert (bad.code, found["ok"], len(found["problems"])) == (2, False, 2)
    assert any("unknown setting 'plane'" in problem for problem in found["problems"])
    assert pano_mvs("check", "nowhere.yaml", "--json").code == 2


def test_check_returns_what_is_wrong() -> None:
    assert product.check("quality").ok
    found = product.check("quality", settings={"depth.plane": 64})
    assert (found.ok, found.stages) == (False, 0)
    assert found.problems[0].startswith("settings['depth.plane']: stage 'depth': unknown setting 'plane'")
    assert json.loads(json.dumps(found.to_json()))["workflow"] == "quality"
    with pytest.raises(product.UsageError, match="nowhere"):
        product.check("nowhere.yaml")


def test_images_that_cannot_be_read_are_a_mistake_too(tmp_path: Path) -> None:
    workflow = tmp_path / "wf.yaml"
    workflow.write_bytes(b"\xff\xfe\x00")
    assert not product.check(workflow).ok


def test_fmt_prints_which_files_have_changed_as_json(pano_mvs: Command, tmp_path: Path) -> None:
    paths = [tmp_path / "a.yaml", tmp_path / "b.yaml"]
    paths[0].write_text(TEXT)
    paths[1].write_text(LAID_OUT)
    files = [{"file": str(path), "changed": path == paths[0]} for path in paths]
    only = pano_mvs("fmt", *paths, "--check", "--json")
    assert (only.code, json.loads(only.text)) == (4, {"files": files, "written": False})
    assert paths[0].read_text() == TEXT
    done = pano_mvs("fmt", *paths, "--json")
    assert (done.code, json.loads(done.text)) == (0, {"files": files, "written": True})
    assert paths[0].read_text() == LAID_OUT
    assert pano_mvs("fmt", *paths, "--diff", "--json").code == 2


def test_a_text_is_laid_out() -> None:
    assert product.format_workflow(TEXT) == product.format_workflow(LAID_OUT) == LAID_OUT
    with pytest.raises(product.WorkflowError):
        product.format_workflow("stages: [")
    with pytest.raises(product.UsageError, match=r"text='a\.yaml' is the name of a file: it must be the text"):
        product.format_workflow("a.yaml")
    not_text: object = Path("a.yaml")
    with pytest.raises(product.UsageError, match="must be the text"):
        product.format_workflow(not_text)  # type: ignore[arg-type]
