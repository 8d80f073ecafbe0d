"""Settings of algorithms, each stated once: name, type, default, bounds and help are those of a dataclass's field.

@dataclass(frozen=True)
class SweepSettings:
    planes: int = setting(128, ge=3, le=4096, doc="number of depth hypotheses")

    def __post_init__(self) -> None:
        check_settings(self)

`engine.stages.settings.params_from` makes the parameters of a stage from them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

from pano_mvs.core.errors import UsageError
from pano_mvs.core.named_registry import NamedRegistry

Value = TypeVar("Value")
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
    told = Setting(doc=doc, ge=ge, gt=gt, le=le, odd=odd, registry=registry)
    return field(default=default, metadata={_KEY: told})


def settings_of(kind: type) -> dict[str, tuple[Setting, Any]]:
    """Return what is declared of each setting of a dataclass, and its default, by name."""
    return {one.name: (one.metadata[_KEY], one.default) for one in fields(kind) if _KEY in one.metadata}


def check_settings(settings: Any) -> None:
    """Raise UsageError if a setting of a dataclass is out of its bounds."""
    for name, (told, _) in settings_of(type(settings)).items():
        value = getattr(settings, name)
        if why := told.problem(value):
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
