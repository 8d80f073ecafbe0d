"""A setting is stated once: its bounds hold for the algorithm and for the stage, and its help is in the schema."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field, ValidationError

from pano_mvs.core.errors import PluginError, UsageError
from pano_mvs.core.named_registry import NamedRegistry
from pano_mvs.core.settings import Setting, check_settings, checks_settings, setting, settings_of
from pano_mvs.engine.stages.params import Params, arguments_from, params_from, settings_from
from pano_mvs.engine.stages.stage import Each, spec_of, stage
from pano_mvs.scene import Features

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


@params_from(ZooSettings, own_last=True)
class OwnLastParams(Params):
    """Settings of a zoo."""

    place: str = Field(default="here", description="where")


def test_fields_of_the_class_come_first_or_last() -> None:
    settings = list(settings_of(ZooSettings))
    assert list(ZooParams.model_fields) == ["place", *settings]
    assert list(OwnLastParams.model_fields) == [*settings, "place"]
    assert OwnLastParams.model_validate({"count": 4, "place": "there"}).place == "there"


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


@checks_settings
def feed(
    animal: str,
    *,
    pieces: Annotated[int, Setting("how many", ge=1, odd=True)] = 3,
    sauce: Annotated[str, Setting("which", registry=ANIMALS)] = "cat",
    hour: int = 12,
) -> str:
    """Return what was done."""
    return f"{animal}: {pieces} with {sauce} at {hour}"


@params_from(ZooSettings, feed)
class FeedParams(Params):
    """Settings of feeding."""


def test_the_settings_of_a_function_are_its_annotated_parameters() -> None:
    assert list(settings_of(feed)) == ["pieces", "sauce"]
    params = FeedParams.model_validate({"pieces": 5, "count": 4})
    assert feed("cow", **arguments_from(feed, params)) == "cow: 5 with cat at 12"
    assert settings_from(ZooSettings, params).count == 4
    stated = {"default": 3, "description": "how many", "minimum": 1, "title": "Pieces", "type": "integer"}
    assert FeedParams.model_json_schema()["properties"]["pieces"] == stated


def test_a_stage_may_have_the_settings_of_algorithms_as_its_only_parameters() -> None:
    @stage("zoo.feed", settings=(ZooSettings, feed))
    def fed(features: Each[Features], params: Params) -> Features:
        return features

    @stage("zoo.open", settings=ZooSettings)
    def opened(features: Each[Features], params: Params) -> Features:
        return features

    both, one = (spec.params_type for each in (fed, opened) if (spec := spec_of(each)))
    assert list(both.model_fields) == [*settings_of(ZooSettings), *settings_of(feed)]
    assert settings_from(ZooSettings, one.model_validate({"count": 4})) == ZooSettings(count=4)
    assert one.__doc__ == "Settings of zoo.open."
    with pytest.raises(ValidationError, match="less than or equal to 9"):
        one.model_validate({"count": 10})


def feed_again(*, hour: int = 12, pieces: Annotated[int, Setting("how many")] = 1) -> None: ...


def eat(pieces: Annotated[int, Setting("how many", ge=1)] = 3) -> None: ...


def sleep(hours: int) -> None: ...


class Keeper: ...


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        (None, "must be a function or a dataclass with settings, .* got None"),
        ("feed", "must be a function .* got 'feed'"),
        ("", "must be a function .* got ''"),
        (("feed",), "must be a function .* got 'feed'"),
        ({feed}, r"must be a function .* or a tuple or list of them, got \{<function feed"),
        ((feed, None), "must be a function .* got None"),
        ([], "settings= names no function; name one, or leave it out"),
        (sleep, "sleep in settings= has no settings; annotate its keyword-only parameters with Setting"),
        ((feed, sleep), "sleep in settings= has no settings"),
        (FeedParams, "FeedParams in settings= cannot be read"),
        (Keeper, "the settings of Keeper in settings= cannot be read: .*dataclass"),
        (eat, "eat in settings= cannot be read: .* must be a keyword-only parameter"),
        (partial(feed, "cow"), "in settings= cannot be read"),
        ((feed, feed_again), "both feed and feed_again in settings= have a setting 'pieces'; rename one"),
        ([feed, feed], "both feed and feed in settings= have a setting 'pieces'"),
    ],
)
def test_what_cannot_be_the_settings_of_a_stage_is_refused(settings: Any, why: str) -> None:
    """Equal names hid each other, an empty model was accepted, and other values raised a bare TypeError."""

    def fed(features: Each[Features], params: Params) -> Features:
        return features

    with pytest.raises(PluginError, match=rf"stage 'zoo\.fed' \(.*test_settings\.py:\d+\): .*{why}"):
        stage("zoo.fed", settings=settings)(fed)


def without_params(features: Each[Features]) -> Features:
    return features


def with_a_model_of_its_own(features: Each[Features], params: ZooParams) -> Features:
    return features


def with_two(features: Each[Features], params: Params, others: Params) -> Features:
    return features


def with_two_models(features: Each[Features], others: ZooParams, params: Params) -> Features:
    return features


@pytest.mark.parametrize(
    ("function", "got"),
    [
        (without_params, "none"),
        (with_a_model_of_its_own, "params: ZooParams"),
        (with_two, "params, others"),
        (with_two_models, "others, params"),
    ],
)
def test_a_stage_with_settings_of_algorithms_has_one_argument_for_them(function: Callable[..., Any], got: str) -> None:
    """Without one they were shown and never used, and the fields of another model were missing at run time."""
    why = rf"'zoo\.fed' .* exactly one argument annotated Params itself .* got {got}; .* with params_from"
    with pytest.raises(PluginError, match=why):
        stage("zoo.fed", settings=feed)(function)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"pieces": -1}, "pieces must be at least 1, got -1"),
        ({"pieces": 2}, "pieces must be odd"),
        ({"sauce": "cow"}, "there is no animal 'cow'"),
    ],
)
def test_a_function_and_its_stage_refuse_values_out_of_bounds(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        feed("cow", **changes)
    with pytest.raises(ValidationError, match=next(iter(changes))):
        FeedParams.model_validate(changes)


def test_a_setting_must_be_a_keyword() -> None:
    def eat(pieces: Annotated[int, Setting("how many", ge=1)] = 3) -> int:
        return pieces

    with pytest.raises(TypeError, match="pieces must be a keyword-only parameter"):
        settings_of(eat)
