"""What a plugin is installed from: a folder with a pyproject.toml, an archive, or a name; and what it asks for."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

from pano_mvs.core.digest import digest_from_file, digest_from_value
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import exists, is_file, is_folder, reason_of, resolved
from pano_mvs.engine.stages.registry import ENTRY_POINT_GROUP
from pano_mvs_environments.index import MODES, Mode, installed_environment

Wish: TypeAlias = Literal["overlay", "isolated", "none"]
"""What a plugin asks for; "none" is to be installed beside pano_mvs."""

_NAME = re.compile(r"([A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9])?)\s*(\[[^]]*\])?\s*((?:[<>=!~@;].*)?)", re.DOTALL)
_ARCHIVES = (".whl", ".tar.gz", ".zip")
_LEFT_OUT = ("__pycache__", "build", "dist", "node_modules")


@dataclass(frozen=True, slots=True)
class PluginSource:
    """What a plugin is installed from."""

    name: str  # of its distribution
    shown: str  # what the user can give to install it again
    requirement: str  # as pip takes it
    digest: str  # of its content; "" if that is known only to the index of packages
    asks: Wish  # what its pyproject.toml asks for; "none" if it has none here


def plugin_source(given: str) -> PluginSource:
    """Return what a path or a name stands for.

    Raises:
        InputError: if it is a path without a plugin.
        UsageError: if it is neither a path nor the name of a distribution.
    """
    path = Path(given).expanduser()
    if is_folder(path):
        return _of_folder(resolved(path))
    if is_file(path):
        return _of_archive(resolved(path))
    if (known := installed_environment(given) if _NAME.fullmatch(given) else None) is not None:
        again = Path(known.source)
        if again.is_absolute():
            if not exists(again):
                raise InputError(
                    f"{given} was installed from {again}, which does not exist any more; give another path"
                )
            return plugin_source(known.source)
        given = known.source
    match = _NAME.fullmatch(given)
    if match is None or os.sep in match[1] or exists(path):
        raise UsageError(f"{given}: is neither a folder, nor a wheel or an archive, nor the name of a package")
    return PluginSource(match[1], given, given, "", "none")


def _of_folder(folder: Path) -> PluginSource:
    project_file = folder / "pyproject.toml"
    try:
        found = tomllib.loads(project_file.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise InputError(
            f"{folder}: has no pyproject.toml. A plugin that is installed is a package; a single file is named by a "
            "workflow, or lies in your plugin folder"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{project_file}: cannot be read ({reason_of(error)})") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{project_file}: is not valid TOML: {error}") from error
    project, tool = _table(found, "project"), _table(_table(found, "tool"), "pano_mvs")
    name, asks = project.get("name"), tool.get("environment", "none")
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(f"{project_file}: states no `name` under [project]")
    if asks not in MODES and asks != "none":
        raise InputError(
            f"{project_file}: `environment` under [tool.pano_mvs] must be {' or '.join(map(repr, MODES))}, got {asks!r}"
        )
    groups = _table(project, "entry-points")
    if not any(group.startswith("pano_mvs.") for group in groups) and "entry-points" not in project.get("dynamic", ()):
        raise InputError(
            f"{project_file}: is not a plugin of pano_mvs: it has no entry point, such as "
            f'[project.entry-points."{ENTRY_POINT_GROUP}"]'
        )
    return PluginSource(name, str(folder), f"{name} @ {folder.as_uri()}", _digest_of(folder), asks)


def _table(values: dict[str, Any], key: str) -> dict[str, Any]:
    found = values.get(key, {})
    return found if isinstance(found, dict) else {}


def _digest_of(folder: Path) -> str:
    """Return a digest of the files of a project, without hidden ones and what was built."""
    return digest_from_value({str(path.relative_to(folder)): digest_from_file(path) for path in _files_of(folder)})


def _files_of(folder: Path) -> Iterator[Path]:
    for place, folders, names in os.walk(folder):
        folders[:] = [
            name for name in folders if not name.startswith(".") and name not in _LEFT_OUT and "egg-info" not in name
        ]
        yield from (Path(place, name) for name in names if not name.startswith(".") and is_file(Path(place, name)))


def _of_archive(path: Path) -> PluginSource:
    if not path.name.endswith(_ARCHIVES):
        raise InputError(
            f"{path}: is not a wheel or an archive of a package ({', '.join(_ARCHIVES)}). A plugin that is a single "
            "Python file is not installed: name it under `plugins:` in a workflow, or put it into your plugin folder"
        )
    name = path.name.partition("-")[0] if path.suffix == ".whl" else re.sub(r"-\d.*", "", path.name)
    return PluginSource(name, str(path), f"{name} @ {path.as_uri()}", digest_from_file(path), "none")


def wish_of(source: PluginSource, given: str) -> Mode | None:
    """Return the kind of environment for a plugin: the given one, or else what it asks for; None for none.

    Raises:
        UsageError: if there is no such kind.
    """
    if given and given not in get_args(Wish):
        raise UsageError(f"--environment {given}: must be one of {', '.join(get_args(Wish))}")
    known = installed_environment(source.name)
    if not given and not source.digest and known is not None:
        return known.mode  # installed by its name before, which does not say what it asks for
    wished = given or source.asks
    return next((mode for mode in MODES if mode == wished), None)
