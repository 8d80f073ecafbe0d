"""The dense part of a workflow, run in memory on poses that are given: what the benchmarks of depth measure.

Of a workflow the stages that produce something for each view are run (sweeps and filters, whatever they are called),
wired as the file says; pictures and poses come from the caller in place of the stages before them.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.core.digest import digest_from_value
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.stage import INDEX_PORT, Cardinality, Port
from pano_mvs.engine.stages.stage_code import stage_code
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import StageEntry
from pano_mvs.scene import Axis, Panorama, PointCloud, Pose, Poses, RangeMap, Record, Views, WorldAxes
from pano_mvs.scene.surfaces import Structure
from pano_mvs.session.session import open_session
from tools.benchmarks.captures import Capture

Overrides = Annotated[list[str] | None, typer.Option("--set", metavar="STAGE.PARAM=VALUE")]
"""The option `--set` of a benchmark, as that of `pano-mvs run`."""


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

    @property
    def planes(self) -> Structure | None:
        """The planes of the place that the last stage found which finds any."""
        found = [item for items in self.results.values() for item in items.values() if isinstance(item, Structure)]
        return found[-1] if found else None


class DenseChain:
    """The dense stages of a workflow, ready to run on captures.

    Results are stored in `memory`, which several chains may share, by settings, wiring and code of the stage and of all
    stages before it.
    """

    def __init__(
        self, workflow: str, *, overrides: Sequence[str] = (), memory: MutableMapping[str, Record] | None = None
    ) -> None:
        session = open_session(workflow, overrides=overrides)
        self.stages: Mapping[str, StageEntry] = session.workflow.stages
        self.graph: Graph = session.graph
        self.memory = memory
        self.dense = [
            name
            for name in self.graph.order
            if self.graph.axes[name] is Axis.VIEW and self.stages[name].spec.output.axis is Axis.VIEW
        ]

    def run(
        self,
        capture: Capture,
        *,
        poses: Poses | None = None,
        references: Sequence[str] | None = None,
        label: str | None = None,
    ) -> DenseRun:
        """Run all dense stages; each for the images that the references depend on.

        Args:
            capture: pictures, and true poses.
            poses: other poses than the true ones.
            references: the images whose last maps are wanted; all if not given.
            label: name of the capture in the memory; nothing is stored without one.
        """
        solved = poses or true_poses(capture)
        given, done = given_records(capture, solved), DenseRun()
        for name, images in self._needed(solved, references or list(capture.panoramas)).items():
            index, started = self.index(name, solved), time.process_time()
            own = "" if label is None or self.memory is None else f"{label}-{self.key(name)}-{name}"
            done.results[name] = {}
            for image in (one for one in images if one in index.neighbours):
                known = self.memory.get(f"{own}-{image}") if own and self.memory is not None else None
                done.results[name][image] = known or self.run_one(name, image, index, given, done)
                if own and self.memory is not None:
                    self.memory[f"{own}-{image}"] = done.results[name][image]
            done.cpu_s[name] = time.process_time() - started
        return done

    def key(self, name: str | None = None) -> str:
        """Return a digest of settings and code of a stage and all dense stages before it; of all, without a name."""
        last = len(self.dense) if name is None else self.dense.index(name) + 1
        selectors = [name for name, entry in self.stages.items() if entry.spec.output is Views]
        return digest_from_value([self.settings(stage) for stage in (*self.dense[:last], *selectors)])[:16]

    def settings(self, name: str) -> list[object]:
        """Return all that the result of a stage depends on, besides the results of other stages."""
        entry, edges = self.stages[name], self.graph.edges[name]
        wiring = sorted([port, edge.producer] for port, edge in edges.items())
        code = stage_code(entry.spec, entry.params).digest
        return [name, entry.spec.name, entry.params.model_dump_json(), code, wiring]

    def _needed(self, poses: Poses, references: Sequence[str]) -> dict[str, list[str]]:
        """Return the images that each stage has to be run for, in the order of the stages."""
        needed: dict[str, set[str]] = {name: set() for name in self.dense}
        needed[self.dense[-1]] = set(references)
        for name in reversed(self.dense):
            own, neighbours = needed[name], self.index(name, poses).neighbours
            near = {other for image in own for other in neighbours.get(image, ())}
            for port in self.stages[name].spec.ports:
                edge = self.graph.edges[name].get(port.name)
                if edge is not None and edge.producer in needed:
                    needed[edge.producer] |= near if port.cardinality is Cardinality.NEAR else own
        return {name: sorted(images) for name, images in needed.items()}

    def index(self, name: str, poses: Poses) -> Views:
        """Return the sources of each image for a stage."""
        edge = self.graph.edges[name].get(INDEX_PORT)
        selectors = [key for key, entry in self.stages.items() if entry.spec.output is Views]
        entry = self.stages[edge.producer if edge else selectors[0]]
        views = entry.spec.function(poses=poses, params=entry.params, ctx=context())
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
            items = done.results.get(edge.producer) or _given(port, given)
            arguments[port.name] = _delivered(port, items, image, index)
        return entry.spec.function(**arguments, **extras(entry))

    def fused(self, capture: Capture, run: DenseRun) -> PointCloud:
        """Return the cloud of the workflow's fusion, of the maps that it is wired to."""
        name, entry = next((name, entry) for name, entry in self.stages.items() if entry.spec.output is PointCloud)
        cloud = entry.spec.function(
            ranges=run.range_maps[self.graph.edges[name]["ranges"].producer],
            poses={image: Pose(pose) for image, pose in capture.poses.items()},
            images=dict(capture.panoramas),
            planes=run.planes,
            **extras(entry),
        )
        assert isinstance(cloud, PointCloud)
        return cloud


