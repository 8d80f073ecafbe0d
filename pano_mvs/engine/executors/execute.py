"""Run one unit: load its inputs, call the stage, store the result."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np

from pano_mvs.core import kernel_cache
from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import ChangedFileError, ContractError, PluginError
from pano_mvs.core.process_state import Changes, ProcessState, has_plugins
from pano_mvs.engine.cache.store import ItemRef, Store, UnitRecord
from pano_mvs.engine.executors.changed_files import changed_items, changed_settings
from pano_mvs.engine.executors.lazy_mapping import LazyMapping
from pano_mvs.engine.planning.units import OF_CODE, Unit, UnitInput
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.ports import Cardinality, Names, Port
from pano_mvs.scene import Axis
from pano_mvs.scene.pairs_and_views import pair_from_name

# A process may open only about a thousand files, and a stage may read several kinds.
_MAX_OPEN_FILES = 128
_MAX_BYTES = 128_000_000


class ChangedStateError(PluginError):
    """A plugin, in a thread that it left behind, changed what a unit of another stage computes."""


def execute_unit(unit: Unit, store: Store, *, threads: int) -> UnitRecord:
    """Run a unit and store its result; the record is written last.

    The time of the unit does not include that of compiling kernels, which later units do not need.

    Raises:
        ChangedFileError: if an input file is not the one whose digest is in the key.
        ContractError: if the stage returns something other than what it declared.
        ChangedStateError: if a plugin changed the process while a built-in stage was running.
        Exception: any exception of the stage.
    """
    started, compiling_s = time.perf_counter(), kernel_cache.compilation_time.seconds
    with store.scratch() as scratch:
        context = Context(np.random.default_rng(_seed(unit)), scratch, threads)
        arguments = arguments_of(unit, store)
        value = _called(unit, arguments, context)
        _check_kind(value, unit)
        if reasons := [*changed_items(unit, store).values(), *changed_settings(unit, store)]:
            raise ChangedFileError(reasons[0])
        try:
            output = store.put_value(value)
            items = {name: store.put_value(item) for name, item in value.explode().items()}
        except ContractError as error:
            error.add_note(f"returned by stage {unit.entry.spec.name} ({unit.entry.spec.origin}) for {unit.label}")
            raise
    record = UnitRecord(
        unit.key,
        unit.identity,
        output,
        items,
        context.metrics,
        tuple(context.notes),
        context.rejected,
        value.doubted(),
        max(0.0, time.perf_counter() - started - (kernel_cache.compilation_time.seconds - compiling_s)),
        checked=True,
    )
    store.put(record)
    return record


def _called(unit: Unit, arguments: dict[str, Any], context: Context) -> Any:
    """Return what the stage returns, with the state of the process as before.

    Raises:
        ChangedStateError: if a plugin changed the state while a built-in stage was running.
        Exception: any exception of the stage.
    """
    process, before, changes = os.getpid(), ProcessState.now() if has_plugins() else None, Changes()
    try:
        value = unit.entry.spec.function(**arguments, **_extras(unit, context))
    finally:
        if os.getpid() != process:  # the stage forked, and this is the child, which must not store or answer
            os._exit(0)
        if before is not None:
            changes = before.restore()
    if changes and not unit.entry.spec.is_built_in:
        context.note(f"it changed {changes} in its process; this was undone")
    elif changes.deciding:
        raise ChangedStateError(f"a plugin changed {changes.deciding} while {unit.label} was computed")
    return value


def _seed(unit: Unit) -> int:
    """Return a seed from a unit's stage, settings and inputs, but not its code: seeds do not change with code."""
    return int(digest_from_value({name: part for name, part in unit.identity.items() if name not in OF_CODE}), 16)


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
    refs = {_gathered_key(port, name): ref for name, ref in value.items()}
    return LazyMapping(refs, partial(store.load, kind=port.kind), max_kept=max_kept_items(value.values()))


def max_kept_items(refs: Iterable[ItemRef]) -> int:
    """Return how many loaded items to keep, so that even the largest ones respect the limits on files and memory."""
    opened, read = 0, 1
    for ref in refs:
        opened = max(opened, sum(part.is_mapped for part in ref.parts.values()))
        read = max(read, sum(part.size_bytes for part in ref.parts.values() if not part.is_mapped))
    by_memory = max(1, _MAX_BYTES // read)
    return min(by_memory, max(1, _MAX_OPEN_FILES // opened)) if opened else by_memory


def _gathered_key(port: Port, name: str) -> str | tuple[str, ...]:
    return pair_from_name(name) if port.kind.axis is Axis.PAIR else name


def _extras(unit: Unit, context: Context) -> dict[str, Any]:
    """Return params, context and source item under the names by which the function takes them."""
    offered: dict[str, Any] = {"params": unit.entry.params, "ctx": context, "item": unit.source}
    return {name: offered[role] for name, role in unit.entry.spec.extras.items()}


def _check_kind(value: object, unit: Unit) -> None:
    spec = unit.entry.spec
    if not isinstance(value, spec.output):
        raise ContractError(
            f"stage {spec.name} ({spec.origin}) returned {type(value).__name__} for {unit.label}, "
            f"it declares {spec.output.kind_name()}"
        )
