"""Events come back from the file as they were, while it grows, and a run does not depend on it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import get_args

import pytest

from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.running.events import (
    StageFinished,
    StageStarted,
    UnitFailed,
    UnitFinished,
    UnitStarted,
    Warned,
    ignore,
)
from pano_mvs.results.records import Finding, Tile, Verdict
from pano_mvs.session.progress import (
    EVENTS_FILE,
    BlockStarted,
    Divided,
    Event,
    EventLog,
    EventReader,
    Forecast,
    KernelsCompiled,
    RunFinished,
    RunStarted,
    TimeLeft,
    WorkersChanged,
    event_from_line,
    line_from_event,
)

VERDICT = Verdict("fair", "Finished", "Usable.", "4 units.", (Tile("images", "4"),), (Finding("fair", "blurred"),))
EVENTS: tuple[Event, ...] = (
    RunStarted("lobby", ("images", "depth"), "slurm", workers=3, threads=2, out=Path("out"), cache=Path("/cache")),
    Forecast((StageForecast("depth", ("images",), 1, None, 2.5, None),), report_s=3.0),
    KernelsCompiled(3, 1.5),
    WorkersChanged(2),
    StageStarted("depth", 4),
    UnitStarted("depth", "ä\u2028.png"),
    UnitFailed("depth", "b.png", "too dark", "there is no range", "logs/b.log", ("line", "\x1b")),
    UnitFinished("depth", "a.png", "run", 1.25),
    StageFinished("depth", "depth.sweep", 4, 3, 0, 1, 0, 2.0, 4.0, {"kept": 0.5}),
    TimeLeft(12.5, at_least=True, done=0.25, unknown=("depth",)),
    Warned("disk"),
    Divided("26 panoramas are run in 3 blocks"),
    BlockStarted("block_2", 2, 3, images=12, images_left=12),
    RunFinished(3, "", run=3, failed=1, seconds=9.0, out=Path("out"), verdict=VERDICT, doubts={"a": "b"}),
)


def test_a_line_has_the_fields_of_the_event() -> None:
    line = json.loads(line_from_event(UnitFinished("depth", "a.png", "run", 1.25)))
    del line["time"]
    assert line == {"event": "unit_finished", "stage": "depth", "item": "a.png", "outcome": "run", "seconds": 1.25}


def test_every_event_comes_back() -> None:
    assert {type(event) for event in EVENTS} == set(get_args(Event))
    found = [event_from_line(line_from_event(event)) for event in EVENTS]
    assert [pair[1] for pair in found if pair is not None] == list(EVENTS)


@pytest.mark.parametrize("line", ["", "{", "[]", '{"event": "later", "time": 1}', '{"event": "warning", "time": 1}'])
def test_other_lines_are_no_events(line: str) -> None:
    assert event_from_line(line) is None


@pytest.mark.skipif(os.name != "posix", reason="Windows keeps files that are open")
def test_reader_follows_the_file_and_notices_another_run(tmp_path: Path) -> None:
    passed: list[Event] = []
    log, reader = EventLog(passed.append), EventReader(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"events\.jsonl"):
        reader.read()
    log(EVENTS[0])
    log.open(tmp_path)
    assert [event for _, event in reader.read()[1]] == [EVENTS[0]]
    log(EVENTS[4])
    with (tmp_path / EVENTS_FILE).open("ab") as stream:
        stream.write(b'{"event": "warning",')
        stream.flush()
        assert [event for _, event in reader.read()[1]] == [EVENTS[4]]
        stream.write(b' "time": 1, "text": "late"}\n')
    assert reader.read() == (False, [(1.0, Warned("late"))])

    second = EventLog(ignore)
    second.open(tmp_path)
    log(EVENTS[-1])  # the first run still writes into its own file
    second(EVENTS[5])
    second(EVENTS[-1])
    is_new, events = reader.read()
    assert is_new
    assert [event for _, event in events] == [EVENTS[5], EVENTS[-1]]
    assert passed == [EVENTS[0], EVENTS[4], EVENTS[-1]]


def test_run_goes_on_without_the_file(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("in the way")
    passed: list[Event] = []
    log = EventLog(passed.append)
    log.open(tmp_path)
    log(EVENTS[0])
    assert isinstance(passed[0], Warned)
    assert passed[1:] == [EVENTS[0]]
