"""Text over the scene: messages in the corners, labels of cameras, and the help."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_KEYS = (
    ("left drag", "turn"),
    ("wheel, right drag", "nearer, farther"),
    ("click a camera", "step inside"),
    ("click elsewhere", "inside: pixel and range"),
    ("Esc, right click", "step out"),
    ("left, right", "next camera"),
    ("o, t, y", "overview, top, front"),
    ("m", "measure: click two points"),
    ("c", "colours of the cloud"),
    ("s", "cloud, mesh, or both"),
    ("x", "what faces away from you"),
    ("b", "cloud within the panorama"),
    ("r", "inside: ranges, unconfirmed ones pale"),
    ("d", "all points"),
    ("l, k", "names, cameras"),
    ("h, q", "this help, quit"),
)
_HELP = "\n".join(f" {keys:<18} {what} " for keys, what in _KEYS)
# Position as a share of the window from the lower left corner, and the edges of the text that are placed there.
_PLACES = {
    "upper_left": (0.008, 0.988, "left", "top"),
    "lower_right": (0.992, 0.012, "right", "bottom"),
    "help": (0.012, 0.9, "left", "top"),
}


class Overlay:
    """Writes text on a plotter, replacing earlier text with the same name."""

    def __init__(self, plotter: Any, font: int, *, ink: str, paper: str) -> None:
        self._plotter, self._font, self._ink, self._paper = plotter, font, ink, paper

    def text(self, lines: list[str], corner: str) -> None:
        """Write lines, except empty ones, into the corner "upper_left" or "lower_right"."""
        shown = "\n".join(f" {line} " for line in lines if line)
        self._panel(shown, corner, font="arial", size=0.8)

    def label(self, points: NDArray[np.float64], texts: list[str], name: str, *, color: str = "") -> None:
        """Write a text at each point (N, 3) of the scene."""
        self._plotter.add_point_labels(
            points,
            texts,
            name=name,
            font_size=round(1.5 * self._font),
            text_color=color or self._ink,
            shape="rounded_rect",
            shape_color=self._paper,
            shape_opacity=0.7,
            margin=4,
            always_visible=True,
            show_points=False,
            reset_camera=False,
            render=False,
            pickable=False,
        )

    def help(self, *, wanted: bool) -> None:
        """Show or hide the help."""
        self._panel(_HELP if wanted else "", "help", font="courier", size=0.7)

    def _panel(self, text: str, name: str, *, font: str, size: float) -> None:
        self._plotter.remove_actor(name, render=False)
        if not text:
            return
        x, y, across, upright = _PLACES[name]
        actor = self._plotter.add_text(
            text,
            position=(x, y),
            viewport=True,
            name=name,
            font=font,
            color=self._ink,
            font_size=size * self._font,
            render=False,
        )
        actor.prop.justification_horizontal, actor.prop.justification_vertical = across, upright
        actor.prop.background_color, actor.prop.background_opacity = self._paper, 0.75
