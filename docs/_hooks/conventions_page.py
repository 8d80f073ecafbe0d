"""The page of the conventions: the docstring of pano_mvs.geometry, which states them once, as it stands there."""

from __future__ import annotations

import inspect
import re

from markdown_text import escaped, table

from pano_mvs import geometry

_INTRODUCTION = """# Conventions

This page is generated from the docstring of `pano_mvs.geometry`; tests check every statement.
[Frames and scale](../frames_and_scale.md) describes the origin, axes and unit of the world."""

_ELSEWHERE = (
    ("COLMAP", "`EQUIRECTANGULAR`, camera x right, y down, z forward, corners at integers", "nothing: it is the same"),
    ("nerfstudio", "camera-to-world, x right, y up, z backward (OpenGL)", "read by `poses.from_model`"),
    ("OpenSfM", "u = longitude / 2π, v = −latitude / 2π", "read by `poses.from_model`"),
    ("SphereSfM", "a camera model SPHERE, with COLMAP's number 11", "read by `poses.from_model`"),
    ("papers with z up", "θ = 2πu/w, φ = πv/h, no half pixel", "ranges are the same, a cloud is mirrored"),
)


def conventions_page() -> str:
    """Return the page."""
    text = inspect.getdoc(geometry) or ""
    title, *sections = re.split(r"\n\n(?=\w+\n {4})", text)
    parts = [_INTRODUCTION, escaped(title)]
    for section in sections:
        name, _, body = section.partition("\n")
        parts += [f"## {name}", _body(inspect.cleandoc(body))]
    elsewhere = table(("program", "its convention", "what to do"), _ELSEWHERE)
    return "\n\n".join([*parts, "## Conventions of other programs", elsewhere]) + "\n"


def _body(text: str) -> str:
    """Return prose as prose, and lines in columns as they are."""
    lines = text.splitlines()
    formulas = [line for line in lines if re.search(r"\S {2,}\S", line)]
    if not formulas:
        return escaped(text)
    prose = "\n".join(line for line in lines if line not in formulas)
    return "\n\n".join(["```\n" + "\n".join(formulas) + "\n```", escaped(prose)])
