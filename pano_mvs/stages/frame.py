"""The world frame and the unit of length of poses: levelled by gravity, scaled to metres."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from pano_mvs.algorithms.poses.georeference import fit_gps, georeferenced_poses, scaled_by_gps
from pano_mvs.algorithms.poses.levelling import level_poses
from pano_mvs.algorithms.poses.metric_scale import scaled_by_baseline, scaled_by_camera_height, scaled_poses
from pano_mvs.algorithms.poses.unit_translations import unit_translations as without_scale_factors
from pano_mvs.algorithms.poses.vertical import find_vertical
from pano_mvs.api import All, Context, InputError, One, Panorama, Params, Poses, stage
from pano_mvs.io.names import match_image_names

_UP_OF_WORLD = np.array([0.0, -1.0, 0.0])


class LevelParams(Params):
    """Settings of poses.level."""

    evidence: Literal["auto", "sensors", "structure", "cameras"] = Field(
        default="auto",
        description="what tells the vertical: the pitch and roll that the pictures state, the level surfaces among the "
        "sparse points, the cameras' own up directions; auto takes the first of them that can be used",
    )


@stage("poses.level")
def level(poses: One[Poses], images: All[Panorama], params: LevelParams, ctx: Context) -> Poses:
    """Turn the world so that y points down along gravity, and z north where compass headings agree.

    The origin goes to the first registered camera; the unit of length stays. Where nothing tells the vertical, the
    poses stay as they are and the report says why.
    """
    headings = {name: image.heading_deg for name, image in images.items() if image.heading_deg is not None}
    levelled, vertical = level_poses(poses, _up_in_cam(images), headings, evidence=params.evidence)
    if not vertical:
        ctx.note(f"the world was not levelled: {vertical.reason}")
    else:
        ctx.note(f"levelled by {vertical.evidence}")
        if np.isfinite(vertical.disagreement_deg):
            ctx.metric("disagreement_deg", vertical.disagreement_deg)
    return levelled


class BaselineParams(Params):
    """A known distance between two cameras."""

    model_config = ConfigDict(populate_by_name=True)

    from_image: str = Field(alias="from", description="name of an image")
    to_image: str = Field(alias="to", description="name of another one")
    metres: float = Field(gt=0, description="distance between their centres")


class ScaleParams(Params):
    """Settings of poses.scale."""

    baseline: BaselineParams | None = Field(
        default=None, description="known distance between two images: {from: a.jpg, to: b.jpg, metres: 1.2}"
    )
    camera_height_m: float | None = Field(
        default=None, gt=0, description="median height of the cameras above the floor, in metres"
    )
    gps: bool = Field(default=False, description="scale by the GPS positions that the pictures state")
    factor: float | None = Field(default=None, gt=0, description="metres per unit of the poses")
    align: Literal["keep", "gps"] = Field(
        default="keep", description="gps also turns the world: x east, y down, z north"
    )
    gps_noise_m: float = Field(default=3.0, gt=0, description="standard deviation of a GPS position along an axis")
    vertical: Literal["auto", "sensors", "structure", "cameras", "world"] = Field(
        default="auto",
        description="the vertical for gps and camera_height_m: as in poses.level, or the world's own y",
    )

    @model_validator(mode="after")
    def _one_origin(self) -> ScaleParams:
        given = [self.baseline is not None, self.camera_height_m is not None, self.gps, self.factor is not None]
        if sum(given) != 1:
            raise ValueError("give exactly one of baseline, camera_height_m, gps: true, factor")
        if self.align == "gps" and not self.gps:
            raise ValueError("align: gps needs gps: true")
        return self


@stage("poses.scale")
def scale(poses: One[Poses], images: All[Panorama], params: ScaleParams, ctx: Context) -> Poses:
    """Make the metre the unit of length, by one length that is known.

    Known may be the distance between two images, the cameras' height above the floor, GPS positions, or the factor
    itself. Everything behind it comes out in metres: ranges, cloud, COLMAP model.

    Raises:
        InputError: if the length cannot be had from the poses: an image that is not registered, no floor, GPS
            positions too close together for their noise.
    """
    if params.baseline is not None:
        metric = _by_baseline(poses, images, params.baseline)
    elif params.factor is not None:
        metric = scaled_poses(poses, params.factor, origin=f"the given factor {params.factor:g}")
    elif params.camera_height_m is not None:
        metric, floor = scaled_by_camera_height(
            poses, _up(poses, images, params.vertical), metres=params.camera_height_m
        )
        if not floor:
            raise InputError(f"camera_height_m gives no scale: {floor.reason}. Give a baseline instead")
    else:
        metric = _by_gps(poses, images, params, ctx)
    ctx.note(f"unit of length: {metric.scale}")
    return metric


class UnitTranslationsParams(Params):
    """Settings of poses.unit_translations."""

    enabled: bool = Field(default=True, description="false passes the poses on as they are")


@stage("poses.unit_translations")
def unit_translations(poses: One[Poses], params: UnitTranslationsParams) -> Poses:
    """Forget the translation scale factors: every camera at distance 1 from the first. The paper's ablation."""
    return without_scale_factors(poses) if params.enabled else poses


def _by_baseline(poses: Poses, images: All[Panorama], baseline: BaselineParams) -> Poses:
    wanted = (baseline.from_image, baseline.to_image)
    known = match_image_names(wanted, images)
    for name in wanted:
        if name not in known:
            raise InputError(
                f"baseline: {name} is not one image of the capture, which has {', '.join(list(images)[:5])} …"
            )
    first, second = (known[name] for name in wanted)
    return scaled_by_baseline(poses, first, second, metres=baseline.metres)


def _by_gps(poses: Poses, images: All[Panorama], params: ScaleParams, ctx: Context) -> Poses:
    positions = {name: image.position_lla for name, image in images.items() if image.position_lla is not None}
    up = _up(poses, images, params.vertical)
    fit = fit_gps(poses, positions, up, gps_noise_m=params.gps_noise_m, rng=ctx.rng)
    if not fit:
        raise InputError(f"GPS gives no scale: {fit.reason}. Give a baseline or camera_height_m instead, or "
                         "gps_noise_m if the receiver was better")  # fmt: skip
    ctx.metric("gps_residual_m", fit.residual_m)
    ctx.metric("gps_scale_error", fit.scale_error)
    return georeferenced_poses(poses, fit) if params.align == "gps" else scaled_by_gps(poses, fit)


def _up(
    poses: Poses, images: All[Panorama], evidence: Literal["auto", "sensors", "structure", "cameras", "world"]
) -> NDArray[np.float64]:
    if evidence == "world":
        return _UP_OF_WORLD
    vertical = find_vertical(poses, _up_in_cam(images), evidence=evidence)
    if not vertical:
        raise InputError(f"the vertical is not known: {vertical.reason}. Level the poses and give vertical: world")
    return vertical.up_in_world


def _up_in_cam(images: All[Panorama]) -> dict[str, tuple[float, float, float]]:
    return {name: image.up_in_cam for name, image in images.items() if image.up_in_cam is not None}
