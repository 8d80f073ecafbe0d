"""A run as HTML for notebooks."""

from __future__ import annotations

import html
from collections.abc import Iterable

import numpy as np

from pano_mvs.io.images.preview import color_mapped, mark_unconfirmed, range_limits
from pano_mvs.results.figures import duration, figure
from pano_mvs.results.pictures import Picture, picture
from pano_mvs.results.run_output import RunOutput, RunView

_MAX_VIEWS = 6
_WIDTH = 320
_MAX_BYTES = 40_000
_COLORS = {"good": "#1a7f37", "fair": "#9a6700", "bad": "#cf222e", "": "inherit"}


def run_html(run: RunOutput) -> str:
    """Return the verdict, images of some views, and a table of the stages, as self-contained HTML."""
    verdict = run.verdict
    title = f"<b>{_text(run.summary.workflow.name or 'pano-mvs')}</b>: {_text(verdict.outcome)}."
    judgement = f'<b style="color:{_COLORS[verdict.mood]}">{_text(verdict.judgement)}</b>'
    tiles = " · ".join(f"<b>{_text(tile.value)}</b> {_text(tile.label)}" for tile in verdict.tiles)
    findings = "".join(f"<li>{_text(found.text)} {_text(found.remedy)}</li>" for found in verdict.findings)
    parts = [
        f"<p>{title} {judgement} {_text(verdict.sentence)}</p>",
        f"<p>{tiles}</p>" if tiles else "",
        f"<ul>{findings}</ul>" if findings else "",
        "".join(_view_html(run.views[name]) for name in chosen(list(run.views))),
        _stages_html(run),
        f"<p>{_text(str(run.out))}</p>",
    ]
    return f"<div>{''.join(parts)}</div>"


def chosen(names: list[str], most: int = _MAX_VIEWS) -> list[str]:
    """Return at most this number of names, evenly spaced.

    >>> chosen(["a", "b", "c", "d", "e"], 3)
    ['a', 'c', 'e']
    """
    return [names[round(at)] for at in np.linspace(0, len(names) - 1, min(len(names), most))] if names else []


def _view_html(view: RunView) -> str:
    pictures = _pictures(view)
    if not pictures:
        return ""
    shown = "".join(
        f'<img src="{small.uri}" width="{small.size_hw[1]}" height="{small.size_hw[0]}" alt="{what}">'
        for what, small in pictures
    )
    return (
        f'<figure style="display:inline-block;margin:4px">{shown}<figcaption>{_text(view.name)}</figcaption></figure>'
    )


def _pictures(view: RunView) -> Iterable[tuple[str, Picture]]:
    found = []
    if view.image is not None:
        found.append(("panorama", picture(view.image, width=_WIDTH, most_bytes=_MAX_BYTES)))
    if view.range_map is not None:
        colors = color_mapped(view.range_map, *range_limits(view.range_map))
        if view.confidence is not None:
            colors = mark_unconfirmed(colors, view.confidence)
        found.append(("range map", picture(colors, width=_WIDTH, most_bytes=_MAX_BYTES)))
    return found


def _stages_html(run: RunOutput) -> str:
    names = ("run", "cached", "failed", "blocked")
    head = "".join(f"<th>{name}</th>" for name in ("stage", "use", *names, "time"))
    rows = "".join(
        f"<tr><td>{_text(stage.name)}</td><td>{_text(stage.use)}</td>"
        + "".join(f"<td>{figure(getattr(stage, name))}</td>" for name in names)
        + f"<td>{duration(stage.seconds)}</td></tr>"
        for stage in run.summary.stages
    )
    return f"<table><tr>{head}</tr>{rows}</table>" if rows else ""


def _text(value: str) -> str:
    return html.escape(value)
