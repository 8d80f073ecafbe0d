"""What run.json and the report say of a run."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from math import isfinite
from pathlib import PurePosixPath
from typing import Any

import numpy as np

import pano_mvs
from pano_mvs.core.paths import resolved
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.running.events import RunResult, StageSummary
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import Workflow
from pano_mvs.scene import Axis, Panorama, PointCloud, Poses, RangeMap, Record, Scores, TwoView
from pano_mvs.scene.index import pair_from_name
from pano_mvs.scene.pose_groups import split_groups

_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "pycolmap", "pyvista", "scipy")
_ROLES: Mapping[str, type[Record]] = {"images": Panorama, "pairs": TwoView, "poses": Poses, "ranges": RangeMap,
                                      "cloud": PointCloud}  # fmt: skip


def summarise(run: Run, result: RunResult, *, started: datetime, seconds: float) -> dict[str, Any]:
    """Return everything that run.json and the report say, as plain JSON values."""
    workflow = run.workflow
    scores = _scores(run)
    return {
        "workflow": {"name": workflow.name, "path": str(workflow.path or ""), "overrides": list(workflow.overrides)},
        "cache": str(resolved(run.store.root)),
        "version": pano_mvs.__version__,
        "started": started.isoformat(timespec="seconds"),
        "machine": _machine(),
        "executor": {"name": run.executor.name, "workers": run.executor.capacity, "threads": run.executor.threads},
        "seconds": round(seconds, 3),
        "exit_code": result.exit_code,
        "stopped": result.stopped,
        "units": {
            "run": result.computed,
            "cached": result.cached,
            "failed": sum(stage.failed for stage in result.stages),
            "blocked": sum(stage.blocked for stage in result.stages),
        },
        "stages": [_stage(summary, workflow) for summary in result.stages],
        "failures": [
            {
                "stage": f.stage,
                "item": f.item,
                "cause": f.cause,
                "consequence": f.consequence,
                "trace": f.trace,
                "log": f.log,
            }
            for f in result.failures
            if not f.blocked
        ],
        "blocked": [{"stage": f.stage, "item": f.item, "cause": f.cause} for f in result.failures if f.blocked],
        "rejected": {image: {"stage": stage, "reason": why} for image, (stage, why) in result.rejected.items()},
        "doubts": {image: {"stage": stage, "reason": why} for image, (stage, why) in result.doubts.items()},
        "warnings": list(result.warnings),
        "notes": [note for summary in result.stages for note in summary.notes],
        "results": _result_stages(run),
        "poses": _poses(run, result),
        "scores": next(iter(scores.values()), {}),
        "all_scores": scores if len(scores) > 1 else {},
        "views": _views(run, result),
        "cloud": _cloud(run, result),
        "workflow_text": workflow.text,
        "versions": _versions(),
        "files": dict(sorted(result.published.items())),
        "left_over": dict(sorted(result.left_over.items())),
    }


def chain_of(workflow: Workflow, graph: Graph, kind: type[Record]) -> list[str]:
    """Return the stages that make a kind one from the other, beginning with the first of the workflow.

    What does not come from the first, such as a second sweep beside it, is another branch and not in the chain.
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


def latest(run: Run, kind: type[Record]) -> Record | None:
    """Return the value of the last stage, of the first chain, that made a whole value of a kind in this run."""
    for name in reversed(chain_of(run.workflow, run.graph, kind)):
        value = run.load(name, kind)
        if value is not None:
            return value
    return None


def _stage(summary: StageSummary, workflow: Workflow) -> dict[str, Any]:
    return {
        "name": summary.name,
        "use": summary.use,
        "version": workflow.stages[summary.name].spec.version,
        "params": workflow.stages[summary.name].params.model_dump(mode="json"),
        "units": summary.units,
        "run": summary.run,
        "cached": summary.cached,
        "failed": summary.failed,
        "blocked": summary.blocked,
        "seconds": round(summary.seconds, 3),
        "unit_seconds": round(summary.unit_seconds, 3),
        "metrics": summary.metrics,
    }


def _last_stage_of(run: Run, result: RunResult, kind: type[Record]) -> StageSummary | None:
    chain = chain_of(run.workflow, run.graph, kind)
    return next((summary for summary in reversed(result.stages) if summary.name in chain), None)


def _poses(run: Run, result: RunResult) -> dict[str, Any]:
    poses = latest(run, Poses)
    if not isinstance(poses, Poses):
        return {}
    links = []
    for stage in result.stages:
        if issubclass(run.workflow.stages[stage.name].spec.output, TwoView):
            links = [_link(pair, metrics) for pair, metrics in stage.unit_metrics.items()]
    groups = split_groups(poses)
    return {
        "registered": list(poses.names),
        "blocked": [{"stage": f.stage, "item": f.item, "cause": f.cause} for f in result.failures if f.blocked],
        "rejected": {image: why for image, (_, why) in result.rejected.items()},
        "doubts": {image: result.doubts[image][1] for image in poses.names if image in result.doubts},
        "confirmed": _confirmed(poses),
        "centers": poses.centers.tolist(),
        "points": len(poses.points_in_world),
        "frame": poses.frame,
        "scale": poses.scale,
        "metric": poses.metric,
        "up": _up(groups[0]),
        "groups": [
            {
                "images": list(group.names),
                "frame": group.frame,
                "scale": group.scale,
                "metric": group.metric,
                "points": len(group.points_in_world),
                "up": _up(group),
                "nearest_pair": nearest_pair(groups[0].names, group.names, links) if number else None,
            }
            for number, group in enumerate(groups)
        ],
        "links": links,
    }


