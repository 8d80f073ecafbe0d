"""Registries of values that users choose by name and to which plugins add, such as the costs of a sweep."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from inspect import unwrap
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, Generic, TypeVar

from pano_mvs.core.errors import PluginError, UsageError

Value = TypeVar("Value")
_ATTRIBUTE = "__pano_mvs_registrations__"
_unavailable: dict[tuple[str, str], str] = {}
_broken: list[str] = []


@dataclass(frozen=True, slots=True)
class Registration:
    """The name under which a plugin registered a function."""

    kind: str  # what the registry holds, in words: "sweep cost"
    name: str  # by which users choose it
    origin: str  # where the function is defined, `file:line`


class NamedRegistry(Generic[Value]):
    """Values of one kind by name: the built-in ones, and those of plugins."""

    def __init__(self, kind: str, builtin: Mapping[str, Value]) -> None:
        self.kind = kind
        self._builtin = dict(builtin)
        self._added: dict[str, tuple[Value, CodeType]] = {}

    def names(self) -> tuple[str, ...]:
        """Return all names, the built-in ones first."""
        return *self._builtin, *sorted(self._added)

    def register(self, name: str, value: Value, function: Callable[..., Any]) -> None:
        """Add a plugin's value; it replaces one that a plugin registered before under the same name.

        Args:
            name: letters, digits, '-', '_' and '.'.
            value: what `get` returns.
            function: the plugin's function or class behind the value; its file counts as the code of the value.

        Raises:
            PluginError: if the name has other characters, or is that of a built-in value.
        """
        if not name or not all(sign.isalnum() or sign in "-_." for sign in name):
            raise PluginError(f"a {self.kind} cannot be called {name!r}: use letters, digits, '-', '_' and '.'")
        if name in self._builtin:
            raise PluginError(f"the {self.kind} {name!r} is built in: register yours under another name")
        code = _code_of(function)
        self._added[name] = value, code
        registration = Registration(self.kind, name, f"{code.co_filename}:{code.co_firstlineno}")
        setattr(function, _ATTRIBUTE, (*registrations_of(function), registration))

    def get(self, name: str) -> Value:
        """Return the value registered under a name.

        Raises:
            UsageError: if there is none; the message lists the known names.
        """
        self.check(name)
        return self._builtin[name] if name in self._builtin else self._added[name][0]

    def check(self, name: str) -> str:
        """Return the name if it is registered, else raise UsageError."""
        why = self.why_withheld(name)
        if name in self._builtin or (name in self._added and not why):
            return name
        if why:
            raise UsageError(f"the {self.kind} {name!r} cannot be used: {why}")
        close = get_close_matches(name, self.names(), n=2, cutoff=0.5)
        hint = f"did you mean {' or '.join(map(repr, close))}? " if close else ""
        text = (
            f"there is no {self.kind} {name!r}; {hint}known: {', '.join(self.names())}. If it is a plugin's, install "
            "the plugin or list its file under `plugins:`"
        )
        raise UsageError("\n".join([text, *_broken]))

    def why_withheld(self, name: str) -> str:
        """Return why a name that plugins define cannot be used, such as two definitions; "" if it can."""
        return _unavailable.get((self.kind, name), "")

    def code_file(self, name: str) -> Path | None:
        """Return the plugin file behind a name, or None if the value is built in."""
        return Path(self._added[name][1].co_filename) if name in self._added else None


def _code_of(function: Callable[..., Any]) -> CodeType:
    """Return the code of a function, of one that is wrapped, or of a class's first method."""
    inner = unwrap(function)
    if isinstance(inner, type):
        inner = next((method for method in vars(inner).values() if isinstance(method, FunctionType)), inner)
    code = getattr(inner, "__code__", None)
    if not isinstance(code, CodeType):
        raise PluginError(f"{function!r} cannot be registered: it is neither a function nor a class with methods")
    return code


def set_unavailable(reasons: Mapping[tuple[str, str], str], broken: Sequence[str]) -> None:
    """Declare which names cannot be used, kind and name to the reason, and why plugins with others failed to load."""
    _unavailable.clear()
    _unavailable.update(reasons)
    _broken[:] = broken


def registrations_of(value: object) -> tuple[Registration, ...]:
    """Return the names under which an object is registered; most objects have none."""
    found = getattr(value, _ATTRIBUTE, ())
    return found if isinstance(found, tuple) and all(isinstance(one, Registration) for one in found) else ()
