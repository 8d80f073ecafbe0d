"""One line of what the doctor found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "note", "warning", "failed"]
"""`note`: nothing is wrong. `warning`: something will be slower or missing. `failed`: a run cannot work."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What was looked at, and how it is.

    Attributes:
        group: what it belongs to: packages, libraries, machine, disk, plugins.
        what: what was looked at.
        state: how it is.
        detail: what was found.
        remedy: what to do about it; given with every warning and failure.
    """

    group: str
    what: str
    state: State
    detail: str
    remedy: str = ""
