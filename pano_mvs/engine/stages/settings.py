"""The parameters of a stage from the settings of its algorithm, so that each setting is stated once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, Field, create_model

from pano_mvs.core.settings import Declared, odd, settings_of
from pano_mvs.engine.stages.params import Params, RegisteredIn

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
    added: dict[str, Any] = {name: _field(one) for source in sources for name, one in settings_of(source).items()}

    def decorate(model: type[Model]) -> type[Model]:
        name = model.__name__
        bases: Any = (model, create_model(name, __base__=Params, **added)) if own_last else model
        rest = {} if own_last else added
        made: type[Model] = create_model(
            name, __base__=bases, __module__=model.__module__, __doc__=model.__doc__, **rest
        )
        return made

    return decorate


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
