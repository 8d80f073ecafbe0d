"""The verdict of a run: how it ended, whether the result is reliable, and its main figures."""

from __future__ import annotations

from collections.abc import Collection

from pano_mvs.core.text import plural
from pano_mvs.results.figures import degrees, figure, median, share, significant
from pano_mvs.results.findings import compares_views, doubt_mood, findings
from pano_mvs.results.records import Tile, Verdict
from pano_mvs.results.residuals import Residuals
from pano_mvs.results.summary import RunSummary
from pano_mvs.results.thresholds import (
    FAIR_COMPLETE,
    FAIR_CONSISTENT,
    FAIR_REGISTERED,
    FAIR_RESIDUAL_PX,
    GOOD_COMPLETE,
    GOOD_CONSISTENT,
    GOOD_REGISTERED,
    GOOD_RESIDUAL_PX,
    mood_of,
)

_SOME_FAILED, _INTERRUPTED = 3, 130
_OUTCOMES = {
    0: ("good", "Finished"),
    1: ("bad", "Stopped by an internal error"),
    2: ("bad", "Stopped: the workflow or an input cannot be used"),
    _SOME_FAILED: ("fair", "Finished, with failed items"),
    4: ("bad", "Stopped by a quality threshold or a safety check"),
    _INTERRUPTED: ("fair", "Interrupted"),
}
_JUDGEMENTS = {
    "good": "The result looks reliable.",
    "fair": "Usable, with doubts: see below.",
    "bad": "Do not rely on this result.",
    "": "",
}


def verdict(summary: RunSummary, *, residuals: Residuals | None = None, image_width: int | None = None) -> Verdict:
    """Return the verdict on a run; unknown figures are left out.

    Args:
        summary: of the run.
        residuals: of the points, if known.
        image_width: of the panoramas in pixels, if known.
    """
    code = summary.exit_code
    mood, outcome = _OUTCOMES.get(code, ("bad", f"Ended with code {code}"))
    if code == _SOME_FAILED and not summary.failures:
        parts = {"panoramas left out": summary.rejected, "doubtful cameras": summary.doubts}
        outcome = f"Finished, with {' and '.join(text for text, found in parts.items() if found) or 'failed items'}"
    residual_deg = residuals.overall.median_deg if residuals else None
    residual_px = residual_deg * image_width / 360 if residual_deg is not None and image_width else None
    tiles = [
        *_registered(summary),
        *_residual(residual_deg, residual_px),
        *_coverage(summary),
        *_cloud(summary),
        *_accuracy(summary),
    ]
    found = findings(summary, residual_px=residual_px)
    moods = {mood, *(tile.mood for tile in tiles), *(finding.mood for finding in found)}
    overall = _worst(moods)
    judged = any(tile.mood for tile in tiles) or overall == "bad"
    judgement = _JUDGEMENTS[overall] if judged else ""
    if code == _INTERRUPTED and overall != "bad":
        judgement = "Not finished."
    return Verdict(overall, outcome, judgement, _sentence(summary), tuple(tiles), found)


def _worst(moods: Collection[str]) -> str:
    return next((name for name in ("bad", "fair", "good") if name in moods), "good")


def _sentence(summary: RunSummary) -> str:
    if summary.merged is not None:
        return f"Merged from {figure(len(summary.merged.blocks))} blocks."
    run, cached, failed = (sum(getattr(s, key) for s in summary.stages) for key in ("run", "cached", "failed"))
    if not run + cached + failed:
        return "There was nothing to compute."
    parts = [f"{figure(run)} computed", f"{figure(cached)} taken from the cache"]
    if failed:
        parts.append(f"{figure(failed)} failed")
    if not run and not failed:
        units = plural(cached, "the one unit of work was", f"all {figure(cached)} units of work were")
        return f"Nothing has changed: {units} taken from the cache."
    total = run + cached + failed
    return f"{figure(total)} {plural(total, 'unit of work', 'units of work')}: {', '.join(parts)}."


def _registered(summary: RunSummary) -> list[Tile]:
    poses = summary.poses
    registered, rejected = len(poses.registered), len(poses.rejected)
    if not registered + rejected:
        return []
    moods = {mood_of(registered / (registered + rejected), GOOD_REGISTERED, FAIR_REGISTERED), doubt_mood(poses)}
    groups, doubts = len(poses.groups), len(poses.doubts)
    label = "panoramas registered" + (f", in {groups} groups" if groups > 1 else "")
    label += f", {doubts} doubtful" if doubts else ""
    return [Tile(f"{registered} of {registered + rejected}", label, _worst(moods))]


def _residual(residual_deg: float | None, residual_px: float | None) -> list[Tile]:
    if residual_deg is None:
        return []
    mood = mood_of(residual_px, GOOD_RESIDUAL_PX, FAIR_RESIDUAL_PX) if residual_px is not None else ""
    pixels = f", {significant(residual_px)} px" if residual_px is not None else ""
    return [Tile(degrees(residual_deg), f"median reprojection residual{pixels}", mood)]


def _coverage(summary: RunSummary) -> list[Tile]:
    tiles = []
    for key, label, limits in (
        ("completeness", "of pixels have a range", (GOOD_COMPLETE, FAIR_COMPLETE)),
        ("consistent", "of pixels agree with other views", (GOOD_CONSISTENT, FAIR_CONSISTENT)),
    ):
        value = median([getattr(view, key) for view in summary.views])
        if value is not None and (key != "consistent" or compares_views(summary)):
            tiles.append(Tile(share(value), label, mood_of(value, *limits)))
    return tiles


def _cloud(summary: RunSummary) -> list[Tile]:
    points = summary.cloud.points
    if points is None:
        return []
    text = f"{points / 1e6:.2f} M" if points >= 1_000_000 else figure(points)
    return [Tile(text, f"{plural(points, 'point')} in the cloud", "" if points else "bad")]


def _accuracy(summary: RunSummary) -> list[Tile]:
    """Return the errors against ground truth, if known."""
    scores = summary.scores
    tiles = []
    error_deg = median([scores.poses.get("median_pair_error_deg")])
    if error_deg is not None:
        tiles.append(Tile(degrees(error_deg), "median pose error against the ground truth"))
    errors = [view.get("median_relative_error") for view in scores.views.values()]
    relative = median(errors)
    if relative is not None:
        tiles.append(Tile(f"{significant(100 * relative)} %", "median range error against the ground truth"))
    return tiles
