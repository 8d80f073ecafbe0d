"""A setting is stated once: its bounds hold for the algorithm and for the stage, and its help is in the schema."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import pytest
from pydantic import Field, ValidationError

from pano_mvs.core.errors import UsageError
from pano_mvs.core.named_registry import NamedRegistry
from pano_mvs.core.settings import check_settings, setting
from pano_mvs.engine.stages.params import Params
from pano_mvs.engine.stages.settings import params_from, settings_from

ANIMALS = NamedRegistry("animal", {"cat": 1, "dog": 2})


@dataclass(frozen=True)
class ZooSettings:
    count: int = setting(3, ge=1, le=9, doc="how many")
    weight: float | None = setting(None, gt=0, doc="of each")
    window: int = setting(5, ge=1, odd=True, doc="side")
    animal: str = setting("cat", registry=ANIMALS, doc="which")
    mood: Literal["good", "bad"] = setting("good", doc="of all")

    def __post_init__(self) -> None:
        check_settings(self)


@params_from(ZooSettings)
class ZooParams(Params):
    """Settings of a zoo."""

    place: str = Field(default="here", description="where")


def test_the_parameters_have_the_settings_with_their_defaults() -> None:
    params = ZooParams.model_validate({"count": 4, "place": "there"})
    assert settings_from(ZooSettings, params) == ZooSettings(count=4)
    assert ZooParams().model_dump() == {"place": "here"} | vars(ZooSettings())
    assert (ZooParams.__name__, ZooParams.__doc__) == ("ZooParams", "Settings of a zoo.")


def test_the_schema_has_bounds_and_help() -> None:
    fields = ZooParams.model_json_schema()["properties"]
    stated = {"default": 3, "description": "how many", "minimum": 1, "maximum": 9}
    assert fields["count"] == stated | {"title": "Count", "type": "integer"}
    assert fields["animal"]["enum"] == ["cat", "dog"]
    assert fields["mood"]["enum"] == ["good", "bad"]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"count": 0}, "count must be at least 1, got 0"),
        ({"count": 10}, "count must be at most 9, got 10"),
        ({"weight": 0.0}, "weight must be positive, got 0.0"),
        ({"window": 4}, "window must be odd, since a window has a centre: 3 or 5"),
        ({"animal": "cow"}, "there is no animal 'cow'"),
    ],
)
def test_values_out_of_bounds_are_refused_by_both(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        ZooSettings(**changes)
    with pytest.raises(ValidationError, match=next(iter(changes))):
        ZooParams.model_validate(changes)
