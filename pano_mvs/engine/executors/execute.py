"""Compute one unit in this process: load its inputs, call the stage, store the result, or state why it failed.

All executors end in `unit_outcome`.
"""

from __future__ import annotations

import math
import os
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from itertools import islice
from numbers import Real
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from pano_mvs.core import kernel_cache
from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import (
    ChangedFileError,
    ContractError,
    InputError,
    PanoMvsError,
    RunStoppedError,
    StoreError,
    UsageError,
)
from pano_mvs.core.files import make_folder
from pano_mvs.core.process_state import restored_state
from pano_mvs.core.text import error_text, shortened
from pano_mvs.engine.cache.blobs import BlobRef, DamagedBlobError
from pano_mvs.engine.cache.store import ItemRef, Store, UnitRecord
from pano_mvs.engine.executors.capture import captured
from pano_mvs.engine.executors.protocol import JobOutcome
from pano_mvs.engine.executors.threads import bound_threads
from pano_mvs.engine.planning.units import OF_CODE, Unit, UnitInput
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.params import key_fields, registered_files
from pano_mvs.engine.stages.stage import Cardinality, Names, Port, place_of
from pano_mvs.scene import Axis
from pano_mvs.scene.record import changed_text, vanished_text
from pano_mvs.scene.two_view import pair_from_name

Key = TypeVar("Key")
Ref = TypeVar("Ref")
Value = TypeVar("Value")

MAX_METRICS = 1000
"""Most metrics of a unit: the summary and the report list all of them, which takes 7 s for 10,000."""

MAX_NOTES = 10_000
"""Most notes of a unit."""

MAX_IMAGES = 100_000
"""Most images that a unit rejects, or doubts: to list them in the summary and the report takes about 5 s."""

MAX_CHARACTERS = 10_000
"""Most characters of a text that a unit reports."""


def execute_unit(unit: Unit, store: Store, *, threads: int) -> UnitRecord:
    """Run a unit and store its result; the record is written last.

    The time of the unit does not include that of compiling kernels, which later units do not need.

    Raises:
        ChangedFileError: if an input file is not the one whose digest is in the key.
        ContractError: if the stage returns something other than what it declared, or reports what a record cannot hold.
        Exception: any exception of the stage.
    """
    started, compiling_s = time.perf_counter(), kernel_cache.compilation_time.seconds
    with store.scratch() as scratch:
        # The code does not count, so that seeds do not change with it.
        seed = digest_from_value({name: part for name, part in unit.identity.items() if name not in OF_CODE})
        context = Context(np.random.default_rng(int(seed, 16)), scratch, threads)
        arguments = arguments_of(unit, store)
        value = _called(unit, arguments, context)
        spec = unit.entry.spec
        if not isinstance(value, spec.output):
            raise ContractError(
                f"stage {spec.name} ({spec.origin}) returned {type(value).__name__} for {unit.label}, "
                f"it declares {spec.output.kind_name()}"
            )
        if reasons := [*changed_items(unit, store).values(), *changed_settings(unit, store)]:
            raise ChangedFileError(reasons[0])
        try:
            output = store.put_value(value)
            items = {name: store.put_value(item) for name, item in value.explode().items()}
        except ContractError as error:
            error.add_note(f"returned by stage {unit.entry.spec.name} ({unit.entry.spec.origin}) for {unit.label}")
            raise
        try:
            metrics = _checked_metrics(context.metrics)
            notes = _checked_notes(context.notes)
            rejected = _checked_reasons("ctx.rejected", context.rejected)
            doubts = _checked_reasons("doubted()", value.doubted())
        except ContractError as error:
            error.add_note(f"reported by stage {spec.name} ({spec.origin}) for {unit.label}")
            raise
    seconds = max(0.0, time.perf_counter() - started - (kernel_cache.compilation_time.seconds - compiling_s))
    record = UnitRecord(unit.key, unit.identity, output, items, metrics, notes, rejected, doubts, seconds)
    store.put(record)
    return record


def _checked_metrics(found: object) -> dict[str, float]:
    """Return the metrics of a unit, or raise ContractError if a record cannot hold them."""
    metrics = _checked_kind("ctx.metrics", found, dict)
    checked: dict[str, float] = {}
    for key, value in _limited("ctx.metrics", metrics.items(), MAX_METRICS):
        name = _checked_text("the name of a metric", key)
        if not isinstance(value, Real):
            raise ContractError(f"ctx.metrics[{name!r}] is {_kind_of(value)}, not a number")
        number = float(value)
        if not math.isfinite(number):
            raise ContractError(f"ctx.metrics[{name!r}] is {number}: ctx.metric(name, value) leaves such values out")
        checked[name] = number
    return checked


def _checked_notes(found: object) -> tuple[str, ...]:
    """Return the notes of a unit, or raise ContractError if a record cannot hold them."""
    notes = _limited("ctx.notes", _checked_kind("ctx.notes", found, list), MAX_NOTES)
    return tuple(_checked_text("a note", note) for note in notes)


