"""Why a unit has to be computed: the difference between its identity in the last run and now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.planning.units import OF_CODE, Unit

_SHOWN = 3


def reason_to_run(unit: Unit, last_key: str | None, store: Store) -> str:
    """Return why a unit is not in the cache.

    Args:
        unit: the unit.
        last_key: its key in the latest run of this workflow; None if it was not part of that run.
        store: the cache, which may still have the record of that run.
    """
    if last_key is None:
        return "new"
    if last_key == unit.key:
        return "its cached result is missing or damaged, or it did not finish"
    last = store.read_record(last_key)
    if last is None:
        return "changed (the record of the last run is missing)"
    before, now = last.identity, unit.identity
    if before.get("schema") != now["schema"]:
        return "this version makes its key differently"
    differences = [
        *_differences("param", before.get("params", {}), now["params"]),
        *_inputs(unit, before.get("inputs", {}), now["inputs"]),
    ]
    if before.get("stage") != now["stage"]:
        differences.insert(0, f"stage {before.get('stage')} → {now['stage']}")
    elif before.get("version") != now["version"]:
        differences.insert(0, f"version of {now['stage']} {before.get('version')} → {now['version']}")
    if before.get("code") != now["code"]:
        file = f" ({unit.entry.spec.origin.rpartition(':')[0]})" if unit.entry.spec.code_digest else ""
        differences.insert(0, f"code of {now['stage']} changed{file}")
    differences.extend(_upgrades(before.get("libraries"), now["libraries"]))
    differences.extend(_differences("kind", before.get("kinds", {}), now["kinds"]))
    return "; ".join(differences) or "this version makes its key differently"


def only_the_code_differs(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Return whether two identities differ, and only in the code or the libraries."""
    parts = {*before, *now} - OF_CODE
    return before != now and all(name in before and name in now and before[name] == now[name] for name in parts)


def _upgrades(before: object, now: Mapping[str, str]) -> list[str]:
    """Return the changed versions of the libraries that both identities name."""
    if not isinstance(before, Mapping):
        return []
    return [f"{name} {before[name]} → {now[name]}" for name in sorted({*before} & {*now}) if before[name] != now[name]]


def _differences(what: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    return [
        f"{what} {name} {before.get(name)!r} → {now.get(name)!r}"
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    ]


def _inputs(unit: Unit, before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    changed: list[str] = []
    if unit.source is not None and before.get("name") != now["name"]:
        return [f"renamed from {before.get('name')}"]
    for port in sorted({*before, *now}):
        old, new = before.get(port), now.get(port)
        if old == new:
            continue
        if unit.source is not None:
            changed.extend(f"input {path.name}" for path in unit.source.files.values())
        else:
            changed.append(f"input {port}: {_changed_items(unit, port, old=old, new=new)}")
    return changed


def _changed_items(unit: Unit, port: str, *, old: Any, new: Any) -> str:
    value = unit.inputs.get(port)
    if value is None or isinstance(value, ItemRef):
        return unit.item or "changed"
    known = {str(entry) for entry in old or []}
    names = [name for name, entry in zip(value, new, strict=True) if str(entry) not in known]
    if not names:
        return "fewer items" if len(new) < len(old or []) else "another order"
    return ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")
