"""The context that a stage receives beside its inputs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pano_mvs.core.text import shortened

COUNT_IN_NOTES = "{count}"
"""At the beginning of a note: the number of units that gave it, and of all; see `Context.note`."""


@dataclass(slots=True)
class Context:
    """What a stage receives beside its inputs.

    Attributes:
        rng: random generator, seeded from the stage, the settings, the inputs and the key `rng_seed` of the entry: a
            unit draws the same numbers on every machine, also after its code has changed.
        scratch: an empty folder for files that the stage writes. It is deleted after the unit; files that the stage
            returns are stored before.
        threads: number of threads that the unit may use.
        metrics: figures of this unit, such as `registered`, for the report and for quality thresholds.
        notes: what a user should know about this unit.
        rejected: image name to the reason why the result leaves it out.
    """

    rng: np.random.Generator
    scratch: Path
    threads: int = 1
    metrics: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    rejected: dict[str, str] = field(default_factory=dict)

    def metric(self, name: str, value: float) -> None:
        """Record a figure of this unit; infinite values and NaN are left out, so that they meet no threshold."""
        if math.isfinite(value):
            self.metrics[name] = float(value)

    def note(self, text: str) -> None:
        """Record what a user should know; the note is repeated if the unit is cached.

        Of equal notes of several units, one is shown. If it begins with `{count}`, that becomes the number of units
        that gave it: "{count} images have no date" is shown as "3 of 12 images have no date".
        """
        self.notes.append(shortened(text))

    def reject(self, image: str, reason: str) -> None:
        """Record that the result leaves out an image; the run then ends with exit code 3."""
        self.rejected[image] = shortened(reason)
