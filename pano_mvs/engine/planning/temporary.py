"""Which stages of a workflow are temporary: their results are dropped once the stages that read them are done."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from pano_mvs.engine.cache.store import ItemRef
from pano_mvs.engine.planning.units import WHOLE, Unit
from pano_mvs.engine.stages.stage import INDEX_PORT, Cardinality
from pano_mvs.engine.workflows.wiring import Edge, Graph
from pano_mvs.engine.workflows.workflow import Workflow
from pano_mvs.scene import Files


def temporary_stages(workflow: Workflow, graph: Graph, *, wanted: Collection[str] = ()) -> dict[str, frozenset[str]]:
    """Return each temporary stage with the stages that read it.

    These are the stages that the workflow marks, without those whose results are needed after the run or by plans:
    files, which are delivered; lists of pairs and views, from which plans know the units of other stages; and the last
    results of a kind, which the report, the viewer and Python read. Neither are sources, which read the user's files.

    Args:
        wanted: stages that the user asked for.
    """
    readers: dict[str, set[str]] = {name: set() for name in graph.order}
    below: dict[str, set[str]] = {name: set() for name in graph.order}  # the stages that depend on one
    is_index = set[str]()
    for name in reversed(graph.order):
        for port, edge in graph.edges[name].items():
            readers[edge.producer].add(name)
            below[edge.producer] |= {name, *below[name]}
            if port == INDEX_PORT:
                is_index.add(edge.producer)
    outputs = {name: workflow.stages[name].spec.output for name in graph.order}
    return {
        name: frozenset(readers[name])
        for name in graph.order
        if workflow.stages[name].policy.temporary
        and name not in {*wanted, *is_index}
        and workflow.stages[name].spec.list_items is None
        and not issubclass(outputs[name], Files)
        and any(issubclass(outputs[other], outputs[name]) for other in below[name])
    }


def items_read(unit: Unit, edges: Mapping[str, Edge]) -> Iterator[tuple[Edge, str, ItemRef]]:
    """Yield each stored value that a unit loads: its edge, its name (image, pair or view), and its reference."""
    for port, edge in edges.items():
        value = unit.inputs.get(port)
        if value is None or edge.port.cardinality is Cardinality.NAMES:
            continue
        if isinstance(value, ItemRef):
            yield edge, unit.item if edge.port.cardinality is Cardinality.EACH else WHOLE, value
        else:
            yield from ((edge, name, ref) for name, ref in value.items())
