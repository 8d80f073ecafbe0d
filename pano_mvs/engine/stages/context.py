"""What a stage is given beside its inputs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pano_mvs.core.text import shortened


@dataclass(slots=True)
class Context:
    """What a stage is given beside its inputs.

    Attributes:
        rng: random generator, seeded from the stage, the settings and the inputs: the same unit draws the same numbers
            everywhere, and goes on to do so when code has been changed.
        scratch: an empty folder for files that the stage writes; gone after the unit, unless returned in a record.
        threads: number of threads that the unit may use.
        metrics: figures of this unit, such as `registered`; shown in the report and read by quality gates.
        notes: what a user should know of this unit.
        rejected: image name to the reason why the result leaves it out.
    """

    rng: np.random.Generator
    scratch: Path
    threads: int = 1
    metrics: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    rejected: dict[str, str] = field(default_factory=dict)

    def metric(self, name: str, value: float) -> None:
        """Record a figure of this unit; one that is not finite is left out, so that it passes no gate."""
        if math.isfinite(value):
            self.metrics[name] = float(value)

    def note(self, text: str) -> None:
        """Record what a user should know; a cached unit says it again."""
        self.notes.append(shortened(text))

    def reject(self, image: str, reason: str) -> None:
        """Record that the result leaves an image out; the run then ends with exit code 3."""
        self.rejected[image] = shortened(reason)
