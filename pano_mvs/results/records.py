"""The parts of run.json as frozen records; `pano_mvs.results.summary` combines them.

Every field has a default, so that a file of an earlier version, or one that was shortened by hand, can be read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict, model_serializer, model_validator

Number = int | float | None
Direction = tuple[float, float, float]


class Entry(BaseModel):
    """Base of the records: immutable; a null in place of a value stands for the default."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    @model_validator(mode="before")
    @classmethod
    def _without_nulls(cls, value: Any) -> Any:
        return {k: v for k, v in value.items() if v is not None} if isinstance(value, Mapping) else value


class OptionalEntry(Entry):
    """A record of something that a run may not have; `{}` in run.json if it has none."""

    def __bool__(self) -> bool:
        """Return whether the run has it."""
        return any(getattr(self, name) != field.default for name, field in type(self).model_fields.items())

    @model_serializer(mode="wrap")
    def _empty_if_absent(self, handler: Any) -> Any:
        return handler(self) if self else {}


class WorkflowSummary(Entry):
    """The workflow that ran.

    Attributes:
        path: its file; empty if it was not read from one.
        overrides: settings that were changed, as `STAGE.PARAM=VALUE`.
    """

    name: str = ""
    path: str = ""
    overrides: tuple[str, ...] = ()


class MergedSummary(Entry):
    """The blocks of a merged capture.

    Attributes:
        blocks: the output folders of the blocks.
        images: folder of all images; empty if the blocks are not links to one folder.
    """

    blocks: tuple[str, ...] = ()
    images: str = ""


class UnitCounts(Entry):
    """Number of units of work, by outcome."""

    run: int = 0
    cached: int = 0
    failed: int = 0
    blocked: int = 0


class StageOutcome(UnitCounts):
    """What one stage did.

    Attributes:
        name: of the stage in the workflow.
        use: the registered stage, such as `depth.sweep`.
        version: of the registered stage.
        params: its settings, as JSON values.
        seconds: from the start of its first unit to the end of its last.
        unit_seconds: sum over its computed units; None in files of early versions.
        metrics: mean over its units of each figure that the stage reports.
    """

    name: str = ""
    use: str = ""
    version: int = 1
    params: Mapping[str, Any] = {}
    units: int = 0
    seconds: float = 0.0
    unit_seconds: float | None = None
    metrics: Mapping[str, Number] = {}


class BlockedUnit(Entry):
    """A unit that could not run because an input of it failed.

    Attributes:
        stage: name of the stage in the workflow.
        item: the image, pair or view; empty if the stage has one unit.
        cause: what failed before.
    """

    stage: str = ""
    item: str = ""
    cause: str = ""

    @property
    def label(self) -> str:
        """`STAGE:ITEM`, or `STAGE` if the stage has one unit."""
        return f"{self.stage}:{self.item}" if self.item else self.stage


class FailedUnit(BlockedUnit):
    """A unit that failed.

    Attributes:
        cause: what went wrong and what to do about it.
        consequence: what the result lacks because of it.
        trace: Python traceback; empty unless the stage's own code is at fault.
        log: file with what the unit printed; empty if it printed nothing.
    """

    consequence: str = ""
    trace: str = ""
    log: str = ""


class ImageReason(Entry):
    """Why an image was left out, or is doubtful, and which stage found it."""

    stage: str = ""
    reason: str = ""


class PairLink(NamedTuple):
    """A pair of images that was matched.

    Attributes:
        inliers: matches that agree with one geometry; 0 if the pair was rejected.
        candidates: matches before verification, if known.
        residual_deg: median epipolar residual, if known.
    """

    first: str
    second: str
    inliers: int
    candidates: int | None = None
    residual_deg: float | None = None


class NearestPair(NamedTuple):
    """The pair that comes closest to joining a group of cameras to the largest group.

    Attributes:
        first: image of the largest group.
        second: image of the other group.
        matches: verified matches of the pair.
        candidates: matches before verification.
    """

    first: str
    second: str
    matches: int = 0
    candidates: int = 0


class PoseGroup(Entry):
    """A group of cameras with a world frame and a unit of length of its own.

    Attributes:
        frame: what the world frame is.
        scale: what the unit of length is.
        metric: whether lengths are in metres.
        points: number of triangulated points.
        up: mean of the cameras' up directions in the world, a unit vector; None if they do not agree.
        z_up_from_world: rotation from the world to the axes of exports with `frame: upright`, by rows.
        camera_height: median height of the cameras above the floor of the cloud, scene units; None if unknown.
        nearest_pair: of a smaller group, the pair that nearly joins it to the largest; None if none was compared.
    """

    images: tuple[str, ...] = ()
    frame: str = ""
    scale: str = ""
    metric: bool = False
    points: int | None = None
    up: Direction | None = None
    z_up_from_world: tuple[Direction, ...] = ()
    camera_height: float | None = None
    nearest_pair: NearestPair | None = None


