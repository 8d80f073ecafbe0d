"""The settings of a stage: a frozen pydantic model, and which of its fields count towards the cache key."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationInfo,
    create_model,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from pano_mvs.core.named_registry import NamedRegistry
from pano_mvs.core.paths import expanded
from pano_mvs.core.settings import Declared, odd, settings_of


class Params(BaseModel):
    """Base of every stage's settings: frozen, no unknown fields, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)


class _NotInKey:
    """Marks a setting that does not change the result."""


class _KeyedByContent:
    """Marks a path that counts by its content, not its name."""


NOT_IN_KEY = _NotInKey()
"""Mark of a setting that is not in cache keys, such as `threads: Annotated[int, NOT_IN_KEY] = 0`."""


def _resolve(path: Path, info: ValidationInfo) -> Path:
    context = info.context or {}
    base = context.get("bases", {}).get(info.field_name, context.get("base"))
    path = expanded(path)
    return path if base is None or path.is_absolute() else Path(base) / path


InputPath: TypeAlias = Annotated[Path, AfterValidator(_resolve), _KeyedByContent()]
"""A file or folder that the stage reads, relative to the workflow file; its content is in the cache key."""

SourcePath: TypeAlias = Annotated[Path, AfterValidator(_resolve), NOT_IN_KEY]
"""A file or folder that a source lists. Each item has its own cache key; the path is in none."""


