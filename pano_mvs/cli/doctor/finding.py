"""The result of one check."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

State: TypeAlias = Literal["ok", "note", "warning", "failed"]
"""`note`: nothing is wrong. `warning`: something is slower or missing. `failed`: a run cannot work."""


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check.

    Attributes:
        group: packages, libraries, machine, disk or plugins.
        what: the subject of the check.
        state: the verdict.
        detail: what was found.
        remedy: what to do; given with every warning and failure.
    """

    group: str
    what: str
    state: State
    detail: str
    remedy: str = ""
