"""The parameters of a stage from the settings of its algorithm, so that each setting is stated once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, TypeVar, get_type_hints

from pydantic import AfterValidator, Field, create_model

from pano_mvs.core.settings import Setting, odd, settings_of
from pano_mvs.engine.stages.params import Params, RegisteredIn

Model = TypeVar("Model", bound=Params)
Settings = TypeVar("Settings")


def params_from(settings: type) -> Callable[[type[Model]], type[Model]]:
    """Add the settings of an algorithm to the parameters of a stage.

    @params_from(SweepSettings)
    class SweepParams(Params):
        backend: str = "numba"  # what is not a setting of the algorithm

    Args:
        settings: a dataclass whose fields are `core.settings.setting`.
    """
    hints = get_type_hints(settings)
    added: dict[str, Any] = {name: _field(hints[name], *told) for name, told in settings_of(settings).items()}

    def decorate(model: type[Model]) -> type[Model]:
        return create_model(model.__name__, __base__=model, __module__=model.__module__, __doc__=model.__doc__, **added)

    return decorate


def _field(kind: Any, told: Setting, default: Any) -> tuple[Any, Any]:
    if told.registry is not None:
        kind = Annotated[kind, RegisteredIn(told.registry)]
    if told.odd:
        kind = Annotated[kind, AfterValidator(odd)]
    return kind, Field(default=default, ge=told.ge, gt=told.gt, le=told.le, description=told.doc)


def settings_from(settings: type[Settings], params: Params) -> Settings:
    """Return the settings of an algorithm out of the parameters of a stage."""
    return settings(**{name: getattr(params, name) for name in settings_of(settings)})
