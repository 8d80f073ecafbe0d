"""The events of a run as spans of OpenTelemetry, which a collector receives over HTTP (OTLP).

There is a span of the run, in it one of each stage, and in that one of each unit that was computed.
"""

from __future__ import annotations

import logging
import os
import re
import threading
import time
from collections.abc import Mapping
from typing import Any

from pano_mvs import __version__
from pano_mvs.core.errors import PanoMvsError, UsageError
from pano_mvs.core.extras import import_extra
from pano_mvs.core.text import shortened, without_controls
from pano_mvs.engine.running.events import StageFinished, StageStarted, UnitFailed, UnitFinished, Warned
from pano_mvs.results.summary import FAILED_ITEMS
from pano_mvs.session.observers import ObservedRun
from pano_mvs.session.progress import Event, RunFinished, RunStarted

_WAIT_S = 5.0


class Spans:
    """Sends spans of the events of a run; the run goes on if they cannot be sent."""

    def __init__(self, run: ObservedRun, exporter: Any = None) -> None:
        """Begin to listen.

        Args:
            exporter: a `SpanExporter`; None for OTLP over HTTP to the collector that OTEL_… variables name.

        Raises:
            UsageError: if OpenTelemetry is not installed, or refuses the variables.
        """
        self._observed = run
        self._endpoint = _endpoint()
        self._trace = _import("opentelemetry.trace")
        try:
            http = "opentelemetry.exporter.otlp.proto.http.trace_exporter"
            self._exporter = exporter or _import(http).OTLPSpanExporter(self._endpoint)
            self._provider = _provider(self._exporter)
        except PanoMvsError:
            raise
        except (ValueError, RuntimeError) as error:
            raise UsageError(
                f"--otel: {str(error).rstrip('.')}. Correct the environment variables that begin with OTEL_"
            ) from error
        self._messages = _Messages()
        self._tracer = self._provider.get_tracer("pano_mvs", __version__)
        self._run: Any = None  # the span of the run, or of the block of a large capture, that is going on
        self._stages: dict[str, Any] = {}  # the spans of those that have begun and not ended
        self._failures: dict[tuple[str, str], UnitFailed] = {}
        self._has_warned = self._is_closed = False

    def __call__(self, event: Event) -> None:
        """Take an event into account; at the last one, wait a few seconds until all is sent."""
        self._take(event)
        if isinstance(event, RunFinished) and event.out == self._observed.out:
            self.close()
        else:
            self._warn_of_failures()

    def _take(self, event: Event) -> None:
        match event:
            case RunStarted():
                given = _attributes(event, "workflow", "executor", "workers", "threads", "out", "cache")
                self._run = self._start(f"run {event.workflow}", given)
            case StageStarted():
                if event.stage in self._stages:  # a run that starts over repeats its stages
                    self._end(self._stages.pop(event.stage))
                given = _attributes(event, "stage", "units")
                self._stages[event.stage] = self._start(event.stage, given, within=self._run)
            case UnitFailed():
                self._failures[event.stage, event.item] = event
            case UnitFinished(outcome="run" | "failed"):
                self._add_unit(event)
            case StageFinished() if span := self._stages.pop(event.stage, None):
                counts = _attributes(event, "use", "units", "run", "cached", "failed", "blocked", "unit_seconds")
                metrics = {f"pano_mvs.metric.{name}": float(value) for name, value in event.metrics.items()}
                self._end(span, {**counts, **metrics})
            case Warned() if self._run is not None:
                self._run.add_event("warning", {"pano_mvs.text": without_controls(event.text)})
            case RunFinished() if self._run is not None:  # the whole of several blocks has no span
                for stage in self._stages.values():
                    self._end(stage)
                self._stages.clear()
                if event.exit_code not in (0, FAILED_ITEMS):
                    self._set_error(self._run, event.stopped)
                found = _attributes(event, "exit_code", "stopped", "run", "cached", "failed", "blocked")
                if event.verdict is not None:
                    found |= _attributes(event.verdict, "mood", "judgement")
                self._end(self._run, found)
                self._run = None
            case _:
                pass

    def _add_unit(self, event: UnitFinished) -> None:
        stage, now_ns = self._stages.get(event.stage, self._run), time.time_ns()
        given = _attributes(event, "stage", "item", "outcome")
        began_ns = now_ns - round(1e9 * event.seconds)
        span = self._start(f"{event.stage} unit", given, within=stage, at_ns=began_ns)
        failure = self._failures.pop((event.stage, event.item), None)
        if failure is not None:
            span.set_attributes(_attributes(failure, "consequence", "log"))
            self._set_error(span, failure.cause)
        self._end(span, at_ns=now_ns)

    def _start(self, name: str, attributes: Mapping[str, Any], *, within: Any = None, at_ns: int | None = None) -> Any:
        context = None if within is None else self._trace.set_span_in_context(within)
        return self._tracer.start_span(
            without_controls(name), context, attributes=attributes, start_time=at_ns or time.time_ns()
        )

    def _end(self, span: Any, attributes: Mapping[str, Any] | None = None, *, at_ns: int | None = None) -> None:
        span.set_attributes(attributes or {})
        span.end(at_ns or time.time_ns())

    def _set_error(self, span: Any, why: str) -> None:
        span.set_status(self._trace.Status(self._trace.StatusCode.ERROR, without_controls(why)))

    def close(self) -> None:
        """Send the remaining spans; warn if that is impossible."""
        if self._is_closed:
            return
        self._is_closed = True
        closing = threading.Thread(target=self._provider.shutdown, daemon=True)
        closing.start()
        try:
            closing.join(_WAIT_S)
            if closing.is_alive():
                self._exporter.shutdown()  # ends the pause before another attempt
                closing.join(1.0)
        finally:
            self._messages.close()
        self._warn_of_failures(is_late=closing.is_alive())

    def _warn_of_failures(self, *, is_late: bool = False) -> None:
        """Warn, once, if OpenTelemetry has logged that it could not send, or it is late."""
        if self._has_warned or not (self._messages.first or is_late):
            return
        self._has_warned = True
        place = re.sub("//.*@", "//", self._endpoint)  # without a password
        reason = f" OpenTelemetry says: {self._messages.first}" if self._messages.first else ""
        self._observed.warn(
            f"spans could not be sent to {place}. Start a collector there that takes OTLP over HTTP, or name "
            f"another one by OTEL_EXPORTER_OTLP_ENDPOINT. The run is not affected.{reason}"
        )


