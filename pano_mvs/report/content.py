"""The content of the page, gathered from the summary, the cache and an earlier page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from pano_mvs.report.camera_map import CameraMap, camera_maps, up_of
from pano_mvs.report.cloud import CloudPictures, TurnableCloud, cloud_pictures, turnable_cloud
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.masked_areas import MaskedAreas, masked_areas
from pano_mvs.report.view_cards import (
    Shares,
    ViewCard,
    chosen_views,
    key_of,
    shares_of,
    view_cards,
)
from pano_mvs.results.coverage import coverage, coverage_from_fact, coverage_key, fact_of
from pano_mvs.results.figures import score_tables, side_by_side
from pano_mvs.results.next_time import Suggestion, marks_of, suggestions
from pano_mvs.results.pictures import Picture, evenly_spaced, picture, preview_panels
from pano_mvs.results.records import PairLink, PosesSummary, StageOutcome, UnitCounts, Verdict, ViewSummary
from pano_mvs.results.residuals import Histogram, Residuals, histogram, reprojection_residuals
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.results.verdict import verdict
from pano_mvs.scene.scores import NO_TRUTH
from pano_mvs.scene.two_view import pair_name

MAX_SUGGESTIONS = 12  # suggestions that the page shows


def advice(
    summary: RunSummary, values: StoredValues, earlier: EarlierPage, *, chosen: Sequence[str]
) -> tuple[Suggestion, ...]:
    """Return what to do next time, the most urgent first."""
    if not values.digest("poses"):
        return suggestions(summary)
    everything = [view.name for view in summary.views]
    names = everything if len(everything) <= 60 else chosen
    key = coverage_key(values, names)
    fact = earlier.fact(key)
    if fact is None:
        fact = fact_of(coverage(values, names))
        earlier.keep(key, fact)
    return suggestions(summary, coverage_from_fact(fact))


# Names of folders that do not say which capture it is: the name of the folder above comes first.
_GENERIC = {
    "images",
    "image",
    "img",
    "photos",
    "pictures",
    "panoramas",
    "panos",
    "frames",
    "input",
    "jpg",
    "png",
    "raw",
}
_MONTHS = "Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"


@dataclass(frozen=True)
class CaptureFacts:
    """The capture of a run."""

    name: str  # of the folder with the images, or else of the workflow
    date: str  # when the run began, in words; "" if unknown
    panoramas: int
    # ((height, width) of the full sphere in the file, number of images), the most frequent size first
    sizes: tuple[tuple[tuple[int, int], int], ...] = ()
    measured: int = 0  # number of images whose size was looked up: at most 100, evenly spaced
    # (height, width) at which most images are processed; None if that is the size of the files
    working_hw: tuple[int, int] | None = None


def capture_facts(summary: RunSummary, values: StoredValues, *, panoramas: int) -> CaptureFacts:
    """Return what is known of the capture of a run; `panoramas` is its number of images."""
    names = list(values.refs.get("images", {}))
    known = [values.panorama(name) for name in names[:: -(-len(names) // 100) or 1]]
    found = [panorama for panorama in known if panorama is not None]
    sizes = Counter(panorama.source_size_hw for panorama in found)
    working = Counter(panorama.size_hw for panorama in found).most_common(1)
    same = bool(found) and all(panorama.size_hw == panorama.source_size_hw for panorama in found)
    return CaptureFacts(
        capture_name(summary),
        date_in_words(summary.started),
        panoramas,
        tuple(sizes.most_common(4)),
        len(found),
        working[0][0] if working and not same else None,
    )


def capture_name(summary: RunSummary) -> str:
    """Return the name of the folder or video with the images, else that of the workflow.

    >>> stages = [{"name": "images", "use": "source.folder", "params": {"path": "/tours/old mill/images"}}]
    >>> capture_name(RunSummary.from_json({"stages": stages}))
    'old mill / images'
    """
    folder = summary.source_folder
    path = PurePath(folder) if folder is not None else PurePath()
    if not path.name:
        return summary.workflow.name
    parent = path.parent.name
    return f"{parent} / {path.name}" if parent and path.name.lower() in _GENERIC else path.name


def date_in_words(started: str) -> str:
    """Return a date and time of ISO 8601 in words; other texts as they are.

    >>> date_in_words("2026-11-02T18:10:03+00:00")
    '2 Nov 2026, 18:10 UTC'
    """
    try:
        when = datetime.fromisoformat(started)
    except ValueError:
        return started
    zone = " UTC" if when.tzinfo is not None else ""
    when = when.astimezone(UTC) if zone else when
    return f"{when.day} {_MONTHS[when.month - 1]} {when.year}, {when:%H:%M}{zone}"


MAX_THUMBNAILS = 1000
MAX_BYTES = 6_000
_VERSION = 2


def thumbnails(
    out_dir: Path, views: Sequence[ViewSummary], results: StoredValues, *, kept: EarlierPage
) -> dict[str, Picture]:
    """Return small images of at most 1,000 evenly spaced views, by name."""
    chosen = evenly_spaced(views, MAX_THUMBNAILS)
    with ThreadPoolExecutor(2) as pool:
        found = pool.map(lambda view: _thumbnail(out_dir, view, results, kept=kept), chosen)
        return {view.name: small for view, small in zip(chosen, found, strict=True) if small is not None}


def measured_shares(views: Sequence[ViewSummary], results: StoredValues, kept: EarlierPage) -> dict[str, Shares]:
    """Return the shares of the sphere of at most 1,000 evenly spaced views, by name; the sky does not count."""
    found: dict[str, Shares] = {}
    for view in evenly_spaced(views, 1000):
        name = view.name
        key = key_of(results, name, "s", version=_VERSION)
        fact = kept.fact(key) if key else None
        shares = Shares(*fact) if fact else None
        if shares is None and key:
            confidence = results.confidence(name)
            sky = results.sky(name)
            shares = shares_of(confidence, None if sky is None else ~sky) if confidence is not None else None
            if shares is not None:
                kept.keep(key, astuple(shares))
        if shares is not None:
            found[name] = shares
    return found


def _thumbnail(out_dir: Path, view: ViewSummary, results: StoredValues, *, kept: EarlierPage) -> Picture | None:
    key = key_of(results, view.name, "t", version=_VERSION)
    known = kept.picture(key) if key else None
    if known is not None:
        return known
    panels = preview_panels(out_dir, view.preview, small=True)
    return picture(np.vstack(panels), width=160, most_bytes=MAX_BYTES, key=key) if panels else None


@dataclass(frozen=True)
class Row:
    """One panorama."""

    name: str
    registered: bool | None  # whether it has a pose; None if no stage computed poses
    reason: str  # why it was left out, or ""
    doubtful: str  # why its pose is doubtful, or ""
    p_right: float | None  # the probability that its pose is right, or None
    shares: Shares | None  # of the sphere around it, if measured
    completeness: float | None  # share of pixels with a range, as its stage reported it, or None
    consistent: float | None  # share of pixels on which other views agree, likewise
    links: int  # number of images with which it has a common geometry
    residual_deg: float | None  # median reprojection residual, or None
    p95_deg: float | None  # 95 % of its residuals are smaller, or None
    thumbnail: Picture | None  # its preview, or None
    group: int | None = None  # number of its group; None if there is only one group

    @property
    def doubt(self) -> float:
        """Sort key, largest first: panoramas left out, doubtful ones, then those with the smallest shares.

        Doubtful ones are sorted by the probability of their poses.
        """
        if self.reason or self.doubtful:
            return 5.0 if self.reason else round(4.0 - (self.p_right or 0.0), 4)
        known = (self.completeness or 0.0) + (self.consistent or 0.0)
        return round(2.0 - known, 4)


def panorama_rows(
    summary: RunSummary,
    *,
    shares: Mapping[str, Shares],
    residuals: Residuals | None,
    thumbnails: Mapping[str, Picture],
) -> tuple[Row, ...]:
    """Return at most 5,000 rows in the order of the capture, followed by images that were left out."""
    poses = summary.poses
    registered = set(poses.registered)
    rejected = {name: rejection.reason for name, rejection in summary.rejected.items()} | dict(poses.rejected)
    figures = {view.name: view for view in summary.views}
    links = Counter(name for link in poses.links if link.inliers for name in link[:2])
    group_of = {name: number for number, group in enumerate(poses.groups) for name in group.images if poses.groups[1:]}
    doubts = summary.doubtful_images
    order = [*poses.registered, *figures, *poses.rejected, *summary.rejected, *doubts]
    rows = []
    for name in list(dict.fromkeys(order))[:5000]:
        median, p95, _ = (residuals.views.get(name) if residuals else None) or (None, None, 0)
        view = figures.get(name, ViewSummary())
        rows.append(
            Row(
                name,
                name in registered if poses else None,
                rejected.get(name, ""),
                doubts.get(name, ""),
                poses.p_right.get(name),
                shares.get(name),
                view.completeness,
                view.consistent,
                links[name],
                median,
                p95,
                thumbnails.get(name),
                group_of.get(name),
            )
        )
    return tuple(rows)


@dataclass(frozen=True, slots=True)
class StageGroupRow:
    """What a group of stages did, or a stage that is in none."""

    name: str
    stages: tuple[str, ...]  # its stages; empty for a stage in no group
    counts: UnitCounts  # sums over its stages
    units: int
    work_s: float | None  # sum over its computed units; None if a stage does not state it


def stage_groups(stages: Sequence[StageOutcome]) -> tuple[StageGroupRow, ...]:
    """Return a row for each group of stages, and for each stage that is in none; empty if there are no groups."""
    members: dict[tuple[str, str], list[StageOutcome]] = {}
    for stage in stages:
        members.setdefault((stage.group, "" if stage.group else stage.name), []).append(stage)
    if not any(group for group, _ in members):
        return ()
    return tuple(
        StageGroupRow(
            group or name,
            tuple(stage.name for stage in own) if group else (),
            UnitCounts(**{field: sum(getattr(stage, field) for stage in own) for field in UnitCounts.model_fields}),
            sum(stage.units for stage in own),
            None if any(stage.unit_seconds is None for stage in own) else sum(stage.unit_seconds or 0 for stage in own),
        )
        for (group, name), own in members.items()
    )


@dataclass(frozen=True)
class Content:
    """The content of the page."""

    capture: CaptureFacts  # what the report is about
    verdict: Verdict  # the head of the page
    advice: tuple[Suggestion, ...]  # what to do next time, the most urgent first
    groups: tuple[PosesSummary, ...]  # the poses of each group of cameras, the largest first
    maps: tuple[tuple[CameraMap, ...], ...]  # the cameras of each group, from above and from the side
    metric: frozenset[str]  # images whose ranges are in metres
    # (first, second, candidates or None, reason) of pairs without a common geometry
    rejected_pairs: tuple[tuple[str, str, int | None, str], ...]
    pairs: int  # number of compared pairs
    cloud: CloudPictures  # pictures of the cloud
    turnable: TurnableCloud | None  # the cloud for the viewer in the page; None if there is none
    cards: tuple[ViewCard, ...]  # views shown in full
    total_views: int
    masked: MaskedAreas  # what is masked in the panoramas
    rows: tuple[Row, ...]  # one for each panorama
    total_rows: int
    mean_shares: Shares | None  # of the sphere, over all measured views
    measured_views: int  # number of these
    residuals: Residuals | None  # of the points
    pair_residuals: Histogram | None  # medians of the pairs' residuals
    scores: tuple[tuple[str, Mapping[str, Any]], ...]  # (stage, tables) of each branch with scores
    comparison: Mapping[str, Any]  # the medians of several branches side by side
    notes: tuple[str, ...]  # what could not be shown
    facts: Mapping[str, Any]  # figures that the next page may reuse


def gather(out_dir: Path, summary: RunSummary, values: StoredValues, *, earlier: EarlierPage) -> Content:
    """Return the content of the page; missing or damaged values are left out and named in the notes."""
    poses, views = summary.poses, summary.views
    groups = poses.by_group()
    rejected_pairs = _rejected_pairs(poses.links, values)
    reasons = {(first, second): why for first, second, _, why in rejected_pairs}
    record = values.poses
    residuals = reprojection_residuals(record) if record is not None else None
    chosen = [views[idx] for idx in chosen_views(views, always=poses.doubts)]
    group_of = {name: number for number, group in enumerate(groups) for name in group.registered}
    cards = view_cards(out_dir, chosen, values, kept=earlier, groups=group_of)
    shares = measured_shares(views, values, earlier) | {card.name: card.shares for card in cards if card.shares}
    rows = panorama_rows(
        summary, shares=shares, residuals=residuals, thumbnails=thumbnails(out_dir, views, values, kept=earlier)
    )
    scores = tuple(
        (stage, score_tables(scored))
        for stage, scored in summary.scores_by_stage.items()
        # else there is nothing to say but that nobody has a ground truth
        if scored.poses or scored.views or not set(scored.notes) <= {NO_TRUTH}
    )
    total_rows = len({*poses.registered, *(view.name for view in views), *poses.rejected, *summary.rejected})
    judged = summary.model_copy(update={"views": tuple(_judged(view, shares) for view in views)})
    advised = advice(judged, values, earlier, chosen=[view.name for view in chosen])
    marked = advised[:MAX_SUGGESTIONS]
    return Content(
        capture=capture_facts(summary, values, panoramas=total_rows or len(values.refs.get("images", {}))),
        verdict=verdict(judged, residuals=residuals, image_width=_image_width(values)),
        advice=advised,
        groups=groups,
        maps=tuple(camera_maps(group, reasons, marks=marks_of(marked, number)) for number, group in enumerate(groups)),
        metric=frozenset(name for group in groups if group.metric for name in group.registered),
        rejected_pairs=rejected_pairs,
        pairs=len(poses.links),
        cloud=cloud_pictures(values, earlier, up=up_of(poses)),
        turnable=turnable_cloud(values, groups[0], earlier, up=up_of(poses)),
        cards=cards,
        total_views=len(views),
        masked=masked_areas(values, earlier),
        rows=rows,
        total_rows=total_rows,
        mean_shares=Shares(*np.mean([astuple(own) for own in shares.values()], axis=0).tolist()) if shares else None,
        measured_views=len(shares),
        residuals=residuals,
        pair_residuals=histogram([link.residual_deg for link in poses.links if link.residual_deg is not None]),
        scores=scores,
        comparison=side_by_side(scores),
        notes=tuple(sorted(set(values.notes))),
        facts=earlier.signed_facts(),
    )


def _rejected_pairs(links: Sequence[PairLink], values: StoredValues) -> tuple[tuple[str, str, int | None, str], ...]:
    """Return the pairs without inliers, those with the most candidates first, with reasons for the first 300."""
    rejected = sorted((link for link in links if not link.inliers), key=lambda link: -(link.candidates or 0))
    return tuple(
        (
            link.first,
            link.second,
            link.candidates,
            values.pair_reason(pair_name(link.first, link.second)) if idx < 300 else "",
        )
        for idx, link in enumerate(rejected)
    )


def _judged(view: ViewSummary, shares: Mapping[str, Shares]) -> ViewSummary:
    """Return a view with its shares of the unmasked sphere, if measured, instead of its shares of pixels."""
    own = shares.get(view.name)
    if own is None:
        return view
    measured = {"completeness": own.complete, "consistent": own.confirmed}
    return view.model_copy(update={"metrics": {**view.metrics, **measured}})


def _image_width(values: StoredValues) -> int | None:
    for name in values.refs.get("images", {}):
        panorama = values.panorama(name)
        return panorama.size_hw[1] if panorama is not None else None
    return None
