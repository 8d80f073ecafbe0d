"""Every error that pano_mvs raises on purpose.

    PanoMvsError
    ├── UsageError (ValueError)            exit 2: a call or an option that cannot work
    │   └── WorkflowError                  exit 2: errors in a workflow file, with line and column
    ├── InputError (ValueError)            exit 2, or 3 if the run can go on: a file that cannot be used
    │   └── ChangedFileError               exit 3: a file that changed after the run had listed it
    ├── PluginError (ImportError)          exit 2: a plugin that failed to import or to register
    ├── ContractError (TypeError)          exit 1: a stage returned something it had not declared
    ├── StoreError (OSError)               exit 4: the cache or the output folder cannot be written
    └── RunStoppedError (RuntimeError)     exit 4: a quality threshold or a stage stopped the run

A message says what is wrong, with which item, where, and what to do about it. Expected degeneracy
(too few matches, pure rotation) is not an error: functions return a falsy value with the reason.
"""

from __future__ import annotations

from pathlib import Path


class PanoMvsError(Exception):
    """Base of all errors that pano_mvs raises on purpose."""

    exit_code = 1


class UsageError(PanoMvsError, ValueError):
    """A call or an option that cannot work."""

    exit_code = 2


class WorkflowError(UsageError):
    """One or more errors in a workflow; `problems` holds a text for each, and a cause that several have but once."""

    def __init__(self, problems: list[str]) -> None:
        self.problems = _each_cause_once(problems)
        super().__init__("\n".join(self.problems))


class InputError(PanoMvsError, ValueError):
    """A file or folder of the user that cannot be used; the message names it and the remedy."""

    exit_code = 2


class ChangedFileError(InputError):
    """A file of the user that changed, or disappeared, after the run had listed it."""

    exit_code = 3

    def __init__(self, message: str, path: Path | None = None) -> None:
        self.path = path
        super().__init__(message)


class PluginError(PanoMvsError, ImportError):
    """A plugin that failed to import or to register."""

    exit_code = 2


class ContractError(PanoMvsError, TypeError):
    """A stage returned something other than what it declared."""

    exit_code = 1


class StoreError(PanoMvsError, OSError):
    """The cache or the output folder cannot be read or written."""

    exit_code = 4


class RunStoppedError(PanoMvsError, RuntimeError):
    """The run stops here, such as at a quality threshold; what was computed stays in the cache."""

    exit_code = 4


def _each_cause_once(problems: list[str]) -> list[str]:
    """Return problems without what follows their first line, such as a traceback, if it was there before."""
    told: set[str] = set()
    shorter = []
    for problem in problems:
        first, _, cause = problem.partition("\n")
        shorter.append(first if cause in told else problem)
        told.add(cause)
    return shorter
