"""`pano-mvs show`: the text of a workflow, or one file with all settings."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pano_mvs.core.digest import digest_from_value
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.planning.resolve import _static_identity
from pano_mvs.engine.workflows.resolved import resolved_yaml
from pano_mvs.session.session import Session, open_session, presets_folder
from tests.cli.conftest import Command
from tests.engine.conftest import Toy

PRESETS = sorted(path.stem for path in presets_folder().glob("*.yaml"))


def resolved_session(session: Session, folder: Path, name: str = "all.yaml") -> Session:
    """Return the session of a workflow's resolved form."""
    path = folder / name
    path.write_text(resolved_yaml(session.workflow, session.graph), encoding="utf-8")
    return open_session(path, cache=session.store_root, out=session.out)


def identities(session: Session, store: Store) -> dict[str, object]:
    """Return what the keys of each stage are made of, without its inputs, and where these come from."""
    return {
        name: (
            digest_from_value(_static_identity(entry, store)),
            {port: edge.producer for port, edge in session.graph.edges[name].items()},
            entry.policy.model_dump(exclude={"inputs"}),
        )
        for name, entry in session.workflow.stages.items()
    }


@pytest.mark.parametrize("preset", PRESETS)
def test_a_resolved_preset_has_the_same_keys(preset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    session = open_session(preset)
    again = resolved_session(session, tmp_path)
    store = Store(tmp_path / "cache")
    assert identities(again, store) == identities(session, store)
    assert list(again.workflow.stages) == list(session.workflow.stages)
    assert again.workflow.id == session.workflow.id
    assert resolved_yaml(again.workflow, again.graph) == resolved_yaml(session.workflow, session.graph)


def test_every_setting_is_there_with_its_value(pano_mvs: Command, tmp_path: Path) -> None:
    shown = pano_mvs("show", "quality", "--resolved", "--set", "depth.planes=77").text
    assert "    planes: 77\n" in shown
    assert "    near: null\n" in shown
    assert "    cost: census_gradient\n" in shown
    depth = open_session("quality").workflow.stages["depth"].params
    assert all(f"    {name}: " in shown for name in type(depth).model_fields)
    written = pano_mvs("show", "quality", "--resolved", "--set", "depth.planes=77", "--out", tmp_path / "mine.yaml")
    assert (written.code, written.text) == (0, f"written to {tmp_path / 'mine.yaml'}\n")
    assert (tmp_path / "mine.yaml").read_text() == shown
    assert pano_mvs("check", tmp_path / "mine.yaml").code == 0
    again = pano_mvs("show", "fast", "--out", tmp_path / "mine.yaml")
    assert (again.code, "such a file already" in again.flat) == (2, True)
    assert (tmp_path / "mine.yaml").read_text() == shown
    (tmp_path / "file").touch()
    refused = pano_mvs("show", "quality", "--out", tmp_path / "file" / "mine.yaml")
    assert (refused.code, "cannot be written" in refused.flat) == (2, True)


def test_a_resolved_workflow_depends_on_no_other_file_and_computes_nothing_again(
    pano_mvs: Command, toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(toy.folder)  # where its paths are relative
    (toy.folder / "top.yaml").write_text(
        "pano_mvs: 1\nname: toy\nextends: wf.yaml\n"
        "stages: {scaled: {by: 5, retries: 2}, mean: {min_success: 0.5}, all: null}\n"
    )
    options = ["--cache", toy.folder / "cache", "--out", toy.folder / "out", "--executor", "serial"]
    assert pano_mvs("run", "top.yaml", *options).code == 0
    shown = pano_mvs("show", "top.yaml", "--resolved").text
    assert "retries: 2" in shown
    assert "min_success: 0.5" in shown
    assert "extends" not in shown
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "all.yaml").write_text(shown)
    monkeypatch.chdir(elsewhere)
    again = pano_mvs("run", "all.yaml", *options)
    assert again.code == 0
    assert "(nothing to compute)" in again.text


def test_without_resolved_the_files_are_shown_as_they_are(pano_mvs: Command, toy: Toy) -> None:
    text = "pano_mvs: 1\nextends: wf.yaml  # mine\nstages: {scaled: {by: 5}}\n"
    (toy.folder / "top.yaml").write_text(text)
    shown = pano_mvs("show", toy.folder / "top.yaml").text
    assert shown.startswith(text)
    assert f"# extended: {toy.folder / 'wf.yaml'}" in shown
    assert "toy.difference" in shown
    refused = pano_mvs("show", "nowhere")
    assert (refused.code, "no workflow file 'nowhere'" in refused.flat) == (2, True)


PLUGIN = '''
from pano_mvs.api import All, Files, Panorama, Params, stage


class TextParams(Params):
    text: str = ""
    number: float = 0.0
    texts: tuple[str, ...] = ()
    table: dict[str, float | None] = {}


@stage("odd.text")
def text(images: All[Panorama], params: TextParams) -> Files:
    """Nothing."""
    return Files({})
'''


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("odd")
    (folder / "images").mkdir()
    (folder / "odd.py").write_text(PLUGIN)
    return folder


WORDS = st.text(st.characters(min_codepoint=32, max_codepoint=0x2FF, exclude_categories=("C", "Z")) | st.just(" "))
TRICKY = st.sampled_from(["null", "~", "yes", "no", "1", "1e5", "0x10", "0o7", "- a", "a: b", "#", "''", " a ", ".inf"])


@pytest.mark.slow
@settings(max_examples=20)
@given(
    text=WORDS | TRICKY,
    number=st.floats(allow_nan=False, allow_infinity=False),
    texts=st.lists(WORDS | TRICKY, max_size=3),
    table=st.dictionaries(st.sampled_from(["a", "null", "1", "y"]), st.none() | st.floats(-1e300, 1e300), max_size=3),
)
def test_any_values_survive(
    odd: Path, text: str, number: float, texts: list[str], table: dict[str, float | None]
) -> None:
    path = odd / "wf.yaml"
    path.write_text(
        "pano_mvs: 1\nname: odd\nplugins: [odd.py]\n"
        "stages:\n  images: {use: source.folder, path: images}\n  odd: {use: odd.text}\n"
    )
    session = open_session(path, cache=odd / "cache")
    entry = session.workflow.stages["odd"]
    params = type(entry.params).model_validate({"text": text, "number": number, "texts": tuple(texts), "table": table})
    object.__setattr__(entry, "params", params)
    again = resolved_session(session, odd)
    assert again.workflow.stages["odd"].params.model_dump() == params.model_dump()
