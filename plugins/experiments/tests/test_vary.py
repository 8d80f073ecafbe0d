"""`pano-mvs vary`: a toy workflow with each combination of settings."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
from pano_mvs_experiments import vary as module
from pano_mvs_experiments.vary import Experiment, variation_of
from pano_mvs_experiments.vary_results import (
    METRICS,
    Average,
    Best,
    CombinationResult,
    Variation,
    VariedRun,
    averages_of,
    best_of,
    direction_of,
)

import pano_mvs
from pano_mvs.core.errors import UsageError, WorkflowError
from pano_mvs.engine.cache.store import Store
from pano_mvs.results.records import UnitCounts
from pano_mvs.session.progress import Event, RunFinished
from tests.cli.conftest import Command, Outcome
from tests.docs.pages import block, text_of
from tests.engine.conftest import PATIENCE_S, Toy, finished_records, heed_interrupts
from tests.engine.rows import KEPT, Rows


def vary(pano_mvs: Command, toy: Toy, *options: str | os.PathLike[str]) -> Outcome:
    own = ("--out", toy.folder / "v", "--cache", toy.folder / "cache", "--executor", "serial")
    return pano_mvs("vary", toy.folder / "wf.yaml", *own, *options)


def results(toy: Toy) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((toy.folder / "v" / "vary.json").read_text())
    return found


def computed(found: dict[str, Any]) -> list[int]:
    return [run["units"]["run"] for run in found["runs"]]


GRID = ("--set", "scaled.by=2,3,5,7", "--set", "all.rng_seed=0,1,2")
SMALL_GRID = ("--set", "scaled.by=2,3", "--set", "all.rng_seed=0,1")


@pytest.mark.slow
def test_a_grid_of_12_computes_each_distinct_unit_once(toy: Toy, pano_mvs: Command) -> None:
    """The toy capture has 28 units, so 12 runs have 336; 97 are distinct.

    7 do not depend on the settings: 5 numbers and 2 indices. With each factor, 15 are computed again, and 3 for the
    seeds. Of the 20 files of one mean each, 2 equal those of another factor.
    """
    done = vary(pano_mvs, toy, *GRID)
    assert done.code == 0, done.text
    found = results(toy)
    assert sum(computed(found)) == finished_records(toy) == 7 + 4 * (15 + 3) + 18 == 97
    assert sum(sum(run["units"].values()) for run in found["runs"]) == 12 * 28
    assert "12 combinations × 1 capture × 1 seed: 12 runs" in done.text
    assert "97 units computed" in done.text
    names = [each["name"] for each in found["combinations"]]
    assert names == [f"by={by},rng_seed={seed}" for by in (2, 3, 5, 7) for seed in (0, 1, 2)]
    for name in names:
        assert (toy.folder / "v" / "capture" / name / "all.txt").is_file()
    texts = {(toy.folder / "v" / "capture" / name / "all.txt").read_bytes() for name in names}
    assert len(texts) == 12


def test_runs_share_what_is_temporary_and_drop_it_when_all_have_ended(tmp_path: Path, pano_mvs: Command) -> None:
    rows = Rows(tmp_path)
    own = ("--out", tmp_path / "v", "--cache", tmp_path / "cache", "--executor", "serial")
    done = pano_mvs("vary", tmp_path / "wf.yaml", *own, "--set", "last.value=5,6,8")
    assert done.code == 0, done.text
    found = json.loads((tmp_path / "v" / "vary.json").read_text())
    assert computed(found) == [25, 8, 8]
    outs = [f"v/capture/value={value}" for value in (5, 6, 8)]
    assert [rows.kept(of=out) for out in outs] == [KEPT] * 3
    again = pano_mvs("vary", tmp_path / "wf.yaml", *own, "--set", "last.value=5,6,8")
    assert computed(json.loads((tmp_path / "v" / "vary.json").read_text())) == [0, 0, 0], again.text


@pytest.mark.slow
def test_the_same_command_resumes(toy: Toy, pano_mvs: Command) -> None:
    assert vary(pano_mvs, toy, *SMALL_GRID).code == 0
    before = results(toy)
    assert vary(pano_mvs, toy, *SMALL_GRID).code == 0
    assert computed(results(toy)) == [0] * 4
    assert [run["out"] for run in results(toy)["runs"]] == [run["out"] for run in before["runs"]]
    shutil.rmtree(toy.folder / "v" / "capture" / "by=3,rng_seed=1")
    (toy.folder / "v" / "vary.csv").unlink()
    assert vary(pano_mvs, toy, *SMALL_GRID).code == 0
    assert (toy.folder / "v" / "capture" / "by=3,rng_seed=1" / "all.txt").is_file()
    assert (toy.folder / "v" / "vary.csv").is_file()


@pytest.mark.slow
def test_more_values_reuse_the_runs_of_the_others(toy: Toy, pano_mvs: Command) -> None:
    assert vary(pano_mvs, toy, "--set", "scaled.by=2,3").code == 0
    assert vary(pano_mvs, toy, "--set", "scaled.by=2,3,4", "--seeds", "2").code == 0
    by_run = {(run["combination"], run["seed"]): run["units"]["run"] for run in results(toy)["runs"]}
    assert by_run["by=2", 0] == by_run["by=3", 0] == 0
    assert by_run["by=2", 1] == by_run["by=3", 1] == 1


@pytest.mark.slow
def test_seeds_have_folders_of_their_own_and_seed_0_is_an_ordinary_run(toy: Toy, pano_mvs: Command) -> None:
    done = vary(pano_mvs, toy, "--set", "scaled.by=2,3", "--seeds", "3", "--metric", "scaled.value")
    assert done.code == 0, done.text
    assert "2 combinations × 1 capture × 3 seeds: 6 runs" in done.text
    folder = toy.folder / "v" / "capture"
    assert sorted(path.name for path in folder.iterdir()) == [
        *("by=2", "by=2,seed=1", "by=2,seed=2", "by=3", "by=3,seed=1", "by=3,seed=2")
    ]
    assert len({(path / "all.txt").read_bytes() for path in folder.iterdir()}) == 6
    ordinary = pano_mvs("run", toy.folder / "wf.yaml", "--set", "scaled.by=2", "--cache", toy.folder / "cache")
    assert "0 units computed" in ordinary.text
    assert Path("out/toy/all.txt").read_bytes() == (folder / "by=2" / "all.txt").read_bytes()


@pytest.mark.slow
def test_a_list_and_draws_from_a_file(toy: Toy, pano_mvs: Command) -> None:
    file = toy.folder / "list.yaml"
    file.write_text("list:\n  - {}\n  - {scaled.by: 4, mean.retries: 2}\n")
    assert vary(pano_mvs, toy, "--vary", file).code == 0
    assert [each["name"] for each in results(toy)["combinations"]] == ["default", "by=4,retries=2"]
    assert results(toy)["varied"] == ["scaled.by", "mean.retries"]
    file.write_text("random: {count: 2, seed: 1, settings: {scaled.by: {min: 1, max: 9}}}")
    assert "holds an experiment that varies scaled.by, mean.retries" in vary(pano_mvs, toy, "--vary", file).flat
    shutil.rmtree(toy.folder / "v")
    assert vary(pano_mvs, toy, "--vary", file).code == 0
    drawn = [each["settings"]["scaled.by"] for each in results(toy)["combinations"]]
    assert len(set(drawn)) == 2
    assert vary(pano_mvs, toy, "--vary", file, "--set", "mean.retries=0,1").code == 0
    assert len(results(toy)["combinations"]) == 4
    assert "0 units computed" in vary(pano_mvs, toy, "--vary", file, "--set", "mean.retries=0,1").text


def test_settings_that_do_not_vary_are_in_all_runs(toy: Toy, pano_mvs: Command) -> None:
    assert vary(pano_mvs, toy, "--set", "mean.retries=1", "--set", "scaled.by=2,3").code == 0
    assert results(toy)["settings"] == {"mean.retries": "1"}
    run = json.loads((toy.folder / "v" / "capture" / "by=2" / "run.json").read_text())
    assert run["workflow"]["overrides"] == ["mean.retries=1", "scaled.by=2"]
    assert [each["name"] for each in results(toy)["combinations"]] == ["by=2", "by=3"]


def test_groups_of_stages_are_compared(toy: Toy, pano_mvs: Command) -> None:
    (toy.folder / "once.yaml").write_text("pano_mvs: 1\nstages: {scaled: {use: toy.scale, by: 3}}\n")
    (toy.folder / "twice.yaml").write_text(
        "pano_mvs: 1\nstages: {first: {use: toy.scale, by: 2}, scaled: {use: toy.scale, by: 5}}\n"
    )
    toy.edit("wf.yaml", lambda text: text.replace("scaled:     {use: toy.scale, by: 3}", "scaling: {group: once.yaml}"))
    both = f"scaling.group={toy.folder / 'once.yaml'},{toy.folder / 'twice.yaml'}"
    done = vary(pano_mvs, toy, "--set", both, "--metric", "scaled.value")
    assert done.code == 0, done.text
    found = json.loads((toy.folder / "v" / "vary.json").read_text())
    assert found["varied"] == ["scaling.group"]
    once, twice = (each["metrics"]["scaled.value"]["mean"] for each in found["combinations"])
    assert twice == 2 * once
    wrong = vary(pano_mvs, toy, "--set", "scaling.group=nothing.yaml,once.yaml")
    assert (wrong.code, "no shipped group 'nothing.yaml'" in wrong.flat) == (2, True)


@pytest.mark.parametrize(
    ("names", "what"),
    [
        ({"metrics": "x"}, r"metrics=x: write STAGE\.METRIC, or one of registered"),
        ({"until": "x"}, r"there is no stage 'x' in this workflow; it has: images"),
        ({"grid": {"scaled.by": "23"}}, r"grid\['scaled.by'\]: must be a list of values"),
        ({"grid": {"scaled.yb": [2]}}, r"grid\['scaled.yb'\]: stage 'scaled': unknown setting 'yb'\. Known: by, use"),
        ({"grid": {"sclaed.by": [2]}}, r"grid\['sclaed.by'\]: no stage 'sclaed'\. Did you mean 'scaled'"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_runs(toy: Toy, names: dict[str, Any], what: str) -> None:
    """A text was taken for a list of letters."""
    with pytest.raises((UsageError, WorkflowError), match=what):
        pano_mvs.vary(
            toy.folder / "wf.yaml",
            out=toy.folder / "w",
            cache=toy.folder / "wc",
            **({"grid": {"scaled.by": [2]}} | names),
        )
    assert not (toy.folder / "w").exists()
    assert not (toy.folder / "wc").exists()


def test_one_name_may_be_a_text(toy: Toy) -> None:
    found = pano_mvs.vary(
        *(toy.folder / "wf.yaml", (), toy.folder / "w"),
        grid={"scaled.by": [2, 3]},
        metrics="scaled.value",
        until="scaled",
        cache=toy.folder / "cache",
        executor="serial",
    )
    assert found.metrics == ("scaled.value",)
    stages = json.loads((found.runs[0].out / "run.json").read_text())["stages"]
    assert [stage["name"] for stage in stages] == ["images", "scaled"]
    plan = pano_mvs.plan(toy.folder / "wf.yaml", cache=toy.folder / "cache", until="scaled", refresh="images")
    assert [stage.name for stage in plan.stages] == ["images", "scaled"]


def test_equal_combinations_are_named_and_left_out(toy: Toy, pano_mvs: Command) -> None:
    done = vary(pano_mvs, toy, "--set", "scaled.by=3,3.0,4,4")
    assert done.code == 0, done.text
    assert "by=3.0 is left out, because it equals by=3" in done.text
    assert "by=4 (number 4) is left out, because it equals by=4" in done.text
    assert "2 combinations" in done.text
    assert results(toy)["dropped"] == {"by=3.0": "by=3", "by=4 (number 4)": "by=4"}


@pytest.fixture
def captures(toy: Toy) -> list[Path]:
    """Three captures of which two have the same name."""
    folders = [toy.folder / name for name in ("hall/images", "attic/images", "cellar")]
    for number, folder in enumerate(folders):
        shutil.copytree(toy.folder / "capture", folder)
        (folder / "1.txt").write_text(str(10 + number))
    return folders


@pytest.mark.slow
def test_several_captures(toy: Toy, captures: list[Path], pano_mvs: Command) -> None:
    options = [word for folder in captures for word in ("--images", str(folder))]
    done = vary(pano_mvs, toy, *options, "--set", "scaled.by=2,3", "--metric", "scaled.value")
    assert done.code == 0, done.text
    assert "2 combinations × 3 captures × 1 seed: 6 runs" in done.text
    found = results(toy)
    first, second, third = found["captures"]
    assert (first, second) == ("hall_images", "attic_images")
    assert third.endswith("_cellar")
    values = [run["metrics"]["scaled.value"] for run in found["runs"] if run["combination"] == "by=2"]
    assert values == [30.0, 30.2, 30.4]
    (average, _) = [each["metrics"]["scaled.value"] for each in found["combinations"]]
    assert average == {"mean": pytest.approx(30.2), "deviation": None, "captures": 3}
    assert "given twice" in vary(pano_mvs, toy, *options, *options[:2], "--set", "scaled.by=2,3").flat


@pytest.mark.slow
def test_captures_for_which_another_combination_is_the_best_are_named(
    toy: Toy, captures: list[Path], pano_mvs: Command
) -> None:
    toy.edit("plug.py", lambda text: text.replace('"value", x.value', '"value", (x.value - 30.1) * params.by'))
    options = [word for folder in captures for word in ("--images", str(folder))]
    chosen = ("--seeds", "2", "--metric", "mean.value", "--best", "scaled.value")
    done = vary(pano_mvs, toy, *options, "--set", "scaled.by=2,3", *chosen)
    assert done.code == 0, done.text
    found = results(toy)
    assert found["best"]["name"] == "by=3"
    bests = {name: each["best"]["name"] for name, each in found["by_capture"].items()}
    assert [*bests.values()] == ["by=2", "by=3", "by=3"]
    hall = found["by_capture"]["hall_images"]["combinations"]
    assert [each["metrics"]["scaled.value"]["mean"] for each in hall] == pytest.approx([-0.2, -0.3])
    assert "hall_images differs: best by scaled.value (largest): by=2 with -0.2; the next is by=3" in done.flat
    page = (toy.folder / "v" / "vary.html").read_text()
    assert "Another combination is the best for hall_images</b>" in page
    assert page.count('<tr class="best">') == 4
    addresses = re.findall(r'<a href="([^"]+)">seed [01]</a>', page)
    assert len(addresses) == 12
    assert all((toy.folder / "v" / unquote(address)).is_file() for address in addresses)
    assert not re.search(r'(src|href)="(https?:|/)', page)


def test_the_page_of_one_capture_shows_what_is_missing(toy: Toy, pano_mvs: Command) -> None:
    toy.edit("wf.yaml", lambda text: text.replace("use: toy.scale", STOPPING))
    toy.number("3.txt", "13")  # on which it fails
    assert vary(pano_mvs, toy, "--set", "scaled.by=2,<3>").code == 2
    assert vary(pano_mvs, toy, "--set", "scaled.by=2,3", "--stop").code == 3
    page = (toy.folder / "v" / "vary.html").read_text()
    assert "1 of 2 runs have ended" in page
    assert "not run" in page
    assert "Not finished" in page
    assert results(toy)["by_capture"] == {}


STOPPING = "use: toy.scale, on_error: stop"


@pytest.mark.slow
def test_a_combination_that_fails_does_not_end_the_others(toy: Toy, captures: list[Path], pano_mvs: Command) -> None:
    toy.edit("wf.yaml", lambda text: text.replace("use: toy.scale", STOPPING))
    (captures[1] / "3.txt").write_text("13")
    options = [word for folder in captures for word in ("--images", str(folder))]
    done = vary(pano_mvs, toy, *options, "--set", "scaled.by=2,3", "--best", "scaled.by")
    assert done.code == 3
    codes = [run["exit_code"] for run in results(toy)["runs"]]
    assert codes == [0, 0, 4, 4, 0, 0]
    assert done.flat.count("not finished:") == 2
    assert "thirteen is unlucky" in done.flat
    assert [each["exit_code"] for each in results(toy)["combinations"]] == [4, 4]

    stopped = vary(pano_mvs, toy, *options, "--set", "scaled.by=2,3", "--stop")
    assert stopped.code == 3
    assert [run["exit_code"] for run in results(toy)["runs"]] == [0, 0, 4, None, None, None]
    (captures[1] / "3.txt").write_text("12")
    assert vary(pano_mvs, toy, *options, "--set", "scaled.by=2,3", "--stop").code == 0


@pytest.mark.slow
def test_a_capture_that_cannot_be_read_is_in_the_table(toy: Toy, captures: list[Path], pano_mvs: Command) -> None:
    for path in captures[0].iterdir():
        path.unlink()
    options = [word for folder in captures for word in ("--images", str(folder))]
    done = vary(pano_mvs, toy, *options, "--set", "scaled.by=2,3", "--metric", "scaled.value")
    assert done.code == 3, done.text
    average = results(toy)["combinations"][0]["metrics"]["scaled.value"]
    assert average["captures"] == 2
    assert "(2 of 3)" in done.flat


@pytest.mark.slow
def test_an_interrupted_experiment_resumes(toy: Toy, pano_mvs: Command) -> None:
    words = [sys.executable, "-m", "pano_mvs", "vary", str(toy.folder / "wf.yaml"), "--set", "scaled.by=2,3,4"]
    words += ["--out", str(toy.folder / "v"), "--cache", str(toy.folder / "cache"), "--executor", "serial"]
    process = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"TOY_SLEEP_S": "0.3"},
        cwd=toy.folder,
        preexec_fn=heed_interrupts,
    )
    deadline = time.monotonic() + PATIENCE_S
    while finished_records(toy) < 34:  # in the second run
        assert process.poll() is None, process.stdout and process.stdout.read()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    text, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, text
    assert "run the same command again" in text
    assert [run["exit_code"] for run in results(toy)["runs"]] == [0, 130, None]
    finished = finished_records(toy)
    assert vary(pano_mvs, toy, "--set", "scaled.by=2,3,4").code == 0
    assert computed(results(toy))[0] == 0
    assert sum(computed(results(toy))) == finished_records(toy) - finished


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--set", "scaled.by=2,x"), "--set scaled.by: stage 'scaled': by: .*(got \"x\")"),
        (("--set", "scaled.yb=2,3"), "--set scaled.yb: stage 'scaled': unknown setting 'yb'. Known: by, use"),
        (("--set", "scald.by=2,3"), "--set scald.by=2: no stage 'scald'. Did you mean 'scaled'"),
        (("--set", "scaled.by=2,3", "--images", "nowhere"), "--images nowhere: there is no such folder"),
        (("--set", "scaled.by=2,3", "--metric", "scald.value"), "--metric scald.value: no stage 'scald'. Did you mean"),
        (("--set", "scaled.by=2,3", "--metric", "value"), "--metric value: write STAGE.METRIC, or one of registered"),
        (("--set", "scaled.by=2,3", "--best", "scaled.value:big"), "write scaled.value:max if the largest is the best"),
        (("--set", "all.rng_seed=1,2", "--seeds", "2"), "--seeds 2 and all.rng_seed both set the seed"),
        (("--set", "all=null", "--seeds", "2"), "--seeds 2: no stage of this workflow draws random numbers"),
        (("--set", "scaled.by=2,3", "--executor", "none"), "there is no executor 'none'"),
        (("--vary", "v.yaml", "--set", "scaled.by=2"), "v.yaml:1:20: scaled.by is set twice, also by --set scaled.by"),
        (("--vary", "bad.yaml"), "bad.yaml:3:17: stage 'scaled': by: .*(got \"x\")"),
        (("--vary", "bad.yaml"), "bad.yaml:2:17: no stage 'nothing'"),
    ],
)
def test_mistakes_are_found_before_anything_runs(
    toy: Toy, pano_mvs: Command, options: tuple[str, ...], message: str
) -> None:
    Path("v.yaml").write_text("grid: {scaled.by: [2, 3]}")
    Path("bad.yaml").write_text("list:\n  - {nothing.x: 3}\n  - {scaled.by: x}\n")
    done = vary(pano_mvs, toy, *options)
    assert done.code == 2
    assert re.search(message, done.flat), done.text
    assert not (toy.folder / "v").exists()


def test_every_mistake_is_reported_once(toy: Toy, captures: list[Path], pano_mvs: Command) -> None:
    options = [word for folder in captures for word in ("--images", str(folder))]
    done = vary(pano_mvs, toy, *options, "--set", "scaled.by=2,x,y", "--set", "mean.retries=0,-1")
    assert done.code == 2
    assert done.flat.count("error:") == 3, done.text


@pytest.mark.slow
def test_a_folder_that_holds_something_else_is_refused(toy: Toy, pano_mvs: Command) -> None:
    out = toy.folder / "v"
    grid = ("--set", "scaled.by=2,3")
    out.write_text("")
    assert "this is a file" in vary(pano_mvs, toy, *grid).flat
    out.unlink()
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    refused = vary(pano_mvs, toy, *grid)
    assert refused.code == 2
    assert "holds notes.txt and no vary.json. Give a new or an empty folder" in refused.flat
    (out / "notes.txt").unlink()
    assert pano_mvs("run", toy.folder / "wf.yaml", "--out", out, "--cache", toy.folder / "cache").code == 0
    assert "holds the output of a run and no vary.json" in vary(pano_mvs, toy, *grid).flat
    shutil.rmtree(out)
    out.mkdir()
    (out / "vary.json").write_text("[1]")
    assert "is not the vary.json of an experiment" in vary(pano_mvs, toy, *grid).flat
    (out / "vary.json").unlink()
    assert vary(pano_mvs, toy, *grid).code == 0
    (toy.folder / "other.yaml").write_text("pano_mvs: 1\nextends: wf.yaml\n")
    words = ("vary", toy.folder / "other.yaml", "--out", out, "--cache", toy.folder / "cache", *grid)
    assert "holds an experiment with another workflow, toy" in pano_mvs(*words).flat
    before = (out / "vary.json").read_bytes()
    refused = vary(pano_mvs, toy, "--set", "mean.retries=0,1")
    assert refused.code == 2
    assert "holds an experiment that varies scaled.by; this one varies mean.retries. Give another --out" in refused.flat
    assert (out / "vary.json").read_bytes() == before


@pytest.mark.slow
def test_a_folder_over_more_captures_is_refused(toy: Toy, captures: list[Path], pano_mvs: Command) -> None:
    grid = ("--set", "scaled.by=2,3")
    both = [word for folder in captures for word in ("--images", folder)]
    assert vary(pano_mvs, toy, *both, *grid).code == 0
    refused = vary(pano_mvs, toy, "--images", captures[0], *grid)
    assert refused.code == 2
    assert re.search("holds an experiment over attic_images, .*_cellar, which this one leaves out", refused.flat)


def test_the_time_of_a_run_is_that_of_its_own_units(toy: Toy, pano_mvs: Command) -> None:
    assert vary(pano_mvs, toy, "--set", "scaled.by=2,3").code == 0
    store = Store(toy.folder / "cache", for_reading=True)
    for run in results(toy)["runs"]:
        out = str((toy.folder / "v" / run["out"]).resolve())
        entry = next(each for each in store.runs.entries() if each.out == out)
        records = [store.read_record(key) for units in entry.keys.values() for key in units.values()]
        expected = sum(record.seconds for record in records if record is not None)
        assert run["metrics"]["seconds"] == pytest.approx(expected, rel=1e-6)


def test_a_stage_that_is_not_there_is_found_before_the_first_run(toy: Toy, pano_mvs: Command) -> None:
    done = vary(pano_mvs, toy, "--set", "scaled.by=2,3", "--until", "nothing")
    assert done.code == 2
    assert "there is no stage 'nothing'" in done.flat
    assert not (toy.folder / "v").exists()


@pytest.mark.slow
def test_the_folder_of_another_combination_is_refused(toy: Toy, captures: list[Path], pano_mvs: Command) -> None:
    grid = ("--set", "scaled.by=2,3")
    assert vary(pano_mvs, toy, *grid, "--set", "mean.retries=1").code == 0
    before = (toy.folder / "v" / "vary.json").read_bytes()
    refused = vary(pano_mvs, toy, *grid, "--set", "mean.retries=2")
    assert refused.code == 2
    assert (
        "holds the run of another combination: it has mean.retries=1, and this one has mean.retries=2" in refused.flat
    )
    assert "it has mean.retries=1, and this one has no mean.retries" in vary(pano_mvs, toy, *grid).flat
    assert (toy.folder / "v" / "vary.json").read_bytes() == before
    other = shutil.copytree(captures[0], toy.folder / "elsewhere" / "capture")
    assert vary(pano_mvs, toy, "--out", "w", "--images", toy.folder / "capture", *grid).code == 0
    refused = vary(pano_mvs, toy, "--out", "w", "--images", other, *grid)
    assert "holds a run over another capture" in refused.flat


def test_json_and_csv_hold_the_same(toy: Toy, pano_mvs: Command) -> None:
    done = vary(pano_mvs, toy, *SMALL_GRID, "--metric", "scaled.value", "--json")
    assert done.code == 0, done.text
    found = results(toy)
    text = done.text if done.text.startswith("{") else done.text[done.text.index("\n{") :]
    printed = json.loads(text)
    assert printed == found
    with (toy.folder / "v" / "vary.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 4
    for row, run in zip(rows, found["runs"], strict=True):
        assert row["combination"] == run["combination"]
        assert f"by={row['scaled.by']},rng_seed={row['all.rng_seed']}" == row["combination"]
        assert int(row["units_run"]) == run["units"]["run"]
        assert float(row["scaled.value"]) == run["metrics"]["scaled.value"]
        assert (toy.folder / "v" / run["out"] / "run.json").is_file()


@pytest.mark.slow
def test_a_dry_run_shows_what_would_be_computed_and_writes_nothing(toy: Toy, pano_mvs: Command) -> None:
    done = vary(pano_mvs, toy, *GRID, "--dry-run")
    assert done.code == 0
    assert not (toy.folder / "v").exists()
    assert re.search("about [0-9]+ units to compute", done.text)  # the number of pairs is not known yet
    assert vary(pano_mvs, toy, "--set", "scaled.by=2").code == 0
    done = vary(pano_mvs, toy, "--set", "scaled.by=2,3", "--set", "all.rng_seed=0,1", "--dry-run")
    # 5 scaled, 4 differences, 1 shifted, 5 means, 5 files and 1 file of all; one file of all for each further seed
    rows = [line.split("│")[1:-1] for line in done.text.splitlines() if line.startswith("│")]
    assert [row[-1].strip() for row in rows] == ["0", "1", "up to 21", "up to 1"]
    assert "up to 23 units to compute" in done.text
    done = vary(pano_mvs, toy, "--set", "scaled.by=2,3", "--set", "all.rng_seed=0,1", "--dry-run", "--json")
    found = json.loads(done.text[done.text.index("{") :])
    assert [(run["units"], run["bound"]) for run in found["runs"]] == [(0, ""), (1, ""), (21, "up to"), (1, "up to")]
    assert found["units"] == 23
    assert found["runs"][3]["settings"] == {"scaled.by": "3", "all.rng_seed": "1"}


@pytest.mark.slow
def test_vary_in_python_returns_records(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(toy.folder)
    ended: list[Event] = []
    arguments: dict[str, Any] = {"cache": "cache", "executor": "serial", "metrics": ["scaled.value"]}
    found: Variation = pano_mvs.vary(
        "wf.yaml",
        "capture",
        "v",
        grid={"scaled.by": [2, 3.5]},
        settings={"mean.retries": 1},
        seeds=2,
        progress=lambda event: ended.append(event) if isinstance(event, RunFinished) else None,
        **arguments,
    )
    assert found.exit_code == 0
    assert len(ended) == 4
    assert [each.name for each in found.combinations] == ["by=2", "by=3.5"]
    assert found["by=2"].averages["scaled.value"] == Average(30.0, 0.0, 1)
    assert found.computed == sum(run.units.run for run in found.runs) > 0
    assert json.loads((toy.folder / "v" / "vary.json").read_text()) == found.to_json()
    listed = pano_mvs.vary("wf.yaml", out="w", combinations=[{"scaled.by": 2}, {}], **arguments)
    assert [each.name for each in listed.combinations] == ["by=2", "default"]
    settings = {"scaled.by": {"min": 1, "max": 5, "integer": True}}
    drawn = pano_mvs.vary("wf.yaml", out="x", random={"count": 2, "settings": settings}, **arguments)
    assert 1 <= len(drawn.combinations) <= 2
    with pytest.raises(WorkflowError, match=r"grid\['scaled.by'\]: stage 'scaled': by"):
        pano_mvs.vary("wf.yaml", out="y", grid={"scaled.by": ["x"]}, **arguments)
    with pytest.raises(WorkflowError, match=r"settings\['mean.retries'\]: stage 'mean'"):
        pano_mvs.vary("wf.yaml", out="y", grid={"scaled.by": [1]}, settings={"mean.retries": -1}, **arguments)
    with pytest.raises(UsageError, match=r"^seeds 0: give a number from 1|^seeds=0: give"):
        pano_mvs.vary("wf.yaml", out="y", seeds=0, **arguments)


def run(capture: str, seed: int, value: float | None) -> VariedRun:
    metrics = {} if value is None else {"a.b": value}
    return VariedRun(capture, "c", seed, Path(), 0, "", 1.0, UnitCounts(), metrics)


def test_averages_over_captures_and_deviations_over_seeds() -> None:
    runs = [run("x", 0, 1.0), run("x", 1, 3.0), run("y", 0, 10.0), run("y", 1, 10.0)]
    assert averages_of(runs, ["a.b", "a.c"]) == {"a.b": Average(6.0, 0.5**0.5, 2)}
    # The capture y has no value for seed 1: no mean over captures can be compared with that of seed 0.
    assert averages_of([*runs[:3], run("y", 1, None)], ["a.b"]) == {"a.b": Average(6.0, None, 2)}
    assert averages_of([run("x", 0, 1.0), run("y", 0, None)], ["a.b"]) == {"a.b": Average(1.0, None, 1)}


def combination(name: str, mean: float | None, deviation: float | None = None, captures: int = 2) -> CombinationResult:
    averages = {} if mean is None else {"a.b": Average(mean, deviation, captures)}
    return CombinationResult(name, {}, 0, averages)


def best(*combinations: CombinationResult, by: str = "a.b", is_repeatable: bool = False) -> Best:
    return best_of(combinations, by, captures=2, is_repeatable=is_repeatable)


def test_the_best_is_ahead_by_more_than_the_deviation_over_seeds() -> None:
    assert best(combination("p", 1.0, 0.1), combination("q", 2.0, 0.1)).name == "q"
    assert best(combination("p", 1.0, 0.1), combination("q", 2.0, 0.1), by="a.b:min").name == "p"
    close = best(combination("p", 1.95, 0.1), combination("q", 2.0, 0.01), combination("r", 1.0, 0.01))
    assert close.name == ""
    assert "differ by 0.05, which is not more than the deviation over seeds (0.1)" in close.text
    unknown = best(combination("p", 1.0), combination("q", 2.0))
    assert unknown.name == ""
    assert "--seeds 3 measures it" in unknown.text
    assert best(combination("p", 1.0), combination("q", 2.0), is_repeatable=True).name == "q"
    assert "are equal" in best(combination("p", 2.0), combination("q", 2.0), is_repeatable=True).text
    few = best(combination("p", 1.0, 0.1), combination("q", 2.0, 0.1, captures=1))
    assert few.name == ""
    assert "only p has it for every capture" in few.text
    assert "no combination has it" in best(combination("p", None)).text


def test_errors_and_times_are_best_if_they_are_small() -> None:
    assert direction_of("scores.w_mae") == ("scores.w_mae", "min")
    assert direction_of("seconds") == ("seconds", "min")
    assert direction_of("filters.completeness") == ("filters.completeness", "max")
    assert direction_of("scores.w_mae:max") == ("scores.w_mae", "max")
    assert Counter(direction_of(f"a.{name}")[1] for name in ("median_pair_error_deg", "ause", "abs_rel")) == {"min": 3}


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The page of the documentation, in a folder with the captures that it names."""
    monkeypatch.chdir(tmp_path)
    for name in ("photos/lobby", "photos/flat", "photos/house"):
        Path(name).mkdir(parents=True)
    return text_of("experiments.md")