def _checked_reasons(name: str, found: object) -> dict[str, str]:
    """Return reasons by image, or raise ContractError if a record cannot hold them."""
    reasons = _checked_kind(name, found, Mapping)
    return {
        _checked_text(f"an image in {name}", image): _checked_text(f"a reason in {name}", reason)
        for image, reason in _limited(name, reasons.items(), MAX_IMAGES)
    }


def _limited(name: str, found: Iterable[Value], most: int) -> list[Value]:
    """Return what a unit reports, or raise ContractError if it has too many entries."""
    entries = list(islice(found, most + 1))
    if len(entries) > most:
        raise ContractError(f"{name} has more than {most:,} entries, which is the most that a unit may report")
    return entries


def _checked_text(name: str, text: object) -> str:
    if not isinstance(text, str):
        raise ContractError(f"{name} is {_kind_of(text)}, not a text")
    plain = str.__str__(text)  # a subclass may state another length
    if len(plain) > MAX_CHARACTERS:
        raise ContractError(
            f"{name} has {len(plain):,} characters, but at most {MAX_CHARACTERS:,} are possible; ctx.note(text) and "
            "ctx.reject(image, reason) shorten texts"
        )
    return plain


def _checked_kind(name: str, found: Any, kind: type[Any]) -> Any:
    if not isinstance(found, kind):
        raise ContractError(f"{name} is {_kind_of(found)}, not a {kind.__name__.lower()}")
    return found


def _kind_of(value: object) -> str:
    return "None" if value is None else f"a value of type {type(value).__name__}"


def _called(unit: Unit, arguments: dict[str, Any], context: Context) -> Any:
    """Return what the stage returns, with the state of the process as before if it, or a part of it, is a plugin's."""
    process, spec = os.getpid(), unit.entry.spec
    offered: dict[str, Any] = {"params": unit.entry.params, "ctx": context, "item": unit.source}
    is_ours = spec.is_built_in and not registered_files(unit.entry.params)
    with nullcontext() if is_ours else restored_state() as changes:
        try:
            value = spec.function(**arguments, **{name: offered[role] for name, role in spec.extras.items()})
        finally:
            if os.getpid() != process:  # the stage forked, and this is the child, which must not store or answer
                os._exit(0)
    if changes:
        context.note(f"it changed {', '.join(changes)} in its process; this was undone")
    return value


def arguments_of(unit: Unit, store: Store) -> dict[str, Any]:
    """Return the inputs of a unit by port; large arrays are memory-mapped, and All ports load items on access."""
    ports = {port.name: port for port in unit.entry.spec.ports}
    return {name: _load(ports[name], value, store) for name, value in unit.inputs.items()}


def _load(port: Port, value: UnitInput, store: Store) -> object:
    if value is None:
        return None
    if isinstance(value, ItemRef):
        return store.load(value, port.kind)
    if port.cardinality is Cardinality.NEAR:
        return [store.load(ref, port.kind) for ref in value.values()]
    if port.cardinality is Cardinality.NAMES:
        return Names(value)
    refs = {(pair_from_name(name) if port.kind.axis is Axis.PAIR else name): ref for name, ref in value.items()}
    return LazyMapping(
        refs, partial(store.load, kind=port.kind), max_kept=max_kept_items(value.values(), store.blobs.is_mapped)
    )


