"""What a reader wants to know first: did it work, for how much of the capture, and how well."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pano_mvs.report.figures import figure, median, share

_OUTCOMES = {
    0: ("good", "Finished"),
    1: ("bad", "Stopped by an internal error"),
    2: ("bad", "Stopped: the workflow or an input cannot be used"),
    3: ("fair", "Finished, with failed items"),
    4: ("bad", "Stopped by a quality gate or a guard"),
    130: ("fair", "Interrupted"),
}


@dataclass(frozen=True)
class Tile:
    """One headline figure.

    Attributes:
        value: the figure.
        label: what it counts.
        mood: "good", "fair", "bad" or "" where no judgement is due.
    """

    value: str
    label: str
    mood: str = ""


@dataclass(frozen=True)
class Verdict:
    """The head of the report.

    Attributes:
        mood: "good", "fair" or "bad".
        outcome: how the run ended.
        sentence: what came out of it, in one sentence.
        tiles: the headline figures.
    """

    mood: str
    outcome: str
    sentence: str
    tiles: tuple[Tile, ...]


def verdict(summary: Mapping[str, Any]) -> Verdict:
    """Return the verdict on a run from its summary; figures that are not known are left out."""
    mood, outcome = _OUTCOMES.get(summary.get("exit_code", 0), ("bad", f"Ended with code {summary.get('exit_code')}"))
    tiles = [*_registered(summary), *_coverage(summary), *_cloud(summary), *_accuracy(summary)]
    if mood == "good" and any(tile.mood == "bad" for tile in tiles):
        mood = "fair"
    return Verdict(mood, outcome, _sentence(summary), tuple(tiles))


def _sentence(summary: Mapping[str, Any]) -> str:
    stages = summary.get("stages") or []
    run, cached = (sum(stage.get(key) or 0 for stage in stages) for key in ("run", "cached"))
    failed = sum(stage.get("failed") or 0 for stage in stages)
    if not run + cached + failed:
        return "No unit of work was due."
    parts = [f"{figure(run)} computed", f"{figure(cached)} taken from the cache"]
    if failed:
        parts.append(f"{figure(failed)} failed")
    if not run and not failed:
        return f"Nothing had changed: all {figure(cached)} units of work were taken from the cache."
    return f"{figure(run + cached + failed)} units of work: {', '.join(parts)}."


def _registered(summary: Mapping[str, Any]) -> list[Tile]:
    poses = summary.get("poses") or {}
    registered, rejected = len(poses.get("registered") or []), len(poses.get("rejected") or {})
    if not registered + rejected:
        return []
    part = registered / (registered + rejected)
    mood = "good" if part >= 0.95 else "fair" if part >= 0.5 else "bad"
    return [Tile(f"{registered} of {registered + rejected}", "panoramas registered", mood)]


def _coverage(summary: Mapping[str, Any]) -> list[Tile]:
    views = summary.get("views") or []
    tiles = []
    for key, label, limits in (
        ("completeness", "of pixels have a range", (0.9, 0.6)),
        ("consistent", "of pixels agree with other views", (0.5, 0.25)),
    ):
        value = median([view.get(key) for view in views])
        if value is not None:
            mood = "good" if value >= limits[0] else "fair" if value >= limits[1] else "bad"
            tiles.append(Tile(share(value), label, mood))
    return tiles


def _cloud(summary: Mapping[str, Any]) -> list[Tile]:
    points = (summary.get("cloud") or {}).get("points")
    if points is None:
        return []
    text = f"{points / 1e6:.2f} M" if points >= 1_000_000 else figure(points)
    return [Tile(text, "points in the cloud", "" if points else "bad")]


def _accuracy(summary: Mapping[str, Any]) -> list[Tile]:
    """Return how far the result is from the truth, where that is known."""
    scores = summary.get("scores") or {}
    tiles = []
    error_deg = median([(scores.get("poses") or {}).get("median_pair_error_deg")])
    if error_deg is not None:
        tiles.append(Tile(f"{error_deg:.2g}°", "median pose error against the truth"))
    errors = [view.get("median_relative_error") for view in (scores.get("views") or {}).values()]
    relative = median(errors)
    if relative is not None:
        tiles.append(Tile(f"{100 * relative:.2g} %", "median range error against the truth"))
    return tiles
