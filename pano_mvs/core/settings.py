"""Settings of algorithms: name, type, default, bounds and help of each are stated once.

They are fields of a dataclass:

@dataclass(frozen=True)
class SweepSettings:
    planes: int = setting(128, ge=3, le=4096, doc="number of depth hypotheses")

    def __post_init__(self) -> None:
        check_settings(self)

or keyword-only parameters of a function:

@checks_settings
def median_range(range_map: RangeMap, *, window: Annotated[int, Setting("side", ge=3, odd=True)] = 5) -> RangeMap:

`engine.stages.params.params_from` makes the parameters of a stage from either.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar, get_type_hints

from pano_mvs.core.errors import UsageError
from pano_mvs.core.named_registry import NamedRegistry

Value = TypeVar("Value")
Arguments = ParamSpec("Arguments")
_KEY = "pano_mvs.setting"


@dataclass(frozen=True, slots=True)
class Setting:
    """What is known of a setting beside its name, type and default.

    Attributes:
        doc: help text.
        ge: the least value.
        gt: a bound that it must exceed.
        le: the largest value.
        odd: whether it must be odd.
        registry: of what it names; None if it names nothing.
    """

    doc: str
    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    odd: bool = False
    registry: NamedRegistry[Any] | None = None

    def problem(self, value: Any) -> str:
        """Return what is wrong with a value, "must be …"; empty if nothing is. None is always taken."""
        if value is None:
            return ""
        if self.registry is not None:
            self.registry.check(value)
        if self.odd and value % 2 == 0:
            return _odd_problem(value)
        if self.ge is not None and not value >= self.ge:
            return f"must be at least {self.ge}"
        if self.gt is not None and not value > self.gt:
            return "must be positive" if self.gt == 0 else f"must be more than {self.gt}"
        return f"must be at most {self.le}" if self.le is not None and not value <= self.le else ""


def setting(
    default: Value,
    *,
    doc: str,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    odd: bool = False,
    registry: NamedRegistry[Any] | None = None,
) -> Value:
    """Declare a field of a dataclass as a setting; see `Setting`."""
    declared = Setting(doc=doc, ge=ge, gt=gt, le=le, odd=odd, registry=registry)
    return field(default=default, metadata={_KEY: declared})


@dataclass(frozen=True, slots=True)
class Declared:
    """A setting as a dataclass or a function declares it: its type and default, and what else is known of it."""

    kind: Any
    default: Any
    setting: Setting


@cache
def settings_of(source: Callable[..., Any]) -> dict[str, Declared]:
    """Return the settings that a dataclass or a function declares, by name."""
    kinds = get_type_hints(source)
    if isinstance(source, type):
        found = {one.name: (one.default, one.metadata[_KEY]) for one in fields(source) if _KEY in one.metadata}
    else:
        found = dict(_settings_of_function(source))
    return {name: Declared(kinds[name], *stated) for name, stated in found.items()}


def _settings_of_function(function: Callable[..., Any]) -> Iterator[tuple[str, tuple[Any, Setting]]]:
    parameters = inspect.signature(function).parameters
    for name, hint in get_type_hints(function, include_extras=True).items():
        for mark in getattr(hint, "__metadata__", ()):
            if isinstance(mark, Setting):
                if parameters[name].kind is not inspect.Parameter.KEYWORD_ONLY:
                    raise TypeError(f"{function.__qualname__}: the setting {name} must be a keyword-only parameter")
                yield name, (parameters[name].default, mark)


def check_settings(settings: Any) -> None:
    """Raise UsageError if a setting of a dataclass is out of its bounds."""
    kind: Callable[..., Any] = type(settings)
    for name, declared in settings_of(kind).items():
        _check(name, declared, getattr(settings, name))


def checks_settings(function: Callable[Arguments, Value]) -> Callable[Arguments, Value]:
    """Make a function raise UsageError if a setting among its arguments is out of its bounds."""

    @wraps(function)
    def checked(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Value:
        for name, declared in settings_of(function).items():
            if name in kwargs:
                _check(name, declared, kwargs[name])
        return function(*args, **kwargs)

    return checked


def _check(name: str, declared: Declared, value: Any) -> None:
    if why := declared.setting.problem(value):
        raise UsageError(f"{name} {why}, got {value}")


def odd(value: int) -> int:
    """Return a value that is odd.

    Raises:
        UsageError: if it is even.
    """
    if value % 2 == 0:
        raise UsageError(_odd_problem(value))
    return value


def _odd_problem(value: int) -> str:
    return f"must be odd, since a window has a centre: {value - 1} or {value + 1}"
