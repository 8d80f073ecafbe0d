"""Check for a display, and for a library that renders without one."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Mapping

from pano_mvs.core.errors import UsageError

_DRAWING_LIBRARIES = ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so")
_REMEDY = "Use --screenshot FILE to write an image without a window"


def require_display(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> None:
    """Raise UsageError if no window can be opened."""
    if platform.startswith("linux") and not environment.get("DISPLAY"):
        raise UsageError(
            f"there is no display (DISPLAY is not set), so no window can be opened. {_REMEDY}, or run "
            "this on a machine with a screen, or over ssh -X"
        )


def require_window(window_class: str) -> None:
    """Raise UsageError if VTK fell back to off-screen rendering, because the display does not respond."""
    if window_class in ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow"):
        raise UsageError(f"the display {os.environ.get('DISPLAY', '')} does not respond. {_REMEDY}")


def require_drawing(
    environment: Mapping[str, str] = os.environ,
    platform: str = sys.platform,
    *,
    loads: Callable[[str], bool] | None = None,
) -> None:
    """Raise UsageError if there is neither a display nor a library for off-screen rendering; VTK would crash."""
    if not platform.startswith("linux") or environment.get("DISPLAY"):
        return
    if not any((loads or _loads)(name) for name in _DRAWING_LIBRARIES):
        raise UsageError(
            "images cannot be rendered: neither EGL nor OSMesa is installed. Install one: for Debian "
            "and Ubuntu `apt install libegl1 libgl1-mesa-dri`"
        )


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def quiet_vtk() -> None:
    """Suppress VTK's message about a missing X server before off-screen rendering."""
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
