"""The parts of run.json as frozen records; `pano_mvs.results.summary` combines them.

Every field has a default, so that a file of an earlier version, or one that was shortened by hand, can be read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict, model_serializer, model_validator

from pano_mvs.scene.poses import World, WorldAxes

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
    """The workflow that ran."""

    name: str = ""
    path: str = ""  # its file; empty if it was not read from one
    overrides: tuple[str, ...] = ()  # settings that were changed, as `STAGE.PARAM=VALUE`


class MergedSummary(Entry):
    """The blocks of a merged capture."""

    blocks: tuple[str, ...] = ()  # the output folders of the blocks
    images: str = ""  # folder of all images; empty if the blocks are not links to one folder


class UnitCounts(Entry):
    """Number of units of work, by outcome."""

    run: int = 0
    cached: int = 0
    failed: int = 0
    blocked: int = 0


class StageOutcome(UnitCounts):
    """What one stage did."""

    name: str = ""  # of the stage in the workflow
    use: str = ""  # the registered stage, such as `depth.sweep`
    group: str = ""  # the group of stages that it belongs to; empty if it is in none
    version: int = 1  # of the registered stage
    params: Mapping[str, Any] = {}  # its settings, as JSON values
    units: int = 0
    seconds: float = 0.0  # from the start of its first unit to the end of its last
    unit_seconds: float | None = None  # sum over its computed units; None in files of early versions
    metrics: Mapping[str, Number] = {}  # mean over its units of each figure that the stage reports


class BlockedUnit(Entry):
    """A unit that could not run because an input of it failed."""

    stage: str = ""  # name of the stage in the workflow
    item: str = ""  # the image, pair or view; empty if the stage has one unit
    cause: str = ""  # what failed before

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
    """A pair of images that was matched."""

    first: str
    second: str
    inliers: int  # matches that agree with one geometry; 0 if the pair was rejected
    candidates: int | None = None  # matches before verification, if known
    residual_deg: float | None = None  # median epipolar residual, if known


class NearestPair(NamedTuple):
    """The pair that comes closest to joining a group of cameras to the largest group."""

    first: str  # image of the largest group
    second: str  # image of the other group
    matches: int = 0  # verified matches of the pair
    candidates: int = 0  # matches before verification


class PoseGroup(Entry):
    """A group of cameras with a world frame and a unit of length of its own."""

    images: tuple[str, ...] = ()
    frame: str = ""  # what the world frame is
    scale: str = ""  # what the unit of length is
    metric: bool = False  # whether lengths are in metres
    # "level": y points down along gravity; "north": z also points north; "unknown"
    axes: WorldAxes = WorldAxes.UNKNOWN
    # latitude and longitude (deg) and altitude (m) of the origin of the world; None if they are not known
    origin_lla: tuple[float, float, float] | None = None
    points: int | None = None  # number of triangulated points
    # mean of the cameras' up directions in the world, a unit vector; None if they do not agree
    up: Direction | None = None
    # rotation from the world to the axes of exports with `frame: upright`, by rows
    z_up_from_world: tuple[Direction, ...] = ()
    # median height of the cameras above the floor of the cloud, scene units; None if unknown
    camera_height: float | None = None
    # of a smaller group, the pair that nearly joins it to the largest; None if none was compared
    nearest_pair: NearestPair | None = None


class PosesSummary(OptionalEntry):
    """The camera poses; all empty if the run has none."""

    registered: tuple[str, ...] = ()  # images with a pose
    blocked: tuple[BlockedUnit, ...] = ()  # units that could not run
    rejected: Mapping[str, str] = {}  # image without a pose to the reason
    doubts: Mapping[str, str] = {}  # registered image whose pose is doubtful to the reason
    # image to the share of its texture that other images confirm, and the share that is expected
    confirmed: Mapping[str, tuple[float | None, float | None]] = {}
    # image to what was measured for and against its pose, by measurement; None where it is missing
    evidence: Mapping[str, Mapping[str, float | None]] = {}
    # image to the probability that its pose is right; None where nothing was measured about it
    p_right: Mapping[str, float | None] = {}
    centers: tuple[Direction, ...] = ()  # of the registered cameras in the world, in the order of `registered`
    points: int = 0  # number of triangulated points
    frame: str = ""  # what the world frame is; of the largest group, as are the next five fields
    scale: str = ""  # what the unit of length is
    metric: bool = False  # whether lengths are in metres
    axes: WorldAxes = WorldAxes.UNKNOWN  # what is known of the axes of the world; see `PoseGroup`
    origin_lla: tuple[float, float, float] | None = None
    up: Direction | None = None  # mean of the cameras' up directions, a unit vector; None if they do not agree
    groups: tuple[PoseGroup, ...] = ()  # of cameras that no reliable pair connects, the largest first
    links: tuple[PairLink, ...] = ()  # the pairs that were matched

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
            **{name: getattr(group, name) for name in (*World._fields, "up")},
            points=group.points or 0,
        )


class ScoresSummary(OptionalEntry):
    """How far a result is from the ground truth; all empty if none is known."""

    poses: Mapping[str, Any] = {}  # figure to value, over all cameras
    views: Mapping[str, Mapping[str, Number]] = {}  # image to figure to value
    notes: tuple[str, ...] = ()  # what was left out, and why


class ViewSummary(Entry):
    """The final range map of one view; in run.json the metrics stand beside the name."""

    name: str = ""  # of the image
    preview: str = ""  # file in the output folder that shows it; empty if there is none
    # what its stage reported, such as `completeness` and `consistent`, shares of the pixels
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
    """The fused cloud."""

    points: int | None = None  # number of points; None if the run has no cloud


@dataclass(frozen=True)
class Tile:
    """One headline figure of the report."""

    value: str  # the figure, as text
    label: str  # what it counts
    mood: str = ""  # "good", "fair" or "bad"; "" if it is not judged


@dataclass(frozen=True)
class Finding:
    """A finding about a run."""

    mood: str  # "bad" or "fair"; "" for a note
    text: str  # what it is
    remedy: str = ""  # what to do about it, or ""


@dataclass(frozen=True)
class Verdict:
    """Whether the result of a run is reliable."""

    mood: str  # "good", "fair" or "bad"
    outcome: str  # how the run ended
    judgement: str  # whether the result is reliable, in a sentence; empty if there is nothing to judge
    sentence: str  # what was done, in one sentence
    tiles: tuple[Tile, ...]  # the headline figures
    findings: tuple[Finding, ...]  # what is wrong or doubtful, the worst first
