"""The events of a run become spans, which a collector receives; without one, the run is the same."""

from __future__ import annotations

import _thread
import gzip
import logging
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace import ReadableSpan
from opentelemetry.sdk.trace.export import SpanExportResult
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from pano_mvs_records.spans import Spans
from typer.testing import CliRunner

import pano_mvs
from pano_mvs.cli.app import app
from pano_mvs.core.errors import UsageError
from pano_mvs.engine.running.events import StageFinished, StageStarted, UnitFailed, UnitFinished, Warned, ignore
from pano_mvs.session.observers import ObservedRun, Observers
from pano_mvs.session.progress import Event, EventReader, Progress, RunFinished, RunStarted
from tests.engine.conftest import Toy

START = RunStarted("lobby", ("features", "depth"), "processes", workers=2, threads=1, out=Path("out"))
NOWHERE = "http://user:secret@127.0.0.1:1"
"""Nothing listens on this port."""


@pytest.fixture(autouse=True)
def no_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_SERVICE_NAME"):
        monkeypatch.delenv(name, raising=False)


def listening(progress: Progress, exporter: object) -> Progress:
    """Return a callback that passes events on, and to spans."""
    warnings: list[str] = []
    spans = Spans(ObservedRun(Path(), warnings.append), exporter)
    return Observers(Path(), {"otel": spans}, warnings).beside(progress)


def spans_of(*events: Event) -> dict[str, ReadableSpan]:
    """Return the spans of events, by their name and item."""
    exporter = InMemorySpanExporter()
    passed: list[Event] = []
    callback = listening(passed.append, exporter)
    for event in events:
        callback(event)
    assert passed == list(events)
    found = {}
    for span in exporter.get_finished_spans():
        item = str((span.attributes or {}).get("pano_mvs.item", ""))
        found[f"{span.name} {item}".rstrip()] = span
    return found


def attributes(span: ReadableSpan) -> dict[str, Any]:
    return {name.removeprefix("pano_mvs."): value for name, value in (span.attributes or {}).items()}


def ns(span: ReadableSpan) -> tuple[int, int]:
    assert span.start_time is not None
    assert span.end_time is not None
    return span.start_time, span.end_time


def test_units_are_in_stages_and_stages_in_the_run() -> None:
    found = spans_of(
        START,
        StageStarted("depth", 3),
        UnitFinished("depth", "a.png", "run", 0.25),
        UnitFinished("depth", "b.png", "cached", 0.0),
        Warned("the disk is nearly full"),
        StageFinished("depth", "depth.sweep", 3, 1, 1, 0, 1, 0.25, 0.25, {"kept": 0.5}),
        RunFinished(0, "", run=1, cached=1),
    )
    assert set(found) == {"run lobby", "depth", "depth unit a.png"}, "cached units take no time"
    run, stage, unit = found["run lobby"], found["depth"], found["depth unit a.png"]
    assert run.parent is None
    assert [span.parent.span_id for span in (stage, unit) if span.parent] == [
        span.context.span_id for span in (run, stage) if span.context
    ]
    assert ns(unit)[1] - ns(unit)[0] == 250_000_000
    assert ns(run)[0] <= ns(stage)[0] <= ns(stage)[1] <= ns(run)[1]
    assert attributes(run) | {"executor": "processes", "workers": 2, "exit_code": 0, "run": 1} == attributes(run)
    assert attributes(stage) | {"use": "depth.sweep", "cached": 1, "metric.kept": 0.5} == attributes(stage)
    assert [event.name for event in run.events] == ["warning"]
    assert run.status.is_ok or run.status.is_unset
    assert run.resource.attributes["service.name"] == "pano-mvs"


def test_failed_unit_has_the_cause_and_any_name_is_sent() -> None:
    found = spans_of(
        START,
        StageStarted("depth", 1),
        UnitFailed("depth", "\udcff.png", "too dark: \udcff", "there is no range", "logs/a.log"),
        UnitFinished("depth", "\udcff.png", "failed", 0.5),
        RunFinished(3, "", failed=1),
    )
    unit = found["depth unit \\udcff.png"]
    assert not unit.status.is_ok
    assert unit.status.description == "too dark: \\udcff"
    assert attributes(unit) | {"outcome": "failed", "consequence": "there is no range"} == attributes(unit)
    assert found["run lobby"].status.is_unset, "there are results"


def test_stages_that_start_over_or_do_not_end_have_spans() -> None:
    found = spans_of(START, StageStarted("depth", 1), StageStarted("depth", 2), RunFinished(130, "interrupted"))
    assert attributes(found["depth"])["units"] == 2
    assert found["run lobby"].status.description == "interrupted"
    exporter = InMemorySpanExporter()
    callback = listening(ignore, exporter)
    for event in (START, StageStarted("depth", 1), StageStarted("depth", 2), RunFinished(4, "too few")):
        callback(event)
    assert [span.name for span in exporter.get_finished_spans()] == ["depth", "depth", "run lobby"]