class _Messages(logging.Handler):
    """Takes what OpenTelemetry logs, such as each attempt to send, which would appear between the lines of the run."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        # the first warning or error, which names the cause; later ones say that there is no further attempt
        self.first = ""
        self._logger = logging.getLogger("opentelemetry")
        self._logger.addHandler(self)
        self._logger.propagate = False

    def emit(self, record: logging.LogRecord) -> None:
        error = f": {record.exc_info[1]}" if record.exc_info else ""
        self.first = self.first or shortened(f"{record.getMessage()}{error}", 300)

    def close(self) -> None:
        self._logger.removeHandler(self)
        self._logger.propagate = True
        super().close()


def _import(module: str) -> Any:
    return import_extra(module, "--otel", "otel")


def _endpoint() -> str:
    """Return the address to which spans are sent, by the standard environment variables."""
    base = os.environ.get("OTEL_EXPORTER_OTLP_ENDPOINT") or "http://localhost:4318"
    return os.environ.get("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT") or f"{base.rstrip('/')}/v1/traces"


def _provider(exporter: Any) -> Any:
    resources = _import("opentelemetry.sdk.resources")
    own = resources.Resource.create({"service.name": "pano-mvs", "service.version": __version__})
    resource = own.merge(resources.OTELResourceDetector().detect())  # OTEL_SERVICE_NAME replaces ours
    provider = _import("opentelemetry.sdk.trace").TracerProvider(resource=resource, shutdown_on_exit=False)
    provider.add_span_processor(_import("opentelemetry.sdk.trace.export").BatchSpanProcessor(exporter))
    return provider


def _attributes(record: object, *names: str) -> dict[str, Any]:
    values = {f"pano_mvs.{name}": getattr(record, name) for name in names}
    return {
        name: value if isinstance(value, int | float) else without_controls(str(value))
        for name, value in values.items()
    }