@dataclass(frozen=True)
class RegisteredIn:
    """Marks a setting that holds a name from a registry: `cost: Annotated[str, RegisteredIn(SWEEP_COSTS)] = "census"`.

    An unknown name is an error in the workflow. If a plugin registered the name, its code counts towards the cache key.
    """

    registry: NamedRegistry[Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema of a string that is checked against the registry."""
        return core_schema.no_info_after_validator_function(self.registry.check, handler(source))

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the schema with all registered names, including those of plugins."""
        return handler(core) | {"enum": list(self.registry.names())}


@dataclass(frozen=True)
class ReadBy:
    """Marks a path that a plugin may read: the code of the plugin that reads it counts towards the cache key.

    path: Annotated[InputPath, ReadBy(file_of_reader)]
    """

    file_of_reader: Callable[[Path], Path | None]  # returns the plugin's file for a path; None if no plugin reads it


def key_fields(params: Params) -> tuple[dict[str, Any], dict[str, list[Path]]]:
    """Return the fields that count towards the cache key: plain values, and paths that count by content."""
    plain: dict[str, Any] = {}
    paths: dict[str, list[Path]] = {}
    dumped = params.model_dump(mode="json")
    for name, field in type(params).model_fields.items():
        marks = {type(mark) for mark in _marks(field.annotation, field.metadata)}
        value = getattr(params, name)
        if _NotInKey in marks:
            continue
        if _KeyedByContent in marks and value is not None:
            paths[name] = _paths_in(value)
        else:
            plain[name] = dumped[name]
    return plain, paths


def json_settings(params: Params, place: Callable[[Path], Path]) -> dict[str, Any]:
    """Return settings as JSON values, with another path in the place of each."""
    values = {name: _placed(getattr(params, name), place) for name in type(params).model_fields}
    return type(params).model_construct(**values).model_dump(mode="json", by_alias=True)


def _placed(value: Any, place: Callable[[Path], Path]) -> Any:
    if isinstance(value, Path):
        return place(value)
    if isinstance(value, dict):
        return {key: _placed(inner, place) for key, inner in value.items()}
    return type(value)(_placed(inner, place) for inner in value) if isinstance(value, list | tuple) else value


def registered_files(params: Params) -> dict[str, Path]:
    """Return each setting with a name that a plugin registered, or a path that one reads, and the plugin's file.

    The code of that file counts.
    """
    found: dict[str, Path] = {}
    for name, field in type(params).model_fields.items():
        value, file = getattr(params, name), None
        for mark in _marks(field.annotation, field.metadata):
            if isinstance(mark, RegisteredIn):
                file = mark.registry.code_file(value)
            elif isinstance(mark, ReadBy) and value is not None:
                file = mark.file_of_reader(value)
            if file is not None:
                found[name] = file
    return found


def files_of(params: Params) -> dict[str, list[Path]]:
    """Return each setting that names input files or folders, with their paths."""
    found: dict[str, list[Path]] = {}
    for name, field in type(params).model_fields.items():
        if any(getattr(mark, "func", None) is _resolve for mark in _marks(field.annotation, field.metadata)):
            found[name] = _paths_in(getattr(params, name))
    return found


def takes_path(model: type[Params], name: str, text: str) -> bool:
    """Return whether a text is meant as a path by a setting: unless it is a list or mapping, and these are allowed."""
    field = next((one for key, one in model.model_fields.items() if name in (key, one.alias)), None)
    if field is None:
        return False
    kinds = [field.annotation, *_marks(field.annotation)]
    if Path not in kinds:
        return False
    brackets = {list: "[", tuple: "[", dict: "{"}
    return not any(text.lstrip().startswith(brackets.get(get_origin(kind), "\0")) for kind in kinds)


def _paths_in(value: Any) -> list[Path]:
    """Return the paths in a value: a path, a list or dict of them, or None."""
    if isinstance(value, Path):
        return [value]
    if isinstance(value, dict):
        return [path for key in sorted(value) for path in _paths_in(value[key])]
    return [path for item in value or () for path in _paths_in(item)]


def _marks(annotation: Any, marks: Sequence[Any] = ()) -> Iterator[Any]:
    """Yield the marks of a setting, on itself or inside a type such as `InputPath | None`."""
    yield from marks
    for part in (*getattr(annotation, "__args__", ()), *getattr(annotation, "__metadata__", ())):
        yield part
        yield from _marks(part)


Model = TypeVar("Model", bound=Params)
Settings = TypeVar("Settings")


def params_from(*sources: Callable[..., Any], own_last: bool = False) -> Callable[[type[Model]], type[Model]]:
    """Add the settings of algorithms to the parameters of a stage.

    @params_from(SweepSettings)
    class SweepParams(Params):
        backend: str = "numba"  # what is not a setting of the algorithm

    Args:
        sources: dataclasses whose fields are `core.settings.setting`, or functions whose keyword-only parameters are
            `Annotated` with a `core.settings.Setting`.
        own_last: whether the fields of the class itself come after the added ones in the schema and the reference.
    """
    added = _fields(sources)

    def decorate(model: type[Model]) -> type[Model]:
        name = model.__name__
        bases: Any = (model, create_model(name, __base__=Params, **added)) if own_last else model
        rest = {} if own_last else added
        made: type[Model] = create_model(
            name, __base__=bases, __module__=model.__module__, __doc__=model.__doc__, **rest
        )
        return made

    return decorate


def settings_model(stage: str, *sources: Callable[..., Any]) -> type[Params]:
    """Return the parameters of a stage that are the settings of algorithms only; see `params_from`."""
    return create_model(stage, __base__=Params, __doc__=f"Settings of {stage}.", **_fields(sources))


def _fields(sources: Sequence[Callable[..., Any]]) -> dict[str, Any]:
    return {name: _field(one) for source in sources for name, one in settings_of(source).items()}


def _field(declared: Declared) -> tuple[Any, Any]:
    kind, told = declared.kind, declared.setting
    if told.registry is not None:
        kind = Annotated[kind, RegisteredIn(told.registry)]
    if told.odd:
        kind = Annotated[kind, AfterValidator(odd)]
    return kind, Field(default=declared.default, ge=told.ge, gt=told.gt, le=told.le, description=told.doc)


def settings_from(settings: type[Settings], params: Params) -> Settings:
    """Return the settings of an algorithm, a dataclass, out of the parameters of a stage."""
    return settings(**arguments_from(settings, params))


def arguments_from(function: Callable[..., Any], params: Params) -> dict[str, Any]:
    """Return the settings that a function declares, by name, out of the parameters of a stage."""
    return {name: getattr(params, name) for name in settings_of(function)}
