"""Describe why a unit failed, and where."""

from __future__ import annotations

import traceback

from pano_mvs.core.errors import PanoMvsError
from pano_mvs.core.text import shortened
from pano_mvs.engine.planning.units import Unit

_MAX_TRACE_CHARACTERS = 20_000


def cause_of(unit: Unit, error: BaseException) -> tuple[str, str]:
    """Return what went wrong, and the traceback if the code failed.

    The messages of our own errors are used as they are; for other errors the line that raised them is added.
    """
    notes = shortened("".join(f" ({note})" for note in getattr(error, "__notes__", [])))
    if isinstance(error, PanoMvsError):
        return f"{shortened(str(error))}{notes}", ""
    frames = traceback.extract_tb(error.__traceback__)
    # For a plugin, name the line in the plugin; otherwise the line that raised the error.
    own = unit.entry.spec.origin.rpartition(":")[0] if unit.entry.spec.code_digest else ""
    if own and isinstance(error, ModuleNotFoundError):
        notes += " (a plugin imports the files beside it at its top, not inside functions)"
    frame = next((f for f in reversed(frames) if f.filename == own), frames[-1])
    cause = f"{frame.filename}:{frame.lineno}: {type(error).__name__}: {_text(error)}{notes}"
    return cause, shortened("".join(traceback.format_exception(error)), _MAX_TRACE_CHARACTERS)


def _text(error: BaseException) -> str:
    try:
        return shortened(str(error))
    except Exception as second:  # a plugin's exception may fail to make its text
        return f"(its message cannot be shown: {type(second).__name__})"
