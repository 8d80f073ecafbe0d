from __future__ import annotations

import pytest

from pano_mvs.core.errors import UsageError
from pano_mvs.viewer.view import require_display, require_drawing, require_window


def test_without_a_display_the_remedy_is_named() -> None:
    with pytest.raises(UsageError, match=r"no display .* --screenshot FILE"):
        require_display({}, "linux")
    require_display({"DISPLAY": ":0"}, "linux")
    require_display({}, "darwin")
    require_display({}, "win32")


def test_a_display_that_does_not_answer_is_told_from_one_that_does() -> None:
    with pytest.raises(UsageError, match="does not respond"):
        require_window("vtkEGLRenderWindow")
    require_window("vtkXOpenGLRenderWindow")


def test_without_any_way_to_draw_the_packages_are_named() -> None:
    with pytest.raises(UsageError, match="apt install libegl1"):
        require_drawing({}, "linux", loads=lambda name: False)
    require_drawing({}, "linux", loads=lambda name: "OSMesa" in name)
    require_drawing({"DISPLAY": ":0"}, "linux", loads=lambda name: False)
    require_drawing({}, "darwin", loads=lambda name: False)
