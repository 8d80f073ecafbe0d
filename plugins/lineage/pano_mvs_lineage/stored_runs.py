"""Runs as their output folders and caches have them: what each unit was made of, and what it made."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from pano_mvs.core.errors import InputError, PanoMvsError, StoreError
from pano_mvs.core.paths import children, is_file, is_folder, resolved
from pano_mvs.core.text import shortened_list
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RUN_JSON, RunSummary, cache_of
from pano_mvs.session.session import reopen

_SKIPPED = frozenset({"logs", "blocks"})


@dataclass(frozen=True)
class StoredRun:
    """A run in an output folder, and the cache that it used, if that is still there."""

    out: Path
    summary: RunSummary
    store: Store | None
    notes: tuple[str, ...] = ()  # what is missing, and why

    @staticmethod
    def open(out: Path, cache: Path | None = None) -> StoredRun:
        """Open the latest run into an output folder.

        Args:
            cache: folder of the cache; None for $PANO_MVS_CACHE, or else the one that run.json names.

        Raises:
            InputError: if the folder has no run.json that can be read, or `cache` is not a cache.
        """
        summary = RunSummary.read(out)
        root = cache_of(summary, cache)
        if not is_file(root / "layout.json"):
            if cache is not None:
                raise InputError(f"{root} is not a cache of pano_mvs. Give the cache that the run used")
            return StoredRun(out, summary, None, (f"the cache of {out}, {root}, is not there",))
        store = Store(root, for_reading=True)
        run = StoredRun(out, summary, store)
        if not run.keys:
            return StoredRun(out, summary, store, (f"the cache {root} contains no run into {out}",))
        return run

    @cached_property
    def keys(self) -> Mapping[str, Mapping[str, str]]:
        """The cache key of each unit, by stage and item; empty if the cache does not know the run."""
        if self.store is None:
            return {}
        own = str(resolved(self.out))
        try:
            found = (entry for entry in self.store.runs.entries() if entry.out == own and not entry.pinned)
            return next((entry.keys for entry in found), {})
        except StoreError:
            return {}

    @cached_property
    def output(self) -> RunOutput:
        """The output of the run, whose values are loaded when they are used."""
        store = self.store
        values = StoredValues() if store is None else StoredValues.of_folder(self.out, self.summary, store)
        return RunOutput(self.out, self.summary, values)

    @cached_property
    def producers(self) -> Mapping[str, Mapping[str, str]]:
        """The stage that feeds each port, by stage and port; empty if the workflow is no longer there."""
        try:
            session = reopen(str(self.out), overrides=[], images=None, cache=None)
        except PanoMvsError:
            return {}
        edges = session.graph.edges
        return {stage: {port: edge.producer for port, edge in edges[stage].items()} for stage in session.graph.order}

    def made_by(self, stage: str, port: str, digest: str) -> tuple[str, str, UnitRecord] | None:
        """Return the stage, the item and the record of the unit whose value a stage read; None if it is not known.

        Without the workflow, it is the last stage before it that made this value, which several may have made.
        """
        producer = self.producers.get(stage, {}).get(port)
        order = [outcome.name for outcome in self.summary.stages]
        before = order[: order.index(stage)] if stage in order else order
        for name in [producer] if producer is not None else reversed(before):
            found = self._makers(name).get(digest)
            record = None if found is None else self.record(name, found)
            if found is not None and record is not None:
                return name, found, record
        return None

    def _makers(self, stage: str) -> Mapping[str, str]:
        """Return the unit of a stage that made each value, by its digest."""
        if stage not in self._known_makers:
            made: dict[str, str] = {}
            for item, record in self.records(stage):
                for value in (record.output, *record.items.values()):
                    made.setdefault(value.digest, item)
            self._known_makers[stage] = made
        return self._known_makers[stage]

    @cached_property
    def _known_makers(self) -> dict[str, Mapping[str, str]]:
        return {}

    def record(self, stage: str, item: str) -> UnitRecord | None:
        """Return what a unit was made of and what it made; None if the cache does not have it."""
        key = self.keys.get(stage, {}).get(item)
        return None if key is None or self.store is None else self._read_record(key)

    @cached_property
    def _read_record(self) -> Callable[[str], UnitRecord | None]:
        """Reads the record of a key; the way back from one file asks for some of them a hundred times."""
        assert self.store is not None
        return lru_cache(maxsize=4096)(self.store.read_record)

    def records(self, stage: str) -> Iterator[tuple[str, UnitRecord]]:
        """Yield the units of a stage that the cache has, with their items."""
        for item in self.keys.get(stage, {}):
            record = self.record(stage, item)
            if record is not None:
                yield item, record

    @property
    def unlisted(self) -> str:
        """A note on what run.json does not list; "" if it lists all."""
        if self.summary.merged is not None:
            blocks = shortened_list(list(map(str, self.summary.merged.blocks)))
            return f"{self.out} was merged from blocks; their runs state images, settings and versions: {blocks}"
        found = {"images": self.summary.inputs, "versions of libraries": self.summary.versions}
        lacking = " and no ".join(what for what, values in found.items() if not values)
        if not lacking:
            return ""
        return (
            f"{self.out}: its run.json lists no {lacking}, which are not compared: an earlier version of pano_mvs "
            "wrote it, or the run ended early. Run the workflow again to add them"
        )

    @property
    def settings(self) -> dict[str, Any]:
        """Each setting as `STAGE.SETTING`, and the stage behind each name as `STAGE.use`."""
        found: dict[str, Any] = {}
        for stage in self.summary.stages:
            found[f"{stage.name}.use"] = stage.use
            found |= {f"{stage.name}.{name}": value for name, value in stage.params.items()}
        return found

    @property
    def metrics(self) -> dict[str, float]:
        """Each metric as `STAGE.METRIC`, the mean over the units of the stage."""
        return {
            f"{stage.name}.{name}": float(value)
            for stage in self.summary.stages
            for name, value in stage.metrics.items()
            if value is not None
        }


def as_paths(folders: str | Path | Iterable[str | Path]) -> list[Path]:
    """Return one folder, or several, as paths."""
    return [Path(folders)] if isinstance(folders, str | Path) else [Path(folder) for folder in folders]


def find_runs(folders: Iterable[Path]) -> list[Path]:
    """Return the output folders of runs in some folders: these themselves, or those below them, by their names.

    Links to folders are followed; a run that is met twice is listed once.

    Raises:
        InputError: if a folder does not exist, or holds no run.
    """
    found: dict[Path, Path] = {}
    for folder in folders:
        if not is_folder(folder):
            raise InputError(f"{folder}: there is no such folder. Give an output folder, or a folder of these")
        outs = list(_runs_below(folder, set()))
        if not outs:
            raise InputError(f"{folder}: there is no run in this folder or below it; each has a {RUN_JSON}")
        for out in outs:
            found.setdefault(resolved(out), out)
    return list(found.values())


def _runs_below(folder: Path, seen: set[Path]) -> Iterator[Path]:
    """Yield the folders with a run.json, each place once."""
    if resolved(folder) in seen:  # a link that leads back
        return
    seen.add(resolved(folder))
    if is_file(folder / RUN_JSON):
        yield folder
    for inner in children(folder):
        if is_folder(inner) and inner.name not in _SKIPPED and not inner.name.startswith("."):
            yield from _runs_below(inner, seen)
