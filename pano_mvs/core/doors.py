"""Doors for plugins: values of one kind that installed packages offer by entry points, and files by registration.

A package that is installed names a value in its entry points, in the group of the door; its module is imported when the
value is used, so that a command that does not need it does not pay for it. A plugin file registers its values when it
is imported. What cannot be loaded disables its own names only.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.metadata import Distribution, EntryPoint, EntryPoints, PackageNotFoundError, distribution, entry_points
from typing import Any, TypeVar

from pano_mvs.core.errors import PluginError
from pano_mvs.core.named_registry import NamedRegistry
from pano_mvs.core.text import error_summary

Value = TypeVar("Value")
DISTRIBUTION = "pano-mvs"


@dataclass(frozen=True, slots=True)
class RunOption:
    """An option that a plugin adds to `pano-mvs run`."""

    name: str  # without the dashes: "queue"
    help: str
    metavar: str = ""  # what its value is, in capitals; empty for a flag
    multiple: bool = False  # whether it may be given more than once


class Door(NamedRegistry[Value]):
    """Values of one kind by name: the built-in ones, those of plugin files, and those of installed packages."""

    def __init__(
        self,
        kind: str,
        group: str,
        builtin: Mapping[str, Value] | None = None,
        *,
        accepts: Callable[[object], Value | None],
    ) -> None:
        """Open a door.

        Args:
            kind: what comes through it, in words: "executor".
            group: of the entry points.
            builtin: the values that the core has.
            accepts: returns the value behind an entry point, or None if it is not of this kind.
        """
        super().__init__(kind, builtin or {})
        self.group = group
        self._accepts = accepts
        self._loaded: dict[str, Value] = {}

    def register(self, name: str, value: Value, function: Callable[..., Any]) -> None:
        """Add a plugin's value; see `NamedRegistry.register`.

        Raises:
            PluginError: if the name has other characters, is that of a built-in value, or an installed package offers
                another value with it.
        """
        for entry in installed(self.group).get(name, ()):
            if entry.module != function.__module__:  # a package may register what its entry point names
                raise PluginError(
                    f"the {self.kind} {name!r} is that of {origin_of(entry)}: register yours under another name"
                )
        super().register(name, value, function)

    def names(self) -> tuple[str, ...]:
        """Return all names: the built-in ones, those of files, and those of packages, which need not load."""
        others = [*self._added, *(name for name in installed(self.group) if name not in self._builtin)]
        return *self._builtin, *sorted(dict.fromkeys(others))

    def get(self, name: str) -> Value:
        """Return a value; a module that is not loaded yet is imported.

        Raises:
            UsageError: if no value has this name.
            PluginError: if it cannot be loaded, or two plugins offer it.
        """
        if name not in self._builtin and (why := self.why_withheld(name)):
            raise PluginError(f"the {self.kind} {name!r} cannot be used: {why}")
        if name in self._builtin or name in self._added or name not in installed(self.group):
            return super().get(name)
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def origin(self, name: str) -> str:
        """Return where a name comes from: a file, or what `origin_of` returns for its entry points."""
        if (file := self.code_file(name)) is not None:
            return str(file)
        if name in self._builtin:
            return "built in"
        return " and ".join(map(origin_of, self._entries(name)))

    def _entries(self, name: str) -> Sequence[EntryPoint]:
        """Return the entry points of a name; a package cannot take that of a bundled plugin, just as a file cannot."""
        entries = installed(self.group).get(name, ())
        return [entry for entry in entries if is_bundled(entry)] or entries

    def problem(self, name: str) -> str:
        """Return why a name cannot be used; "" if it can."""
        try:
            self.get(name)
        except PluginError as error:
            return str(error)
        return ""

    def check(self, name: str) -> str:
        """Return the name if somebody offers it, else raise UsageError."""
        if name in installed(self.group) and name not in self._builtin:
            return name
        return super().check(name)

    def _load(self, name: str) -> Value:
        entries = self._entries(name)
        if len(entries) > 1:
            both = " and ".join(f"{origin_of(entry)} ({entry.value})" for entry in entries)
            raise PluginError(f"{self.kind} {name!r} is offered twice: by {both}. Uninstall one of them")
        (entry,) = entries
        try:
            value = self._accepts(load_entry(entry))
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # also others than Exception, as a plugin's code may raise
            raise PluginError(
                f"the {self.kind} {name!r} of {origin_of(entry)} cannot be used, because {entry.value} failed to load: "
                f"{error_summary(error)}. {_remedy(entry)}"
            ) from error
        if value is None:
            raise PluginError(
                f"the {self.kind} {name!r} of {origin_of(entry)} cannot be used: {entry.value} is not "
                f"{'an' if self.kind[0] in 'aeio' else 'a'} {self.kind}. {_remedy(entry)}"
            )
        return value


def load_entry(entry: EntryPoint) -> Any:
    """Import what an entry point names; what the import prints or changes in this process does not stay."""
    with redirect_stdout(sys.stderr):
        if is_bundled(entry):
            return entry.load()
        from pano_mvs.core.process_state import restored_state  # which loads numpy

        with restored_state():
            return entry.load()


@cache
def installed(group: str) -> Mapping[str, Sequence[EntryPoint]]:
    """Return the entry points of a group by name; more than one of a name if several packages offer it."""
    found: dict[str, list[EntryPoint]] = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: (entry.value, origin_of(entry))):
        same = found.setdefault(entry.name, [])
        if all(other.value != entry.value for other in same):  # the same package may be on the path twice
            same.append(entry)
    return found


def origin_of(entry: EntryPoint) -> str:
    """Return the distribution of an entry point with its version; of a bundled plugin, the name of its package."""
    package = entry.module.partition(".")[0]
    if is_bundled(entry) and package != "pano_mvs":
        return package
    return " ".join(_name_and_version(entry.dist)) if entry.dist else entry.value


@cache
def own_packages() -> frozenset[str]:
    """Return the names of the packages of our distribution: the core, and the bundled plugins."""
    try:
        entries = distribution(DISTRIBUTION).entry_points
    except PackageNotFoundError:  # run from a folder
        entries = EntryPoints()
    return frozenset({"pano_mvs", *(entry.module.partition(".")[0] for entry in entries)})


def is_bundled(entry: EntryPoint) -> bool:
    """Return whether an entry point is one of our own distribution."""
    return entry.dist is not None and _name_and_version(entry.dist)[0] == DISTRIBUTION


@lru_cache(maxsize=1024)
def _name_and_version(dist: Distribution) -> tuple[str, str]:
    """Return the name and the version of a distribution; each of the two would parse the whole metadata again."""
    metadata = dist.metadata
    return metadata["Name"], metadata["Version"]


def _remedy(entry: EntryPoint) -> str:
    return f"Install {DISTRIBUTION} again" if is_bundled(entry) else "Update or uninstall that plugin"


FUNCTIONS = Door[Callable[..., Any]](
    "function",
    "pano_mvs.functions",
    accepts=lambda value: value if callable(value) else None,
)
"""Functions that plugins add to the names of `pano_mvs` itself."""
