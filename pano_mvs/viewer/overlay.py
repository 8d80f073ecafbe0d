"""Letters over the picture: corners, names beside what they name, the keys."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_KEYS = (
    ("left drag", "turn"),
    ("wheel, right drag", "nearer, farther"),
    ("click a camera", "step inside"),
    ("Esc, right click", "step out"),
    ("left, right", "next camera"),
    ("o, t, y", "overview, top, front"),
    ("m", "measure: click two points"),
    ("c", "colours of the cloud"),
    ("x", "points that turn their back"),
    ("b", "cloud within the panorama"),
    ("d", "all points"),
    ("l, k", "names, cameras"),
    ("h, q", "this help, quit"),
)
_HELP = "\n".join(f" {keys:<18} {what} " for keys, what in _KEYS)


class Overlay:
    """Writes on a plotter; what is written under a name takes the place of what was there."""

    def __init__(self, plotter: Any, font: int, *, ink: str, paper: str) -> None:
        self._plotter, self._font, self._ink, self._paper = plotter, font, ink, paper

    def text(self, lines: list[str], corner: str) -> None:
        """Write lines, but for empty ones, into a corner such as "upper_left"."""
        self._plotter.remove_actor(corner, render=False)
        shown = "\n".join(line for line in lines if line)
        if shown:
            self._plotter.add_text(shown, position=corner, font_size=0.8 * self._font, color=self._ink, font="arial",
                                   shadow=True, name=corner, render=False)  # fmt: skip

    def label(self, points: NDArray[np.float64], texts: list[str], name: str, *, color: str = "") -> None:
        """Write a text at each point (N, 3) of the scene."""
        self._plotter.add_point_labels(
            points, texts, name=name, font_size=round(1.5 * self._font), text_color=color or self._ink,
            shape="rounded_rect", shape_color=self._paper, shape_opacity=0.7, margin=4, always_visible=True,
            show_points=False, reset_camera=False, render=False, pickable=False,
        )  # fmt: skip

    def help(self, *, wanted: bool) -> None:
        """Show the keys, or take them away."""
        self._plotter.remove_actor("help", render=False)
        if wanted:
            place = 1.5 * self._font, self._plotter.window_size[1] - 5.5 * self._font
            actor = self._plotter.add_text(_HELP, position=place, name="help", font="courier", color=self._ink,
                                           font_size=0.7 * self._font, render=False)  # fmt: skip
            actor.prop.justification_vertical = "top"
            actor.prop.background_color, actor.prop.background_opacity = self._paper, 0.85
