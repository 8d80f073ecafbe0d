"""Create the summary of a run from the result of the engine."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from math import isfinite
from pathlib import PurePosixPath
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

import pano_mvs
from pano_mvs.algorithms.points.plan_grid import find_storeys
from pano_mvs.core.extras import installed_version
from pano_mvs.core.paths import resolved
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.running.events import StageSummary
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import Workflow
from pano_mvs.results.records import (
    BlockedUnit,
    CloudSummary,
    Direction,
    FailedUnit,
    ImageReason,
    NearestPair,
    PairLink,
    PoseGroup,
    PosesSummary,
    ScoresSummary,
    StageOutcome,
    UnitCounts,
    ViewSummary,
    WorkflowSummary,
)
from pano_mvs.results.stored_values import ROLES
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import Axis, PointCloud, Poses, Record, Scores, TwoView, TwoViews
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.upright import mean_up_direction, world_up, z_up_from_world

_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "pycolmap", "pyvista", "scipy")


def summarise(run: Run, poses: Poses | None, *, started: datetime, seconds: float) -> RunSummary:
    """Return the summary of a run, finished or not, without a verdict.

    Args:
        run: after `execute`, also if it raised.
        poses: its cameras as they are judged in the end; None without any.
    """
    workflow, result = run.workflow, run.result
    scores = _scores(run)
    blocked = tuple(
        BlockedUnit(stage=failure.stage, item=failure.item, cause=failure.cause) for failure in result.blocked
    )
    results = final_stages(run)
    posed = _poses(run, poses, blocked)
    return RunSummary(
        workflow=WorkflowSummary(
            name=workflow.name,
            path=str(resolved(workflow.path)) if workflow.path is not None else "",
            overrides=tuple(workflow.overrides),
        ),
        cache=str(resolved(run.store.root)),
        version=pano_mvs.__version__,
        started=started.isoformat(timespec="seconds"),
        machine=_machine(),
        executor={"name": run.executor.name, "workers": run.executor.capacity, "threads": run.executor.threads},
        seconds=round(seconds, 3),
        exit_code=result.exit_code,
        stopped=result.stopped,
        units=UnitCounts(**result.units),
        stages=tuple(_stage(summary, workflow) for summary in result.stages),
        failures=tuple(
            FailedUnit(**{name: getattr(failure, name) for name in FailedUnit.model_fields})
            for failure in result.failures
        ),
        blocked=blocked,
        rejected=_reasons(result.rejected),
        doubts=_reasons(result.doubts),
        warnings=tuple(result.warnings),
        # Two stages that did the same, such as solvers before and after learned matches, note the same.
        notes=(*dict.fromkeys(note for summary in result.stages for note in summary.notes), *_scale_notes(posed)),
        results=results,
        poses=posed,
        scores=next(iter(scores.values()), ScoresSummary()),
        all_scores=scores if len(scores) > 1 else {},
        views=_views(run, results.get("ranges", "")),
        cloud=_cloud(run),
        workflow_text=workflow.text,
        versions={
            "python": platform.python_version(),
            "pano_mvs": pano_mvs.__version__,
            "system": platform.platform(),
            **{name: installed_version(name) or "not installed" for name in _LIBRARIES},
        },
        files=dict(sorted(result.published.items())),
        left_over=dict(sorted(result.left_over.items())),
        inputs=run.listing.digests(),
    )


def _stage(summary: StageSummary, workflow: Workflow) -> StageOutcome:
    entry = workflow.stages[summary.stage]
    same = ("use", "units", "run", "cached", "failed", "blocked", "metrics")
    return StageOutcome(
        **{name: getattr(summary, name) for name in same},
        name=summary.stage,
        group=entry.group,
        version=entry.spec.version,
        params=entry.params.model_dump(mode="json"),
        seconds=round(summary.seconds, 3),
        unit_seconds=round(summary.unit_seconds, 3),
    )


def _reasons(found: Mapping[str, tuple[str, str]]) -> dict[str, ImageReason]:
    return {image: ImageReason(stage=stage, reason=reason) for image, (stage, reason) in found.items()}


def _poses(run: Run, poses: Poses | None, blocked: tuple[BlockedUnit, ...]) -> PosesSummary:
    result = run.result
    if poses is None:
        return PosesSummary()
    cloud = latest(run, PointCloud)
    clouds = [] if cloud is None else cloud.groups()
    found = {number: camera_height(*pair) for number, pair in enumerate(zip(split_groups(poses), clouds, strict=False))}
    return poses_summary(
        poses,
        blocked=blocked,
        rejected={image: why for image, (_, why) in result.rejected.items()},
        doubts={image: result.doubts[image][1] for image in poses.names if image in result.doubts},
        links=_links(run),
        heights={number: float(f"{height:.4g}") for number, height in found.items() if height is not None},
    )


def _links(run: Run) -> tuple[PairLink, ...]:
    """Return the pairs that were matched, with what later stages that judge all pairs found."""
    matched: dict[tuple[str, ...], Mapping[str, float]] = {}
    for stage in run.result.stages:
        if issubclass(run.workflow.stages[stage.stage].spec.output, TwoView):
            images = run.states[stage.stage].members
            matched |= {images[pair]: metrics for pair, metrics in stage.unit_metrics.items()}
    views = latest(run, TwoViews)
    return pair_links(matched, {} if views is None else views.views)


def pair_links(
    matched: Mapping[tuple[str, ...], Mapping[str, float]], later: Mapping[tuple[str, str], TwoView]
) -> tuple[PairLink, ...]:
    """Return the pairs of a capture.

    Args:
        matched: pairs that a matcher compared to the figures that it stated.
        later: the geometries of all pairs after stages that judge them together. They replace what a matcher rejected.
    """
    links = {images: _link(images, metrics) for images, metrics in matched.items()}
    for pair, view in later.items():
        if view and not (pair in links and links[pair].inliers):
            links[pair] = PairLink(*pair, len(view), view.candidates, round(view.residual_deg, 5))
    return tuple(links.values())


def poses_summary(
    poses: Poses,
    *,
    rejected: Mapping[str, str],
    doubts: Mapping[str, str],
    links: tuple[PairLink, ...],
    blocked: tuple[BlockedUnit, ...] = (),
    heights: Mapping[int, float] | None = None,
) -> PosesSummary:
    """Return the summary of poses.

    Args:
        heights: group to the height of its cameras above the floor, where it is known.
    """
    groups = split_groups(poses)
    return PosesSummary(
        registered=tuple(poses.names),
        blocked=blocked,
        rejected=rejected,
        doubts=doubts,
        confirmed=_confirmed(poses),
        evidence={
            name: {key: value if value is None else float(f"{value:.4g}") for key, value in row.items()}
            for name, row in poses.evidence.items()
        },
        p_right=_probabilities(poses),
        centers=poses.centers.tolist(),
        points=len(poses.points_in_world),
        **poses.worlds[0]._asdict(),
        up=_up(groups[0]),
        groups=tuple(
            PoseGroup(
                images=tuple(group.names),
                **group.worlds[0]._asdict(),
                points=len(group.points_in_world),
                up=_up(group),
                z_up_from_world=tuple((float(x), float(y), float(z)) for x, y, z in z_up_from_world(world_up(group))),
                camera_height=(heights or {}).get(number),
                nearest_pair=nearest_pair(groups[0].names, group.names, links) if number else None,
            )
            for number, group in enumerate(groups)
        ),
        links=links,
    )


def _confirmed(poses: Poses) -> dict[str, tuple[float | None, float | None]]:
    """Return the confirmed and the expected share of each image; None if unknown."""
    if poses.confirmed_shares is None or poses.expected_shares is None:
        return {}
    columns = zip(poses.names, poses.confirmed_shares.tolist(), poses.expected_shares.tolist(), strict=True)
    shares = {name: (_rounded_share(confirmed), _rounded_share(expected)) for name, confirmed, expected in columns}
    return {name: pair for name, pair in shares.items() if pair[0] is not None}


def _probabilities(poses: Poses) -> dict[str, float | None]:
    """Return the probability that each pose is right; None if nothing was measured about it."""
    if poses.right_probabilities is None:
        return {}
    columns = zip(poses.names, poses.right_probabilities.tolist(), strict=True)
    return {name: _rounded_share(probability) for name, probability in columns}


def _rounded_share(share: float) -> float | None:
    return round(share, 4) if isfinite(share) else None


def nearest_pair(largest: Sequence[str], other: Sequence[str], links: Sequence[PairLink]) -> NearestPair | None:
    """Return the pair that comes closest to connecting two groups: that with the most matches, then candidates.

    Args:
        largest: images of the largest group.
        other: images of another one.

    Returns:
        The pair; None if no image of one group was compared with one of the other.
    """
    inside, outside = set(largest), set(other)
    found = []
    for link in links:
        for a, b in ((link.first, link.second), (link.second, link.first)):
            if a in inside and b in outside:
                found.append((-link.inliers, -(link.candidates or 0), a, b))
    if not found:
        return None
    matches, candidates, a, b = min(found)
    return NearestPair(a, b, -matches, -candidates)


def _link(images: tuple[str, ...], metrics: Mapping[str, float]) -> PairLink:
    candidates, residual_deg = metrics.get("candidates"), metrics.get("residual_deg")
    first, second = images
    return PairLink(
        first,
        second,
        int(metrics.get("inliers", 0)),
        None if candidates is None else int(candidates),
        None if residual_deg is None else round(residual_deg, 5),
    )


def _up(poses: Poses) -> Direction | None:
    """Return the mean of the cameras' up directions in the world, rounded; None if they do not agree."""
    up = mean_up_direction(poses.rotations)
    if up is None:
        return None
    x, y, z = (round(float(value), 6) for value in up)
    return x, y, z


