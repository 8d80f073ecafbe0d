"""The verdict of a run, its main figures, and its findings: what is wrong or doubtful, and what to do about it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence

from pano_mvs.core.text import plural, shortened_list
from pano_mvs.results.figures import degrees, figure, median, share, significant
from pano_mvs.results.records import Finding, PoseGroup, PosesSummary, Tile, Verdict
from pano_mvs.results.residuals import Residuals
from pano_mvs.results.summary import FAILED_ITEMS, INTERRUPTED, RunSummary
from pano_mvs.scene.masking import MEANING_OF_MASKS

_OUTCOMES = {
    0: ("good", "Finished"),
    1: ("bad", "Stopped by an internal error"),
    2: ("bad", "Stopped: the workflow or an input cannot be used"),
    FAILED_ITEMS: ("fair", "Finished, with failed items"),
    4: ("bad", "Stopped by a quality threshold or a safety check"),
    INTERRUPTED: ("fair", "Interrupted"),
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
        residuals: of the points, if known.
        image_width: of the panoramas in pixels, if known.
    """
    code = summary.exit_code
    mood, outcome = _OUTCOMES.get(code, ("bad", f"Ended with code {code}"))
    if code == FAILED_ITEMS and not summary.failures:
        parts = {"panoramas left out": summary.rejected, "doubtful cameras": summary.doubts}
        outcome = f"Finished, with {' and '.join(text for text, found in parts.items() if found) or 'failed items'}"
    residual_deg = residuals.overall.median_deg if residuals else None
    residual_px = residual_deg * image_width / 360 if residual_deg is not None and image_width else None
    tiles = list(_tiles(summary, residual_deg, residual_px))
    found = findings(summary, residual_px=residual_px)
    moods = {mood, *(tile.mood for tile in tiles), *(finding.mood for finding in found)}
    overall = _worst(moods)
    judged = any(tile.mood for tile in tiles) or overall == "bad"
    judgement = _JUDGEMENTS[overall] if judged else ""
    if code == INTERRUPTED and overall != "bad":
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


def _tiles(summary: RunSummary, residual_deg: float | None, residual_px: float | None) -> Iterator[Tile]:
    poses, points, scores = summary.poses, summary.cloud.points, summary.scores
    registered, rejected = len(poses.registered), len(poses.rejected)
    if registered + rejected:
        moods = {mood_of(registered / (registered + rejected), GOOD_REGISTERED, FAIR_REGISTERED), doubt_mood(poses)}
        groups, doubts = len(poses.groups), len(poses.doubts)
        label = "panoramas registered" + (f", in {groups} groups" if groups > 1 else "")
        label += f", {doubts} doubtful" if doubts else ""
        yield Tile(f"{registered} of {registered + rejected}", label, _worst(moods))
    if residual_deg is not None:
        mood = mood_of(residual_px, GOOD_RESIDUAL_PX, FAIR_RESIDUAL_PX) if residual_px is not None else ""
        pixels = f", {significant(residual_px)} px" if residual_px is not None else ""
        yield Tile(degrees(residual_deg), f"median reprojection residual{pixels}", mood)
    for key, label, limits in (
        ("completeness", "of pixels have a range", (GOOD_COMPLETE, FAIR_COMPLETE)),
        ("consistent", "of pixels agree with other views", (GOOD_CONSISTENT, FAIR_CONSISTENT)),
    ):
        value = median([getattr(view, key) for view in summary.views])
        if value is not None and (key != "consistent" or compares_views(summary)):
            yield Tile(share(value), label, mood_of(value, *limits))
    if points is not None:
        text = f"{points / 1e6:.2f} M" if points >= 1_000_000 else figure(points)
        yield Tile(text, f"{plural(points, 'point')} in the cloud", "" if points else "bad")
    error_deg = median([scores.poses.get("median_pair_error_deg")])
    if error_deg is not None:
        yield Tile(degrees(error_deg), "median pose error against the ground truth")
    relative = median([view.get("median_relative_error") for view in scores.views.values()])
    if relative is not None:
        yield Tile(f"{significant(100 * relative)} %", "median range error against the ground truth")


