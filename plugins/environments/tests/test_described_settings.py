"""Settings that were described as JSON are checked, keyed and shown as those of the stage itself."""

from __future__ import annotations

import json
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pano_mvs_environments.settings import UndescribableError, description_of, model_from
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from pano_mvs.api import NOT_IN_KEY, InputPath, NamedRegistry, Params, RegisteredIn, Setting, SourcePath
from pano_mvs.engine.stages.params import key_fields, settings_model, takes_path
from pano_mvs.engine.stages.registry import Registry


def again(model: type[BaseModel]) -> type[Params]:
    """Return the settings as a process knows them that reads their description."""
    return model_from(json.loads(json.dumps(description_of(model))))


def errors_of(model: type[BaseModel], values: dict[str, Any]) -> list[tuple[Any, ...]]:
    with pytest.raises(ValidationError) as raised:
        model.model_validate(values)
    return [(one["loc"], one["type"], one["msg"]) for one in raised.value.errors()]


def test_the_settings_of_all_stages_have_the_same_schema() -> None:
    described = 0
    for name, spec in Registry.installed().stages.items():
        try:
            model = again(spec.params_type)
        except UndescribableError:
            continue  # RegisteredIn and ReadBy
        assert model.model_json_schema() == spec.params_type.model_json_schema(), name
        described += 1
    assert described >= 60


class Colour(Enum):
    RED = "red"
    BLUE = "blue"


class Inner(Params):
    size: int = Field(default=3, ge=1)


class Many(Params):
    """Settings of many types."""

    needed: float = Field(gt=0, description="what is needed")
    count: int = Field(default=2, ge=1, le=9)
    word: str = Field(default="a", pattern="^[a-z]+$", min_length=1)
    choice: Literal["one", "two", 3] = "one"
    colour: Colour = Colour.RED
    maybe: float | None = None
    pair: tuple[int, int] = (1, 2)
    several: tuple[str, ...] = ()
    bounded: list[Annotated[int, Field(ge=0)]] = Field(default_factory=list)
    named: dict[str, float] = Field(default={})
    inner: Inner = Inner()
    path: InputPath | None = None
    folder: SourcePath = Path("photos")
    threads: Annotated[int, NOT_IN_KEY] = 0
    from_: str = Field(default="x", alias="from")


WRONG: list[dict[str, Any]] = [
    {},
    {"needed": 0},
    {"needed": "much"},
    {"needed": float("nan")},
    {"needed": 1, "count": 10},
    {"needed": 1, "count": 2.5},
    {"needed": 1, "word": "UP"},
    {"needed": 1, "word": ""},
    {"needed": 1, "choice": "four"},
    {"needed": 1, "pair": [1]},
    {"needed": 1, "bounded": [1, -1]},
    {"needed": 1, "named": {"a": "b"}},
    {"needed": 1, "inner": {"size": 0}},
    {"needed": 1, "inner": {"sise": 1}},
    {"needed": 1, "inner": 3},
    {"needed": 1, "path": 3},
    {"needed": 1, "counts": 3},
]


@pytest.mark.parametrize("values", WRONG, ids=str)
def test_what_is_wrong_is_said_alike(values: dict[str, Any]) -> None:
    assert errors_of(again(Many), values) == errors_of(Many, values)


def test_an_unknown_colour_is_refused_where_names_are_its_values() -> None:
    ((_, _, said),) = errors_of(again(Many), {"needed": 1, "colour": "green"})
    assert said == errors_of(Many, {"needed": 1, "colour": "green"})[0][2]


def test_the_key_holds_the_same_values_and_paths(tmp_path: Path) -> None:
    values = {"needed": 1.5, "path": "a.txt", "colour": "blue", "named": {"b": 1}, "from": "y", "threads": 7}
    models: list[type[Params]] = [Many, again(Many)]
    one, other = (key_fields(model.model_validate(values, context={"base": tmp_path})) for model in models)
    assert one == other
    assert other[1] == {"path": [tmp_path / "a.txt"]}
    assert not {"threads", "folder"} & other[0].keys()
    assert [takes_path(model, "path", "1") for model in models] == [True, True]


def odd_size(*, size: Annotated[int, Setting("size of a window", ge=3, odd=True)] = 5) -> None:
    """Use a setting."""


def test_settings_of_a_function_keep_their_bounds() -> None:
    model = settings_model("filters.any", odd_size)
    assert not description_of(model)["asks"]
    for size in (1, 4):
        assert errors_of(again(model), {"size": size}) == errors_of(model, {"size": size})
    assert again(model)().model_dump() == {"size": 5}


class Checked(Params):
    near: float = 1.0
    far: float = 2.0

    @model_validator(mode="after")
    def _in_order(self) -> Checked:
        if self.near >= self.far:
            raise ValueError("near must be less than far")
        return self


class CheckedField(Params):
    near: float = 1.0

    @field_validator("near")
    @classmethod
    def _positive(cls, near: float) -> float:
        return near


class Lax(Params):
    model_config = ConfigDict(extra="ignore")


class Holder(Params):
    inner: Checked = Checked()


@pytest.mark.parametrize("model", [Checked, CheckedField, Lax, Holder])
def test_code_that_checks_settings_must_be_asked(model: type[Params]) -> None:
    assert description_of(model)["asks"]
    assert not description_of(Many)["asks"]


def test_the_process_of_the_plugin_is_asked_about_settings_that_look_right() -> None:
    asked: list[Params] = []
    model = model_from(description_of(Checked), asked.append)
    model.model_validate({"near": 3.0})
    with pytest.raises(ValidationError, match="valid number"):
        model.model_validate({"near": "x"})
    assert [one.model_dump() for one in asked] == [{"near": 3.0, "far": 2.0}]


BACKENDS: NamedRegistry[int] = NamedRegistry("backend", {"first": 1})


class Registered(Params):
    backend: Annotated[str, RegisteredIn(BACKENDS)] = "first"


def test_names_of_a_registry_are_refused() -> None:
    with pytest.raises(UndescribableError, match=r"the setting 'backend' is marked RegisteredIn.*use Literal"):
        description_of(Registered)
