"""Which command made the files in a folder from runs: a shared page, or the tables of an experiment."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from pano_mvs.core.files import read_regular, write_text
from pano_mvs.results.summary import RunSummary

ORIGIN = ".pano-mvs-origin"
"""Name of the file in the folder. It contains no path, since a page may be published."""


@dataclass(frozen=True, slots=True)
class RunName:
    """What identifies a run wherever its output folder lies."""

    workflow: str  # its name
    started: str  # date and time, ISO 8601 in UTC

    @classmethod
    def of(cls, summary: RunSummary) -> Self:
        """Return the name of a run."""
        return cls(summary.workflow.name, summary.started)


@dataclass(frozen=True, slots=True)
class Origin:
    """How the files in a folder were made."""

    command: str  # such as `share`
    runs: tuple[RunName, ...] = ()  # those that they were made from; empty for all runs below the folder

    def write(self, folder: Path) -> None:
        """Write the origin into a folder.

        Raises:
            StoreError: if it cannot be written.
        """
        runs = [{"workflow": run.workflow, "started": run.started} for run in self.runs]
        write_text(folder / ORIGIN, json.dumps({"command": self.command, "runs": runs}) + "\n")

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """Return the origin of the files in a folder; None if it has none that can be read."""
        try:
            found = json.loads(read_regular(folder / ORIGIN))
            runs = tuple(RunName(str(run["workflow"]), str(run["started"])) for run in found["runs"])
            return cls(str(found["command"]), runs)
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None
