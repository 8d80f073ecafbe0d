"""The observers otel and notify: what their options are."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from pano_mvs.session.observers import ObservedRun, ObserverKind
from pano_mvs.session.progress import Progress


@contextmanager
def _spans(_values: tuple[str, ...], run: ObservedRun) -> Iterator[Progress]:
    from pano_mvs_records.spans import Spans

    spans = Spans(run)
    try:
        yield spans
    finally:
        spans.close()


@contextmanager
def _message(values: tuple[str, ...], run: ObservedRun) -> Iterator[Progress]:
    from pano_mvs_records.message import Message

    yield Message(values, run)


otel = ObserverKind(_spans, "Send the run, its stages and units as spans to an OpenTelemetry collector.")
notify = ObserverKind(
    _message,
    "Send a message when the run has ended, to an address of apprise such as ntfy://topic; repeatable.",
    "URL",
)
