"""Find the stages that produced the final values of a run: the last of a chain of stages of the same kind."""

from __future__ import annotations

from typing import TypeVar

from pano_mvs.engine.running.run import Run
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import Workflow
from pano_mvs.results.stored_values import ROLES
from pano_mvs.scene import Record

_Kind = TypeVar("_Kind", bound=Record)


def chain_of(workflow: Workflow, graph: Graph, kind: type[Record]) -> list[str]:
    """Return the chain of stages that produce a kind of value from one another, starting with the first.

    A stage that does not depend on the first, such as a second sweep beside it, is on another branch and not included.
    """
    makers = [name for name in graph.order if issubclass(workflow.stages[name].spec.output, kind)]
    above: dict[str, set[str]] = {}
    for name in graph.order:
        feeding = {edge.producer for edge in graph.edges[name].values()}
        above[name] = feeding.union(*(above[producer] for producer in feeding))
    chain = makers[:1]
    for name in makers[1:]:
        if chain[-1] in above[name]:
            chain.append(name)
    return chain


def latest(run: Run, kind: type[_Kind]) -> _Kind | None:
    """Return the value of a kind from the last stage of the first chain that produced one, or None."""
    for name in reversed(chain_of(run.workflow, run.graph, kind)):
        value = run.load(name, kind)
        if isinstance(value, kind):
            return value
    return None


def final_stages(run: Run) -> dict[str, str]:
    """Return role (see `ROLES`) to the stage that made the final values: the last of the first chain with any.

    If the run ended early, a stage that had hardly begun does not replace the one before it.
    """
    found: dict[str, str] = {}
    for role, kind in ROLES.items():
        chain = chain_of(run.workflow, run.graph, kind)
        made = {name: len(run.states[name].items) for name in chain if name in run.states and run.states[name].items}
        least = max(made.values(), default=0) / 2 if run.result.stopped else 0
        if names := [name for name, count in made.items() if count >= least]:
            found[role] = names[-1]
    return found
