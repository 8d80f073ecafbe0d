"""Plan a run: what it would compute, without computing it."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from pano_mvs.core.errors import StoreError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.planning.plan import StagePlan, make_plan
from pano_mvs.engine.planning.run_options import RunOptions
from pano_mvs.session.python_errors import names_arguments
from pano_mvs.session.session import Session, check_output, open_session
from pano_mvs.session.settings import overrides_from_settings


@dataclass(frozen=True, slots=True)
class RunPlan:
    """What a run would compute.

    Attributes:
        stages: in the order of the workflow.
    """

    stages: tuple[StagePlan, ...]

    def __getitem__(self, stage: str) -> StagePlan:
        """Return the plan of one stage.

        Raises:
            KeyError: if the workflow has no such stage.
        """
        return {plan.name: plan for plan in self.stages}[stage]

    @property
    def units(self) -> int:
        """Number of units that would be computed for certain."""
        return sum(len(plan.run) for plan in self.stages)

    @property
    def may_follow(self) -> bool:
        """Whether more units may have to be computed, depending on their results."""
        return any(plan.may_run or plan.open for plan in self.stages)


@names_arguments
def plan(
    workflow: str | Path,
    images: str | Path | None = None,
    out: str | Path | None = None,
    *,
    settings: Mapping[str, object] | None = None,
    cache: str | Path | None = None,
    until: Sequence[str] = (),
    only: Sequence[str] = (),
    refresh: Sequence[str] = (),
) -> RunPlan:
    """Return what `run` would compute with the same arguments; nothing is computed or written.

    >>> import pano_mvs
    >>> plan = pano_mvs.plan("quickstart", out="out", settings={"depth.planes": 192})
    >>> list(plan["depth"].run)  # after the example of `pano_mvs.run`, which has other planes
    ['000.png', '001.png', '002.png', '003.png']

    Raises:
        UsageError: if the workflow, a setting or a folder cannot be used.
        InputError: if the images cannot be listed.
    """
    session = open_session(
        workflow,
        overrides=overrides_from_settings(settings or {}),
        images=images,
        cache=cache,
        out=out,
        run_options=RunOptions(tuple(until), tuple(only), tuple(refresh)),
    )
    check_output(session)
    return plan_session(session)


def plan_session(session: Session) -> RunPlan:
    """Return what the run of an open session would compute."""
    store = Store(session.store_root, for_reading=True)
    workflow, graph = session.run_options.applied_to(session.workflow, session.graph)
    with without_collector():
        plans = make_plan(workflow, graph, store, options=session.run_options)
    with suppress(StoreError):  # a cache of other users can be read, not written
        store.stat_cache.save()
    return RunPlan(tuple(plans))


@contextmanager
def without_collector() -> Iterator[None]:
    """Suspend Python's garbage collector, since a plan creates many objects that stay, and no cycles."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