def max_kept_items(refs: Iterable[ItemRef], is_mapped: Callable[[BlobRef], bool]) -> int:
    """Return how many loaded items to keep, so that even the largest ones respect the limits on files and memory.

    Args:
        is_mapped: whether a part is memory-mapped; see `BlobStore.is_mapped`.
    """
    opened, read = 0, 1
    for ref in refs:
        mapped = [is_mapped(part) for part in ref.parts.values()]
        opened = max(opened, sum(mapped))
        sizes = (part.size_bytes for part, is_open in zip(ref.parts.values(), mapped, strict=True) if not is_open)
        read = max(read, sum(sizes))
    by_memory = max(1, 128_000_000 // read)
    # A process may open only about a thousand files, and a stage may read several kinds.
    return min(by_memory, max(1, 128 // opened)) if opened else by_memory


class LazyMapping(Mapping[Key, Value], Generic[Key, Ref, Value]):
    """A mapping that loads values on access and keeps only the latest ones, so that not all need fit into memory.

    Iteration over keys, length and membership load nothing.

    Args:
        refs: key to the reference that `load` takes, in the order of iteration.
        load: reads one value; its exceptions are raised by the access.
    """

    def __init__(self, refs: Mapping[Key, Ref], load: Callable[[Ref], Value], *, max_kept: int = 64) -> None:
        self._max_kept = max_kept
        self._refs = refs
        self._load = load
        self._latest: OrderedDict[Key, Value] = OrderedDict()

    def __getitem__(self, key: Key) -> Value:
        """Return a value, loading it unless it is among the latest ones."""
        if key in self._latest:
            self._latest.move_to_end(key)
            return self._latest[key]
        value = self._latest[key] = self._load(self._refs[key])
        if len(self._latest) > self._max_kept:
            self._latest.popitem(last=False)
        return value

    def __contains__(self, key: object) -> bool:
        """Return whether a key exists, without loading its value."""
        return key in self._refs

    def __iter__(self) -> Iterator[Key]:
        return iter(self._refs)

    def __len__(self) -> int:
        return len(self._refs)


def changed_items(unit: Unit, store: Store) -> dict[str, str]:
    """Return the files of a capture that a unit reads and that have changed since they were listed, with the reasons.

    Files whose size, time stamps and inode are unchanged are not read.
    """
    listed = {store.blobs.path(ref): ref.digest for ref in unit.input_blobs() if ref.external}
    if unit.source is not None:
        listed |= {unit.source.files[role]: digest for role, digest in unit.source.digests.items()}
    found = {path: _reason(path, digest, store) for path, digest in listed.items()}
    return {str(path): reason for path, reason in found.items() if reason}


def changed_settings(unit: Unit, store: Store) -> list[str]:
    """Return a reason for each file in a unit's settings that has changed since the key was made."""
    digests = unit.identity["params"]
    pairs = [
        pair
        for name, paths in key_fields(unit.entry.params)[1].items()
        for pair in zip(paths, digests[name], strict=True)
    ]
    return [reason for path, digest in pairs if (reason := _reason(path, digest, store))]


def _reason(path: Path, digest: str, store: Store) -> str:
    try:
        if store.stat_cache.digest(path) == digest:
            return ""
        store.stat_cache.forget(path)  # its entry may be damaged
        return "" if store.stat_cache.digest(path) == digest else changed_text(path)
    except InputError:
        return vanished_text(path)


def cause_of(unit: Unit, error: BaseException) -> tuple[str, str]:
    """Return what went wrong, and the traceback if the code failed.

    The messages of our own errors are used as they are; for other errors the line that raised them is added.
    """
    notes = shortened("".join(f" ({note})" for note in getattr(error, "__notes__", [])))
    if isinstance(error, PanoMvsError):
        return f"{error_text(error)}{notes}", ""
    if unit.entry.spec.code_digest and isinstance(error, ModuleNotFoundError):
        notes += " (a plugin imports the files beside it at its top, not inside functions)"
    cause = f"{place_of(error, unit.entry.spec)}: {type(error).__name__}: {error_text(error)}{notes}"
    return cause, shortened("".join(traceback.format_exception(error)), 20_000)


def unit_outcome(unit: Unit, store: Store, *, threads: int, log: Path) -> JobOutcome:
    """Run a unit with its output in `log`, store its result, and return how it ended."""
    if (remote := unit.entry.spec.remote) is not None:
        there: JobOutcome = remote.outcome(unit, store, threads=threads, log=log)
        return there
    started = time.perf_counter()
    try:
        make_folder(log.parent)
        log.touch()
    except OSError as error:
        return JobOutcome("stopped", cause=str(store.cannot_write(error)), error="StoreError", exit_code=4)
    try:
        with captured(log):
            bound_threads(threads)
            record = execute_unit(unit, store, threads=threads)
    except BaseException as error:  # a unit has also failed if its stage exits, or raises other than Exception
        if type(error) is KeyboardInterrupt:
            raise
        return replace(failed_outcome(unit, store, error), seconds=time.perf_counter() - started)
    return JobOutcome("done", record, seconds=record.seconds)


def failed_outcome(unit: Unit, store: Store, error: BaseException) -> JobOutcome:
    """Return how a unit ended that raised an error, even if the error cannot be described."""
    try:
        return _failed(unit, store, error)
    except BaseException as second:  # a plugin's error may hold anything, and memory may be used up
        return JobOutcome("failed", cause=f"{type(error).__name__} ({type(second).__name__}: {error_text(second)})")


def _failed(unit: Unit, store: Store, error: BaseException) -> JobOutcome:
    if isinstance(error, StoreError | RunStoppedError) and not isinstance(error, DamagedBlobError):
        kind = StoreError if isinstance(error, StoreError) else RunStoppedError
        return JobOutcome("stopped", cause=error_text(error), error=kind.__name__, exit_code=error.exit_code)
    changed = changed_items(unit, store)
    if isinstance(error, ChangedFileError) and error.path is not None:
        store.stat_cache.forget(error.path)
        changed.setdefault(str(error.path), error_text(error))  # its content may have been restored
    if changed and unit.source is None:
        return JobOutcome("changed", cause="\n".join(changed.values()), changed=changed)
    if reasons := [*changed.values(), *changed_settings(unit, store)]:
        return JobOutcome("failed", cause=reasons[0])
    if isinstance(error, DamagedBlobError):
        return JobOutcome("damaged", cause=error_text(error))
    gone = next((ref for ref in unit.input_blobs() if not store.blobs.exists(ref)), None)
    if gone is not None:  # garbage collection deleted it before the stage read it
        return JobOutcome("damaged", cause=str(store.blobs.discard(gone, "is missing")))
    cause, trace = cause_of(unit, error)
    exit_code = error.exit_code if isinstance(error, InputError | UsageError) else 0
    return JobOutcome("failed", cause=cause, trace=trace, exit_code=exit_code)