def _scale_notes(poses: PosesSummary) -> tuple[str, ...]:
    """Return what to say about the unit of the largest group: nothing if it is the metre or no floor is known."""
    height = poses.groups[0].camera_height if poses.groups else None
    return () if height is None or poses.metric else (height_note(height),)


def _scores(run: Run) -> dict[str, ScoresSummary]:
    """Return the scores of each branch, by stage."""
    found = {}
    for name in run.graph.order:
        if issubclass(run.workflow.stages[name].spec.output, Scores):
            scores = run.load(name, Scores)
            if isinstance(scores, Scores):
                found[name] = ScoresSummary(poses=scores.poses, views=scores.views, notes=scores.notes)
    return found


def _views(run: Run, stage_name: str) -> tuple[ViewSummary, ...]:
    stage = next((summary for summary in run.result.stages if summary.stage == stage_name), None)
    if stage is None or run.states[stage.stage].axis is not Axis.VIEW:
        return ()
    previews: dict[str, str] = {}
    for path in run.result.published:
        _, folder, name = f"/{path}".rpartition("/preview/")
        if folder:
            previews.setdefault(str(PurePosixPath(name).with_suffix("")), path)
    return tuple(
        ViewSummary(
            name=item,
            preview=previews.get(str(PurePosixPath(item).with_suffix("")), previews.get(item, "")),
            metrics={name: round(value, 6) for name, value in stage.unit_metrics.get(item, {}).items()},
        )
        for item in run.states[stage.stage].items
    )