def _confirmed(poses: Poses) -> dict[str, list[float | None]]:
    """Return the confirmed and the expected share of each image for which one is known; None where one is not."""
    if poses.confirmed_shares is None or poses.expected_shares is None:
        return {}
    pairs = zip(poses.confirmed_shares.tolist(), poses.expected_shares.tolist(), strict=True)
    shares = {name: [round(v, 4) if isfinite(v) else None for v in pair]
              for name, pair in zip(poses.names, pairs, strict=True)}  # fmt: skip
    return {name: pair for name, pair in shares.items() if pair[0] is not None}


def nearest_pair(largest: Sequence[str], other: Sequence[str], links: Sequence[Sequence[Any]]) -> list[Any] | None:
    """Return the pair that comes closest to joining two groups: that with most matches, or else most candidates.

    Args:
        largest: images of the largest group.
        other: images of another one.
        links: of run.json: both images, the inliers, and the candidates where they are known.

    Returns:
        The image of the largest group, that of the other one, the matches and the candidates; None where no pair of
        them was compared.
    """
    inside, outside = set(largest), set(other)
    found = []
    for first, second, inliers, *more in links:
        for a, b in ((first, second), (second, first)):
            if a in inside and b in outside:
                found.append((-int(inliers), -int((more[0] if more else None) or 0), str(a), str(b)))
    if not found:
        return None
    matches, candidates, a, b = min(found)
    return [a, b, -matches, -candidates]


def _link(pair: str, metrics: Mapping[str, float]) -> list[Any]:
    """Return both images, the inliers (0: rejected), and the candidates and the residual where they are known."""
    candidates, residual_deg = metrics.get("candidates"), metrics.get("residual_deg")
    return [*pair_from_name(pair), int(metrics.get("inliers", 0)), None if candidates is None else int(candidates),
            None if residual_deg is None else round(residual_deg, 5)]  # fmt: skip


def _up(poses: Poses) -> list[float] | None:
    """Return the mean of the cameras' up directions in the world, None if they point everywhere."""
    mean = -np.asarray(poses.rotations)[:, 1].sum(axis=0) / max(1, len(poses.names))
    length = float(np.linalg.norm(mean))
    return [round(float(part) / length, 6) for part in mean] if length > 0.1 else None


def _result_stages(run: Run) -> dict[str, str]:
    """Return which stage made what the report shows: the last one, of the first chain, that made anything.

    Where a run did not get to its end, a stage that had hardly begun does not hide what the one before had made.
    """
    found: dict[str, str] = {}
    for role, kind in _ROLES.items():
        chain = chain_of(run.workflow, run.graph, kind)
        made = {name: len(run.states[name].items) for name in chain if name in run.states and run.states[name].items}
        least = max(made.values(), default=0) / 2 if run.result.stopped else 0
        if names := [name for name, count in made.items() if count >= least]:
            found[role] = names[-1]
    return found


def _scores(run: Run) -> dict[str, Any]:
    """Return the scores by stage: one, or one for each branch that has some."""
    found: dict[str, Any] = {}
    for name in run.graph.order:
        if issubclass(run.workflow.stages[name].spec.output, Scores):
            scores = run.load(name, Scores)
            if isinstance(scores, Scores):
                found[name] = {"poses": scores.poses, "views": scores.views, "notes": list(scores.notes)}
    return found


def _views(run: Run, result: RunResult) -> list[dict[str, Any]]:
    name = _result_stages(run).get("ranges")
    stage = next((summary for summary in result.stages if summary.name == name), None)
    if stage is None or run.states[stage.name].axis is not Axis.VIEW:
        return []
    previews: dict[str, str] = {}
    for path in result.published:
        _, folder, name = f"/{path}".rpartition("/preview/")
        if folder:
            previews.setdefault(str(PurePosixPath(name).with_suffix("")), path)
    return [
        {"name": item, "preview": previews.get(str(PurePosixPath(item).with_suffix("")), previews.get(item, ""))}
        | _rounded(stage.unit_metrics.get(item, {}))
        for item in run.states[stage.name].items
    ]


def _cloud(run: Run, result: RunResult) -> dict[str, Any]:
    stage = _last_stage_of(run, result, PointCloud)
    if stage is None or "points" not in stage.metrics:
        return {}
    return {"points": int(stage.metrics["points"])}


def _rounded(metrics: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in metrics.items()}


def _machine() -> dict[str, Any]:
    """Return what a run's times depend on."""
    found: dict[str, Any] = {"processor": platform.machine(), "cores": available_threads()}
    with suppress(AttributeError, ValueError, OSError):  # not every system tells
        found["memory_gb"] = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    return found


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "pano_mvs": pano_mvs.__version__, "system": platform.platform()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
