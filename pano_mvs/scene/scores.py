"""Scores of a result against ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from pano_mvs.scene.record import Axis, Record

NO_TRUTH = "there is no ground truth for these images"
"""The note of scores without figures if the truth of no image is known."""


@dataclass(frozen=True, eq=False)
class Scores(Record):
    """Scores of a result against ground truth; empty without ground truth.

    Attributes:
        poses: name of a pose metric to its value.
        views: image name to name of a depth metric to its value.
        notes: what was ignored, with the reason.
    """

    axis: ClassVar[Axis | None] = Axis.ONE

    poses: dict[str, Any]
    views: dict[str, dict[str, float]]
    notes: tuple[str, ...] = ()
