"""What `run` prints and suggests."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.cli.commands import COMMANDS
from pano_mvs.cli.console import Console
from pano_mvs.cli.run.command import interrupted_by_termination
from pano_mvs.cli.run.printing import has_scene, next_commands, print_summary
from pano_mvs.core.errors import InputError
from pano_mvs.core.processes import start_of
from pano_mvs.engine.cache.store import Store
from pano_mvs.results.records import CloudSummary, Finding, StageOutcome, Verdict
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.session.captures import run as run_workflow
from pano_mvs.session.session import open_session, reopen, run_command
from tests.cli.conftest import Command
from tests.engine.conftest import PATIENCE_S, Toy, finished_records, start, wait_for_records
from tests.engine.running.test_run import BEFORE_MEANS, hold_means, wait_for_means

ON_POSIX = pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=PATIENCE_S)
    return process.returncode, out, err


def finish_here(toy: Toy, *options: str) -> tuple[int, str, str]:
    """Run in this process, which saves most of the time of a small run."""
    places = ("--cache", str(toy.folder / "cache"), "--out", str(toy.folder / "out"), "--executor", "serial")
    result = CliRunner().invoke(app, ["run", str(toy.folder / "wf.yaml"), *places, *options])
    return result.exit_code, result.stdout, result.stderr


def events_of(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


@pytest.mark.slow
def test_events_are_complete_and_nothing_else_is_printed(toy: Toy) -> None:
    toy.number("3.txt", "13")
    toy.edit("plug.py", lambda text: text.replace('"""Multiply."""', '"""Multiply."""\n    print("noise", x.value)'))
    code, out, _ = finish(start(toy, "--json", "--executor", "processes", "--workers", "2"))
    assert code == 3
    events = events_of(out)
    assert [events[0]["event"], events[-1]["event"]] == ["run_started", "run_finished"]
    assert (events[0]["schema"], events[0]["executor"], events[0]["workers"]) == (1, "processes", 2)
    assert events[-1]["exit_code"] == 3
    opened = {event["stage"]: event["units"] for event in events if event["event"] == "stage_started"}
    assert set(opened) == set(events[0]["stages"])
    assert Counter(event["stage"] for event in events if event["event"] == "unit_finished") == opened
    closed = {event["stage"]: event for event in events if event["event"] == "stage_finished"}
    assert {name: event["units"] for name, event in closed.items()} == opened
    for what in ("run", "failed", "blocked"):
        assert sum(event[what] for event in closed.values()) == events[-1][what]
    (failed,) = (event for event in events if event["event"] == "unit_failed")
    assert (failed["stage"], failed["item"], failed["said"]) == ("scaled", "3.txt", ["noise 13.0"])
    assert Path(failed["log"]).read_text() == "noise 13.0\n"
    begun = Counter((event["stage"], event["item"]) for event in events if event["event"] == "unit_started")
    assert set(begun.values()) == {1}


@pytest.mark.slow
def test_nothing_but_events_is_on_the_standard_output(toy: Toy) -> None:
    toy.edit(
        "plug.py",
        lambda text: text.replace("def list_items(params):", "print('a')\ndef list_items(params):\n    print('b')"),
    )
    code, out, err = finish(start(toy, "--json", "--executor", "serial"))
    assert code == 0
    assert events_of(out)[0]["event"] == "run_started"
    assert {"a", "b"} <= set(err.split())


def test_events_of_a_run_that_cannot_begin_end_as_well(toy: Toy) -> None:
    for number in range(1, 6):
        toy.number(f"{number}.txt", "not a number")
    code, out, err = finish_here(toy, "--json")
    assert code == 2
    assert events_of(out)[-1]["exit_code"] == 2
    assert "none of the 5 items" in err


@pytest.mark.slow
@ON_POSIX
def test_interrupt_lets_units_finish_and_says_how_to_go_on(toy: Toy) -> None:
    hold = hold_means(toy)
    process = start(toy, "--executor", "processes", "--workers", "2")
    wait_for_means(toy, process, 2)
    process.send_signal(signal.SIGINT)
    _read_until(process, "2 units may finish within")
    hold.unlink()
    code, _, err = finish(process)
    assert code == 130
    assert json.loads((toy.folder / "out" / "run.json").read_bytes())["stopped"] == "interrupted"
    assert (toy.folder / "out" / "report.html").is_file()
    assert f"pano-mvs run {toy.folder / 'wf.yaml'}" in err.replace("\n", "")
    records = [path.read_bytes() for path in (toy.folder / "cache" / "records").rglob("*.json")]
    assert sum(b'"stage": "toy.mean"' in record for record in records) == 2, "the units in flight have finished"
    assert toy.run().computed == 28 - len(records)


def _interrupts(number: signal.Signals) -> bool:
    try:
        os.kill(os.getpid(), number)
    except KeyboardInterrupt:
        return True
    return False


@ON_POSIX
def test_a_terminal_that_closes_interrupts_once() -> None:
    """A terminal that closes may send its signal twice; under nohup it must not end anything."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        with interrupted_by_termination():
            assert _interrupts(signal.SIGHUP)
            assert not _interrupts(signal.SIGHUP)
            assert _interrupts(signal.SIGTERM)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with interrupted_by_termination():
            assert not _interrupts(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


@ON_POSIX
@pytest.mark.slow
def test_a_second_run_into_a_folder_is_refused_until_the_first_has_ended(toy: Toy) -> None:
    """The second computed beside the first, and whichever came last said that all was well."""
    first = start(toy, "--workers", "2", sleep_s=600)
    wait_for_records(toy, first, 6)
    earlier = {path.name for path in (toy.folder / "cache" / "tmp").iterdir()}
    code, out, err = finish(start(toy, "--json"))
    assert code == 4
    assert events_of(out)[-1]["exit_code"] == 4
    assert f"another run is writing into {toy.folder / 'out'}: process {first.pid} on" in err.replace("\n", "")
    assert first.poll() is None
    first.kill()
    finish(first)
    left = [path.name for path in (toy.folder / "cache" / "tmp").iterdir()]
    assert earlier & set(left)
    deadline = time.monotonic() + PATIENCE_S
    while any(start_of(int(name.split("-")[2])) is not None for name in left if name.startswith(".tmp-")):
        assert time.monotonic() < deadline, "a worker outlives the run"  # they notice the end of the run by and by
        time.sleep(0.1)
    assert finish(start(toy, "--executor", "serial"))[0] == 0
    assert not (toy.folder / "out" / ".pano-mvs-lock").exists()
    assert not list((toy.folder / "cache" / "tmp").iterdir()), "what the killed run left behind is gone"


def _read_until(process: subprocess.Popen[str], *words: str) -> None:
    assert process.stdout is not None
    said = []
    for line in process.stdout:
        said.append(line)
        if all(word in line for word in words):
            return
    code, _, err = finish(process)
    pytest.fail(f"it ended with {code} and never said {words}, but {said} and {err}")


@pytest.mark.slow
@ON_POSIX
def test_second_interrupt_ends_at_once(toy: Toy) -> None:
    """The units in flight may take an hour, and so may the run after the first interrupt."""
    toy.edit("plug.py", lambda text: f"from pano_mvs.engine.running import run\nrun.GRACE_S = 3600.0\n{text}")
    process = start(toy, "--json", "--executor", "processes", "--workers", "2", sleep_s=3600.0)
    for _ in range(2):  # when the second is told of, the first is at work
        _read_until(process, '"unit_started"', '"mean"')
    process.send_signal(signal.SIGINT)
    _read_until(process, "may finish")
    process.send_signal(signal.SIGINT)
    code, out, _ = finish(process)
    assert code == 130
    assert events_of(out)[-1]["exit_code"] == 130


@ON_POSIX
@pytest.mark.slow
def test_workers_end_with_a_run_that_is_killed(toy: Toy) -> None:
    toy.edit(
        "plug.py",
        lambda text: text.replace(
            '"""Multiply."""',
            '''"""Multiply."""
    open(f"pid-{os.getpid()}", "w").close(); time.sleep(300)''',
        ),
    )
    process = start(toy, "--executor", "processes", "--workers", "1")
    deadline = time.monotonic() + PATIENCE_S
    while not (found := list(toy.folder.glob("pid-*"))) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    process.communicate()
    pid = int(found[0].name.removeprefix("pid-"))
    deadline = time.monotonic() + 120  # less than the unit would take
    while time.monotonic() < deadline:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        if "(zombie)" in _state(pid):
            return
        time.sleep(0.05)
    os.kill(pid, signal.SIGKILL)
    pytest.fail("the worker goes on for nobody")


def _state(pid: int) -> str:
    path = Path(f"/proc/{pid}/status")
    return path.read_text() if path.is_file() else ""


def test_failure_shows_the_last_lines_and_where_the_rest_is(toy: Toy) -> None:
    toy.number("3.txt", "13")
    toy.edit("plug.py", lambda text: text.replace('"""Multiply."""', '"""Multiply."""\n    print("just before")'))
    code, out, _ = finish_here(toy)
    assert code == 3
    assert "  | just before" in out
    assert "3.txt.log" in out
    assert "thirteen is unlucky" in out
    assert "just before" not in [line.strip() for line in out.splitlines()], "units do not print among our lines"


@pytest.mark.parametrize(
    "place",
    [
        '"""Multiply."""\n    if x.value == 30: ',
        "def list_items(params):\n    ",
        '"""A toy pipeline."""\nimport os, sys\n',
    ],
)
def test_a_plugin_that_exits_in_this_process_is_an_error(toy: Toy, place: str) -> None:
    """Each of them ended the command with exit code 0 and without a word."""
    how = "sys.exit(0)"
    toy.edit("plug.py", lambda text: text.replace(place.strip().splitlines()[0], f"{place}{how}", 1))
    toy.edit("plug.py", lambda text: text.replace("import os\n", "import os, sys\n", 1))
    code, _, err = finish_here(toy)
    in_unit = "Multiply" in place
    assert code == (3 if in_unit else 2), err
    shown = (toy.folder / "out" / "report.html").read_text() if in_unit else err
    assert "plug.py" in shown
    assert "SystemExit: 0" in shown
    assert "there is no stage" not in shown


@ON_POSIX
@pytest.mark.slow
def test_an_interrupt_lets_a_single_worker_finish_its_unit(toy: Toy) -> None:
    hold = hold_means(toy)
    process = start(toy, "--workers", "1")
    wait_for_means(toy, process, 1)
    process.send_signal(signal.SIGTERM)
    _read_until(process, "1 unit may finish within")
    hold.unlink()
    assert finish(process)[0] == 130
    assert finished_records(toy) == BEFORE_MEANS + 1


def commands_of(text: str) -> list[list[str]]:
    """Return the words of each command below `next:`, which must be the last lines."""
    *_, after = text.split("\nnext:\n")
    assert all(line.startswith("  pano-mvs ") for line in after.splitlines()), after
    return [shlex.split(line)[1:] for line in after.splitlines()]


@pytest.fixture
def here(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> Toy:
    """The toy, in its folder, with names that need quotes."""
    monkeypatch.setenv("COLUMNS", "60")
    (toy.folder / "my photos").mkdir()
    for number in (1, 2, 3):
        (toy.folder / "my photos" / f"{number}.txt").write_text("5")
    toy.edit("plug.py", lambda text: text.replace('"all.txt"', '"cloud.ply"'))
    return toy


@pytest.fixture
def to_look_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """The commands that show results are installed, and no others of plugins."""
    monkeypatch.setattr(COMMANDS, "names", lambda: ("share", "view"))


@pytest.mark.usefixtures("to_look_at")
def test_the_last_lines_are_the_next_commands(pano_mvs: Command, here: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(here.folder)
    ran = pano_mvs("run", "wf.yaml", "--images", "my photos", "--out", "my out", "--executor", "serial")
    assert ran.code == 0
    assert commands_of(ran.text) == [["view", "my out"]]
    assert "open my out/report.html in a browser\nnext:" in ran.text


@pytest.mark.usefixtures("to_look_at")
def test_a_run_with_failures_names_the_command_that_repeats_it(
    pano_mvs: Command, here: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(here.folder)
    (here.folder / "my photos" / "2.txt").write_text("13")
    options = ["--images", "my photos", "--set", "scaled.by=4", "--out", "my out", "--cache", "my cache"]
    first = pano_mvs("run", "wf.yaml", *options, "--executor", "serial")
    assert first.code == 3
    again, _ = commands_of(first.text)
    (here.folder / "my photos" / "2.txt").write_text("14")
    repeated = pano_mvs(*again)
    assert repeated.code == 0
    assert "2 units computed" not in repeated.text
    assert commands_of(repeated.text) == [["view", "my out"]]
    stages = {stage.name: stage.params for stage in _summary(here.folder / "my out")}
    assert stages["scaled"] == {"by": 4.0}


def test_a_partial_run_names_the_command_for_the_rest(
    pano_mvs: Command, here: Toy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(here.folder)
    ran = pano_mvs("run", "wf.yaml", "--until", "scaled", "--executor", "serial")
    (rest,) = commands_of(ran.text)
    assert rest == ["run", "wf.yaml"]
    assert "share" not in ran.text, "there is nothing to show yet"
    assert pano_mvs(*rest).code == 0


@pytest.mark.usefixtures("to_look_at")
def test_verdict_and_reasons_come_before_the_next_commands(
    here: Toy, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(here.folder)
    here.run()
    session = here.session()
    output = _output(session.out, cloud=CloudSummary(points=9))
    print_summary(output, Console(), following=next_commands(output, session))
    lines = capsys.readouterr().out.splitlines()
    start = lines.index("Usable, with doubts: see below.")
    assert lines[start + 1] == "doubtful: One is odd. Look at it."
    assert lines[start + 2].startswith("results in ")
    assert lines[start + 3] == "next:"
    assert [line.split()[1] for line in lines[start + 4 :]] == ["share"]


@pytest.mark.usefixtures("to_look_at")
def test_share_names_the_cache_if_another_one_is_set(finished: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    session = finished.session()
    output = _output(session.out, cloud=CloudSummary(points=9), cache=str(session.store_root))
    out = str(session.out)
    assert next_commands(output, session) == [shlex.join(["pano-mvs", "share", out, "--to", f"{out}_page"])]
    monkeypatch.setenv("PANO_MVS_CACHE", str(finished.folder / "elsewhere"))
    assert next_commands(output, session)[-1].endswith(f"--cache {session.store_root}")


def test_commands_that_are_not_installed_are_not_suggested(finished: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    session = finished.session()
    output = _output(session.out, cloud=CloudSummary(points=9), files={"cloud.ply": ""})
    for names in (("view",), ("share",), ()):
        monkeypatch.setattr(COMMANDS, "names", lambda names=names: names)
        assert [shlex.split(command)[1] for command in next_commands(output, session)] == list(names)


def test_a_command_names_presets_and_leaves_out_defaults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PANO_MVS_CACHE", raising=False)
    assert run_command(open_session("fast")) == "pano-mvs run fast"
    (tmp_path / "photos").mkdir()
    (tmp_path / "elsewhere").mkdir()
    session = open_session("fast", images="photos", overrides=["depth.planes=48"], out="o", cache="c")
    command = "pano-mvs run fast --images photos --set depth.planes=48 --out o --cache c"
    assert run_command(session) == command
    assert run_command(session, "--only", "depth:a b") == f"{command} --only 'depth:a b'"
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert f"--images {tmp_path / 'photos'}" in run_command(session), "the folder is not here any more"
    (tmp_path / "elsewhere" / "fast.yaml").write_text("pano_mvs: 1\nextends: fast\n")
    assert run_command(open_session("fast.yaml")) == "pano-mvs run fast.yaml"


def test_an_output_folder_opens_the_session_of_its_run(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(toy.folder)
    run_workflow("wf.yaml", "capture", "out", settings={"scaled.by": 9}, cache="cache", executor="serial")
    (toy.folder / "elsewhere").mkdir()
    monkeypatch.chdir(toy.folder / "elsewhere")
    session = reopen("../out", overrides=[], images=None, cache=None)
    assert session.workflow.stages["scaled"].params.model_dump() == {"by": 9.0}
    assert session.store_root == toy.folder / "cache"
    assert session.out == Path("../out")
    (toy.folder / "wf.yaml").unlink()
    with pytest.raises(InputError, match="Give another workflow"):
        reopen("../out", overrides=[], images=None, cache=None)


@pytest.mark.parametrize("name", ["cloud.ply", "sad/cloud.ply", "mesh.ply", "colmap/sparse/0/cameras.bin"])
def test_what_can_be_seen_is_known_from_the_names_of_files(name: str) -> None:
    assert has_scene(RunSummary(files={"range/1.tiff": "", name: ""}))
    others = ("range/1.tiff", "report.html", "colmap/images/1.jpg", "points.laz")
    assert not has_scene(RunSummary(files=dict.fromkeys(others, "")))


def _summary(out: Path) -> tuple[StageOutcome, ...]:
    return RunSummary.read(out).stages


def _output(out: Path, **fields: object) -> RunOutput:
    """Return the output of a run with other fields in its summary, and a verdict with one reason."""
    finding = Finding("fair", "One is odd.", "Look at it.")
    verdict = Verdict("fair", "Finished", "Usable, with doubts: see below.", "", (), (finding,))
    summary = RunSummary(verdict=verdict, **fields)  # type: ignore[arg-type]
    return RunOutput(out, summary, StoredValues.of_folder(out, summary, Store(out.parent / "cache")))
