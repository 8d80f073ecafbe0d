"""Install a plugin, in an environment of its own if it asks for one, and remove it."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib import invalidate_caches
from importlib.metadata import distribution, distributions
from itertools import count
from pathlib import Path
from typing import Any

import pano_mvs
from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.doors import DISTRIBUTION, installed
from pano_mvs.core.errors import InputError, PluginError, UsageError
from pano_mvs.core.files import remove_whole
from pano_mvs.core.paths import children, exists, is_folder
from pano_mvs.core.yaml_text import did_you_mean
from pano_mvs.engine.stages.registry import Registry
from pano_mvs_environments.build import build, installer, python_in
from pano_mvs_environments.index import (
    FORMAT,
    MARK,
    Environment,
    Mode,
    canonical,
    enter,
    environments,
    folders_in_use,
    installed_environment,
    leave,
    sole_installation,
)
from pano_mvs_environments.interpreter import ask, run_command
from pano_mvs_environments.sources import PluginSource, plugin_source, wish_of
from pano_mvs_environments.stages import examined


@dataclass(frozen=True, slots=True)
class InstalledPlugin:
    """A plugin that was installed.

    Attributes:
        name: of its distribution.
        version: of its distribution.
        environment: "overlay", "isolated", or "none" if it is installed beside pano_mvs.
        folder: of its environment; "" if it has none.
        stages: names of its stages; empty if it has no environment.
        is_new: False if the same plugin was there already, and works.
    """

    name: str
    version: str
    environment: str
    folder: str
    stages: tuple[str, ...]
    is_new: bool = True

    def to_json(self) -> dict[str, Any]:
        """Return the plugin as a JSON value."""
        return asdict(self)


def install_plugin(
    source: str | Path,
    *,
    environment: str = "",
    force: bool = False,
    on_wait: Callable[[], None] | None = None,
) -> InstalledPlugin:
    """Install a plugin, in an environment of its own if it asks for one, and otherwise beside pano_mvs.

    Args:
        source: folder with a pyproject.toml, wheel or archive, or a requirement such as "my-plugin>=2".
        environment: "overlay", "isolated" or "none", instead of what its pyproject.toml asks for.
        force: build its environment again, even if nothing has changed.
        on_wait: called if another process is installing a plugin, for which this one waits.

    Raises:
        InputError: if it cannot be installed, with the reason of pip or uv; nothing is changed then.
        UsageError: if the source or the environment is not valid.
        StoreError: if the folder of the environments cannot be written.
    """
    found = plugin_source(str(source))
    mode = wish_of(found, environment)
    if mode is None:
        return _install_here(found)
    with sole_installation(on_wait) as folder:
        _sweep(folder)
        known, digest = installed_environment(found.name), _digest_of(found, mode)
        if known is not None and found.digest and known.digest == digest and not force and not examined(known):
            return _installed(known, is_new=False)
        with _new_folder(folder, f"{canonical(found.name)}-{digest[:12]}") as place:
            build(place, found, mode)
            made = _described(place, found, mode=mode, digest=digest)
            _check_names(made)
            enter(made)
        _sweep(folder)
    return _installed(made, is_new=True)


def _digest_of(source: PluginSource, mode: Mode) -> str:
    """Return a digest of all that an environment is made from, as far as it is known before."""
    return digest_from_value(
        [FORMAT, source.requirement, source.digest, mode, pano_mvs.__version__, sys.version, sys.prefix]
    )


@contextmanager
def _new_folder(folder: Path, name: str) -> Iterator[Path]:
    """Yield a folder that does not exist, and remove it if the context fails."""
    place = next(
        path for number in count(1) if not exists(path := folder / (name if number == 1 else f"{name}-{number}"))
    )
    try:
        yield place
    except BaseException:
        remove_whole(place)
        raise


def _sweep(folder: Path) -> None:
    """Remove environments that are not in the index: older ones, and those of interrupted installations.

    The user chooses the folder, which may hold other things: only what `build` has marked is removed.
    """
    used = folders_in_use()
    for path in children(folder):
        if is_folder(path) and exists(path / MARK) and path not in used:
            remove_whole(path)


def _described(place: Path, source: PluginSource, *, mode: Mode, digest: str) -> Environment:
    """Return a new environment, with the stages that its interpreter finds."""
    python = str(python_in(place))
    question = {"do": "describe", "distribution": source.name, "mode": mode}
    try:
        # All libraries count as its own: it must not touch kernels of others before its own libraries are known.
        found = ask(python, question, folder=place, libraries={"numba": ""})
    except PluginError as error:
        raise InputError(f"{source.shown}: the plugin cannot be loaded in its environment:\n{error}") from error
    if "problem" in found:
        raise InputError(f"{source.shown}: the plugin {source.name} cannot have an environment: {found['problem']}")
    return Environment(
        name=found["name"],
        version=found["version"],
        mode=mode,
        source=source.shown,
        folder=str(place),
        python=python,
        python_version=found["python_version"],
        pano_mvs=pano_mvs.__version__,
        installation=sys.prefix,
        digest=digest,
        stages=tuple(found["stages"]),
        libraries=found["libraries"],
    )


def _check_names(made: Environment) -> None:
    """Raise InputError if a stage of a new environment is defined by another plugin."""
    registry = Registry.installed()
    others = {one.origin for one in environments() if canonical(one.name) == canonical(made.name)}
    for described in made.stages:
        name = described["name"]
        origin = registry.origins.get(name)
        if origin is not None and origin not in others:
            raise InputError(
                f"{made.source}: the stage {name!r} is defined by {origin} too, so neither could be used. Rename it, "
                "or remove that plugin"
            )


def _install_here(source: PluginSource) -> InstalledPlugin:
    """Install a plugin beside pano_mvs."""
    before = {canonical(one.name) for one in distributions()}
    if installed_environment(source.name) is not None:
        raise UsageError(
            f"{source.name} is installed in an environment of its own: run `pano-mvs plugin remove {source.name}` first"
        )
    try:
        run_command([*installer(Path(sys.executable), shutil.which("uv")), source.requirement])
    except PluginError as error:
        raise InputError(f"{source.name} cannot be installed:\n{error}") from error
    _look_again()
    found = distribution(source.name)
    if not _is_plugin(found):
        what = "which was installed before"
        if canonical(found.name) not in before:
            _uninstall(found.name)
            what = "so it was removed again"
        raise InputError(f"{source.name} is not a plugin of pano_mvs, {what}. Correct the name")
    return InstalledPlugin(found.name, found.version, "none", "", ())


def _uninstall(name: str) -> None:
    uv = shutil.which("uv")
    pip = (sys.executable, "-P", "-m", "pip", "uninstall", "--yes", "--quiet", "--disable-pip-version-check")
    command = (uv, "pip", "uninstall", "--quiet", "--python", sys.executable) if uv else pip
    try:
        run_command([*command, name])
    except PluginError as error:
        raise InputError(f"{name} cannot be removed:\n{error}") from error
    _look_again()


def _look_again() -> None:
    """Let this process find what was installed or removed."""
    invalidate_caches()
    installed.cache_clear()


def _installed(found: Environment, *, is_new: bool) -> InstalledPlugin:
    names = tuple(described["name"] for described in found.stages)
    return InstalledPlugin(found.name, found.version, found.mode, found.folder, names, is_new)


def remove_plugin(name: str, *, on_wait: Callable[[], None] | None = None) -> InstalledPlugin:
    """Remove a plugin that is installed: its environment, or its distribution.

    Args:
        name: of its distribution.
        on_wait: called if another process is installing a plugin, for which this one waits.

    Returns:
        What was removed.

    Raises:
        UsageError: if no plugin of this name is installed.
        InputError: if it cannot be removed, with the reason of pip or uv.
        StoreError: if the folder of the environments cannot be written.
    """
    if installed_environment(name) is None:
        return _remove_here(name)
    with sole_installation(on_wait) as folder:
        found = installed_environment(name)
        if found is None:
            raise UsageError(f"the plugin {name!r} has just been removed by another process")
        leave(found.name)
        _sweep(folder)
    return _installed(found, is_new=False)


def _remove_here(name: str) -> InstalledPlugin:
    plugins = {canonical(one.name): one for one in distributions() if _is_plugin(one)}
    found = plugins.get(canonical(name))
    if found is None:
        names = [*(one.name for one in plugins.values()), *(one.name for one in environments())]
        raise UsageError(f"no plugin {name!r} is installed as a package.{did_you_mean(name, names)}")
    _uninstall(found.name)
    return InstalledPlugin(found.name, found.version, "none", "", (), is_new=False)


def _is_plugin(found: Any) -> bool:
    return found.name != DISTRIBUTION and any(entry.group.startswith("pano_mvs.") for entry in found.entry_points)
