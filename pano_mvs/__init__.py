"""Dense 3D from 360° photographs.

    run = pano_mvs.run("quickstart", images="photos", out="out")    # compute, or take from the cache
    run = pano_mvs.load("out")                                      # what an earlier run made
    plan = pano_mvs.plan("quickstart", images="photos")             # what a run would compute
    scores = pano_mvs.evaluate_run("out", "truth")                  # how far it is from ground truth
    run.share("page")                                               # a page to send, shown in a notebook
    run.view()                                                      # a window with the cloud and the cameras

The command line is `pano-mvs`. Authors of plugins import `pano_mvs.api`. The conventions (frames, pixels, ranges) are
stated once, in `pano_mvs.geometry`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pano_mvs.core.errors import InputError, PanoMvsError, RunStoppedError, StoreError, UsageError, WorkflowError
    from pano_mvs.results.run_output import RunOutput, RunView, load
    from pano_mvs.results.summary import RunSummary
    from pano_mvs.session.captures import run
    from pano_mvs.session.checking import WorkflowCheck, check, format_workflow
    from pano_mvs.session.planning import RunPlan, plan

__version__ = "0.1.0"

__all__ = [
    "InputError",
    "PanoMvsError",
    "RunOutput",
    "RunPlan",
    "RunStoppedError",
    "RunSummary",
    "RunView",
    "StoreError",
    "UsageError",
    "WorkflowCheck",
    "WorkflowError",
    "__version__",
    "check",
    "format_workflow",
    "load",
    "plan",
    "run",
]

# Where each name is; imported when it is first used, since the libraries behind it take a second to load.
_HOMES = {
    "InputError": "core.errors",
    "PanoMvsError": "core.errors",
    "RunOutput": "results.run_output",
    "RunPlan": "session.planning",
    "RunStoppedError": "core.errors",
    "RunSummary": "results.summary",
    "RunView": "results.run_output",
    "StoreError": "core.errors",
    "UsageError": "core.errors",
    "WorkflowCheck": "session.checking",
    "WorkflowError": "core.errors",
    "check": "session.checking",
    "format_workflow": "session.checking",
    "load": "results.run_output",
    "plan": "session.planning",
    "run": "session.captures",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    if not name.startswith("_"):
        from pano_mvs.core.doors import FUNCTIONS  # which plugins offer

        if name in FUNCTIONS.names():
            return FUNCTIONS.get(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    from pano_mvs.core.doors import FUNCTIONS

    return sorted({*globals(), *_HOMES, *FUNCTIONS.names()})