GOOD_REGISTERED, FAIR_REGISTERED = 0.95, 0.5
# Residuals are measured in pixels of the panorama: a median within one pixel is good.
GOOD_RESIDUAL_PX, FAIR_RESIDUAL_PX = 1.0, 2.0
# The sky fills up to half of the sphere, so only a much smaller share of valid pixels is bad.
GOOD_COMPLETE, FAIR_COMPLETE = 0.8, 0.35
# No other view confirms walls without texture: a third of the pixels of a furnished room is a good share.
GOOD_CONSISTENT, FAIR_CONSISTENT = 0.3, 0.12


def mood_of(value: float, good: float, fair: float) -> str:
    """Return "good", "fair" or "bad".

    Args:
        good: threshold of "good"; a lower bound if it is greater than `fair`, else an upper bound.
        fair: threshold of "fair".
    """
    if good > fair:
        return "good" if value >= good else "fair" if value >= fair else "bad"
    return "good" if value <= good else "fair" if value <= fair else "bad"


_SHOWN_GROUPS = 5
_SHOWN_DOUBTS = 5
_NAMES_AND_FIGURES = re.compile(r"\d+([.,]\d+)?|'[^']*'")
_ENDINGS = re.compile(r"\b(is|are)\b|(?<=\w)e?s\b")  # endings that differ between singular and plural


def findings(summary: RunSummary, *, residual_px: float | None = None) -> tuple[Finding, ...]:
    """Return what is wrong or doubtful in a run, the worst first.

    Args:
        residual_px: median reprojection residual in pixels of the panoramas, if known.
    """
    found = [
        *_masks(summary),
        *_stopped(summary),
        *_failures(summary),
        *_registration(summary),
        *_doubts(summary),
        *_groups(summary),
        *_graph(summary),
        *_imprecision(residual_px),
        *_views(summary),
        *_cloud(summary),
        *_baseline(summary),
    ]
    return tuple(sorted(found, key=lambda finding: ("bad", "fair", "").index(finding.mood)))


def _masks(summary: RunSummary) -> Iterator[Finding]:
    """Yield a finding if masks hide most of the images: they may be inverted, and little overlap is left."""
    for stage in summary.stages:
        masked = stage.metrics.get("masked")
        if masked is not None and masked > 0.5:
            yield Finding(
                "bad" if summary.stopped else "fair",
                f"The masks hide {share(masked)} of what the images show, in the mean of the images that have one.",
                f"{MEANING_OF_MASKS}.",
            )


def _stopped(summary: RunSummary) -> Iterator[Finding]:
    if summary.exit_code == INTERRUPTED:
        yield Finding(
            "fair",
            "The run was interrupted. This report shows what it had finished.",
            "Run the same command again to continue.",
        )
    elif summary.stopped:
        text = f"The run stopped early: {summary.stopped}"
        text += "" if text.endswith((".", "!", "?")) else "."
        yield Finding("bad", text, "Correct this and run the same command again.")


def _failures(summary: RunSummary) -> Iterator[Finding]:
    failures, blocked = summary.failures, summary.blocked
    if not failures:
        return
    stages = Counter(failure.stage for failure in failures)
    where = ", ".join(f"{count} in {stage}" for stage, count in stages.most_common(3))
    further = f"{figure(len(blocked))} further {plural(len(blocked), 'unit')}"
    more = f"; {further} could not run because of {plural(len(failures), 'it', 'them')}" if blocked else ""
    verb = plural(len(failures), "unit of work failed", "units of work failed")
    yield Finding("fair", f"{figure(len(failures))} {verb} ({where}){more}.", "The report lists each with its cause.")


