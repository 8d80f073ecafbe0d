"""The analysis of one pixel: its ray, its range after each stage, its neighbours, and its cost curve."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.cost_curve import CostCurve, cost_curve
from pano_mvs.algorithms.sweep.limits import limits_by_sweeping
from pano_mvs.algorithms.sweep.preparation import planes_before
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.sweep import sweep_input
from pano_mvs.core.errors import UsageError
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.executors.execute import arguments_of
from pano_mvs.engine.planning.units import Unit
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_from_pixel
from pano_mvs.geometry.pose_errors import align_centers
from pano_mvs.io.truth import read_truth
from pano_mvs.scene import Panorama, Pose, RangeMap
from pano_mvs.scene.surfaces import Structure
from pano_mvs.stages.depth import SweepParams


@dataclass(frozen=True)
class StageRange:
    """Range of the pixel after one stage."""

    stage: str
    use: str
    range: float  # in scene units; NaN if it has none
    confidence: int  # 0–255


@dataclass(frozen=True)
class SourceSight:
    """A neighbour's view of the surface point of the pixel."""

    name: str  # of the image
    baseline: float  # distance between the cameras in scene units
    parallax_deg: float  # angle at the surface between the two rays
    pixel_px: tuple[float, float]  # (x, y) in the neighbour
    color_rgb: tuple[int, int, int]  # there
    masked: bool  # whether the neighbour is masked there
    # of the winning range in this neighbour alone, relative to the worst cost; NaN if it does not count
    cost: float


@dataclass(frozen=True, eq=False)
class Inspection:
    """One pixel of one image."""

    image: str
    column: int  # of the pixel, from 0; its centre is at column + ½
    row: int  # likewise
    size_hw: tuple[int, int]  # of the image at the resolution of the sweep
    color_rgb: tuple[int, int, int]  # of the pixel
    ray_in_cam: NDArray[np.float64]  # (3,) unit ray through its centre
    ray_in_world: NDArray[np.float64]  # (3,) likewise
    center_in_world: NDArray[np.float64]  # (3,) of the camera, scene units
    stages: tuple[StageRange, ...]  # its range after each stage that produces ranges, as far as stored
    sweep: str  # name of the stage whose cost curve is shown
    settings: SweepSettings  # of that sweep
    curve: CostCurve
    sources: tuple[SourceSight, ...]
    true_range: float  # in scene units; NaN if unknown
    notes: tuple[str, ...]

    @property
    def azimuth_deg(self) -> float:
        """Azimuth of the ray: 0 is ahead, 90 to the right."""
        return float(np.rad2deg(np.arctan2(self.ray_in_cam[0], self.ray_in_cam[2])))

    @property
    def elevation_deg(self) -> float:
        """Elevation of the ray: 90 is up."""
        return float(np.rad2deg(np.arcsin(np.clip(-self.ray_in_cam[1], -1, 1))))


UnitFound = tuple[Unit, UnitRecord | None]


