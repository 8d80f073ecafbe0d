"""One law of a contract, to be checked by any test runner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Law:
    """One law of a contract.

    Attributes:
        name: who must do what.
        check: raises AssertionError if it is broken; whatever else it raises breaks the law too.
    """

    name: str
    check: Callable[[], None]

    def __str__(self) -> str:
        """Return the name, by which tests are shown."""
        return self.name