def _registration(summary: RunSummary) -> Iterator[Finding]:
    registered, rejected = len(summary.poses.registered), summary.poses.rejected
    total = registered + len(rejected)
    if not total or not rejected:
        return
    mood = mood_of(registered / total, GOOD_REGISTERED, FAIR_REGISTERED)
    text = (
        f"{len(rejected)} of {total} {plural(total, 'panorama')} {plural(len(rejected), 'has', 'have')} no pose: "
        f"{_commonest(list(rejected.values()))}."
    )
    if mood == "good":
        yield Finding("", text)
    else:
        remedy = "Take more panoramas between these, 0.5–1 m apart indoors, so that consecutive ones overlap well."
        yield Finding(mood, text, "Correct the masks first." if any(_masks(summary)) else remedy)


def doubt_mood(poses: PosesSummary) -> str:
    """Return "fair" if some registered cameras are doubtful, "bad" if more than half are, else "good"."""
    return mood_of(1 - len(poses.doubts) / max(1, len(poses.registered)), 1.0, 0.5)


def _doubts(summary: RunSummary) -> Iterator[Finding]:
    doubts, poses = summary.doubtful_images, summary.poses
    if not doubts:
        return
    what = "camera" if poses.doubts else "image"
    count = f"{len(doubts)} {plural(len(doubts), f'{what} is', f'{what}s are')} doubtful"
    mood = doubt_mood(poses) if poses.doubts else "fair"
    if len(doubts) > 1 and len(reasons := {*doubts.values()}) == 1 and doubts.keys() >= {*poses.registered}:
        yield Finding(mood, f"All {count}: {reasons.pop()}.")
        return
    named = [f"{name} ({reason})" for name, reason in doubts.items()]
    more = f"; and {len(named) - _SHOWN_DOUBTS} more" if len(named) > _SHOWN_DOUBTS else ""
    them = plural(len(doubts), "it and its", "them and their")
    yield Finding(
        mood,
        f"{count}: {'; '.join(named[:_SHOWN_DOUBTS])}{more}.",
        f"Take panoramas between {them} neighbours that show something unique, or leave "
        f"{plural(len(doubts), 'it', 'these images')} out.",
    )


def _groups(summary: RunSummary) -> Iterator[Finding]:
    groups = summary.poses.groups
    if len(groups) < 2:
        return
    sizes = [
        f"group {number} has {len(group.images)} ({shortened_list(group.images, rest=' …')})"
        for number, group in enumerate(groups[1:], start=1)
    ]
    more = f"; and {len(sizes) - _SHOWN_GROUPS} more" if len(sizes) > _SHOWN_GROUPS else ""
    largest = len(groups[0].images)
    text = (
        f"{len(groups)} groups of panoramas share no reliable connection: each has its own frame and scale. The "
        f"largest has {largest} {plural(largest, 'panorama')}; "
        f"{'; '.join(sizes[:_SHOWN_GROUPS])}{more}. They may also be different places."
    )
    yield Finding("fair", text, pictures_between(groups))


def pictures_between(groups: Sequence[PoseGroup]) -> str:
    """Return between which images to take more, to connect smaller groups to the largest one, which is the first."""
    found = []
    for pair in (group.nearest_pair for group in groups[1:]):
        if pair:
            matches, candidates = pair.matches, pair.candidates
            known = (
                f"{matches} {plural(matches, 'match', 'matches')}"
                if matches
                else f"{candidates} {plural(candidates, 'candidate')}"
            )
            found.append(f"{pair.first} and {pair.second} ({known})")
    if not found:
        return "Take panoramas between the groups, 0.5–1 m apart, so that they overlap both."
    more = " …" if len(found) > _SHOWN_GROUPS else ""
    return f"To connect them, take panoramas between {'; between '.join(found[:_SHOWN_GROUPS])}{more}."


def _commonest(reasons: Sequence[str]) -> str:
    """Return the most frequent reason, ignoring figures and names in it, and its frequency."""
    kinds = [_ENDINGS.sub("", _NAMES_AND_FIGURES.sub("…", reason)) for reason in reasons]
    ((kind, count),) = Counter(kinds).most_common(1)
    example = reasons[kinds.index(kind)]
    return example if len(reasons) == 1 else f"{count} {plural(count, 'time')} such as “{example}”"


