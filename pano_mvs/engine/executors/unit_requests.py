"""Units as requests to workers, which share only the cache with the main process: written as JSON, read and served.

A stage that combines all pairs may have half a million inputs. Such large inputs are written into a file in the cache,
some in each line, so that neither process holds all of them as text. Workers keep loaded stages and opened caches
between units.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pano_mvs.core.errors import PanoMvsError, PluginError, StoreError, UsageError
from pano_mvs.core.files import make_folder
from pano_mvs.core.paths import is_inside, reason_of
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.executors.execute import failed_outcome, unit_outcome
from pano_mvs.engine.executors.protocol import Job, JobOutcome
from pano_mvs.engine.planning.units import PENDING, Unit, UnitInput
from pano_mvs.engine.stages.params import Params, json_settings
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import Cardinality, SourceItem, StageSpec
from pano_mvs.engine.stages.stage_code import code_digest, stage_code
from pano_mvs.engine.workflows.policy import Policy
from pano_mvs.engine.workflows.workflow import StageEntry

TEXT_VERSION = 3
LARGE_INPUT = 2000  # the inputs of an All port are written into a file if they are more than this
_ITEMS_PER_LINE = 500


def request_to_json(job: Job, store: Store) -> dict[str, Any]:
    """Return the request to a worker: the unit, and the paths of its plugins, the cache and the log.

    Large inputs are written into the job's `inputs_file`.

    Raises:
        StoreError: if the file cannot be written.
    """
    large = has_large_inputs(job.unit)
    if large:
        try:
            write_large_inputs(job.unit, store, job.inputs_file)
        except OSError as error:
            raise store.cannot_write(error) from error
    return {
        "unit": unit_to_json(job.unit, store, inputs_file=job.inputs_file if large else None),
        "plugins": {str(path.absolute()): digest for path, digest in job.plugins.items()},
        "store": [str(store.root.absolute()), store.durable, store.min_free_bytes],
        "log": str(job.log.absolute()),
        "threads": job.threads,
        "timeout_s": job.timeout_s,
        "fresh": job.fresh,
    }


def has_large_inputs(unit: Unit) -> bool:
    """Return whether some inputs of a unit are too many for one message."""
    return bool(_large_ports(unit))


def write_large_inputs(unit: Unit, store: Store, path: Path) -> None:
    """Write the large inputs of a unit, and the parts of its identity that describe them."""
    make_folder(path.parent)
    with path.open("w", encoding="utf-8") as stream:
        for port in _large_ports(unit):
            value = unit.inputs[port]
            assert isinstance(value, dict)
            items = zip(value.items(), unit.identity["inputs"][port], strict=True)
            while some := list(islice(items, _ITEMS_PER_LINE)):
                refs = {name: ref for (name, ref), _ in some}
                line = {
                    "port": port,
                    "many": {name: ref.to_json() for name, ref in refs.items()},
                    "identity": [described for _, described in some],
                    "external": _external_files(refs.values(), store),
                }
                stream.write(json.dumps(line) + "\n")


def unit_to_json(unit: Unit, store: Store, *, inputs_file: Path | None = None) -> dict[str, Any]:
    """Return everything beside the cache that a worker needs to compute a unit; paths are absolute.

    Args:
        inputs_file: that `write_large_inputs` wrote; None if all inputs are to be in the message.
    """
    spec = unit.entry.spec
    large = _large_ports(unit) if inputs_file is not None else ()
    inputs = {port: value for port, value in unit.inputs.items() if port not in large}
    identity, source = dict(unit.identity), None
    if unit.source is not None:
        files = {role: str(path.absolute()) for role, path in unit.source.files.items()}
        digests = dict(unit.source.digests)
        source = {"name": unit.source.name, "files": files, "links": unit.source.links, "digests": digests}
    if large:
        identity["inputs"] = {name: [] if name in large else part for name, part in identity["inputs"].items()}
    return {
        "text_version": TEXT_VERSION,
        "stage": unit.entry.name,
        "use": spec.name,
        "version": spec.version,
        "code": spec.code_digest,
        "params": json_settings(unit.entry.params, Path.absolute),
        "item": unit.item,
        "members": list(unit.members),
        "inputs": {port: _input_to_json(unit, port, value) for port, value in inputs.items()}
        | {port: {"many": {}} for port in large},
        "inputs_file": str(inputs_file.absolute()) if large and inputs_file else "",
        "external": _external_files(_refs(inputs), store),
        "source": source,
        "key": unit.key,
        "identity": identity,
    }


def unit_from_json(text: Mapping[str, Any], spec: StageSpec, store: Store) -> Unit:
    """Return the unit that `unit_to_json` described, and register its input files with the store.

    Raises:
        UsageError: if another version wrote it, or it is for another version of the stage.
        StoreError: if the file with its inputs cannot be read.
    """
    found = (text["version"], text["code"], text["text_version"])
    if found != (spec.version, spec.code_digest, TEXT_VERSION):
        raise UsageError(_changed(spec))
    for digest, path in text["external"].items():
        store.blobs.place_external(digest, Path(path))
    params = spec.params_type.model_validate(text["params"])
    require_same_code(spec, params, text["identity"])
    inputs = {port: _input_from_json(value) for port, value in text["inputs"].items()}
    if text["inputs_file"]:
        _read_large_inputs(Path(text["inputs_file"]), inputs, text["identity"], store=store)
    source = text["source"]
    if source is not None:
        files = {role: Path(path) for role, path in source["files"].items()}
        source = SourceItem(source["name"], files, links=tuple(source["links"]), digests=source["digests"])
    return Unit(
        entry=StageEntry(text["stage"], spec, params, Policy(use=spec.name), ""),
        item=text["item"],
        members=tuple(text["members"]),
        inputs=inputs,
        key=text["key"],
        identity=text["identity"],
        source=source,
    )


def _read_large_inputs(
    path: Path, inputs: Mapping[str, UnitInput], identity: Mapping[str, Any], *, store: Store
) -> None:
    """Add the inputs in a file to those of a unit, and to its identity."""
    try:
        with path.open(encoding="utf-8") as stream:
            for text in stream:
                line = json.loads(text)
                found = inputs[line["port"]]
                assert isinstance(found, dict)
                found.update((name, ItemRef.from_json(ref)) for name, ref in line["many"].items())
                identity["inputs"][line["port"]].extend(line["identity"])
                for digest, external in line["external"].items():
                    store.blobs.place_external(digest, Path(external))
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: the inputs of a unit cannot be read ({reason_of(error)}). Run again") from error


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


def _large_ports(unit: Unit) -> tuple[str, ...]:
    """Return the All ports with more inputs than one message should have."""
    many = (port.name for port in unit.entry.spec.ports if port.cardinality is Cardinality.ALL)
    return tuple(name for name in many if isinstance(found := unit.inputs.get(name), dict) and len(found) > LARGE_INPUT)


def _refs(inputs: Mapping[str, UnitInput]) -> Iterator[ItemRef]:
    for value in inputs.values():
        if isinstance(value, ItemRef):
            yield value
        elif value:
            yield from value.values()


def _external_files(refs: Iterable[ItemRef], store: Store) -> dict[str, str]:
    """Return digest to path of the parts that are files of the user."""
    parts = (part for ref in refs for part in ref.parts.values())
    return {part.digest: str(store.blobs.path(part).absolute()) for part in parts if part.external}


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


def run_request(request: Mapping[str, Any]) -> JobOutcome:
    """Compute the unit of a request; see `request_to_json`."""
    try:
        store = _store(*request["store"])
        given, texts = request["plugins"], request.get("plugin_texts", {})
        # Files sent with the request are written to a temporary folder.
        files = {path: _written(digest, *texts[path]) if path in texts else path for path, digest in given.items()}
        plugins = {files[path]: digest for path, digest in given.items()}
        unit = unit_from_json(request["unit"], _spec(request["unit"]["use"], plugins), store)
    except PanoMvsError as error:
        return JobOutcome("stopped", cause=str(error), error="UsageError")
    try:
        outcome = unit_outcome(unit, store, threads=request["threads"], log=Path(request["log"]))
    except KeyboardInterrupt as error:  # raised by the stage: workers ignore interrupts
        outcome = failed_outcome(unit, store, error)
    for path, here in files.items():  # name the original file rather than the copy here
        if here != path:
            outcome = replace(outcome, cause=outcome.cause.replace(here, path), trace=outcome.trace.replace(here, path))
    return outcome


_folders: dict[str, TemporaryDirectory[str]] = {}


def _written(digest: str, name: str, texts: Mapping[str, str]) -> str:
    if digest not in _folders:
        folder = _folders[digest] = TemporaryDirectory(prefix="pano-mvs-plugin-")
        for relative, text in texts.items():
            path = Path(folder.name) / relative
            if not is_inside(path, Path(folder.name)):
                raise UsageError(
                    f"plugin {name} imports {relative}, which is not beside it, so that it cannot be sent to workers"
                )
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    return str(Path(_folders[digest].name) / name)


@cache
def _store(root: str, durable: bool, min_free_bytes: int) -> Store:
    return Store(Path(root), durable=durable, min_free_bytes=min_free_bytes)


@cache
def load_installed() -> Registry:
    """Load all installed stages, once in a process."""
    # Before the first unit, because numba reads its maximum number of threads when it is loaded.
    importlib.import_module("numba")
    return Registry.installed()


@cache
def _of_files(plugins: tuple[tuple[str, str], ...]) -> Registry:
    """Load plugin files with the given digests of their code."""
    registry = Registry()
    for path, digest in plugins:
        registry.add_file(Path(path))
        if code_digest(Path(path)) != digest:
            raise UsageError(
                f"plugin {path} is not the same in the worker: it was changed during the run. Run "
                "the same command again"
            )
    return registry


def _spec(name: str, plugins: Mapping[str, str]) -> StageSpec:
    """Return a stage by name, from the plugin files or the installed ones, after loading what it may use."""
    spec = _of_files(tuple(plugins.items())).stages.get(name)
    if spec is None:
        spec = load_installed().stages.get(name)
    if spec is None:
        raise PluginError(f"the worker knows no stage {name!r}; {load_installed().suggest(name)}")
    return spec
