"""Put a finished run into metres: the same workflow with stages that multiply poses, ranges, … by a factor.

Range maps, planes and clouds of scaled poses are the scaled ones, so nothing dense is computed again: the cached
results are multiplied, and only exports, scores and other stages that read them run again.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.files import replacing
from pano_mvs.core.paths import is_file, resolved
from pano_mvs.core.text import shortened_list
from pano_mvs.engine.workflows.policy import Policy
from pano_mvs.engine.workflows.resolved import resolved_yaml
from pano_mvs.engine.workflows.wiring import Edge, Graph, wire
from pano_mvs.engine.workflows.workflow import StageEntry, Workflow
from pano_mvs.io.images.names import match_image_names
from pano_mvs.results.run_output import RunOutput
from pano_mvs.scene import Panorama, PointCloud, Poses, RangeMap, Record, TwoView, TwoViews
from pano_mvs.scene.panorama import StaticMasks
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.surfaces import Structure
from pano_mvs.scene.two_view import Pairs, Views
from pano_mvs.session.session import Session, open_session
from pano_mvs.session.summarise import chain_of

WORKFLOW_FILE = "metres.yaml"  # the workflow with the scale, in the output folder
_PREFIX = "metres_"
_SCALED: Mapping[type[Record], tuple[str, str]] = {
    Poses: ("poses.scale", "poses"),
    RangeMap: ("filters.scale", "range_map"),
    Structure: ("depth.scale_planes", "planes"),
    PointCloud: ("fusion.scale", "cloud"),
}
_WITHOUT_LENGTHS = (Panorama, Pairs, Views, TwoView, TwoViews, StaticMasks)
_LENGTH = re.compile(r"\s*([0-9]*\.?[0-9]+)\s*(mm|cm|m|in|ft|)\s*")
_METRES = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}


@dataclass(frozen=True)
class Measurement:
    """A known length."""

    length: float  # in the units of the run
    metres: float  # the same in metres
    group: int  # number of the group of poses in which it was measured
    origin: str  # what was measured

    @property
    def factor(self) -> float:
        """Metres per unit of the run."""
        return self.metres / self.length


def metres_from_text(text: str) -> float:
    """Return the metres of a length such as `3.42m`, `342 cm` or `11.2ft`; a plain number is metres.

    >>> metres_from_text("3.42m"), metres_from_text("342 cm")
    (3.42, 3.42)

    Raises:
        UsageError: if it is not a positive length.
    """
    if re.fullmatch(r"\s*[0-9]*,[0-9]+\s*[a-z]*\s*", text.lower()):
        raise UsageError(f"{text[:80]!r}: write a point, not a comma: {text[:80].replace(',', '.')}")
    found = _LENGTH.fullmatch(text.lower())
    metres = float(found[1]) * _METRES[found[2]] if found else 0.0
    if not metres > 0:
        raise UsageError(f"{text[:80]!r} is not a length: write a positive number and m, cm, mm, ft or in: 3.42m")
    return metres


def measured_between(run: RunOutput, first: str, second: str, *, metres: float, group: int = 0) -> Measurement:
    """Return the measurement of a distance between two cameras or two points.

    Args:
        first: name of a registered image, or coordinates `x,y,z`, as the viewer and other programs show them.
        second: the other end.
        group: the group of poses in which points were measured; images state theirs.

    Raises:
        UsageError: if an end is neither, both are in one place, or images are in different groups.
        InputError: if the run has no poses.
    """
    if run.poses is None or not run.poses.names:
        raise InputError(f"{run.out}: the run has no poses. Look at its report.html")
    groups = split_groups(run.poses)
    ends: list[NDArray[np.float64]] = []
    homes: set[int] = set()
    named = []
    for end in (first, second):
        text = end
        point = _point(text)
        if point is None:
            number, name = _camera(groups, text)
            homes.add(number)
            point = groups[number].centers[groups[number].names.index(name)]
            text = name
        ends.append(point)
        named.append(text)
    if len(homes) > 1:
        raise UsageError(f"{first} and {second} are in different groups of poses, which have separate scales")
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if not length > 1e-9:
        raise UsageError(f"{first} and {second} are in the same place. Measure a longer distance")
    home = homes.pop() if homes else group
    if home >= len(groups):
        raise UsageError(f"--group {home}: the run has {len(groups)} groups of poses, numbered from 0")
    return Measurement(length, metres, home, f"the distance of {metres:g} m from {named[0]} to {named[1]}")


def measured_camera_height(run: RunOutput, *, metres: float, group: int = 0) -> Measurement:
    """Return the measurement of the height of the cameras above the floor of the cloud.

    Raises:
        UsageError: if the run found no floor below the cameras.
    """
    groups = run.summary.poses.groups
    height = groups[group].camera_height if group < len(groups) else None
    if height is None:
        raise UsageError(f"{run.out}: no floor was found below the cameras. Measure a distance instead: A B 3.42m")
    return Measurement(height, metres, group, f"the cameras' height of {metres:g} m above the floor of the cloud")


def lost_scale(session: Session) -> str:
    """Return a note if the output folder of a session was in metres and the session writes scene units; else ""."""
    scaled = session.out / WORKFLOW_FILE
    path = session.workflow.path
    if not is_file(scaled) or (path is not None and resolved(path) == resolved(scaled)):
        return ""
    return (
        f"{session.out} was put into metres before, by pano-mvs scale, and is in the units of the workflow again. To "
        f"use metres, repeat the measurement: pano-mvs scale {session.out} A B 3.42m"
    )


def how_to_scale_blocks(run: RunOutput) -> str:
    """Return what to do to put results into metres that are merged from blocks."""
    blocks = [] if run.summary.merged is None else run.summary.merged.blocks
    if run.summary.poses.metric:
        return (
            f"{run.out} is merged from blocks and is in metres ({run.summary.poses.scale}). To correct the lengths, "
            f"correct each block that is in metres, then merge again. Blocks: {', '.join(blocks)}"
        )
    return (
        f"{run.out} is merged from blocks. Put a block into metres by two images, or two points, of its own, and merge "
        "again; the merged results take over its unit:\n"
        f"  {shlex.join(['pano-mvs', 'scale', *blocks[:1]])} A B 3.42m\n"
        f"  {shlex.join(['pano-mvs', 'merge', *blocks, '--out', str(run.out)])}"
    )


def scaled_session(run: RunOutput, known: Measurement, *, cache: Path | None = None) -> Session:
    """Return the session that puts a run into metres, and write its workflow to metres.yaml in the output folder.

    The workflow is that of the run, with all its settings, and the stages metres_…, which multiply the final poses,
    ranges, planes and clouds. A run that is in metres already is corrected: its factor changes.

    Args:
        cache: folder of the cache; None for that of the run.

    Raises:
        UsageError: if the workflow of the run cannot be found, or a stage mixes lengths in ways that cannot be scaled.
    """
    recorded = run.summary.workflow
    if not recorded.path or not is_file(Path(recorded.path)):
        raise UsageError(
            f"{run.out}: its workflow file {recorded.path or '(unknown)'} is not there. Run `pano-mvs scale` in the "
            "folder in which the run was started, or add a stage poses.scale to the workflow"
        )
    moved = any(text.startswith("images.path=") for text in recorded.overrides)
    overrides = [text for text in recorded.overrides if not text.startswith("images.path=")]
    session = open_session(
        recorded.path,
        overrides=overrides,
        images=run.summary.source_folder if moved else None,
        cache=cache or run.summary.cache or None,
        out=resolved(run.out),
    )
    stages = dict(session.workflow.stages)
    before = {name: entry for name, entry in stages.items() if name.startswith(_PREFIX)}
    if before:
        workflow = replace(session.workflow, stages=stages | {n: _again(entry, known) for n, entry in before.items()})
    else:
        workflow = _Rewiring(session, known).workflow()
    graph = wire(workflow)
    path = run.out / WORKFLOW_FILE
    text = resolved_yaml(workflow, graph)
    with replacing(path) as scratch:
        scratch.write_text(text, encoding="utf-8")
    return replace(session, workflow=replace(workflow, path=path, text=text, overrides=()), graph=graph)


def _again(entry: StageEntry, known: Measurement) -> StageEntry:
    """Return a stage that scales, corrected by a measurement in the unit that it made."""
    params: Any = entry.params
    changed = {"factor": params.factor * known.factor, "group": known.group}
    if params.group != known.group:
        raise UsageError(
            f"group {params.group} of the poses was scaled before, and group {known.group} cannot be scaled as well. "
            "Add stages poses.scale to the workflow instead"
        )
    if entry.spec.name == "poses.scale":
        changed["origin"] = known.origin
    return replace(entry, params=params.model_copy(update=changed))


class _Rewiring:
    """Adds stages that scale, and connects them with the stages that read final values."""

    def __init__(self, session: Session, known: Measurement) -> None:
        self.session = session
        self.known = known
        self.graph: Graph = session.graph
        self.stages = session.workflow.stages
        makers = [name for name in self.graph.order if self._kind(name) is not None]
        self.makers = set(makers)
        needed = set(makers)
        for name in reversed(self.graph.order):
            if name in needed:
                needed.update(edge.producer for edge in self.graph.edges[name].values())
        self.upstream = needed
        poses = chain_of(session.workflow, self.graph, Poses)
        if not poses:
            raise UsageError("the workflow has no poses, so there is nothing to scale")
        self.poses = poses[-1]
        self.added: dict[str, StageEntry] = {}

    def workflow(self) -> Workflow:
        changed = {}
        for name, entry in self.stages.items():
            if name not in self.upstream:
                inputs = {port: self._source(name, edge) for port, edge in self.graph.edges[name].items()}
                changed[name] = replace(entry, policy=entry.policy.model_copy(update={"inputs": inputs}))
        # Final values that nothing reads are scaled, too: run.json and the viewer show them.
        for kind in (Poses, RangeMap, PointCloud):
            chain = chain_of(self.session.workflow, self.graph, kind)
            if chain:
                self._scaled(chain[-1])
        return replace(self.session.workflow, stages={**self.stages, **self.added, **changed})

    def _kind(self, name: str) -> type[Record] | None:
        output = self.stages[name].spec.output
        return next((kind for kind in _SCALED if issubclass(output, kind)), None)

    def _source(self, reader: str, edge: Edge) -> str:
        """Return what feeds a port of a final stage."""
        if edge.producer in self.makers:
            return self._scaled(edge.producer)
        output = self.stages[edge.producer].spec.output
        if edge.producer in self.upstream and not issubclass(output, _WITHOUT_LENGTHS):
            raise UsageError(
                f"stage {reader!r} reads {output.kind_name()} of stage {edge.producer!r}, which cannot be scaled "
                "afterwards. Add a stage poses.scale to the workflow instead: docs/frames_and_scale.md"
            )
        return edge.producer

    def _scaled(self, maker: str) -> str:
        """Return the name of the stage that scales the result of a stage."""
        kind = self._kind(maker)
        assert kind is not None
        use, port = _SCALED[kind]
        inputs = {port: maker}
        settings: dict[str, Any] = {"factor": self.known.factor, "group": self.known.group}
        if kind is Poses:
            settings["origin"] = self.known.origin
            inputs["images"] = [n for n in self.graph.order if issubclass(self.stages[n].spec.output, Panorama)][-1]
        elif kind is RangeMap:
            inputs["pose"] = self.poses
        name = f"{_PREFIX}{maker}"
        spec = self.session.registry.stages[use]
        policy = Policy.model_validate({"use": use, "in": inputs})
        self.added[name] = StageEntry(name, spec, spec.params_type.model_validate(settings), policy, WORKFLOW_FILE)
        return name


def _camera(groups: list[Poses], text: str) -> tuple[int, str]:
    names = [name for group in groups for name in group.names]
    matched = match_image_names([text], names)
    if text not in matched:
        raise UsageError(
            f"{text[:80]!r} is not one registered image, nor coordinates x,y,z. Images: "
            f"{shortened_list(names, 8, rest=' …')}"
        )
    name = matched[text]
    return next(number for number, group in enumerate(groups) if name in group.names), name


def _point(text: str) -> NDArray[np.float64] | None:
    """Return coordinates x,y,z; None if the text is something else."""
    try:
        point = np.array([float(word) for word in text.split(",")])
    except ValueError:
        return None
    return point if point.shape == (3,) and np.isfinite(point).all() else None