def _graph(summary: RunSummary) -> Iterator[Finding]:
    """Yield a finding on registered cameras that are linked to only one other, if there are at least four cameras."""
    names, links = summary.poses.registered, summary.poses.links
    if len(names) < 4 or not links:
        return
    count = Counter(name for link in links if link.inliers for name in link[:2])
    loose = [name for name in names if 0 < count[name] < 2]
    if not loose:
        return
    shown = shortened_list(loose, rest=" …")
    mood = "fair" if len(loose) > len(names) / 4 else ""
    sharing = plural(len(loose), "camera shares", "cameras share")
    yield Finding(
        mood,
        f"{len(loose)} {sharing} a verified geometry with only one other camera ({shown}): unless their "
        "poses come from a file, nothing confirms them.",
    )


def _imprecision(residual_px: float | None) -> Iterator[Finding]:
    if residual_px is not None and (mood := mood_of(residual_px, GOOD_RESIDUAL_PX, FAIR_RESIDUAL_PX)) != "good":
        yield Finding(
            mood,
            f"The median reprojection residual is {significant(residual_px)} pixels: the poses are imprecise.",
            "Check that the images are sharp, well stitched, and not edited individually; "
            "add poses.refine after the solver if it is missing.",
        )


def compares_views(summary: RunSummary) -> bool:
    """Return whether any stage compared the views; otherwise, no pixel can be confirmed."""
    compared = any("consistency" in stage.use for stage in summary.stages)
    return compared or any(view.consistent for view in summary.views)


def _views(summary: RunSummary) -> Iterator[Finding]:
    complete = median([view.completeness for view in summary.views])
    consistent = median([view.consistent for view in summary.views])
    if complete is not None and (mood := mood_of(complete, GOOD_COMPLETE, FAIR_COMPLETE)) != "good":
        yield Finding(
            mood,
            f"Half of the views have a range for less than {share(complete)} of their pixels.",
            "Sky and masked areas have none; for other areas, look at the views in the report.",
        )
    if consistent is not None and not compares_views(summary):
        yield Finding(
            "",
            "No stage compared the views with each other, so it is unknown whether they agree.",
            "Add filters.consistency.",
        )
    elif consistent is not None and (mood := mood_of(consistent, GOOD_CONSISTENT, FAIR_CONSISTENT)) != "good":
        yield Finding(
            mood,
            f"Other views confirm only {share(consistent)} of the pixels in the median view.",
            "Plain walls cannot be confirmed. If textured surfaces are not confirmed either, the cameras are too "
            "far apart or the poses are wrong.",
        )
    # Most ranges above or below the cameras may be unconfirmed, in half of the views.
    for side, surface in (("above", "ceilings"), ("below", "floors")) if compares_views(summary) else ():
        confirmed = median([view.metrics.get(f"confirmed_{side}") for view in summary.views])
        # With less than this, ranges of a ceiling or floor may be far off.
        if confirmed is not None and confirmed < 0.15:
            yield Finding(
                "fair",
                f"Other views confirm only {share(confirmed)} of the ranges {side} the cameras in the median view; "
                "the others may be wrong.",
                f"Plain {surface} cannot be matched. Previews show their ranges pale; leave them out by confidence "
                "(128 and more is confirmed) or by uncertainty, or use the preset quality.",
            )


def _cloud(summary: RunSummary) -> Iterator[Finding]:
    if summary.cloud.points == 0:
        yield Finding(
            "bad",
            "The cloud has no points: no two views agree on any surface.",
            "Look at the range maps in the report: if they look right, the poses are wrong.",
        )


def _baseline(summary: RunSummary) -> Iterator[Finding]:
    """Yield a finding for each branch that scores no better than a constant range."""
    for stage, scores in summary.scores_by_stage.items():
        views = scores.views.values()
        ours = median([view.get("psnr_db") for view in views])
        constant = median([view.get("best_constant_psnr_db", view.get("constant_psnr_db")) for view in views])
        if ours is not None and constant is not None and ours <= constant:
            text = f"Compared with the ground truth ({stage}), a single constant range scores at least as well"
            yield Finding("bad", f"{text}: {constant:z.1f} dB, against {ours:z.1f} dB.")
