"""Drawings for docs/frames_and_scale.md: where the axes of the camera are in a panorama, and three frames.

Run it as `python docs/_pictures/frame_pictures.py`.
"""

from __future__ import annotations

import cv2
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from quickstart_pictures import IMAGES, ROOT

mpl.use("agg")
SAMPLE = ROOT / "workflows" / "samples" / "classroom" / "images" / "000.png"
COLORS = {"x": "#d1495b", "y": "#3a7d44", "z": "#2f6db5"}
# Where a step to the right, up and forward goes in the drawing.
RIGHT, UP, FORWARD = np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([0.55, 0.42])
FRAMES = (
    ("pano_mvs, COLMAP, OpenCV", {"x": RIGHT, "y": -UP, "z": FORWARD}, "x right, y down, z forward"),
    ("OpenGL, nerfstudio's cameras, glTF", {"x": RIGHT, "y": UP, "z": -FORWARD}, "x right, y up, z backwards"),
    ("z up: LAS, E57, Blender", {"x": RIGHT, "y": FORWARD, "z": UP}, "x right, y forward, z up"),
)


def draw_panorama() -> None:
    """Draw the axes of the camera into a panorama of the sample."""
    picture = np.asarray(cv2.imread(str(SAMPLE)))[..., ::-1]
    height, width = picture.shape[:2]
    figure, axes = plt.subplots(figsize=(10, 5.4), dpi=120)
    axes.imshow(0.75 * picture / 255 + 0.25, extent=(0, width, height, 0))
    marks = (
        (width / 2, height / 2, "+z  forward", "z"),
        (3 * width / 4, height / 2, "+x  right", "x"),
        (width / 4, height / 2, "−x  left", "x"),
        (0, height / 2, "−z  behind", "z"),
        (width, height / 2, "−z  behind", "z"),
        (width / 2, 0, "−y  up (the whole first row)", "y"),
        (width / 2, height, "+y  down (the whole last row)", "y"),
    )
    for x, y, text, axis in marks:
        axes.plot(x, y, "o", color=COLORS[axis], markersize=9, clip_on=False, zorder=3)
        side = {0.0: "left", float(width): "right"}.get(float(x), "center")
        inside = y + (34 if y < height * 0.9 else -30)
        box = {"facecolor": "white", "edgecolor": COLORS[axis], "boxstyle": "round,pad=0.25", "alpha": 0.92}
        nudge = {"left": 8, "right": -8, "center": 0}[side]
        axes.text(x + nudge, inside, text, color=COLORS[axis], ha=side, va="center", fontsize=11, bbox=box)
    axes.set_xticks([0, width / 4, width / 2, 3 * width / 4, width], ["0", "w/4", "w/2", "3w/4", "w"])
    axes.set_yticks([0, height / 2, height], ["0", "h/2", "h"])
    axes.set_xlabel("column: azimuth −180° … 180°")
    axes.set_ylabel("row: elevation 90° … −90°")
    _save(figure, "frames_panorama.jpg")


def draw_frames() -> None:
    """Draw the frames beside each other, all seen from behind and above the camera."""
    figure, all_axes = plt.subplots(1, 3, figsize=(10, 3.5), dpi=120)
    for axes, (title, directions, words) in zip(all_axes, FRAMES, strict=True):
        for name, direction in directions.items():
            arrow = {"arrowstyle": "-|>", "color": COLORS[name], "lw": 3, "mutation_scale": 20}
            axes.annotate("", xy=tuple(direction), xytext=(0, 0), arrowprops=arrow)
            axes.text(
                *(1.15 * direction), name, color=COLORS[name], fontsize=15, ha="center", va="center", weight="bold"
            )
        axes.plot(0, 0, "o", color="#333", markersize=7)
        axes.set_title(title, fontsize=11.5)
        axes.text(0.2, -1.55, words, ha="center", fontsize=10.5, color="#444")
        axes.set_xlim(-1.1, 1.5)
        axes.set_ylim(-1.65, 1.45)
        axes.set_aspect("equal")
        axes.axis("off")
    _save(figure, "frames_axes.jpg")


def _save(figure: plt.Figure, name: str) -> None:
    figure.tight_layout()
    figure.savefig(IMAGES / name, pil_kwargs={"quality": 82})
    plt.close(figure)


if __name__ == "__main__":
    draw_panorama()
    draw_frames()
