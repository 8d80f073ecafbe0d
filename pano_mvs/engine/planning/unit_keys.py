"""Make the cache keys of units from code, settings and inputs, and find the units of a stage from what feeds it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from sys import intern
from typing import Any

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import ChangedFileError, InputError, PanoMvsError, PluginError, UsageError
from pano_mvs.core.file_names import item_problem
from pano_mvs.core.paths import reason_of
from pano_mvs.core.text import error_text, shortened_list
from pano_mvs.engine.cache.stat_cache import State
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.cache.unit_times import CaptureSize
from pano_mvs.engine.planning.units import PENDING, WHOLE, StageState, Unit, UnitInput
from pano_mvs.engine.stages.params import key_fields
from pano_mvs.engine.stages.stage import INDEX_PORT, Cardinality, SourceItem, place_of
from pano_mvs.engine.stages.stage_code import stage_code
from pano_mvs.engine.workflows.wiring import Edge, Graph
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.scene import Axis, Pairs, Record, Views
from pano_mvs.scene.record import changed_text, vanished_text


@dataclass(frozen=True, slots=True)
class _ListedFile:
    digest: str
    state: State | None


@dataclass(slots=True)
class SourceListing:
    """The items of the sources of a run, and the digests of their files."""

    # False to read no file as a whole: for a plan with an empty cache, where all units are computed, whatever their
    # keys
    with_digests: bool = True
    # file to the reason why this run cannot use it any more
    lost: dict[Path, str] = field(default_factory=dict)
    _items: dict[str, tuple[SourceItem, ...]] = field(default_factory=dict)
    _files: dict[Path, _ListedFile] = field(default_factory=dict)
    _reported: dict[Path, str] = field(default_factory=dict)

    def items(self, entry: StageEntry) -> tuple[SourceItem, ...]:
        """Return the items of a source, as they were when it first listed them.

        Raises:
            InputError: if the list cannot be made.
            PluginError: if the function of a plugin that makes it fails.
        """
        assert entry.spec.list_items is not None
        if entry.name not in self._items:
            try:
                items = tuple(entry.spec.list_items(entry.params))
                if other := [item for item in items if not isinstance(item, SourceItem)]:
                    raise TypeError(f"an item is a {type(other[0]).__name__}, not a SourceItem")
            except PanoMvsError:
                raise
            except BaseException as error:
                if entry.spec.is_built_in or type(error) is KeyboardInterrupt:
                    raise
                what = f"{place_of(error, entry.spec)}: {type(error).__name__}: {error_text(error)}"
                raise PluginError(f"{entry.name}: source {entry.spec.name} cannot list its items: {what}") from error
            self._items[entry.name] = items
        return self._items[entry.name]

    def size(self) -> CaptureSize:
        """Return the size of the capture: that of the source with the most images."""
        files = [[tuple(item.files.values()) for item in items if not item.problem] for items in self._items.values()]
        return CaptureSize.of_files(max(files, key=len, default=[]))

    def digests(self) -> dict[str, str]:
        """Return the digest of each file that the run can use, by its absolute path."""
        return {str(path.absolute()): file.digest for path, file in self._files.items() if path not in self.lost}

    def digest(self, path: Path, store: Store) -> str:
        """Return the digest of a listed file, and register the file with the store under it.

        Raises:
            ChangedFileError: if the file has changed since it was listed.
            InputError: if it cannot be read.
        """
        if path in self.lost:
            raise ChangedFileError(self.lost[path], path)
        known = self._files.get(path)
        known = self._listed(path, store) if known is None else self._checked(path, known, store)
        self._files[path] = known
        return known.digest

    def report(self, changed: Mapping[str, str]) -> bool:
        """Record files that a unit found changed; return whether any of them is a listed one."""
        known = {Path(path): reason for path, reason in changed.items()}
        by_absolute = {path.absolute(): path for path in self._files}
        found = {by_absolute[path.absolute()]: why for path, why in known.items() if path.absolute() in by_absolute}
        self._reported |= found
        return bool(found)

    def _listed(self, path: Path, store: Store) -> _ListedFile:
        state = store.stat_cache.state(path)  # before the digest, so that later changes are noticed
        try:
            if not self.with_digests:
                return _ListedFile(_path_digest(path), state)
            return _ListedFile(store.blobs.register_external(path), state)
        except InputError as error:
            self.lost[path] = str(error)
            raise

    def _checked(self, path: Path, known: _ListedFile, store: Store) -> _ListedFile:
        """Return the entry of a file: as before, or with the right digest if the stat cache had a wrong one."""
        reason = self._reported.pop(path, "")
        try:
            if reason:
                store.stat_cache.forget(path)
            digest = store.blobs.register_external(path)
        except InputError as error:
            self.lost[path] = vanished_text(path)
            raise ChangedFileError(self.lost[path], path) from error
        state = store.stat_cache.state(path)
        if digest != known.digest and state == known.state and reason:
            return _ListedFile(digest, state)  # the file is unchanged: a damaged stat cache had a wrong digest
        if digest != known.digest or reason:
            self.lost[path] = reason or changed_text(path)
            raise ChangedFileError(self.lost[path], path)
        return known


def _path_digest(path: Path) -> str:
    """Return a digest of the path of a file."""
    try:
        with path.open("rb"):
            return digest_from_value(str(path))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({reason_of(error)}). Check that it exists and may be read"
        ) from error


KEY_SCHEMA = 4
"""Raise this if the engine passes other inputs, seeds or settings for the same key, or makes keys differently."""


def resolve_source(
    entry: StageEntry, store: Store, *, only: frozenset[str] | None = None, listing: SourceListing | None = None
) -> dict[str, Unit | str]:
    """List the items of a source, and return the unit of each, or the reason why the item cannot be used.

    Args:
        only: names of the items to return; None for all.
        listing: what the run has listed so far; None to list the items again.

    Raises:
        InputError: if the list cannot be made, or names an item twice.
    """
    listing = listing or SourceListing()
    found: dict[str, Unit | str] = {}
    static = _static_identity(entry, store)
    common = digest_from_value(static)
    for item in listing.items(entry):
        if only is not None and item.name not in only:
            continue
        if item.name in found:
            raise InputError(f"{entry.name}: the item {item.name!r} is listed twice")
        if problem := item.problem or item_problem(item.name):
            found[item.name] = problem
            continue
        try:
            digests = {role: listing.digest(path, store) for role, path in sorted(item.files.items())}
        except InputError as error:
            found[item.name] = str(error)
            continue
        inputs = {"files": digests, "name": item.name, **({"links": list(item.links)} if item.links else {})}
        key = digest_from_value([common, inputs])
        source = replace(item, digests=digests)
        found[item.name] = Unit(entry, item.name, (item.name,), {}, key, static | {"inputs": inputs}, source)
    return found


def resolve(
    entry: StageEntry,
    graph: Graph,
    *,
    states: Mapping[str, StageState],
    store: Store,
    listing: SourceListing | None = None,
) -> Iterator[Unit]:
    """Yield the units of a stage whose inputs are all known, given the states of the stages that feed it.

    The other units are entered into the stage's own state. Units come one at a time because a stage may have a million
    of them, whose inputs take more memory than everything else.

    Args:
        listing: see `resolve_source`.
    """
    state = states[entry.name]
    if entry.spec.list_items is not None:
        listed = resolve_source(entry, store, only=graph.only.get(entry.name), listing=listing)
        units: Iterable[tuple[str, tuple[str, ...], Any]] = ((name, (name,), unit) for name, unit in listed.items())
    else:
        resolver = Resolver(entry, graph, states=states, store=store)
        names = resolver.unit_names()
        state.open = names is None
        state.failed |= resolver.blocked
        state.near = resolver.near
        units = ((name, members, resolver.unit(name, members)) for name, members in (names or {}).items())
    for name, members, unit in units:
        state.members[name] = members
        if isinstance(unit, Unit):
            yield unit
        elif unit is None:
            state.pending.add(name)
        else:
            state.failed[name] = unit


class Resolver:
    """Finds the units of a stage that is not a source: all in turn for a plan, or one by name in a run."""

    def __init__(self, entry: StageEntry, graph: Graph, *, states: Mapping[str, StageState], store: Store) -> None:
        self.entry = entry
        self.axis = graph.axes[entry.name]
        self.edges = edges = graph.edges[entry.name]
        self.only = graph.only.get(entry.name)
        self.states = states
        self.store = store
        self.blocked: dict[str, str] = {}  # why there are no units, after `unit_names`, if its index failed
        # unit to its neighbours, if the stage has an index and its unit names are known
        self.near: Mapping[str, tuple[str, ...]] = {}
        self._static: dict[str, Any] = {}
        self._common = ""
        self._near_edges = [edge for edge in edges.values() if edge.port.cardinality is Cardinality.NEAR]

    def unit_names(self) -> Mapping[str, tuple[str, ...]] | None:
        """Return the units of the stage and the images that each concerns, or None if they are not known yet.

        Raises:
            UsageError: if the run is limited to a unit that does not exist.
        """
        names = self._all_names()
        if names is None or self.only is None:
            return names
        missing = sorted(self.only - names.keys())
        if missing:
            raise UsageError(
                f"{self.entry.name} has no unit {missing[0]!r}; it has: {shortened_list(names, 20, rest=' …')}"
            )
        return {name: names[name] for name in names if name in self.only}

    def _all_names(self) -> Mapping[str, tuple[str, ...]] | None:
        if INDEX_PORT in self.edges and not self.entry.spec.every_image:
            return self._units_of_index(self.edges[INDEX_PORT])
        if self.axis is Axis.ONE:
            return {WHOLE: ()}
        each = [edge for edge in self.edges.values() if edge.port.cardinality is Cardinality.EACH]
        if any(self.states[edge.producer].open for edge in each):
            return None
        leading = [edge for edge in each if not edge.exploded and self.states[edge.producer].axis is self.axis]
        names: dict[str, tuple[str, ...]] = {}
        for number, edge in enumerate(leading or each):
            state = self.states[edge.producer]
            exploded: dict[str, tuple[str, ...]] = {name: (name,) for name in state.exploded}
            found = exploded if edge.exploded else dict(state.members)
            names = found if number == 0 else {name: names[name] for name in names if name in found}
        return self._with_neighbours(names) if INDEX_PORT in self.edges else names

    def _with_neighbours(self, names: dict[str, tuple[str, ...]]) -> Mapping[str, tuple[str, ...]] | None:
        """Return units of a stage for every image, after `near` has got each image in the index and its neighbours."""
        views = self._units_of_index(self.edges[INDEX_PORT])
        if views is None or self.blocked:
            return views
        self.near = {name: (name, *self.near[name]) if name in views else () for name in names}
        return names

    def _units_of_index(self, edge: Edge) -> Mapping[str, tuple[str, ...]] | None:
        state = self.states[edge.producer]
        if state.pending or state.open:
            return None
        if WHOLE not in state.items:
            self.blocked[WHOLE] = f"needs {edge.producer}, which failed"
            return {}
        index = self.store.load(state.items[WHOLE], edge.port.kind)
        assert isinstance(index, Pairs | Views)
        # A name occurs once for each neighbour of the image, each time as a separate string: share them.
        self.near = {name: tuple(map(intern, members)) for name, members in index.units().items()}
        if self.axis is Axis.PAIR:
            return self.near
        return {name: (name,) for name in self.near}

    def unit(self, name: str, members: tuple[str, ...]) -> Unit | str | None:
        """Return a unit, or the reason why it cannot run; None if its inputs are not known yet."""
        inputs: dict[str, UnitInput] = {}
        waiting = False
        for port in self.entry.spec.ports:
            edge = self.edges.get(port.name)
            if edge is None:
                inputs[port.name] = None
                continue
            value, problem, waits = self._input(edge, name)
            if problem:
                return problem
            waiting |= waits
            inputs[port.name] = value
        if waiting:
            return None
        if not self._static:
            self._static = _static_identity(self.entry, self.store)
            self._common = digest_from_value(self._static)
        encoded = {port: self._encode(port, value) for port, value in inputs.items()}
        identity = self._static | {"inputs": encoded}
        key = digest_from_value([self._common, encoded])
        return Unit(self.entry, name, members, inputs, key, identity)

    def _input(self, edge: Edge, name: str) -> tuple[UnitInput, str, bool]:
        """Return a unit's input at a port, the reason why there is none, and whether it is not known yet."""
        state = self.states[edge.producer]
        items = state.exploded if edge.exploded else state.items
        match edge.port.cardinality:
            case Cardinality.ONE:
                wanted: Sequence[str] = (WHOLE,)
            case Cardinality.EACH:
                wanted = (name,)
            case Cardinality.NEAR:
                # the neighbours that every Near port has or may still get, so that all ports agree
                wanted = [item for item in self.near[name] if all(map(partial(self._may_have, item), self._near_edges))]
            case Cardinality.NAMES if not state.open and not edge.exploded:
                # A plan assumes that pending units will succeed: their names are known, their values are not.
                names = [item for item in state.members if item in items or item in state.pending]
                return (
                    ({item: items.get(item, PENDING) for item in names}, "", False)
                    if names
                    else (None, self._why(edge, state, ""), False)
                )
            case Cardinality.ALL | Cardinality.NAMES:
                if state.open or state.pending:
                    return None, "", True
                if not items and not state.failed and edge.port.optional:
                    return None, "", False  # the other stage had nothing to do
                return (dict(items), "", False) if items else (None, self._why(edge, state, ""), False)
        if state.open or (edge.exploded and state.pending):
            return None, "", True
        if any(item in state.pending for item in wanted):
            return None, "", True
        if edge.port.cardinality is Cardinality.NEAR:
            found = {item: items[item] for item in wanted if item in items}
            missing = next((item for item in self.near[name] if item not in found), "")
            usable = not missing if self.axis is Axis.PAIR else bool(found) or self.entry.spec.every_image
            return (found, "", False) if usable else (None, self._why(edge, state, missing), False)
        if wanted[0] in items:
            return items[wanted[0]], "", False
        return None, self._why(edge, state, wanted[0]), False

    def _may_have(self, item: str, edge: Edge) -> bool:
        state = self.states[edge.producer]
        if state.open or item in state.pending or (edge.exploded and state.pending):
            return True
        return item in (state.exploded if edge.exploded else state.items)

    @staticmethod
    def _why(edge: Edge, state: StageState, item: str) -> str:
        """Return what is missing: for a single item, it does not matter whether others of its stage have failed."""
        item = WHOLE if WHOLE in state.failed else item
        what = f"{edge.producer}:{item}" if item else edge.producer
        failed = item in state.failed if item else bool(state.failed)
        return f"needs {what}, which {'failed' if failed else 'has no result'}"

    def _encode(self, port: str, value: UnitInput) -> Any:
        """Return the part of an input that counts towards the key: digests, and names where the stage sees them."""
        if value is None:
            return None
        if isinstance(value, ItemRef):
            return value.digest
        if self.edges[port].port.cardinality is Cardinality.NEAR:
            return [ref.digest for ref in value.values()]
        if self.edges[port].port.cardinality is Cardinality.NAMES:
            return list(value)
        return [[name, ref.digest] for name, ref in value.items()]


