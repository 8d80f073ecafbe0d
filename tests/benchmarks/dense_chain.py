"""The dense part of a workflow, run in memory on poses that are given: what the benchmarks of depth measure.

Of a workflow the stages that produce something for each view are run (sweeps and filters, whatever they are called),
wired as the file says; pictures and poses come from the caller in place of the stages before them.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.stage import INDEX_PORT, Cardinality, Port
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.scene import Axis, Panorama, Pose, Poses, RangeMap, Record, Views
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE
from pano_mvs.scene.structure import Structure
from pano_mvs.session.session import open_session
from tests.benchmarks.captures import Capture
from tests.benchmarks.depth_metrics import DepthMetrics, depth_metrics


@dataclass
class DenseRun:
    """What the dense stages made of a capture.

    Attributes:
        results: stage name to image name to what it made; in order.
        cpu_s: stage name to CPU seconds, all views together.
    """

    results: dict[str, dict[str, Record]] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)

    @property
    def range_maps(self) -> dict[str, dict[str, RangeMap]]:
        """The stages that made range maps, in order."""
        maps: dict[str, dict[str, RangeMap]] = {}
        for name, items in self.results.items():
            found = {image: item for image, item in items.items() if isinstance(item, RangeMap)}
            if found:
                maps[name] = found
        return maps


class DenseChain:
    """The dense stages of a workflow, ready to run on captures."""

    def __init__(self, workflow: str, *, overrides: Sequence[str] = ()) -> None:
        session = open_session(workflow, overrides=overrides)
        self.stages: Mapping[str, StageEntry] = session.workflow.stages
        self.graph: Graph = session.graph
        self.dense = [
            name
            for name in self.graph.order
            if self.graph.axes[name] is Axis.VIEW and self.stages[name].spec.output.axis is Axis.VIEW
        ]

    def run(self, capture: Capture, *, poses: Poses | None = None, references: Sequence[str] | None = None) -> DenseRun:
        """Run all dense stages.

        Args:
            capture: pictures, and true poses.
            poses: other poses than the true ones, of all pictures.
            references: the images to make range maps of; all if not given (consistency needs all).
        """
        solved = poses or true_poses(capture)
        given = given_records(capture, solved)
        done = DenseRun()
        for name in self.dense:
            index = self.index(name, solved)
            started = time.process_time()
            done.results[name] = {
                image: self.run_one(name, image, index, given, done)
                for image in (references or capture.panoramas)
                if image in index.neighbours
            }
            done.cpu_s[name] = time.process_time() - started
        return done

    def index(self, name: str, poses: Poses) -> Views:
        """Return the sources of each image for a stage."""
        edge = self.graph.edges[name].get(INDEX_PORT)
        selectors = [key for key, entry in self.stages.items() if entry.spec.output is Views]
        entry = self.stages[edge.producer if edge else selectors[0]]
        views = entry.spec.function(poses=poses, params=entry.params, ctx=_context())
        assert isinstance(views, Views)
        return views

    def run_one(
        self, name: str, image: str, index: Views, given: Mapping[type[Record], dict[str, Any]], done: DenseRun
    ) -> Record:
        """Return what a stage makes of one image.

        Args:
            name: of the stage.
            image: name of the image.
            index: the sources of each image.
            given: what is given, by type and image.
            done: results of the stages before.
        """
        entry = self.stages[name]
        arguments: dict[str, Any] = {}
        for port in entry.spec.ports:
            edge = self.graph.edges[name].get(port.name)
            if edge is None:
                arguments[port.name] = None
                continue
            if port.kind is Structure and edge.producer not in done.results:
                done.results[edge.producer] = {"": self.run_one(edge.producer, "", index, given, done)}
            items = done.results.get(edge.producer) or self._given(port, given)
            arguments[port.name] = _delivered(port, items, image, index)
        arguments |= {
            argument: {"params": entry.params, "ctx": _context()}[what]
            for argument, what in entry.spec.extras.items()
            if what != "item"
        }
        return entry.spec.function(**arguments)

    @staticmethod
    def _given(port: Port, given: Mapping[type[Record], dict[str, Any]]) -> dict[str, Any]:
        for kind, items in given.items():
            if issubclass(kind, port.kind):
                return items
        raise LookupError(f"nothing gives {port}")


def true_poses(capture: Capture) -> Poses:
    """Return the true poses of a capture, without points; the worlds of all captures with truth have y down."""
    return Poses.without_points(
        capture.poses, frame="the truth's, y down along gravity", scale="the truth's", metric=True
    )


def given_records(capture: Capture, poses: Poses) -> dict[type[Record], dict[str, Any]]:
    """Return what the dense stages are given of a capture, by type and image."""
    return {
        Panorama: dict(capture.panoramas),
        Pose: {name: Pose(poses.cam_from_world(idx)) for idx, name in enumerate(poses.names)},
        Poses: {"": poses},
    }


def _delivered(port: Port, items: Mapping[str, Any], image: str, index: Views) -> Any:
    if port.cardinality is Cardinality.EACH:
        return items[image]
    if port.cardinality is Cardinality.NEAR:
        return [items[other] for other in index.neighbours[image] if other in items]
    if port.cardinality is Cardinality.ONE:
        return next(iter(items.values()))
    if port.cardinality is Cardinality.NAMES:
        return tuple(items)
    return dict(items)


def _context() -> Context:
    return Context(np.random.default_rng(0), Path(tempfile.gettempdir()))


@dataclass(frozen=True)
class ViewScores:
    """What one view's range map scores.

    Attributes:
        filled: all pixels with truth.
        consistent: only pixels of confidence 128 or more.
        sky_seen: share of the pixels without surface that have a range of confidence 64 or more; NaN if there are none.
        sky_filled: likewise with a range of any confidence.
    """

    filled: DepthMetrics
    consistent: DepthMetrics
    sky_seen: float
    sky_filled: float


def score_view(range_map: RangeMap, truth: NDArray[np.float32], *, scale: float = 1.0) -> ViewScores:
    """Return the scores of a range map; `scale` takes scene units to the truth's."""
    sure = np.where(range_map.confidence >= CONSISTENT_CONFIDENCE[0], range_map.range, np.float32(np.nan))
    sky = range_map.confidence[~np.isfinite(truth)]
    return ViewScores(
        depth_metrics(range_map.range, truth, scale=scale),
        depth_metrics(sure, truth, scale=scale),
        float((sky >= WEAK_CONFIDENCE[0]).mean()) if len(sky) else float("nan"),
        float((sky > 0).mean()) if len(sky) else float("nan"),
    )


def mean_of(scores: Sequence[ViewScores], protocol: str, figure: str) -> float:
    """Return the mean over views of one figure of "filled" or "consistent"."""
    values = np.array([getattr(getattr(score, protocol), figure) for score in scores])
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