def _cloud(run: Run) -> CloudSummary:
    chain = chain_of(run.workflow, run.graph, PointCloud)
    stage = next((summary for summary in reversed(run.result.stages) if summary.stage in chain), None)
    points = stage.metrics.get("points") if stage else None
    return CloudSummary(points=None if points is None else int(points))


def _machine() -> dict[str, Any]:
    """Return the properties of the machine on which run times depend."""
    found: dict[str, Any] = {"processor": platform.machine(), "cores": available_threads()}
    with suppress(AttributeError, ValueError, OSError):  # not on every system
        found["memory_gb"] = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    return found


PLAUSIBLE_HEIGHT_M = 1.6  # a usual height of a camera on a tripod or a stick
_BLOCKS, _BLOCK_POINTS = 300, 1000


def camera_height(poses: Poses, cloud: PointCloud) -> float | None:
    """Return the median height of the cameras above their floor, in scene units; None if no floor was found.

    With several storeys, it is the height on the one with the most cameras.

    Args:
        poses: of one group.
        cloud: of the same group.
    """
    if not poses.names or len(cloud) < 1000:
        return None
    turn = z_up_from_world(world_up(poses))
    chosen = _sample(len(cloud))
    heights = cloud.points_in_world[chosen].astype(np.float64) @ turn[2]
    ups = cloud.normals_in_world[chosen].astype(np.float64) @ turn[2]
    centers = poses.centers @ turn[2]
    storeys = [storey for storey in find_storeys(heights, ups, centers) if storey.has_floor]
    if not storeys:
        return None
    largest = max(storeys, key=lambda storey: len(storey.cameras))
    height = float(np.median(centers[list(largest.cameras)])) - largest.floor
    return height if height > 0 else None


