"""The stages and other named values of plugins: installed ones, those in the user's folder, and a workflow's own.

A plugin that cannot be loaded, or a name that two plugins define, causes an error only when the name is used.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points
from inspect import isfunction
from pathlib import Path
from types import ModuleType
from typing import TypeAlias

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.doors import load_entry, origin_of
from pano_mvs.core.errors import PluginError
from pano_mvs.core.named_registry import Registration, registrations_of, set_unavailable
from pano_mvs.core.paths import is_file, resolved
from pano_mvs.core.plugin_folders import PLUGINS_VARIABLE, plugin_files_in, user_plugin_folders
from pano_mvs.core.process_state import restored_state
from pano_mvs.core.text import error_summary, error_text, shortened
from pano_mvs.engine.stages.stage import StageSpec, spec_of
from pano_mvs.engine.stages.stage_code import code_digest

ENTRY_POINT_GROUP = "pano_mvs.plugins"
_OF_THE_RUN = ("command", "executor", "observer")  # registrations that no worker needs
_Named: TypeAlias = tuple[tuple[str, str], StageSpec | Registration]  # kind and name, and what has them


@dataclass(frozen=True, slots=True)
class PluginProblem:
    """Why the environment of a plugin cannot be used."""

    text: str
    remedy: str

    def __str__(self) -> str:
        """Return both in one sentence each."""
        return f"{self.text}. {self.remedy[:1].upper()}{self.remedy[1:]}"


@dataclass(frozen=True, slots=True)
class Plugin:
    """A plugin that was found."""

    origin: str  # the distribution, or the file
    names: tuple[tuple[str, str], ...]  # what it defines: ("stage", name), or the kind and name of a registration
    error: str = ""  # why it could not be loaded, in one line; empty if it was loaded
    trace: str = ""  # the traceback of that error; empty if the error says what to do
    environment: str = ""  # the folder of its own environment; empty if it is imported into this process
    # tries its own environment, and returns why its stages cannot be computed there; None if they can
    check: Callable[[], PluginProblem | None] | None = None

    def why_broken(self) -> str:
        """Return why none of its names can be used."""
        if not self.trace:
            return f"the plugin {self.origin} cannot be used: {self.error}"
        return f"the plugin {self.origin} failed to load:\n{self.trace.rstrip()}"


@dataclass(frozen=True, slots=True)
class ProvidedPlugin:
    """A plugin whose stages are not in a module of this process."""

    plugin: Plugin
    stages: tuple[StageSpec, ...] = ()  # none if it cannot be used


@dataclass(slots=True)
class Registry:
    """The stages by name, and the plugins that define them."""

    stages: dict[str, StageSpec] = field(default_factory=dict)
    # what plugins registered beside stages, by kind and name
    registrations: dict[tuple[str, str], Registration] = field(default_factory=dict)
    origins: dict[str, str] = field(default_factory=dict)  # stage name to the plugin that defines it
    plugins: list[Plugin] = field(default_factory=list)  # all that were found, including broken ones
    # names that are defined twice, as in `Plugin.names`, to the two places; such names cannot be used
    clashes: dict[tuple[str, str], str] = field(default_factory=dict)
    _files: dict[Path, tuple[str, Plugin]] = field(default_factory=dict)

    @staticmethod
    def installed() -> Registry:
        """Return a registry with the built-in stages, all installed plugins, and those in the user's plugin folders."""
        registry = Registry()
        for entry in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda entry: (entry.value, entry.name)):
            registry._load_entry_point(entry)
        for folder in user_plugin_folders():
            registry._load_folder(folder)
        registry._withhold()
        return registry

    @property
    def broken(self) -> list[Plugin]:
        """The plugins that could not be loaded."""
        return [plugin for plugin in self.plugins if plugin.error]

    def add_module(self, module: ModuleType, origin: str, *, code: str = "") -> None:
        """Register all stages and other registrations of a module.

        Raises:
            PluginError: if a name is defined elsewhere too; the message names both places.
        """
        if clashes := self._clashes(_defined(module, own_only=bool(code))):
            raise PluginError("; ".join(clashes.values()))
        self._add(module, origin, code)

    def add_file(self, path: Path) -> None:
        """Register the stages and other registrations of a user's file; its code is in the cache keys of its stages.

        Raises:
            PluginError: if the file cannot be read or imported, defines nothing, or defines a name that exists.
        """
        loaded = self._load_file(path)
        if loaded is not None:
            module, digest = loaded
            self.add_module(module, str(path), code=digest)
            self._remember_file(path, module, digest)

    def _load_file(self, path: Path) -> tuple[ModuleType, str] | None:
        """Return a file's module and the digest of its code, or None if the same code is registered already."""
        if not is_file(path):
            raise PluginError(f"plugin file {path} does not exist")
        try:
            digest = code_digest(path)
            if self._files.get(resolved(path), ("", None))[0] == digest:
                return None  # named twice, or by the workflow and in the user's folder
            module = _import_file(path)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # also others than Exception, such as pytest.skip() or a panic in Rust
            raise PluginError(f"plugin file {path} failed to import: {_where(error, path)}") from error
        registered = any(kind != "stage" for kind, _ in _names(module, own_only=False))
        if not registered and not _names(module, own_only=True):
            raise PluginError(f'plugin file {path} defines no stage: decorate a function with @stage("kind.name")')
        return module, digest

    def _remember_file(self, path: Path, module: ModuleType, digest: str) -> None:
        self.plugins.append(Plugin(str(path), _names(module, own_only=True)))
        self._files[resolved(path)] = digest, self.plugins[-1]

    def files_behind(self, stages: Collection[str]) -> dict[Path, str]:
        """Return the plugin files that some stages need, with the digests of their code.

        A file with registrations beside stages is always included if any stage may use them.
        """
        return {
            path: digest
            for path, (digest, plugin) in self._files.items()
            if any(name in stages if kind == "stage" else kind not in _OF_THE_RUN for kind, name in plugin.names)
        }

    def suggest(self, name: str) -> str:
        """Return a hint for an unknown stage name: similar names, and the plugins that could not be loaded."""
        if ("stage", name) in self.clashes:
            return self.clashes["stage", name]
        for plugin in self.broken:
            if ("stage", name) in plugin.names:
                return plugin.why_broken()
        close = get_close_matches(name, self.stages, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(map(repr, close))}?" if close else "`pano-mvs plugins` lists all stages"
        return "\n".join([hint, *(plugin.why_broken() for plugin in self.broken)])

    def _load_entry_point(self, entry: EntryPoint) -> None:
        origin = origin_of(entry)
        try:
            module = load_entry(entry)
            if isfunction(module):
                self._add_provided(module())
                return
            if not isinstance(module, ModuleType):
                raise PluginError(f"the entry point {entry.name} = {entry.value} must name a module or a function")
            clashes = self._clashes(_defined(module, own_only=False))
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            self.plugins.append(_broken(origin, error))
            return
        self.clashes |= clashes
        self._add(module, origin, "")
        self.plugins.append(Plugin(origin, _names(module, own_only=False)))

    def _add_provided(self, provided: Iterable[ProvidedPlugin]) -> None:
        """Add plugins whose stages are not in a module."""
        for one in provided:
            self.clashes |= self._clashes((("stage", spec.name), spec) for spec in one.stages)
            self._add_stages(one.stages, one.plugin.origin)
            self.plugins.append(one.plugin)

    def _load_folder(self, folder: Path) -> None:
        if not folder.is_absolute():
            error = PluginError(f"${PLUGINS_VARIABLE} holds {str(folder)!r}, which is not an absolute path")
            self.plugins.append(_broken(f"${PLUGINS_VARIABLE}", error))
            return
        for path in plugin_files_in(folder):
            try:
                loaded = self._load_file(path)
            except PluginError as error:
                self.plugins.append(_broken(str(path), error.__cause__ or error))
                continue
            if loaded is not None:
                module, digest = loaded
                self.clashes |= self._clashes(_defined(module, own_only=True))
                self._add(module, str(path), digest)
                self._remember_file(path, module, digest)

    def _clashes(self, defined: Iterable[_Named]) -> dict[tuple[str, str], str]:
        """Return the names, as of a module, that are defined elsewhere too, with both places."""
        places = {key: found.origin for key, found in self.registrations.items()}
        places |= {("stage", name): spec.origin for name, spec in self.stages.items()}
        clashes: dict[tuple[str, str], str] = {}
        for (kind, name), found in defined:
            taken = places.setdefault((kind, name), found.origin)
            if taken != found.origin:
                both = f"{taken} and {found.origin}"
                clashes[kind, name] = f"{kind} {name!r} is defined twice: {both}. Rename one of them"
        return clashes

    def _add(self, module: ModuleType, origin: str, code: str) -> None:
        for key, found in _defined(module, own_only=bool(code)):
            if isinstance(found, Registration):
                self.registrations.setdefault(key, found)
            else:
                self._add_stages([found.with_code(code) if code else found], origin)

    def _add_stages(self, stages: Iterable[StageSpec], origin: str) -> None:
        for spec in stages:
            if spec.name not in self.stages:
                self.stages[spec.name] = spec
                self.origins[spec.name] = origin

    def _withhold(self) -> None:
        """Remove names that are defined twice, and state why others may be missing."""
        for kind, name in self.clashes:
            if kind == "stage":
                self.stages.pop(name, None)
        set_unavailable(self.clashes, [plugin.why_broken() for plugin in self.broken])