def inspect_pixel(
    sweep_unit: UnitFound, stages: Sequence[UnitFound], store: Store, *, column: int, row: int, truth: Path | None
) -> Inspection:
    """Return the analysis of a pixel.

    Raises:
        UsageError: if the image has no such pixel.
        InputError: if an input file is missing or damaged.
    """
    unit, record = sweep_unit
    read = _SweepRead.of(unit, store)
    height, width = read.reference.size_hw
    if not (0 <= column < width and 0 <= row < height):
        raise UsageError(
            f"{unit.item} was swept at {width}×{height}: there is no pixel ({column}, {row}); x is 0 to "
            f"{width - 1}, y 0 to {height - 1}"
        )
    params = unit.entry.params
    assert isinstance(params, SweepParams)
    settings = SweepSettings(**{field.name: getattr(params, field.name) for field in dataclasses.fields(SweepSettings)})
    pictures = [view.load() for view in (read.reference, *read.sources)]
    masks = [view.load_mask() for view in (read.reference, *read.sources)]
    near, far = _limits(params, record, pictures, read=read, masks=masks)
    work = sweep_input(
        pictures[0],
        pictures[1:],
        read.source_from_reference,
        near=near,
        far=far,
        settings=settings,
        backend=params.backend,
        device=params.device,
        reference_mask=masks[0],
        source_masks=masks[1:],
    )
    has_floors = params.backend == "numba" and settings.aggregation == "sgm" and read.floors > 0
    curve = cost_curve(work, column=column, row=row, masked=not masks[0][row, column])
    ray = ray_from_pixel([column + 0.5, row + 0.5], (height, width))
    pose = read.poses[0]
    true_range, notes = _true_range(truth, unit.item, read, row=row, column=column)
    found = _stage_ranges(stages, store, row, column=column)
    return Inspection(
        image=unit.item,
        column=column,
        row=row,
        size_hw=(height, width),
        color_rgb=_color(pictures[0] if masks[0][row, column] else read.reference.load_unmasked(), row, column),
        ray_in_cam=ray,
        ray_in_world=pose.rotation.T @ ray,
        center_in_world=pose.center,
        stages=found,
        sweep=unit.entry.name,
        settings=settings,
        curve=curve,
        sources=_sights(curve, ray, read, pictures=pictures[1:], masks=masks[1:]),
        true_range=true_range,
        notes=(*notes, *_curve_notes(unit, record, settings, curve=curve, stages=found, has_floors=has_floors)),
    )


@dataclass(frozen=True, eq=False)
class _SweepRead:
    """The inputs of a sweep's unit."""

    reference: Panorama
    sources: tuple[Panorama, ...]
    names: tuple[str, ...]
    poses: tuple[Rigid3, ...]
    floors: int  # known planes below the reference

    @staticmethod
    def of(unit: Unit, store: Store) -> _SweepRead:
        values: Mapping[str, Any] = arguments_of(unit, store)
        near = unit.inputs["sources"]
        assert isinstance(near, dict)
        poses: list[Pose] = [values["pose"], *values["source_poses"]]
        known: Structure | None = values["known"]
        return _SweepRead(
            values["ref"],
            tuple(values["sources"]),
            tuple(near),
            tuple(pose.cam_from_world for pose in poses),
            0 if known is None else len(planes_before(known, poses[0].cam_from_world, poses[0].group)),
        )

    @property
    def source_from_reference(self) -> list[Rigid3]:
        return [pose @ self.poses[0].inverse() for pose in self.poses[1:]]


def _limits(
    params: SweepParams,
    record: UnitRecord | None,
    pictures: list[NDArray[np.uint8]],
    *,
    read: _SweepRead,
    masks: list[NDArray[np.bool_]],
) -> tuple[float, float]:
    """Return the near and far limits of the stage, estimating them if they are unset."""
    if params.near is not None and params.far is not None:
        return params.near, params.far
    if record is not None and {"near", "far"} <= record.metrics.keys():
        return record.metrics["near"], record.metrics["far"]
    near, far = limits_by_sweeping(
        pictures, list(read.poses), masks=masks, backend=params.backend, device=params.device
    )
    return params.near or near, params.far or far


def _stage_ranges(stages: Sequence[UnitFound], store: Store, row: int, *, column: int) -> tuple[StageRange, ...]:
    found = []
    for unit, record in stages:
        if record is None:
            continue
        value = store.load(record.output, RangeMap)
        assert isinstance(value, RangeMap)
        if row < value.range.shape[0] and column < value.range.shape[1]:
            here = float(value.range[row, column]), int(value.confidence[row, column])
            found.append(StageRange(unit.entry.name, unit.entry.spec.name, *here))
    return tuple(found)