def test_service_name_of_the_user_replaces_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_SERVICE_NAME", "survey")
    found = spans_of(START, RunFinished(0, ""))
    assert found["run lobby"].resource.attributes["service.name"] == "survey"


@dataclass
class Collector:
    """A server that takes spans, and what it has received."""

    url: str = ""
    requests: list[ExportTraceServiceRequest] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)

    def names(self) -> list[str]:
        scopes = [scope for request in self.requests for found in request.resource_spans for scope in found.scope_spans]
        return [span.name for scope in scopes for span in scope.spans]


@pytest.fixture
def collector(monkeypatch: pytest.MonkeyPatch) -> Iterator[Collector]:
    found = Collector()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            data = gzip.decompress(body) if self.headers["Content-Encoding"] == "gzip" else body
            found.requests.append(ExportTraceServiceRequest.FromString(data))
            found.paths.append(self.path)
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        found.url = f"http://127.0.0.1:{server.server_port}"
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", found.url)
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        yield found
        server.shutdown()
        thread.join()


def run_toy(toy: Toy, events: list[Event]) -> pano_mvs.RunOutput:
    return pano_mvs.run(
        toy.folder / "wf.yaml",
        out=toy.folder / "out",
        cache=toy.folder / "cache",
        executor="serial",
        observers={"otel": ()},
        progress=events.append,
    )


def test_collector_receives_a_run(toy: Toy, collector: Collector) -> None:
    toy.number("3.txt", "13")  # fails
    events: list[Event] = []
    assert run_toy(toy, events).summary.exit_code == 3
    names = collector.names()
    assert set(collector.paths) == {"/v1/traces"}
    assert names.count("run toy") == 1
    computed = sum(isinstance(event, UnitFinished) and event.outcome in ("run", "failed") for event in events)
    assert sum(name.endswith(" unit") for name in names) == computed > 5
    assert not [event for event in events if isinstance(event, Warned)]


def test_run_without_a_collector_is_the_same(
    toy: Toy, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The library alone waits for seven seconds, and prints each attempt."""
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", NOWHERE)
    monkeypatch.setattr("pano_mvs_records.spans._WAIT_S", 0.2)
    events: list[Event] = []
    output = run_toy(toy, events)
    assert output.ok
    *_, warning, end = events
    assert isinstance(warning, Warned)
    assert warning.text.startswith("spans could not be sent to http://127.0.0.1:1/v1/traces. Start a collector there")
    assert "Connection" in warning.text
    assert "secret" not in warning.text
    assert isinstance(end, RunFinished)
    assert [event for _, event in EventReader(output.out).read()[1]][-2:] == [warning, end]
    assert not caplog.records
    assert logging.getLogger("opentelemetry").propagate


class Refusing:
    """Refuses everything at once, as a collector that wants another password."""

    def export(self, _spans: object) -> SpanExportResult:
        logging.getLogger("opentelemetry.exporter").error("refused")
        return SpanExportResult.FAILURE

    def shutdown(self) -> None:
        pass


def test_one_warning_comes_while_the_run_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "10")
    passed: list[Event] = []
    callback = listening(passed.append, Refusing())
    callback(START)
    until = time.monotonic() + 60
    while not any(isinstance(event, Warned) for event in passed):
        callback(StageStarted("depth", 1))
        assert time.monotonic() < until
        time.sleep(0.01)
    callback(RunFinished(0, ""))
    assert sum(isinstance(event, Warned) for event in passed) == 1
    assert isinstance(passed[-1], RunFinished)


class Interrupted(Refusing):
    def shutdown(self) -> None:
        _thread.interrupt_main()


def test_interrupt_while_spans_are_sent_loses_no_event() -> None:
    # Background jobs of a shell ignore the signal, and then Python does too.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    passed: list[Event] = []
    callback = listening(passed.append, Interrupted())
    callback(START)
    try:
        with pytest.raises(KeyboardInterrupt):
            callback(RunFinished(0, ""))
    finally:
        signal.signal(signal.SIGINT, before)
    assert isinstance(passed[-1], RunFinished)


def test_variables_that_cannot_be_used_are_refused_before_the_run(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_BSP_MAX_QUEUE_SIZE", "0")
    with pytest.raises(UsageError, match=r"^--otel: max_queue_size .* Correct the environment variables"):
        run_toy(toy, [])
    assert not (toy.folder / "out").exists()


def test_missing_library_is_refused_before_the_run(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.exporter.otlp.proto.http.trace_exporter", None)
    place = ["--out", str(toy.folder / "out"), "--cache", str(toy.folder / "cache")]
    result = CliRunner().invoke(app, ["run", str(toy.folder / "wf.yaml"), *place, "--otel"])
    assert result.exit_code == 2
    assert "--otel needs opentelemetry: pip install 'pano-mvs[otel]'" in " ".join(result.output.split())
    assert not (toy.folder / "out").exists()
