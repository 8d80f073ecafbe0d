"""The outcome of one unit that is computed in this process: done, or failed and why; all executors use this."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from pano_mvs.core.errors import ChangedFileError, InputError, RunStoppedError, StoreError, UsageError
from pano_mvs.core.text import shortened
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.capture import captured
from pano_mvs.engine.executors.changed_files import changed_items, changed_settings
from pano_mvs.engine.executors.execute import ChangedStateError, execute_unit
from pano_mvs.engine.executors.failure_cause import cause_of
from pano_mvs.engine.executors.protocol import JobOutcome
from pano_mvs.engine.executors.threads import bound_threads
from pano_mvs.engine.planning.units import Unit


def unit_outcome(unit: Unit, store: Store, *, threads: int, log: Path) -> JobOutcome:
    """Run a unit with its output in `log`, store its result, and return how it ended."""
    started = time.perf_counter()
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        log.touch()
    except OSError as error:
        return JobOutcome("stopped", cause=str(store.cannot_write(error)), error="StoreError", exit_code=4)
    try:
        with captured(log):
            bound_threads(threads)
            record = execute_unit(unit, store, threads=threads)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a unit has also failed if its stage exits, or raises other than Exception
        return replace(_failed(unit, store, error), seconds=time.perf_counter() - started)
    return JobOutcome("done", record, seconds=record.seconds)


def _failed(unit: Unit, store: Store, error: BaseException) -> JobOutcome:
    if isinstance(error, StoreError | RunStoppedError) and not isinstance(error, DamagedBlobError):
        kind = StoreError if isinstance(error, StoreError) else RunStoppedError
        return JobOutcome("stopped", cause=shortened(str(error)), error=kind.__name__, exit_code=error.exit_code)
    if isinstance(error, ChangedStateError):
        return JobOutcome("failed", cause=str(error), died=True)  # the process cannot be used any more
    changed = changed_items(unit, store)
    if isinstance(error, ChangedFileError) and error.path is not None:
        store.stat_cache.forget(error.path)
        changed.setdefault(str(error.path), str(error))  # its content may have been restored
    if changed and unit.source is None:
        return JobOutcome("changed", cause="\n".join(changed.values()), changed=changed)
    if reasons := [*changed.values(), *changed_settings(unit, store)]:
        return JobOutcome("failed", cause=reasons[0])
    if isinstance(error, DamagedBlobError):
        return JobOutcome("damaged", cause=str(error))
    gone = next((ref for ref in unit.input_blobs() if not store.blobs.exists(ref)), None)
    if gone is not None:  # garbage collection deleted it before the stage read it
        return JobOutcome("damaged", cause=str(store.blobs.discard(gone, "is missing")))
    cause, trace = cause_of(unit, error)
    exit_code = error.exit_code if isinstance(error, InputError | UsageError) else 0
    return JobOutcome("failed", cause=cause, trace=trace, exit_code=exit_code)
