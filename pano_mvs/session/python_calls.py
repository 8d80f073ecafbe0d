"""Calls from Python: settings as values, and errors that name arguments in place of the options of the command line."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from pathlib import PurePath
from typing import ParamSpec, TypeVar

from pano_mvs.core.errors import PanoMvsError, UsageError, WorkflowError

Arguments = ParamSpec("Arguments")
Value = TypeVar("Value")

_SETTING = re.compile(r"(?<![^\s(])--set ([^\s=:]+)")
_WITH_VALUE = re.compile(
    r"(?<![^\s(])--(images|out|cache|executor|queue|until|only|refresh|seeds|metric|best|block-\w+) (?=\S)"
)
_ALONE = re.compile(r"(?<![^\s(])--(images|out|cache|executor|queue|workers|seeds|block-\w+)\b")
_MIN_FREE = re.compile(r"(?<![^\s(])--min-free\b")  # not an argument


def names_arguments(function: Callable[Arguments, Value]) -> Callable[Arguments, Value]:
    """Make the errors of a function that is called from Python name its arguments instead of options."""

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Value:
        try:
            return function(*args, **kwargs)
        except PanoMvsError as error:
            if isinstance(error, WorkflowError):
                error.problems = [arguments_from_options(problem) for problem in error.problems]
            if error.args and isinstance(error.args[0], str):
                error.args = (arguments_from_options(error.args[0]), *error.args[1:])
            raise

    return call


def arguments_from_options(message: str) -> str:
    """Return a message with the arguments of `pano_mvs.run` in place of command line options.

    >>> arguments_from_options("--images photos: there is no such folder")
    'images=photos: there is no such folder'
    >>> arguments_from_options("--set depth.planes=x: must be a number; use fewer --workers")
    "settings['depth.planes']=x: must be a number; use fewer workers"
    """
    message = _SETTING.sub(r"settings['\1']", message)
    message = _WITH_VALUE.sub(lambda found: f"{_argument(found[1])}=", message)
    message = _ALONE.sub(lambda found: _argument(found[1]), message)
    return _MIN_FREE.sub("$PANO_MVS_MIN_FREE", message)


def _argument(option: str) -> str:
    return "metrics" if option == "metric" else option.replace("-", "_")


def as_names(names: str | Iterable[str]) -> tuple[str, ...]:
    """Return the names in an argument; a text is one name.

    >>> as_names("depth"), as_names(["depth", "cloud"])
    (('depth',), ('depth', 'cloud'))
    """
    return (names,) if isinstance(names, str) else tuple(names)


def overrides_from_settings(settings: Mapping[str, object]) -> list[str]:
    """Return settings as `STAGE.PARAM=VALUE`, the value in YAML.

    >>> overrides_from_settings({"images.nadir_deg": 30, "depth.cost": "census", "views": None})
    ['images.nadir_deg=30', 'depth.cost=census', 'views=null']

    Args:
        settings: `STAGE.PARAM` to its value: a string is taken as on the command line, as a path if the setting is one,
            else as YAML; other values may be numbers, booleans, None, paths, and lists and mappings of these.

    Raises:
        UsageError: if a value is of another type.
    """
    return [f"{name}={_yaml(name, value)}" for name, value in settings.items()]


def _yaml(name: str, value: object) -> str:
    if isinstance(value, str | PurePath):
        return str(value)
    if value is None and "." in name:
        return ""  # null would be the name of a file
    try:
        return json.dumps(value, ensure_ascii=False, default=_plain)
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"setting {name}: {error}. Give a number, a text, a boolean, None, a path or a list"
        ) from error


def _plain(value: object) -> object:
    """Return a path as text and a scalar of numpy as a number."""
    if isinstance(value, PurePath):
        return str(value)
    item = getattr(value, "item", None)
    if callable(item):
        return item()
    raise TypeError(f"{type(value).__name__} is not a value of a setting")