def true_poses(capture: Capture) -> Poses:
    """Return the true poses of a capture, without points; the worlds of all captures with truth have y down."""
    return Poses.without_points(
        capture.poses, frame="the truth's", scale="the truth's", metric=True, axes=WorldAxes.LEVEL
    )


def with_true_points(poses: Poses, ranges: Mapping[str, NDArray[np.float32]], *, points: int = 400) -> Poses:
    """Return poses with true surface points and the views that see them: as many random ones of each view, if two do.

    Without points, sources are chosen by distance, and may be behind walls and floors.
    """
    places, bearings, seen = [np.zeros((0, 3))], [np.zeros((0, 3))], []
    for name, pose in poses.cameras.items():
        rays = np.random.default_rng([0xB1, len(places)]).normal(size=(points, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        distance = ranges[name][pixels_containing(rays, ranges[name].shape)].astype(np.float64)
        places.append(pose.inverse().apply(rays[distance > 0] * distance[distance > 0, None]))
    world = np.concatenate(places)
    for idx, (name, pose) in enumerate(poses.cameras.items()):
        in_cam = pose.apply(world)
        away = np.linalg.norm(in_cam, axis=1)
        visible = np.abs(ranges[name][pixels_containing(in_cam, ranges[name].shape)] / away - 1) < 0.02
        bearings.append(in_cam[visible] / away[visible, None])
        seen.append(np.column_stack([np.flatnonzero(visible), np.full(visible.sum(), idx)]))
    tracks = np.concatenate(seen).astype(np.int32)
    kept = np.bincount(tracks[:, 0], minlength=len(world)) > 1
    used = kept[tracks[:, 0]]
    return replace(
        poses,
        points_in_world=world[kept],
        point_colors_rgb=np.zeros((kept.sum(), 3), np.uint8),
        point_errors_rad=np.zeros(kept.sum(), np.float32),
        track_point_idx=(np.cumsum(kept, dtype=np.int32) - 1)[tracks[used, 0]],
        track_image_idx=tracks[used, 1],
        track_bearings=np.concatenate(bearings)[used],
    )


def given_records(capture: Capture, poses: Poses) -> dict[type[Record], dict[str, Any]]:
    """Return what the dense stages are given of a capture, by type and image."""
    return {
        Panorama: dict(capture.panoramas),
        Pose: {name: Pose(poses.cam_from_world(idx)) for idx, name in enumerate(poses.names)},
        Poses: {"": poses},
    }


def context(scratch: Path | None = None) -> Context:
    """Return what a stage is given besides its inputs, with a scratch folder that is made."""
    folder = scratch or Path(tempfile.gettempdir())
    folder.mkdir(parents=True, exist_ok=True)
    return Context(np.random.default_rng(0), folder)


def extras(entry: StageEntry, scratch: Path | None = None) -> dict[str, Any]:
    """Return the settings and the context under the names that a stage has for them."""
    offered = {"params": entry.params, "ctx": context(scratch)}
    return {argument: offered[what] for argument, what in entry.spec.extras.items() if what != "item"}


def _given(port: Port, given: Mapping[type[Record], dict[str, Any]]) -> dict[str, Any]:
    for kind, items in given.items():
        if issubclass(kind, port.kind):
            return items
    raise LookupError(f"nothing gives {port}")


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
