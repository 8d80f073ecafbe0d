"""The command line with an executor that computes nothing.

Of each stage the first unit is computed; the others get its parts under a digest of their own, and a record each. What
a run takes is then what planning, scheduling, recording and delivering take.
"""

from __future__ import annotations

import os
from dataclasses import replace
from unittest.mock import patch

from pano_mvs.cli.app import main
from pano_mvs.core.digest import digest_from_value
from pano_mvs.engine.cache.store import ItemRef, Store, UnitRecord
from pano_mvs.engine.executors.choose import ExecutorRequest, SerialExecutor
from pano_mvs.engine.executors.execute import execute_unit
from pano_mvs.engine.executors.protocol import Executor, Job, JobOutcome

STOP_VARIABLE = "SIMULATED_STOP_AFTER"
"""After so many units the run is interrupted."""


class SimulatedExecutor(SerialExecutor):
    """Stores a record for each unit without computing it, except for the first one of each stage."""

    name = "simulated"

    def __init__(self, store: Store) -> None:
        super().__init__(store, threads=1)
        self._first: dict[str, UnitRecord] = {}
        self._left = int(os.environ.get(STOP_VARIABLE, "0"))

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        """Store the record of the job that was taken."""
        if not self._jobs or timeout_s == 0:
            return None
        self._left -= 1
        if self._left == 0:
            raise KeyboardInterrupt
        job = self._jobs.pop(0)
        return job.number, JobOutcome("done", self._record(job))

    def _record(self, job: Job) -> UnitRecord:
        unit = job.unit
        first = self._first.get(unit.entry.name)
        if first is None:
            first = self._first[unit.entry.name] = execute_unit(unit, self._store, threads=1)
            return first
        output = ItemRef(first.output.kind, digest_from_value(["simulated", unit.key]), first.output.parts)
        record = replace(first, key=unit.key, identity=unit.identity, output=output)
        self._store.put(record)
        return record


def _simulated(store: Store, _request: ExecutorRequest) -> Executor:
    return SimulatedExecutor(store)


if __name__ == "__main__":
    with patch("pano_mvs.session.running.make_executor", _simulated):
        main()