def _sample(count: int) -> NDArray[np.intp] | slice:
    """Return evenly spaced blocks of points, so that little of a memory-mapped cloud is read."""
    if count <= _BLOCKS * _BLOCK_POINTS:
        return slice(None)
    starts = np.linspace(0, count - _BLOCK_POINTS, _BLOCKS).astype(np.intp)
    return np.asarray(starts[:, None] + np.arange(_BLOCK_POINTS), np.intp).ravel()


def height_note(height: float) -> str:
    """Return what a run says about its unit if nothing states the scale."""
    return (
        f"lengths are in scene units: the cameras are {height:.3g} units above the floor. If that was "
        f"{PLAUSIBLE_HEIGHT_M:g} m, one unit is {PLAUSIBLE_HEIGHT_M / height:.3g} m. To use metres, measure a distance "
        "or a height: pano-mvs scale --help"
    )


_Kind = TypeVar("_Kind", bound=Record)


def chain_of(workflow: Workflow, graph: Graph, kind: type[Record]) -> list[str]:
    """Return the chain of stages that produce a kind of value from one another, starting with the first.

    A stage that does not depend on the first, such as a second sweep beside it, is on another branch and not included.
    """
    makers = [name for name in graph.order if issubclass(workflow.stages[name].spec.output, kind)]
    above: dict[str, set[str]] = {}
    for name in graph.order:
        feeding = {edge.producer for edge in graph.edges[name].values()}
        above[name] = feeding.union(*(above[producer] for producer in feeding))
    chain = makers[:1]
    for name in makers[1:]:
        if chain[-1] in above[name]:
            chain.append(name)
    return chain


def latest(run: Run, kind: type[_Kind]) -> _Kind | None:
    """Return the value of a kind from the last stage of the first chain that produced one, or None."""
    for name in reversed(chain_of(run.workflow, run.graph, kind)):
        value = run.load(name, kind)
        if isinstance(value, kind):
            return value
    return None


def final_stages(run: Run) -> dict[str, str]:
    """Return role (see `ROLES`) to the stage that made the final values: the last of the first chain with any.

    If the run ended early, a stage that had hardly begun does not replace the one before it.
    """
    found: dict[str, str] = {}
    for role, kind in ROLES.items():
        chain = chain_of(run.workflow, run.graph, kind)
        made = {name: len(run.states[name].items) for name in chain if name in run.states and run.states[name].items}
        least = max(made.values(), default=0) / 2 if run.result.stopped else 0
        if names := [name for name, count in made.items() if count >= least]:
            found[role] = names[-1]
    return found