def single_unit(entry: StageEntry, inputs: Mapping[str, ItemRef | None], store: Store) -> Unit:
    """Return the unit of a stage outside a workflow; all ports of the stage are One ports.

    Args:
        inputs: port to the stored value; None for optional ports without one.
    """
    static = _static_identity(entry, store)
    encoded = {port: None if ref is None else ref.digest for port, ref in inputs.items()}
    key = digest_from_value([digest_from_value(static), encoded])
    return Unit(entry, WHOLE, (), inputs, key, static | {"inputs": encoded})


def _static_identity(entry: StageEntry, store: Store) -> dict[str, Any]:
    """Return the part of the identity that all units of a stage share."""
    plain, paths = key_fields(entry.params)
    code = stage_code(entry.spec, entry.params)
    kinds: list[type[Record]] = [entry.spec.output, *(port.kind for port in entry.spec.ports)]
    return {
        "schema": KEY_SCHEMA,
        "stage": entry.spec.name,
        "version": entry.spec.version,
        "code": code.digest,
        "libraries": dict(code.libraries),
        "params": plain | {name: [store.stat_cache.digest(path) for path in found] for name, found in paths.items()},
        "kinds": {kind.kind_name(): kind.kind_version for kind in kinds},
        **({"rng_seed": entry.policy.rng_seed} if entry.policy.rng_seed else {}),
    }
