"""Errors of calls from Python: messages name options of the command line, and here become the arguments' names."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from pano_mvs.core.errors import PanoMvsError, WorkflowError

Arguments = ParamSpec("Arguments")
Value = TypeVar("Value")

_SETTING = re.compile(r"(?<![^\s(])--set ([^\s=:]+)")
_WITH_VALUE = re.compile(r"(?<![^\s(])--(images|out|cache|executor|until|only|refresh) (?=\S)")
_ALONE = re.compile(r"(?<![^\s(])--(images|out|cache|executor|workers)\b")
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
    message = _ALONE.sub(r"\1", _WITH_VALUE.sub(r"\1=", message))
    return _MIN_FREE.sub("$PANO_MVS_MIN_FREE", message)