def test_the_python_on_the_page_prints_the_averages(
    page: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def pretend(experiment: Experiment, *_: object, **__: object) -> Variation:
        runs = [
            VariedRun(run.capture, run.combination, run.seed, run.session.out, 0, metrics={"confirmed": float(idx)})
            for idx, run in enumerate(experiment.runs)
        ]
        return variation_of(experiment, runs)

    monkeypatch.setattr(module, "run_experiment", pretend)
    exec(block("experiments.md", "vary"), {})
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "planes=16,cost=census 7.0"
    assert printed[-1].startswith("best by confirmed (largest): planes=48,cost=zncc with 16")


@pytest.mark.slow
def test_the_files_on_the_page_can_be_used(page: str, pano_mvs: Command) -> None:
    found = re.findall(r"<!-- combinations -->\n```yaml\n(.*?)```", page, re.DOTALL)
    assert len(found) == 2
    for text in found:
        Path("v.yaml").write_text(text)
        Path("photos").mkdir()
        done = pano_mvs("vary", "quickstart", "--vary", "v.yaml", "--until", "images", "--dry-run")
        assert done.code == 0, done.text
        Path("photos").rmdir()
    assert "20 combinations" in done.text


def test_the_page_names_all_metrics(page: str) -> None:
    assert all(f"| `{name}` | {meaning}" in page for name, meaning in METRICS.items())
