"""Libraries that an extra of the package installs, imported when they are used."""

from __future__ import annotations

import importlib
from typing import Any

from pano_mvs.core.errors import UsageError


def import_extra(module: str, use: str, extra: str) -> Any:
    """Return a module of an optional library.

    Args:
        module: such as `rocrate.rocrate`.
        use: the option or command that needs it.
        extra: the extra that installs it.

    Raises:
        UsageError: if it is not installed, with the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise UsageError(f"{use} needs {library}: pip install 'pano-mvs[{extra}]'") from error


def installed_version(name: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return None
