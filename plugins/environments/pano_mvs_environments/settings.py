"""Describe the settings of a stage as JSON, and make them from that in a process that does not import the stage.

The model that is made checks types, bounds and names as the original does, because both are pydantic's. What JSON does
not describe, such as a validator of the plugin, is checked by the plugin's own process: the model then asks it.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import AfterValidator, BaseModel, BeforeValidator, Field, create_model, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined, to_jsonable_python

from pano_mvs.api import NOT_IN_KEY, InputPath, Params, ReadBy, RegisteredIn
from pano_mvs.core.doors import own_packages

_PLAIN: dict[str, Any] = {
    "any": Any,
    "bool": bool,
    "bytes": bytes,
    "dict": dict,
    "float": float,
    "int": int,
    "list": list,
    "none": type(None),
    "path": Path,
    "str": str,
}
_NAMES = {value: name for name, value in _PLAIN.items()}
_RESOLVED, _BY_CONTENT = get_args(InputPath)[1:]
_MARKS: dict[str, Any] = {"by content": _BY_CONTENT, "not in key": NOT_IN_KEY, "resolved": _RESOLVED}
_FUNCTIONS: dict[str, Any] = {"after": AfterValidator, "before": BeforeValidator}

Check = Callable[[Params], None]
"""Asks the process of a plugin about settings, and raises ValidationError if they cannot be used."""


class UndescribableError(Exception):
    """A setting that another process cannot know; the message says why, and what to use instead."""


def description_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the settings of a stage as JSON.

    `asks` tells whether the process of the plugin must be asked as well.

    Raises:
        UndescribableError: if a setting holds a name that only the process of the plugin knows.
    """
    return _Description().of_model(model)


class _Description:
    """Describes a model, and remembers whether something could not be described."""

    def __init__(self) -> None:
        self._asks = False

    def of_model(self, model: type[BaseModel]) -> dict[str, Any]:
        self._asks |= _has_code(model) or model.model_config != Params.model_config
        settings = {name: self._of_field(name, info) for name, info in model.model_fields.items()}
        return {"name": model.__name__, "doc": model.__doc__ or "", "settings": settings, "asks": self._asks}

    def _of_field(self, name: str, info: FieldInfo) -> dict[str, Any]:
        try:
            described = {"type": self._of_type(info.annotation), "marks": self._of_marks(info.metadata)}
        except UndescribableError as error:
            raise UndescribableError(f"the setting {name!r} {error}") from None
        default = PydanticUndefined if info.is_required() else info.get_default(call_default_factory=True)
        if default is not PydanticUndefined:
            described["default"] = to_jsonable_python(default)
        return described | {"help": info.description, "alias": info.alias}

    def _of_type(self, kind: Any) -> Any:
        origin, arguments = get_origin(kind), get_args(kind)
        if kind is None or (isinstance(kind, type) and kind in _NAMES):
            return _NAMES[type(None) if kind is None else kind]
        if kind is Any:
            return "any"
        if origin is Annotated:
            return {"of": "marked", "type": self._of_type(arguments[0]), "marks": self._of_marks(arguments[1:])}
        if origin in (Union, types.UnionType):
            return {"of": "union", "types": [self._of_type(one) for one in arguments]}
        if origin is Literal and all(isinstance(one, str | int | bool | None) for one in arguments):
            return {"of": "choice", "values": list(arguments)}
        if isinstance(kind, type) and issubclass(kind, Enum) and all(isinstance(one.value, str | int) for one in kind):
            return {"of": "choice", "values": [one.value for one in kind]}
        if origin in (list, dict, set, frozenset, tuple):
            inner = ["..." if one is ... else self._of_type(one) for one in arguments]
            return {"of": origin.__name__, "types": inner}
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return {"of": "model", "model": _Description.of_model(self, kind)}
        self._asks = True
        return "any"

    def _of_marks(self, marks: Sequence[Any]) -> list[Any]:
        return [described for mark in marks for described in self._of_mark(mark)]

    def _of_mark(self, mark: Any) -> Iterator[Any]:
        """Yield the descriptions of a mark: none if it is a text, several of a `Field` inside a type."""
        known = next((name for name, one in _MARKS.items() if one == mark), None)
        function = getattr(mark, "func", None)
        kind = next((name for name, one in _FUNCTIONS.items() if isinstance(mark, one)), None)
        if isinstance(mark, RegisteredIn | ReadBy):
            raise UndescribableError(
                f"is marked {type(mark).__name__}, whose names or readers differ between environments: use Literal for "
                "names, and an InputPath for files"
            )
        if known is not None:
            yield known
        elif isinstance(mark, FieldInfo):
            for inner in mark.metadata:
                yield from self._of_mark(inner)
        elif kind is not None and function is not None and _is_ours(function):
            yield {"of": kind, "function": f"{function.__module__}:{function.__qualname__}"}
        elif type(mark).__module__ == annotated_types.__name__ and is_dataclass(mark):
            values = {one.name: getattr(mark, one.name) for one in fields(mark)}
            yield {"of": "bound", "class": type(mark).__name__, "values": to_jsonable_python(values)}
        elif isinstance(general := getattr(mark, "__dict__", None), dict) and general.keys() <= {"pattern", "strict"}:
            if general:
                yield {"of": "field", "values": general}
        elif not isinstance(mark, str):
            self._asks = True


