"""NamedRegistry that are chosen by name, and to which plugins add their own: the backends and the costs of a sweep."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Generic, TypeVar

from pano_mvs.core.errors import PluginError, UsageError

Value = TypeVar("Value")
_ATTRIBUTE = "__pano_mvs_parts__"
_unusable: dict[tuple[str, str], str] = {}


@dataclass(frozen=True, slots=True)
class Registration:
    """What a function was registered as.

    Attributes:
        kind: what the part is, in words: "sweep cost".
        name: by which it is chosen.
        origin: where it was defined, `file:line`.
    """

    kind: str
    name: str
    origin: str


class NamedRegistry(Generic[Value]):
    """All parts of one kind by name: those built in, and those of plugins."""

    def __init__(self, kind: str, builtin: Mapping[str, Value]) -> None:
        self.kind = kind
        self._builtin = dict(builtin)
        self._added: dict[str, tuple[Value, Callable[..., Any]]] = {}

    def names(self) -> tuple[str, ...]:
        """Return the names there are, those built in first."""
        return *self._builtin, *sorted(self._added)

    def register(self, name: str, value: Value, function: Callable[..., Any]) -> None:
        """Add a plugin's part, in the place of one of that name that a plugin added before.

        Args:
            name: letters, digits, '-', '_' and '.'.
            value: the part.
            function: the plugin's function behind it, which is marked; its file is the part's code.

        Raises:
            PluginError: if the name is none, or that of a part that is built in.
        """
        if not name or not all(sign.isalnum() or sign in "-_." for sign in name):
            raise PluginError(f"a {self.kind} cannot be called {name!r}: use letters, digits, '-', '_' and '.'")
        if name in self._builtin:
            raise PluginError(f"the {self.kind} {name!r} is built in: register yours under another name")
        self._added[name] = value, function
        code = function.__code__
        mark = Registration(self.kind, name, f"{code.co_filename}:{code.co_firstlineno}")
        setattr(function, _ATTRIBUTE, (*registrations_of(function), mark))

    def get(self, name: str) -> Value:
        """Return the part of that name.

        Raises:
            UsageError: if there is none; with those that there are.
        """
        self.check(name)
        return self._builtin[name] if name in self._builtin else self._added[name][0]

    def check(self, name: str) -> str:
        """Return the name if there is such a part, else raise UsageError."""
        why = _unusable.get((self.kind, name))
        if name in self._builtin or (name in self._added and why is None):
            return name
        if why is not None:
            raise UsageError(f"the {self.kind} {name!r} cannot be used: {why}")
        close = get_close_matches(name, self.names(), n=2, cutoff=0.5)
        hint = f"did you mean {' or '.join(map(repr, close))}? " if close else ""
        raise UsageError(
            f"there is no {self.kind} {name!r}; {hint}known: {', '.join(self.names())}. A plugin's is known once the "
            "plugin is installed, or its file is listed under `plugins:`"
        )

    def is_builtin(self, name: str) -> bool:
        """Return whether a name is that of a part of our own."""
        return name in self._builtin

    def code_file(self, name: str) -> Path | None:
        """Return the file that defines a plugin's part; None for what is built in."""
        return Path(self._added[name][1].__code__.co_filename) if name in self._added else None


def set_unavailable(reasons: Mapping[tuple[str, str], str]) -> None:
    """Say, by kind and name, why parts cannot be had that plugins would give; whatever was said before is forgotten."""
    _unusable.clear()
    _unusable.update(reasons)


def registrations_of(value: object) -> tuple[Registration, ...]:
    """Return what an object was registered as; nothing, mostly."""
    marks = getattr(value, _ATTRIBUTE, ())
    return marks if isinstance(marks, tuple) and all(isinstance(mark, Registration) for mark in marks) else ()
