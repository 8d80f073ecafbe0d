"""Connect the ports of a workflow's stages, and report mismatches before anything runs."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from graphlib import CycleError, TopologicalSorter

from pano_mvs.core.errors import WorkflowError
from pano_mvs.engine.stages.stage import INDEX_PORT, Cardinality, Port, StageSpec
from pano_mvs.engine.workflows.workflow import StageEntry, Workflow
from pano_mvs.scene import Axis


@dataclass(frozen=True, slots=True)
class Edge:
    """A connection from a stage to a port of another one."""

    port: Port
    producer: str  # name of the stage that feeds it
    exploded: bool  # whether it carries the items of the producer's collection instead of the collection


@dataclass(frozen=True, slots=True)
class Graph:
    """The connected stages of a workflow."""

    order: tuple[str, ...]  # stage names, producers first, otherwise as in the file
    edges: Mapping[str, Mapping[str, Edge]]  # stage name to port name to the connection
    axes: Mapping[str, Axis]  # stage name to the axis of its units
    # stage name to its units, for stages that are limited to some of them
    only: Mapping[str, frozenset[str]] = field(default_factory=dict)
    is_part: bool = False  # whether some stages or units of the workflow are left out

    def limited_to(self, ends: Collection[str], only: Mapping[str, frozenset[str]]) -> Graph:
        """Return the graph of the stages `ends` and the stages that they need."""
        needed = set(ends)
        for name in reversed(self.order):
            if name in needed:
                needed.update(edge.producer for edge in self.edges[name].values())
        order = tuple(name for name in self.order if name in needed)
        return Graph(order, self.edges, self.axes, only, is_part=True)


def wire(workflow: Workflow, *, unknown: Collection[str] = ()) -> Graph:
    """Connect every port as `in:` says, or else to the nearest earlier stage that produces its kind.

    Args:
        unknown: names of further stages of which nothing is known, because they have errors. What they may produce or
            need is not reported.

    Raises:
        WorkflowError: with every error: unknown stages or ports in `in:`, kinds that do not fit, inputs that no stage
            produces, ambiguity, cycles.
    """
    wirer = _Wirer(workflow, unknown)
    edges = {name: wirer.connect(entry) for name, entry in workflow.stages.items()}
    order = wirer.sort(edges)
    axes: dict[str, Axis] = {}
    for name in order:
        if name not in wirer.broken and all(edge.producer in axes for edge in edges[name].values()):
            axes[name] = wirer.axis(workflow.stages[name], edges[name], axes)
    if wirer.problems:
        raise WorkflowError(wirer.problems)
    return Graph(order, edges, axes)


def wiring_problems(stages: Mapping[str, StageEntry], unknown: Collection[str] = ()) -> list[str]:
    """Return the errors in the connections of stages, even if their settings, or other stages, are wrong."""
    try:
        wire(Workflow("", None, "", dict(stages)), unknown=unknown)
    except WorkflowError as error:
        return error.problems
    return []


def _remedy(entry: StageEntry, port: Port) -> str:
    """Return what to do about an input that was removed."""
    return f"name another stage by `{entry.name}: {{in: {{{port.name}: STAGE}}}}`, or remove {entry.name!r} as well"


def _delivers(entry: StageEntry, port: Port) -> bool | None:
    """Return True if a stage feeds a port with its items, False if as a whole, None if it cannot feed it."""
    return _delivered_by(entry.spec, port)


def _delivered_by(spec: StageSpec, port: Port) -> bool | None:
    output = spec.output
    if port.cardinality is Cardinality.ONE:
        return False if issubclass(output, port.kind) and output.axis in (Axis.ONE, None) else None
    if issubclass(output, port.kind) and output.axis is not Axis.ONE:
        return False
    inner = output.explodes_into
    return True if inner is not None and issubclass(inner, port.kind) else None


class _Wirer:
    def __init__(self, workflow: Workflow, unknown: Collection[str]) -> None:
        self.stages = workflow.stages
        self.workflow = workflow
        self.unknown = unknown
        self.broken: set[str] = set()
        self.problems: list[str] = []
        self.ancestors: dict[str, set[str]] = {}

    def connect(self, entry: StageEntry) -> dict[str, Edge]:
        ports = {port.name: port for port in entry.spec.all_ports}
        edges: dict[str, Edge] = {}
        for name in entry.policy.inputs:
            if name not in ports:
                close = get_close_matches(name, ports, n=1, cutoff=0.4)
                hint = f"did you mean {close[0]!r}?" if close else f"its ports: {', '.join(ports) or 'none'}"
                self._problem(entry, f"in.{name}", f"stage {entry.name!r} has no port {name!r}; {hint}")
        for port in ports.values():
            edge = self._named(entry, port) if port.name in entry.policy.inputs else self._nearest(entry, port)
            if edge is not None:
                edges[port.name] = edge
        self.ancestors[entry.name] = set().union(
            *({edge.producer} | self.ancestors.get(edge.producer, set()) for edge in edges.values())
        )
        return edges

    def _named(self, entry: StageEntry, port: Port) -> Edge | None:
        name = entry.policy.inputs[port.name]
        if name in self.unknown:
            self.broken.add(entry.name)
            return None
        place = f"in.{port.name}"
        producer = self.stages.get(name)
        if producer is None:
            self._problem(entry, place, self._no_such_stage(entry, port, name))
            return None
        exploded = _delivers(producer, port)
        if exploded is None:
            made = producer.spec.output.kind_name()
            self._problem(entry, place, f"port {port} cannot be fed by {name!r}, which produces {made}")
            return None
        return Edge(port, name, exploded)

    def _no_such_stage(self, entry: StageEntry, port: Port, name: str) -> str:
        """Return why a port cannot be fed by what its `in:` names."""
        if name in self.workflow.groups:
            stages = ", ".join(self.workflow.groups[name].stages)
            return f"port {port.name!r}: {name!r} is a group of stages; name one of its stages: {stages}"
        if removed := self.workflow.removed.get(name):
            what = f"{'group' if removed.spec is None else 'stage'} {name!r} {removed.how}"
            return f"stage {entry.name!r}: port {port.name!r}: {what}; {_remedy(entry, port)}"
        close = get_close_matches(name, self.stages, n=1, cutoff=0.4)
        hint = f"did you mean {close[0]!r}?" if close else f"stages: {', '.join(self.stages)}"
        return f"port {port.name!r}: there is no stage {name!r}; {hint}"

    def _nearest(self, entry: StageEntry, port: Port) -> Edge | None:
        if self.unknown:
            self.broken.add(entry.name)
            return None
        names = list(self.stages)
        earlier = [self.stages[name] for name in names[: names.index(entry.name)]]
        candidates = [stage for stage in earlier if _delivers(stage, port) is not None]
        if not candidates:
            if not port.optional:
                self._problem(entry, "use", self._missing(entry, port))
            return None
        nearest = candidates[-1]
        # What a stage takes by name has its purpose, such as a first solution that only serves to choose pairs.
        named = {name for stage in self.stages.values() for name in stage.policy.inputs.values()}
        before = self.ancestors.get(nearest.name, set()) | named
        others = [stage.name for stage in candidates[:-1] if stage.name not in before]
        if others:
            options = ", ".join([*others, nearest.name])
            self._problem(
                entry,
                "use",
                f"stage {entry.name!r}: port {port} could be fed by {options}; choose with `in: {{{port.name}: …}}`",
            )
            return None
        return Edge(port, nearest.name, bool(_delivers(nearest, port)))

    def _missing(self, entry: StageEntry, port: Port) -> str:
        later = [
            name for name, stage in self.stages.items() if name != entry.name and _delivers(stage, port) is not None
        ]
        hint = f" ({', '.join(later)} below does: move it up or name it in `in:`)" if later else ""
        gone = {
            name: removed.how
            for name, removed in self.workflow.removed.items()
            if name not in self.stages and removed.spec is not None and _delivered_by(removed.spec, port) is not None
        }
        if gone:  # a stage below may read what is missing, so that it cannot feed it
            hint = f" ({'; '.join(f'stage {name!r} {how}' for name, how in gone.items())}): {_remedy(entry, port)}"
        need = "needs an index" if port.name == INDEX_PORT else "needs"
        return f"stage {entry.name!r} {need} {port}, but no earlier stage produces {port.kind.kind_name()}{hint}"

    def sort(self, edges: Mapping[str, Mapping[str, Edge]]) -> tuple[str, ...]:
        position = {name: number for number, name in enumerate(self.stages)}
        graph = {name: {edge.producer for edge in ports.values()} for name, ports in edges.items()}
        sorter = TopologicalSorter(graph)
        try:
            sorter.prepare()
        except CycleError as error:
            cycle = " → ".join(reversed(error.args[1]))
            self._problem(self.stages[error.args[1][0]], "use", f"the stages feed each other in a cycle: {cycle}")
            return ()
        order: list[str] = []
        ready: list[str] = []
        while sorter.is_active():
            ready = sorted([*ready, *sorter.get_ready()], key=position.__getitem__)
            order.append(ready.pop(0))
            sorter.done(order[-1])
        return tuple(order)

    def axis(self, entry: StageEntry, edges: Mapping[str, Edge], axes: Mapping[str, Axis]) -> Axis:
        """Return the axis of a stage's units, and check that its Each ports agree on it."""
        if entry.spec.list_items is not None:
            return Axis.IMAGE
        output = entry.spec.output.axis
        if INDEX_PORT in edges and not entry.spec.every_image:
            return Axis.PAIR if output is Axis.PAIR else Axis.VIEW
        fed = [
            Axis.IMAGE if edge.exploded else axes.get(edge.producer, Axis.ONE)
            for edge in edges.values()
            if edge.port.cardinality is Cardinality.EACH
        ]
        found = max(fed, key=(Axis.ONE, Axis.IMAGE, Axis.VIEW, Axis.PAIR).index, default=Axis.ONE)
        if Axis.PAIR in fed and len(set(fed)) > 1:
            self._problem(entry, "use", f"stage {entry.name!r} mixes Each inputs of pairs and of images")
        if output is not None and (output is Axis.ONE) != (found is Axis.ONE):
            self._problem(
                entry,
                "use",
                f"stage {entry.spec.name!r} returns {entry.spec.output.kind_name()} (one per "
                f"{output}), but its inputs give one unit per {found}",
            )
        return found

    def _problem(self, entry: StageEntry, place: str, message: str) -> None:
        self.broken.add(entry.name)
        self.problems.append(f"{entry.places.get(place, entry.place)}: {message}")
