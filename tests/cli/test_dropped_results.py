"""What the commands say of results that were dropped, and `--keep all`."""

from __future__ import annotations

from pathlib import Path

import pytest

import pano_mvs as package
from tests.cli.conftest import Command
from tests.engine.rows import KEPT, TEMPORARY, Rows


@pytest.fixture
def rows(tmp_path: Path) -> Rows:
    return Rows(tmp_path)


@pytest.fixture
def own(rows: Rows) -> tuple[str | Path, ...]:
    """Options of `run` and `plan`."""
    return rows.folder / "wf.yaml", "--out", rows.folder / "out", "--cache", rows.folder / "cache"


def test_plan_states_what_was_dropped_and_what_would_be_computed_again(
    rows: Rows, own: tuple[str | Path, ...], pano_mvs: Command
) -> None:
    assert pano_mvs("run", *own, "--executor", "serial").code == 0
    said = pano_mvs("plan", *own).flat
    assert "12 cached units have results that were dropped after an earlier run; nothing reads it now" in said
    assert "nothing to compute" in said
    said = pano_mvs("plan", *own, "--set", "last.value=6").flat
    assert "mean:0.txt and 3 more: dropped after an earlier run; last reads it" in said
    assert "16 units would run" in said
    said = pano_mvs("plan", *own, "--keep", "all").flat
    assert "first:0.txt and 3 more: dropped after an earlier run, and to be kept now" in said


def test_the_forecast_of_disk_space_states_what_stays(
    rows: Rows, own: tuple[str | Path, ...], pano_mvs: Command
) -> None:
    """It counted the results of temporary stages, which the run drops again."""
    pano_mvs("run", *own, "--executor", "serial")
    changed = ("--set", "first.value=6")
    wf, out, cache = (rows.folder / name for name in ("wf.yaml", "out", "cache"))
    planned = package.plan(wf, out=out, cache=cache, settings={"first.value": 6})
    sizes = {one.stage: one.stored_bytes or 0.0 for one in planned.forecasts}
    assert planned.dropped_bytes == sum(sizes[name] for name in TEMPORARY) > 0
    assert planned.stored_bytes == sum(sizes.values()) - planned.dropped_bytes > 0
    said = pano_mvs("plan", *own, *changed)
    assert "more until it drops the results of temporary stages" in said.flat
    assert [line.split("│")[-2].strip() for line in said.text.splitlines() if "│ first" in line] == ["dropped"]
    for options in (("--keep", "all"), ("--until", "last")):
        said = pano_mvs("plan", *own, *changed, *options)
        assert "dropped" not in said.text.partition("first:")[0], "what is limited to a part drops nothing"
        assert "temporary stages" not in said.flat


def test_explain_says_that_a_result_was_dropped(rows: Rows, own: tuple[str | Path, ...], pano_mvs: Command) -> None:
    pano_mvs("run", *own, "--executor", "serial")
    said = pano_mvs("plan", *own, "--explain", "mean:1.txt").flat
    assert "mean:1.txt: cached" in said
    assert "result Numbers.values: dropped after an earlier run; computed again when something reads it" in said


def test_keep_all_is_an_option_and_an_argument(rows: Rows, own: tuple[str | Path, ...], pano_mvs: Command) -> None:
    assert pano_mvs("run", *own, "--executor", "serial", "--keep", "all").code == 0
    assert rows.kept() == {*KEPT, *TEMPORARY}
    assert pano_mvs("run", *own, "--executor", "serial").code == 0
    assert rows.kept() == KEPT
    wrong = pano_mvs("run", *own, "--keep", "some")
    assert wrong.code == 2
    assert "'all'" in wrong.flat


def test_keep_all_in_python(rows: Rows) -> None:
    wf, out, cache = (rows.folder / name for name in ("wf.yaml", "out", "cache"))
    package.run(wf, out=out, cache=cache, executor="serial")
    assert package.plan(wf, out=out, cache=cache).units == 0
    assert package.plan(wf, out=out, cache=cache, keep="all").units == 4
    assert package.run(wf, out=out, cache=cache, executor="serial", keep="all").ok
    assert rows.kept() == {*KEPT, *TEMPORARY}


def test_a_resolved_workflow_and_a_laid_out_one_say_what_is_temporary(
    rows: Rows, own: tuple[str | Path, ...], pano_mvs: Command
) -> None:
    wf = rows.folder / "wf.yaml"
    assert pano_mvs("show", wf, "--resolved").text.count("temporary: true") == 3
    before = wf.read_text()
    assert pano_mvs("fmt", wf).code == 0
    assert wf.read_text().count("temporary: true") == before.count("temporary: true")
    assert pano_mvs("check", wf, "--set", "mean.temporary=perhaps").code == 2


def test_cache_commands_find_nothing_wrong_with_dropped_results(
    rows: Rows, own: tuple[str | Path, ...], pano_mvs: Command
) -> None:
    pano_mvs("run", *own, "--executor", "serial")
    verified = pano_mvs("cache", "verify", *own[3:])
    assert (verified.code, "0 damaged" in verified.flat) == (0, True)
    assert "0 units, 0 blobs" in pano_mvs("cache", "gc", "--unused", "0s", "--delete", *own[3:]).flat
    assert pano_mvs("cache", "du", *own[3:]).code == 0
    said = pano_mvs("run", *own, "--executor", "serial").flat
    assert "0 units computed" in said or "nothing" in said
