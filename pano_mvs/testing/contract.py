"""What the contract tests of all kinds of plugins share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pano_mvs.core.errors import UsageError
from pano_mvs.engine.stages.registry import Registry


@dataclass(frozen=True, slots=True)
class ContractTest:
    """A test of a contract."""

    name: str
    check: Callable[[], None]

    def __str__(self) -> str:
        """Return the name, which test runners show."""
        return self.name


def registered_names(kind: str, part: Path | str) -> list[str]:
    """Return the names of some kind that a plugin file registers; a name stands for itself.

    Raises:
        UsageError: if the file registers no such name.
        PluginError: if the file cannot be loaded.
    """
    if isinstance(part, str):
        return [part]
    registry = Registry()
    registry.add_file(part)
    names = [name for known, name in registry.registrations if known == kind]
    if not names:
        raise UsageError(f"{part} registers no {kind}")
    return names
