"""Connect mouse and keyboard events of a window to the actions of the viewer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pano_mvs.viewer.controller import Tour
from pano_mvs.viewer.viewpoint import Viewpoint

# A press and a release within this distance are a click.
_CLICK_PX = 4
_LEFT, _RIGHT = "LeftButton", "RightButton"


class Hands:
    """Handles the events of one interactor.

    Outside, VTK's trackball rotates and moves the camera; inside a panorama, dragging changes the direction of view.
    """

    def __init__(self, tour: Tour, *, seen_from: Callable[[], Viewpoint], update: Callable[[], None]) -> None:
        """Make a handler.

        Args:
            tour: receives the actions of the user.
            seen_from: returns where the window's camera is now.
            update: updates the window to the tour's state.
        """
        self._tour, self._seen_from, self._update = tour, seen_from, update
        self._pressed: dict[str, tuple[int, int]] = {}
        self._last = (0, 0)
        self._interactor: Any = None
        self._style: Any = None

    def attach(self, interactor: Any) -> Any:
        """Handle the events of a VTK interactor, and return its new style."""
        from vtkmodules.vtkInteractionStyle import vtkInteractorStyleTrackballCamera

        self._interactor, self._style = interactor, vtkInteractorStyleTrackballCamera()
        for button in (_LEFT, _RIGHT):
            self._style.AddObserver(f"{button}PressEvent", self._press)
            self._style.AddObserver(f"{button}ReleaseEvent", self._release)
        self._style.AddObserver("MouseMoveEvent", self._move)
        self._style.AddObserver("MouseWheelForwardEvent", self._wheel)
        self._style.AddObserver("MouseWheelBackwardEvent", self._wheel)
        self._style.AddObserver("KeyPressEvent", self._key)
        self._style.AddObserver("CharEvent", lambda _style, _event: None)  # VTK's own keys
        interactor.SetInteractorStyle(self._style)
        return self._style

    @property
    def _inside(self) -> bool:
        return self._tour.state.inside is not None

    @property
    def _size_wh(self) -> tuple[int, int]:
        width, height = self._interactor.GetRenderWindow().GetSize()
        return max(1, width), max(1, height)

    def _place(self) -> tuple[int, int]:
        """Return the position of the pointer from the upper left corner; VTK counts from the lower left."""
        x, y = self._interactor.GetEventPosition()
        return x, self._size_wh[1] - 1 - y

    def _press(self, _style: Any, event: str) -> None:
        button = event.removesuffix("PressEvent")
        self._pressed[button] = self._last = self._place()
        if not self._inside:
            (self._style.OnLeftButtonDown if button == _LEFT else self._style.OnRightButtonDown)()

    def _release(self, _style: Any, event: str) -> None:
        button = event.removesuffix("ReleaseEvent")
        start, here = self._pressed.pop(button, None), self._place()
        if not self._inside:
            (self._style.OnLeftButtonUp if button == _LEFT else self._style.OnRightButtonUp)()
            self._tour.moved_to(self._seen_from())
        if start is not None and max(abs(start[0] - here[0]), abs(start[1] - here[1])) < _CLICK_PX:
            if button == _LEFT:
                self._tour.click(here[0] + 0.5, here[1] + 0.5, self._size_wh)
            else:
                self._tour.step_out()
        self._update()

    def _move(self, _style: Any, _event: str) -> None:
        here = self._place()
        before, self._last = self._last, here
        if not self._pressed:
            if not self._inside:
                self._tour.moved_to(self._seen_from())
            if self._tour.hover(here[0] + 0.5, here[1] + 0.5, self._size_wh):
                self._update()
        elif self._inside:
            self._tour.drag(here[0] - before[0], here[1] - before[1], window_height=self._size_wh[1])
            self._update()
        else:
            self._style.OnMouseMove()

    def _wheel(self, _style: Any, event: str) -> None:
        forward = event == "MouseWheelForwardEvent"
        if self._inside:
            self._tour.zoom(1 if forward else -1)
            self._update()
        else:
            (self._style.OnMouseWheelForward if forward else self._style.OnMouseWheelBackward)()

    def _key(self, _style: Any, _event: str) -> None:
        key = self._interactor.GetKeySym()
        if key == "q":
            self._interactor.TerminateApp()
            return
        if not self._inside:
            self._tour.moved_to(self._seen_from())
        if self._tour.key(key):
            self._update()
