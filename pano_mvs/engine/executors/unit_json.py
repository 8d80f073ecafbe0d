"""Convert units of work to JSON and back, for workers that share only the cache with the main process."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pano_mvs.core.errors import UsageError
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.executors.protocol import Job
from pano_mvs.engine.planning.units import PENDING, Unit, UnitInput
from pano_mvs.engine.stages.params import Params
from pano_mvs.engine.stages.ports import Cardinality
from pano_mvs.engine.stages.stage import SourceItem, StageSpec
from pano_mvs.engine.stages.stage_code import stage_code
from pano_mvs.engine.workflows.policy import Policy
from pano_mvs.engine.workflows.workflow import StageEntry

TEXT_VERSION = 2


def request_to_json(job: Job, store: Store) -> dict[str, Any]:
    """Return the request to a worker: the unit, and the paths of its plugins, the cache and the log."""
    return {
        "unit": unit_to_json(job.unit, store),
        "plugins": {str(path.absolute()): digest for path, digest in job.plugins.items()},
        "store": [str(store.root.absolute()), store.durable, store.min_free_bytes],
        "log": str(job.log.absolute()),
        "threads": job.threads,
        "timeout_s": job.timeout_s,
    }


def unit_to_json(unit: Unit, store: Store) -> dict[str, Any]:
    """Return everything beside the cache that a worker needs to compute a unit; paths are absolute.

    Raises:
        UsageError: if the settings of the stage change when they are written as JSON and read back.
    """
    spec = unit.entry.spec
    return {
        "text_version": TEXT_VERSION,
        "stage": unit.entry.name,
        "use": spec.name,
        "version": spec.version,
        "code": spec.code_digest,
        "params": params_to_json(unit.entry),
        "item": unit.item,
        "members": list(unit.members),
        "inputs": {port: _input_to_json(unit, port, value) for port, value in unit.inputs.items()},
        "external": {ref.digest: str(store.blobs.path(ref).absolute()) for ref in unit.input_blobs() if ref.external},
        "source": None if unit.source is None else _source_to_json(unit.source),
        "key": unit.key,
        "identity": dict(unit.identity),
    }


def unit_from_json(text: Mapping[str, Any], spec: StageSpec, store: Store) -> Unit:
    """Return the unit that `unit_to_json` described, and register its input files with the store.

    Raises:
        UsageError: if another version wrote it, or it is for another version of the stage.
    """
    found = (text["version"], text["code"], text["text_version"])
    if found != (spec.version, spec.code_digest, TEXT_VERSION):
        raise UsageError(_changed(spec))
    for digest, path in text["external"].items():
        store.blobs.place_external(digest, Path(path))
    params = spec.params_type.model_validate(text["params"])
    require_same_code(spec, params, text["identity"])
    return Unit(
        entry=StageEntry(text["stage"], spec, params, Policy(use=spec.name), ""),
        item=text["item"],
        members=tuple(text["members"]),
        inputs={port: _input_from_json(value) for port, value in text["inputs"].items()},
        key=text["key"],
        identity=text["identity"],
        source=None if text["source"] is None else _source_from_json(text["source"]),
    )


def require_same_code(spec: StageSpec, params: Params, identity: Mapping[str, Any]) -> None:
    """Raise UsageError if this process has other code or libraries than the key of a unit says."""
    here = stage_code(spec, params)
    if here.digest != identity["code"]:
        raise UsageError(_changed(spec))
    for name, version in identity["libraries"].items():
        if here.libraries.get(name) != version:
            raise UsageError(
                f"stage {spec.name!r}: the worker has {name} {here.libraries.get(name, '(none)')}, the "
                f"run was started with {version}. Install the same version everywhere, then run the same "
                "command again"
            )


def _changed(spec: StageSpec) -> str:
    return (
        f"stage {spec.name!r} is not the same in the worker ({spec.origin}): it was changed during the "
        "run, or another version is installed there. Run the same command again"
    )


def params_to_json(entry: StageEntry) -> dict[str, Any]:
    """Return a stage's settings as JSON values from which the same settings can be made again.

    Raises:
        UsageError: if that is impossible.
    """
    values = _plain(entry.params)
    if _plain(entry.spec.params_type.model_validate(values)) != values:
        raise UsageError(
            f"stage {entry.name!r} ({entry.spec.origin}): its settings change when they are validated a "
            "second time, so that they cannot be sent to a worker. Use --executor serial"
        )
    return values


def _plain(params: Params) -> dict[str, Any]:
    plain = _with_absolute_paths(params.model_dump(mode="python"), params.model_dump(mode="json"))
    assert isinstance(plain, dict)
    return plain


def _with_absolute_paths(value: Any, as_json: Any) -> Any:
    """Return the JSON form of a value with all paths made absolute."""
    if isinstance(value, Path):
        return str(value.absolute())
    if isinstance(as_json, dict) and isinstance(value, dict):
        pairs = zip(value.values(), as_json.items(), strict=True)
        return {name: _with_absolute_paths(inner, inner_json) for inner, (name, inner_json) in pairs}
    if isinstance(as_json, list) and isinstance(value, list | tuple):
        return [_with_absolute_paths(*pair) for pair in zip(value, as_json, strict=True)]
    return as_json


def _input_to_json(unit: Unit, port: str, value: UnitInput) -> Any:
    if value is None:
        return None
    if isinstance(value, ItemRef):
        return {"one": value.to_json()}
    cardinality = next(found.cardinality for found in unit.entry.spec.ports if found.name == port)
    if cardinality is Cardinality.NAMES:
        return {"names": list(value)}
    return {"many": {name: ref.to_json() for name, ref in value.items()}}


def _input_from_json(value: Any) -> UnitInput:
    if value is None:
        return None
    if "one" in value:
        return ItemRef.from_json(value["one"])
    if "names" in value:
        return dict.fromkeys(value["names"], PENDING)
    return {name: ItemRef.from_json(ref) for name, ref in value["many"].items()}


def _source_to_json(item: SourceItem) -> dict[str, Any]:
    files = {role: str(path.absolute()) for role, path in item.files.items()}
    return {"name": item.name, "files": files, "digests": dict(item.digests)}


def _source_from_json(value: Mapping[str, Any]) -> SourceItem:
    files = {role: Path(path) for role, path in value["files"].items()}
    return SourceItem(value["name"], files, digests=value["digests"])