class PosesSummary(OptionalEntry):
    """The camera poses; all empty if the run has none.

    Attributes:
        registered: images with a pose.
        blocked: units that could not run.
        rejected: image without a pose to the reason.
        doubts: registered image whose pose is doubtful to the reason.
        confirmed: image to the share of its texture that other images confirm, and the share that is expected.
        p_right: image to the probability that its pose is right; None where nothing was measured about it.
        centers: of the registered cameras in the world, in the order of `registered`.
        points: number of triangulated points.
        frame: what the world frame is; of the largest group, as are `scale`, `metric` and `up`.
        scale: what the unit of length is.
        metric: whether lengths are in metres.
        up: mean of the cameras' up directions, a unit vector; None if they do not agree.
        groups: of cameras that no reliable pair connects, the largest first.
        links: the pairs that were matched.
    """

    registered: tuple[str, ...] = ()
    blocked: tuple[BlockedUnit, ...] = ()
    rejected: Mapping[str, str] = {}
    doubts: Mapping[str, str] = {}
    confirmed: Mapping[str, tuple[float | None, float | None]] = {}
    p_right: Mapping[str, float | None] = {}
    centers: tuple[Direction, ...] = ()
    points: int = 0
    frame: str = ""
    scale: str = ""
    metric: bool = False
    up: Direction | None = None
    groups: tuple[PoseGroup, ...] = ()
    links: tuple[PairLink, ...] = ()

    def by_group(self) -> tuple[PosesSummary, ...]:
        """Return the poses of each group, as those of a run that has this group alone."""
        if len(self.groups) < 2:
            return (self,)
        centers = dict(zip(self.registered, self.centers, strict=False))
        return tuple(self._of_group(group, centers) for group in self.groups)

    def _of_group(self, group: PoseGroup, centers: Mapping[str, Direction]) -> PosesSummary:
        names = dict.fromkeys(group.images)
        return PosesSummary(
            registered=tuple(names),
            centers=tuple(centers[name] for name in names if name in centers),
            links=tuple(link for link in self.links if link.first in names and link.second in names),
            doubts={name: self.doubts[name] for name in names if name in self.doubts},
            p_right={name: self.p_right[name] for name in names if name in self.p_right},
            **{name: getattr(group, name) for name in ("frame", "scale", "metric", "up")},
            points=group.points or 0,
        )


class ScoresSummary(OptionalEntry):
    """How far a result is from the ground truth; all empty if none is known.

    Attributes:
        poses: figure to value, over all cameras.
        views: image to figure to value.
        notes: what was left out, and why.
    """

    poses: Mapping[str, Any] = {}
    views: Mapping[str, Mapping[str, Number]] = {}
    notes: tuple[str, ...] = ()


class ViewSummary(Entry):
    """The final range map of one view; in run.json the metrics stand beside the name.

    Attributes:
        name: of the image.
        preview: file in the output folder that shows it; empty if there is none.
        metrics: what its stage reported, such as `completeness` and `consistent`, shares of the pixels.
    """

    name: str = ""
    preview: str = ""
    metrics: Mapping[str, Number] = {}

    @model_validator(mode="before")
    @classmethod
    def _gather_metrics(cls, value: Any) -> Any:
        if not isinstance(value, Mapping) or "metrics" in value:
            return value
        own = {name: value[name] for name in ("name", "preview") if name in value}
        return own | {"metrics": {name: figure for name, figure in value.items() if name not in own}}

    @model_serializer
    def _flat(self) -> dict[str, Any]:
        return {"name": self.name, "preview": self.preview, **self.metrics}

    @property
    def completeness(self) -> float | None:
        """Share of the pixels with a range, if known."""
        return self.metrics.get("completeness")

    @property
    def consistent(self) -> float | None:
        """Share of the pixels on which other views agree, if known."""
        return self.metrics.get("consistent")


class CloudSummary(OptionalEntry):
    """The fused cloud.

    Attributes:
        points: number of points; None if the run has no cloud.
    """

    points: int | None = None


@dataclass(frozen=True)
class Tile:
    """One headline figure of the report.

    Attributes:
        value: the figure, as text.
        label: what it counts.
        mood: "good", "fair" or "bad"; "" if it is not judged.
    """

    value: str
    label: str
    mood: str = ""


@dataclass(frozen=True)
class Finding:
    """A finding about a run.

    Attributes:
        mood: "bad" or "fair"; "" for a note.
        text: what it is.
        remedy: what to do about it, or "".
    """

    mood: str
    text: str
    remedy: str = ""


@dataclass(frozen=True)
class Verdict:
    """Whether the result of a run is reliable.

    Attributes:
        mood: "good", "fair" or "bad".
        outcome: how the run ended.
        judgement: whether the result is reliable, in a sentence; empty if there is nothing to judge.
        sentence: what was done, in one sentence.
        tiles: the headline figures.
        findings: what is wrong or doubtful, the worst first.
    """

    mood: str
    outcome: str
    judgement: str
    sentence: str
    tiles: tuple[Tile, ...]
    findings: tuple[Finding, ...]
