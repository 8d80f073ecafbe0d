"""`pano-mvs crate` describes a run as a research object."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit
from urllib.request import url2pathname

import pytest

from tests.cli.conftest import Command
from tests.engine.conftest import Toy


def read(folder: Path) -> Any:
    from rocrate.rocrate import ROCrate

    return ROCrate(folder)


def blake2b_128(path: Path) -> str:
    return f"blake2b-128:{hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()}"


def test_crate_states_software_settings_inputs_and_outputs(toy: Toy, pano_mvs: Command) -> None:
    (toy.folder / "capture" / "1.txt").rename(toy.folder / "capture" / "ä 1.txt")
    run = ("run", toy.folder / "wf.yaml", "--executor", "serial", "--set", "scaled.by=4", "--out", "out")
    assert pano_mvs(*run).code == 0
    assert pano_mvs("crate", "out").code == 0

    crate, out = read(Path("out")), Path("out")
    (action,) = crate.get_by_type("CreateAction")
    assert crate.root_dataset["mentions"] == action
    assert action["actionStatus"].endswith("CompletedActionStatus")
    assert action["startTime"] <= action["endTime"]
    software = action["instrument"]
    assert software["name"] == "pano_mvs"
    assert {"numpy", "pycolmap"} <= {library["name"] for library in software["softwareRequirements"]}

    settings = {entity["name"]: entity["value"] for entity in action["object"] if entity.type == "PropertyValue"}
    assert settings["scaled.by"] == 4
    assert settings["scaled.use"] == "toy.scale"

    inputs = [entity for entity in action["object"] if entity.type == "File"]
    paths = [Path(url2pathname(urlsplit(entity.id).path)) for entity in inputs]
    assert sorted(paths) == sorted((toy.folder / "capture").iterdir())
    assert [entity["identifier"] for entity in inputs] == [blake2b_128(path) for path in paths]

    outputs = {unquote(entity.id): entity["identifier"] for entity in action["result"]}
    assert set(outputs) == {*json.loads((out / "run.json").read_text())["files"], "run.json"}
    assert outputs == {name: blake2b_128(out / name) for name in outputs}


def test_crate_of_a_stopped_run(toy: Toy, pano_mvs: Command) -> None:
    toy.number("3.txt", "13")
    toy.edit("wf.yaml", lambda text: text.replace("use: toy.scale", "on_error: stop, use: toy.scale"))
    assert pano_mvs("run", toy.folder / "wf.yaml", "--executor", "serial", "--out", "out").code == 4
    assert pano_mvs("crate", "out").code == 0
    (action,) = read(Path("out")).get_by_type("CreateAction")
    assert action["actionStatus"].endswith("FailedActionStatus")
    assert "thirteen is unlucky" in action["error"]


def test_folder_without_a_run_and_missing_library(pano_mvs: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("out").mkdir()
    assert "out/run.json cannot be read" in pano_mvs("crate", "out").flat
    monkeypatch.setitem(sys.modules, "rocrate.rocrate", None)
    missing = pano_mvs("crate", "out")
    assert missing.code == 2
    assert "pip install 'pano-mvs[crate]'" in missing.flat
