"""Describe one unit: whether and why it would run, its inputs, and where its result is stored."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape

from pano_mvs.core.errors import UsageError
from pano_mvs.engine.cache.store import ItemRef, Store, UnitRecord
from pano_mvs.engine.planning.plan import StagePlan, make_plan
from pano_mvs.engine.planning.run_options import RunOptions
from pano_mvs.engine.planning.units import Unit, UnitInput
from pano_mvs.session.session import Session

_SHOWN = 8


def explain_unit(session: Session, label: str, console: Console) -> None:
    """Print the description of a unit, `STAGE:ITEM`, or `STAGE` if it has only one unit.

    Raises:
        UsageError: if there is no such stage or unit.
    """
    stage, _, item = label.partition(":")
    workflow, graph = RunOptions(until=(stage,)).applied_to(session.workflow, session.graph)
    store = Store(session.store_root, for_reading=True)
    found: list[tuple[Unit, UnitRecord | None, str]] = []

    def look(unit: Unit, record: UnitRecord | None, reason: str) -> None:
        if (unit.entry.name, unit.item) == (stage, item):
            found.append((unit, record, reason))

    plan = make_plan(workflow, graph, store, visit=look)[-1]
    if not found:
        console.print(escape(f"{label}: {_why_not(plan, item)}"), highlight=False, soft_wrap=True)
        return
    for line in _lines(*found[0], store=store):
        console.print(escape(line), highlight=False, soft_wrap=True)


def _why_not(plan: StagePlan, item: str) -> str:
    if item in plan.blocked:
        return f"cannot run: {plan.blocked[item]}"
    if item in plan.may_run or plan.open:
        return "waits for outputs that are not computed yet; run what it needs first"
    known = [*plan.cached, *plan.run]
    shown = ", ".join(known[:_SHOWN]) + (" …" if len(known) > _SHOWN else "")
    raise UsageError(f"{plan.name} has no unit {item!r}; it has: {shown or 'none'}")


def _lines(unit: Unit, record: UnitRecord | None, reason: str, *, store: Store) -> list[str]:
    spec = unit.entry.spec
    lines = [
        f"{unit.label}: {'cached' if record is not None else f'would run: {reason}'}",
        f"stage    {spec.name} version {spec.version}, {spec.origin}",
        f"key      {unit.key}",
        f"code     {unit.identity['code']}",
    ]
    lines += [f"library  {name} {version}" for name, version in sorted(unit.identity["libraries"].items())]
    lines += [f"setting  {name}: {value!r}" for name, value in sorted(unit.identity["params"].items())]
    lines += [f"file     {role}: {path}" for role, path in (unit.source.files.items() if unit.source else ())]
    lines += [f"reads    {port}: {_read(value)}" for port, value in unit.inputs.items()]
    if record is None:
        return lines
    lines.append(f"took     {record.seconds:.2f} s")
    lines += [f"figure   {name}: {value:z.6g}" for name, value in record.metrics.items()]
    lines += [f"note     {note}" for note in record.notes]
    for name, ref in record.output.parts.items():
        place = store.blobs.place(ref)
        where = place if isinstance(place, Path) else place.name
        lines.append(f"result   {record.output.kind}.{name}: {where} ({ref.size_bytes} bytes)")
    return lines


def _read(value: UnitInput) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, ItemRef):
        return f"{value.kind} {value.digest}"
    names = [f"{name} ({ref.digest[:8]})" if ref.digest else name for name, ref in value.items()]
    return ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")