def _sights(
    curve: CostCurve,
    ray: NDArray[np.float64],
    read: _SweepRead,
    *,
    pictures: list[NDArray[np.uint8]],
    masks: list[NDArray[np.bool_]],
) -> tuple[SourceSight, ...]:
    """Return the view of each neighbour at the winning range."""
    distance = curve.range if np.isfinite(curve.range) else float(curve.ranges[curve.winner])
    sights = []
    for idx, pose in enumerate(read.source_from_reference):
        point = pose.apply(ray * distance)
        height, width = pictures[idx].shape[:2]
        x, y = pixel_from_ray(point, (height, width))
        column, row = int(x) % width, min(int(y), height - 1)
        between = np.cross(pose.rotation @ ray, point / np.linalg.norm(point))
        sights.append(
            SourceSight(
                name=read.names[idx],
                baseline=float(np.linalg.norm(pose.translation)),
                parallax_deg=float(np.rad2deg(np.arcsin(min(1.0, float(np.linalg.norm(between)))))),
                pixel_px=(float(x), float(y)),
                color_rgb=_color(
                    pictures[idx] if masks[idx][row, column] else read.sources[idx].load_unmasked(), row, column
                ),
                masked=not masks[idx][row, column],
                cost=float(curve.by_source[idx, curve.winner]),
            )
        )
    return tuple(sights)


def _true_range(
    folder: Path | None, image: str, read: _SweepRead, *, row: int, column: int
) -> tuple[float, tuple[str, ...]]:
    """Return the true range in scene units, scaled by the camera centres, or the reason why it is unknown."""
    if folder is None:
        return np.nan, ()
    truth = read_truth(folder)
    estimated = dict(zip((image, *read.names), read.poses, strict=True))
    pictures = dict(zip((image, *read.names), (read.reference, *read.sources), strict=True))
    matched = truth.match(list(estimated))
    views = {name: view for name, view in matched.items() if view.belongs_to(pictures[name].image)}
    if image in matched and image not in views:
        return np.nan, (f"{image} is not the image that the truth in {folder.name} belongs to",)
    ranges = truth.range_map(views[image]) if image in views else None
    if ranges is None or ranges.shape != read.reference.size_hw:
        return np.nan, (f"the truth in {folder.name} has no range map of {image} at the size that was swept",)
    try:
        scale = align_centers(estimated, {name: view.cam_from_world for name, view in views.items()}).scale
    except UsageError as error:
        return np.nan, (f"the true range is not shown: {error}",)
    return float(ranges[row, column]) / scale, ()


def _curve_notes(
    unit: Unit,
    record: UnitRecord | None,
    settings: SweepSettings,
    *,
    curve: CostCurve,
    stages: Sequence[StageRange],
    has_floors: bool,
) -> tuple[str, ...]:
    notes = []
    name = unit.entry.name
    if record is None:
        notes.append(
            f"{name} of {unit.item} is not in the cache for the current settings, images and "
            "version: only the cost curve was computed"
        )
    if settings.levels > 1:
        notes.append(
            f"{name} goes from coarse to fine (levels: {settings.levels}) and tests a few ranges around a "
            "guide; the curve tests all"
        )
    if has_floors:
        notes.append(f"{name} also compares windows on known floors; the curve shows those that face the camera")
    stored = next((found for found in stages if found.stage == name), None)
    if stored is not None and not _alike(stored.range, curve):
        notes.append(f"{name} stored {stored.range:.6g}, the curve's winner is {curve.range:.6g}")
    if curve.reason:
        notes.append(f"no range: {curve.reason}")
    return tuple(notes)


def _alike(stored: float, curve: CostCurve) -> bool:
    """Return whether a stored range agrees with the curve within half a plane."""
    if np.isnan(stored) or np.isnan(curve.range):
        return bool(np.isnan(stored) and np.isnan(curve.range))
    planes = np.arange(len(curve.ranges))
    positions = np.interp([stored, curve.range], curve.ranges, planes)
    return bool(abs(positions[0] - positions[1]) < 0.5)


def _color(picture: NDArray[np.uint8], row: int, column: int) -> tuple[int, int, int]:
    red, green, blue = (int(value) for value in picture[row, column])
    return red, green, blue