def _broken(origin: str, error: BaseException) -> Plugin:
    summary = shortened(error_summary(error))
    return Plugin(origin, (), summary, _trace(error))


def _trace(error: BaseException) -> str:
    """Return the traceback, beginning at the plugin's own code; only the place if that is not Python."""
    step = None if isinstance(error, SyntaxError) else error.__traceback__
    while step is not None and (
        step.tb_frame.f_code.co_filename == __file__ or "importlib" in step.tb_frame.f_code.co_filename
    ):
        step = step.tb_next
    return "".join(traceback.format_exception(type(error), error, step))


def _names(module: ModuleType, *, own_only: bool) -> tuple[tuple[str, str], ...]:
    """Return the names that a module defines; see `Plugin.names`."""
    return tuple(dict.fromkeys(key for key, _ in _defined(module, own_only=own_only)))


def _defined(module: ModuleType, *, own_only: bool) -> Iterator[_Named]:
    """Yield the stages of a module, then what it registers beside them, with kind and name; see `Plugin.names`.

    Args:
        own_only: whether to leave out what it imports.
    """
    for value in vars(module).values():
        spec = spec_of(value)
        if spec is not None and (not own_only or spec.function.__module__ == module.__name__):
            yield ("stage", spec.name), spec
    for value in vars(module).values():
        if not own_only or getattr(value, "__module__", "") == module.__name__:
            for found in registrations_of(value):
                yield (found.kind, found.name), found


def _import_file(path: Path) -> ModuleType:
    """Import a file under a unique name. Its folder is on the path only during the import.

    Modules that it imports from its folder are removed from `sys.modules` afterwards, so that another plugin gets its
    own `helper.py`.
    """
    name = f"pano_mvs_plugin_{digest_from_value(str(resolved(path)))[:12]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise PluginError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    folder = str(resolved(path).parent)
    before = set(sys.modules)
    sys.modules[name] = module
    sys.path.insert(0, folder)
    importlib.invalidate_caches()
    try:
        with redirect_stdout(sys.stderr), restored_state():  # commands write their results to the standard output
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
    """Return the error with the line of the plugin's own file that raised it."""
    if isinstance(error, SyntaxError):
        return f"{error.filename or path}:{error.lineno}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if Path(frame.filename) == path.absolute()]
    place = f"{path}:{own[-1].lineno}: " if own else ""
    deeper = own and own[-1] is not frames[-1] and "importlib" not in frames[-1].filename
    text = f"{place}{type(error).__name__}: {error_text(error)}"
    return f"{text}\n{_trace(error).rstrip()}" if deeper else text