def _is_ours(function: Any) -> bool:
    """Return whether a function is one of a module of pano_mvs, which every environment has."""
    name = getattr(function, "__qualname__", "<")
    return "<" not in name and function.__module__.partition(".")[0] in own_packages()


def _has_code(model: type[BaseModel]) -> bool:
    """Return whether a model has methods that take part in checking its settings."""
    decorators = model.__pydantic_decorators__
    found = (
        decorators.validators,
        decorators.field_validators,
        decorators.root_validators,
        decorators.model_validators,
    )
    overridden = ("__init__", "model_post_init", "model_validate", "__get_pydantic_core_schema__")
    return any(found) or any(
        getattr(getattr(model, name), "__func__", getattr(model, name))
        is not getattr(getattr(BaseModel, name), "__func__", getattr(BaseModel, name))
        for name in overridden
    )


def model_from(description: Mapping[str, Any], check: Check | None = None) -> type[Params]:
    """Return the settings that `description_of` described.

    Args:
        check: called with settings that are right as far as the description goes.
    """
    settings: dict[str, Any] = {name: (_type(one), _field(one)) for name, one in description["settings"].items()}
    validators: dict[str, Any] = {}
    if check is not None:

        def ask(settings: Params) -> Params:
            check(settings)
            return settings

        validators["asked"] = model_validator(mode="after")(ask)
    made: type[Params] = create_model(
        description["name"],
        __base__=Params,
        __doc__=description["doc"] or None,
        __validators__=validators,
        **settings,
    )
    return made


def _type(described: Mapping[str, Any]) -> Any:
    return _marked(_kind(described["type"]), described["marks"])


def _field(described: Mapping[str, Any]) -> Any:
    more = {"description": described["help"], "alias": described["alias"]}
    if "default" in described:
        return Field(default=described["default"], **more)
    return Field(**more)


def _marked(kind: Any, marks: Sequence[Any]) -> Any:
    for mark in marks:
        kind = Annotated[kind, _mark(mark)]
    return kind


def _mark(described: Any) -> Any:
    if isinstance(described, str):
        return _MARKS[described]
    match described["of"]:
        case "bound":
            return getattr(annotated_types, described["class"])(**described["values"])
        case "field":
            return Field(**described["values"])
        case function:
            module, _, name = described["function"].partition(":")
            found: Any = import_module(module)
            for part in name.split("."):
                found = getattr(found, part)
            return _FUNCTIONS[function](found)


def _kind(described: Any) -> Any:
    if isinstance(described, str):
        return _PLAIN[described]
    inner = [... if one == "..." else _kind(one) for one in described.get("types", ())]
    match described["of"]:
        case "marked":
            return _marked(_kind(described["type"]), described["marks"])
        case "union":
            return Union[tuple(inner)]  # noqa: UP007  # of types that are known only now
        case "choice":
            return Literal[tuple(described["values"])]
        case "model":
            return model_from(described["model"])
        case "list" | "set" | "frozenset" as name:
            generic: Any = {"list": list, "set": set, "frozenset": frozenset}[name]
            return generic[inner[0]]
        case "dict":
            return dict[inner[0], inner[1]]  # type: ignore[valid-type]  # likewise
        case _:
            return tuple[tuple(inner)]  # type: ignore[misc]  # likewise
