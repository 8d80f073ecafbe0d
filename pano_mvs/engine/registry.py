"""Which stages, and other parts with names, there are: built-in, installed, or in a file that the workflow names."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import PluginError
from pano_mvs.core.parts import PartMark, marks_of
from pano_mvs.engine.code_digest import code_digest
from pano_mvs.engine.stage import StageSpec, spec_of

ENTRY_POINT_GROUP = "pano_mvs.plugins"


@dataclass(frozen=True, slots=True)
class BrokenPlugin:
    """A plugin that could not be loaded; it harms nobody until one of its stages is used."""

    origin: str
    error: str
    trace: str


@dataclass(slots=True)
class Registry:
    """All stages by name, the parts that plugins add (by kind and name), and the plugins that failed to load."""

    stages: dict[str, StageSpec] = field(default_factory=dict)
    parts: dict[tuple[str, str], PartMark] = field(default_factory=dict)
    origins: dict[str, str] = field(default_factory=dict)
    broken: list[BrokenPlugin] = field(default_factory=list)

    @staticmethod
    def installed() -> Registry:
        """Return the registry of all installed plugins, ours and others', through the same door."""
        registry = Registry()
        for entry in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda entry: (entry.value, entry.name)):
            registry._load_entry_point(entry)
        return registry

    def add_module(self, module: ModuleType, origin: str, *, code: str = "") -> None:
        """Register all stages and parts that a module holds.

        Raises:
            PluginError: if a name is taken by another one; the message names both places.
        """
        for mark in _marks(module, own_only=bool(code)):
            taken = self.parts.setdefault((mark.kind, mark.name), mark)
            if taken.origin != mark.origin:
                raise PluginError(
                    f"{mark.kind} {mark.name!r} is defined twice: {taken.origin} and {mark.origin}. Rename one of them"
                )
        for spec in _specs(module, own_only=bool(code)):
            known = self.stages.get(spec.name)
            if known is not None and known.origin != spec.origin:
                raise PluginError(
                    f"stage {spec.name!r} is defined twice: {known.origin} and {spec.origin}. Rename one of them"
                )
            self.stages[spec.name] = spec.with_code(code) if code else spec
            self.origins[spec.name] = origin

    def add_file(self, path: Path) -> None:
        """Register the stages and parts of one user file; its code counts towards the cache keys of its stages.

        Raises:
            PluginError: if the file cannot be read or imported, or defines neither.
        """
        if not path.is_file():
            raise PluginError(f"plugin file {path} does not exist")
        try:
            digest = code_digest(path)
            module = _import_file(path)
        except (Exception, SystemExit) as error:
            raise PluginError(f"plugin file {path} failed to import: {_where(error, path)}") from error
        if not any(_specs(module, own_only=True)) and not any(_marks(module, own_only=False)):
            raise PluginError(f'plugin file {path} defines no stage: decorate a function with @stage("kind.name")')
        self.add_module(module, str(path), code=digest)

    def suggest(self, name: str) -> str:
        """Return a did-you-mean for an unknown stage name, with any broken plugin that may be to blame."""
        close = get_close_matches(name, self.stages, n=3, cutoff=0.5)
        parts = [f"did you mean {' or '.join(map(repr, close))}?"] if close else ["`pano-mvs plugins` lists all stages"]
        parts.extend(f"(plugin {broken.origin} failed to load: {broken.error})" for broken in self.broken)
        return " ".join(parts)

    def _load_entry_point(self, entry: EntryPoint) -> None:
        origin = f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
        try:
            module = entry.load()
            self.add_module(module, origin)
        except (Exception, SystemExit) as error:
            self.broken.append(BrokenPlugin(origin, f"{type(error).__name__}: {error}", traceback.format_exc()))


def _specs(module: ModuleType, *, own_only: bool) -> Iterator[StageSpec]:
    """Find a module's stages; a user's file may also import stages of others, which are not its own."""
    for value in vars(module).values():
        spec = spec_of(value)
        if spec is not None and (not own_only or spec.function.__module__ == module.__name__):
            yield spec


def _marks(module: ModuleType, *, own_only: bool) -> Iterator[PartMark]:
    """Find what a module, or a helper of it, registers beside stages."""
    for value in vars(module).values():
        if not own_only or getattr(value, "__module__", "") == module.__name__:
            yield from marks_of(value)


def _import_file(path: Path) -> ModuleType:
    """Import a file under a name of its own; its folder is importable only meanwhile.

    The helpers that it imports from its folder are forgotten afterwards, so that another plugin's `helper.py` is not
    taken for this one's.
    """
    name = f"pano_mvs_plugin_{digest_from_value(str(path.resolve()))[:12]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise PluginError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    folder = str(path.resolve().parent)
    before = set(sys.modules)
    sys.modules[name] = module
    sys.path.insert(0, folder)
    importlib.invalidate_caches()
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    finally:
        sys.path.remove(folder)
        for helper in set(sys.modules) - before - {name}:
            if str(getattr(sys.modules[helper], "__file__", None) or "").startswith(folder):
                del sys.modules[helper]
    return module


def _where(error: BaseException, path: Path) -> str:
    """Return the error with the line of the plugin's own file in which it was raised."""
    if isinstance(error, SyntaxError):
        return f"{error.filename or path}:{error.lineno}: {error.msg}"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename) == path]
    place = f"{path}:{frames[-1].lineno}: " if frames else ""
    return f"{place}{type(error).__name__}: {error}"
