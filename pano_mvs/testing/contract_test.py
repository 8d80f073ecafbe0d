"""A test of a contract, to be run by any test runner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ContractTest:
    """A test of a contract.

    Attributes:
        name: what is tested.
        check: raises AssertionError if the contract is broken; any other exception counts as a failure, too.
    """

    name: str
    check: Callable[[], None]

    def __str__(self) -> str:
        """Return the name, which test runners show."""
        return self.name
