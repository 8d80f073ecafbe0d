"""Serve requests in a worker, which keeps loaded stages and opened caches between units."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pano_mvs.core.errors import PanoMvsError, PluginError, UsageError
from pano_mvs.core.paths import is_inside
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.execute import unit_outcome
from pano_mvs.engine.executors.protocol import JobOutcome
from pano_mvs.engine.executors.unit_json import unit_from_json
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import StageSpec
from pano_mvs.engine.stages.stage_code import code_digest


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
    outcome = unit_outcome(unit, store, threads=request["threads"], log=Path(request["log"]))
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
def _installed() -> Registry:
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
        # Before the first unit, because numba reads its maximum number of threads when it is loaded.
        importlib.import_module("numba")
        spec = _installed().stages.get(name)
    if spec is None:
        raise PluginError(f"the worker knows no stage {name!r}; {_installed().suggest(name)}")
    return spec
