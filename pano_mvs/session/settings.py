"""Convert settings from Python values to the syntax of `--set`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import PurePath

from pano_mvs.core.errors import UsageError


def overrides_from_settings(settings: Mapping[str, object]) -> list[str]:
    """Return settings as `STAGE.PARAM=VALUE`, the value in YAML.

    >>> overrides_from_settings({"images.nadir_deg": 30, "depth.cost": "census", "views": None})
    ['images.nadir_deg=30', 'depth.cost=census', 'views=null']

    Args:
        settings: `STAGE.PARAM` to its value: a string is taken as YAML, as on the command line; other values may be
            numbers, booleans, None, paths, and lists and mappings of these.

    Raises:
        UsageError: if a value is of another type.
    """
    return [f"{name}={_yaml(name, value)}" for name, value in settings.items()]


def _yaml(name: str, value: object) -> str:
    if isinstance(value, str):
        return value
    try:
        return json.dumps(value, ensure_ascii=False, default=_plain)
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"setting {name}: {error}. Give a number, a text, a boolean, None, a path or a list"
        ) from error


def _plain(value: object) -> object:
    """Return a path as text and a scalar of numpy as a number."""
    if isinstance(value, PurePath):
        return str(value)
    item = getattr(value, "item", None)
    if callable(item):
        return item()
    raise TypeError(f"{type(value).__name__} is not a value of a setting")
