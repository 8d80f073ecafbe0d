"""The events of a run as JSON lines: in the file `logs/events.jsonl` of the output folder, and read from it again."""

from __future__ import annotations

import dataclasses
import json
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, get_args

from pydantic import TypeAdapter, ValidationError

from pano_mvs.core.text import json_without_controls
from pano_mvs.engine.running.dispatcher import LOG_FOLDER
from pano_mvs.session.progress import Event, Progress, RunFinished, RunStarted, Warned

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
