"""Estimate the remaining time of a run from the times of its finished units."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class StageClock:
    """The pace of one stage; `done` counts all finished units, `computed` those that took `seconds`."""

    units: int
    done: int = 0
    computed: int = 0
    seconds: float = 0.0

    @property
    def left_s(self) -> float | None:
        """Estimated time of its remaining units, one at a time; None if none has been computed yet."""
        if self.done >= self.units:
            return 0.0
        return self.seconds / self.computed * (self.units - self.done) if self.computed else None


class Estimate:
    """The pace of all stages."""

    def __init__(self, workers: int = 1) -> None:
        self.workers = workers
        self.stages: dict[str, StageClock] = {}

    def start(self, name: str, units: int) -> None:
        """Start the clock of a stage, or restart it."""
        self.stages[name] = StageClock(units)

    def count(self, name: str, seconds: float, *, computed: bool) -> None:
        """Count a finished unit."""
        clock = self.stages[name]
        clock.done += 1
        if computed:
            clock.computed += 1
            clock.seconds += seconds

    def of_stage(self, name: str) -> str:
        """Return the remaining time of a stage as text; empty if unknown or zero."""
        clock = self.stages[name]
        left_s = clock.left_s
        at_a_time = min(self.workers, max(1, clock.units - clock.done))
        return f"{duration(left_s / at_a_time)} left" if left_s else ""

    def of_run(self, stages: int) -> str:
        """Return the remaining time of a run as text, a lower bound until all stages have started."""
        known = [clock.left_s for clock in self.stages.values()]
        total = sum(left_s for left_s in known if left_s) / self.workers
        if not total:
            return ""
        is_all = len(self.stages) == stages and None not in known
        return f"{'about' if is_all else 'more than'} {duration(total)} left"


def duration(seconds: float) -> str:
    """Return a duration as text."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
