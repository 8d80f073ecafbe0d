"""A test of a contract, to be run by any test runner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ContractTest:
    """A test of a contract."""

    name: str
    check: Callable[[], None]

    def __str__(self) -> str:
        """Return the name, which test runners show."""
        return self.name
