"""Events of a run, as typed records for a callback, and as JSON lines in the file `logs/events.jsonl`.

A run reports `RunStarted` and `Forecast`, then events of its stages and units, and now and then `KernelsCompiled` and
`TimeLeft`, then `RunFinished`, which is always the last. Stages overlap. If a damaged file is found in the cache, the
run starts over: `StageStarted` is repeated for every stage, and earlier counts no longer apply.

A run in blocks reports `Divided` if nobody asked for blocks, then for each block `BlockStarted` and the events of its
run, and at last `RunFinished` with its own output folder.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, get_args

from pydantic import TypeAdapter, ValidationError

from pano_mvs.core.text import json_without_controls
from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.running.dispatcher import LOG_FOLDER
from pano_mvs.engine.running.events import RunEvent
from pano_mvs.engine.running.events import StageFinished as StageFinished  # these are passed on
from pano_mvs.engine.running.events import StageStarted as StageStarted
from pano_mvs.engine.running.events import UnitFailed as UnitFailed
from pano_mvs.engine.running.events import UnitFinished as UnitFinished
from pano_mvs.engine.running.events import UnitStarted as UnitStarted
from pano_mvs.engine.running.events import Warned as Warned
from pano_mvs.results.records import Verdict


@dataclass(frozen=True, slots=True)
class RunStarted:
    """The run begins."""

    kind: ClassVar[str] = "run_started"
    workflow: str  # its name
    stages: tuple[str, ...]  # names of its stages, in order
    executor: str  # such as `processes`
    workers: int  # number of units at a time
    threads: int  # of each worker
    out: Path  # the output folder
    cache: Path = Path()  # the folder of the cache
    groups: Mapping[str, str] = field(default_factory=dict)  # stage to its group of stages, if it is in one


@dataclass(frozen=True, slots=True)
class Forecast:
    """What the run is expected to take, by earlier runs; this event is missing if the images cannot be listed."""

    kind: ClassVar[str] = "forecast"
    stages: tuple[StageForecast, ...]  # in the order of the workflow
    report_s: float = 0.0  # seconds for the report, after the last stage
    compiles: bool = False  # whether no kernel has been compiled yet, which takes time that is in none of these


@dataclass(frozen=True, slots=True)
class TimeLeft:
    """How long the run is expected to go on. This event comes at most once a second, and only together with others.

    Units that take minutes give no events except, every five seconds, this one; executor `serial` not even that. To
    show the time left at any moment, pass all events to a `pano_mvs.session.time_estimator.TimeEstimator`, and ask it.
    """

    kind: ClassVar[str] = "time_left"
    seconds_left: float  # until the run ends
    at_least: bool = False  # whether this is a lower bound, because of one of the last two
    done: float = 0.0  # share of the work that is done, 0 to 1
    unknown: tuple[str, ...] = ()  # the stages of which nothing is known
    compiles: bool = False  # whether stages are still to come whose kernels may have to be compiled


@dataclass(frozen=True, slots=True)
class KernelsCompiled:
    """Workers are compiling kernels, which happens once for a version; this event comes at most once a second."""

    kind: ClassVar[str] = "kernels_compiled"
    kernels: int  # number of kernels that have been compiled during the run
    seconds: float  # since the number was looked up last


@dataclass(frozen=True, slots=True)
class WorkersChanged:
    """Workers have come or gone, as jobs of a queueing system do; this is the number of units at a time now."""

    kind: ClassVar[str] = "workers_changed"
    workers: int


@dataclass(frozen=True, slots=True)
class Divided:
    """The capture is run in blocks although nobody asked for it; `reason` states in one line how and why."""

    kind: ClassVar[str] = "divided"
    reason: str


@dataclass(frozen=True, slots=True)
class BlockStarted:
    """A run in blocks begins with a block, which is a run with events of its own."""

    kind: ClassVar[str] = "block_started"
    block: str  # its name, such as block_2
    number: int  # the same as a number, from 1
    blocks: int  # number of all blocks
    images: int  # number of its images
    images_left: int  # number of images of the blocks after it


@dataclass(frozen=True, slots=True)
class RunFinished:
    """The run has ended, also if it was interrupted or raised an error."""

    kind: ClassVar[str] = "run_finished"
    exit_code: int  # as of `RunSummary`
    stopped: str  # why it ended early; empty if it did not
    run: int = 0  # number of computed units
    cached: int = 0  # units taken from the cache
    failed: int = 0  # units without a result
    blocked: int = 0  # units that did not run because an input failed
    seconds: float = 0.0  # that the run took
    out: Path = Path()  # the output folder
    verdict: Verdict | None = None  # on the result; None if the run was aborted
    doubts: Mapping[str, str] = field(default_factory=dict)  # doubtful image to the reason


Event = (
    RunStarted
    | Forecast
    | KernelsCompiled
    | WorkersChanged
    | RunEvent
    | TimeLeft
    | Divided
    | BlockStarted
    | RunFinished
)
Progress = Callable[[Event], None]


SCHEMA = 1
EVENTS_FILE = f"{LOG_FOLDER}/events.jsonl"


def line_from_event(event: Event) -> str:
    """Return an event, with the present time, as a line of JSON."""
    fields: dict[str, Any] = {"event": event.kind, "time": round(time.time(), 3)}
    if isinstance(event, RunStarted):
        fields["schema"] = SCHEMA
    fields |= {field.name: getattr(event, field.name) for field in dataclasses.fields(event)}
    if isinstance(event, RunFinished) and event.verdict is None:
        del fields["verdict"], fields["doubts"]
    return json_without_controls(json.dumps(fields, ensure_ascii=False, allow_nan=False, default=_json_value)) + "\n"


def _json_value(value: Any) -> Any:
    """Return what JSON does not know as a JSON value: records as objects, all else as text."""
    is_record = dataclasses.is_dataclass(value) and not isinstance(value, type)
    return dataclasses.asdict(value) if is_record else str(value)


def event_from_line(line: str | bytes) -> tuple[float, Event] | None:
    """Return an event and its time; None if the line is not an event that this version knows."""
    try:
        fields = json.loads(line)
        return float(fields["time"]), _adapters()[fields["event"]].validate_python(fields)
    except (ValueError, KeyError, TypeError, ValidationError):
        return None


@cache
def _adapters() -> dict[str, TypeAdapter[Any]]:
    return {kind.kind: TypeAdapter(kind) for kind in get_args(Event)}


class EventLog:
    """A progress callback that passes events on, and appends them to the file; a run does not fail if that fails."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._stream: BinaryIO | None = None
        self._held: bytes | None = b""  # before the file is opened

    def __call__(self, event: Event) -> None:
        """Write an event, and pass it on; the last one closes the file."""
        self._write(event)
        if isinstance(event, RunFinished):
            self._close()
        self._progress(event)

    def open(self, out: Path) -> None:
        """Begin a new file, with the events so far; another run in this folder must not be writing."""
        path, held, self._held = out / EVENTS_FILE, self._held, None
        try:
            path.parent.mkdir(exist_ok=True)
            path.unlink(missing_ok=True)  # a reader sees that it is another file
            self._stream = path.open("xb", buffering=0)
            self._stream.write(held or b"")
        except OSError as error:
            self._close()
            self._progress(Warned(f"{path} cannot be written, so that `pano-mvs watch` shows nothing: {error}"))

    def _close(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _write(self, event: Event) -> None:
        if self._held is not None:
            self._held += line_from_event(event).encode()
        elif self._stream is not None:
            with suppress(OSError):  # such as a full disk, which ends the run with a message of its own
                self._stream.write(line_from_event(event).encode())


class EventReader:
    """Reads the file while a run appends to it."""

    def __init__(self, out: Path) -> None:
        self._path = out / EVENTS_FILE
        self._first = b""  # the first line: another run begins another file
        self._position = 0

    def read(self) -> tuple[bool, list[tuple[float, Event]]]:
        """Return whether another run has begun since the last call, and the events that are new, with their times.

        Raises:
            OSError: if there is no file.
        """
        with self._path.open("rb") as stream:
            first = stream.readline()
            is_new = first != self._first
            self._first, self._position = first, 0 if is_new else self._position
            stream.seek(self._position)
            data = stream.read()
        whole = data[: data.rfind(b"\n") + 1]
        self._position += len(whole)
        return is_new, [event for line in whole.splitlines() if (event := event_from_line(line)) is not None]
