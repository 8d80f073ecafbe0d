"""World frame and unit of length of poses: levelled by gravity, scaled to metres."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from pano_mvs.algorithms.poses.frame.georeference import fit_gps, fit_survey, georeferenced_poses, scaled_by_gps
from pano_mvs.algorithms.poses.frame.metric_scale import scaled_by_baseline, scaled_by_camera_height, scaled_poses
from pano_mvs.algorithms.poses.frame.metric_scale import unit_translations as without_scale_factors
from pano_mvs.algorithms.poses.frame.vertical import SURE, Evidence, Vertical, find_vertical, level_poses
from pano_mvs.algorithms.poses.frame.vertical_lines import Picture
from pano_mvs.api import All, Context, InputError, One, Panorama, Params, Poses, arguments_from, stage
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.files import matched_positions
from pano_mvs.scene.pose_groups import join_groups, split_groups
from pano_mvs.stages.pose_paths import PosesPath
from pano_mvs.stages.poses import only_links_place


def one_panorama_bytes(_: Params, inputs: Mapping[str, Any]) -> int:
    """Return the memory for the views of one panorama, whose decoding the engine counts."""
    pixels = max(
        (height * width for height, width in (image.size_hw for image in inputs["images"].values())), default=0
    )
    return 100_000_000 + 12 * pixels


@stage("poses.level", settings=level_poses, memory=one_panorama_bytes)
def level(poses: One[Poses], images: All[Panorama], params: Params, ctx: Context) -> Poses:
    """Rotate the world so that y points down along gravity, and z north if compass headings agree.

    The origin is the first registered camera; the unit of length does not change. The frame states the evidence and its
    uncertainty. If the vertical cannot be determined, or not well enough, the poses do not change and the report states
    why. Each group of poses is levelled on its own. A group that was taken upside down is turned around, unless
    `evidence` names a source of the vertical. Where cameras were turned in all directions, lines in the pictures give
    three axes, and brightness, texture and points show which one is vertical.
    """
    if only_links_place(poses, images):
        return poses
    headings = {name: image.heading_deg for name, image in images.items() if image.heading_deg is not None}
    groups, levelled = split_groups(poses), []
    for number, group in enumerate(groups):
        level_group, vertical = level_poses(
            group, _up_in_cam(images), headings, pictures=_pictures(images), **arguments_from(level_poses, params)
        )
        levelled.append(level_group)
        which = f"group {number}: " if len(groups) > 1 else ""
        if vertical.unused:
            ctx.note(f"{which}pitch and roll in the metadata were not used: {vertical.unused}")
        if not vertical:
            ctx.note(f"{which}the world was not levelled: {vertical.reason}")
        else:
            ctx.note(f"{which}levelled by {vertical.evidence}, uncertain by {vertical.uncertainty_deg:.1f}°")
            if _on_orientation(vertical):
                ctx.note(f"{which}{_on_orientation(vertical)}")
            if over := _turned_over(level_group):
                ctx.note(f"{which}upside down unlike the others, which the poses allow for: {', '.join(over)}")
            if not number:
                ctx.metric("uncertainty_deg", vertical.uncertainty_deg)
                for source, weight in vertical.weights.items():
                    ctx.metric(f"weight_{source}", weight)
                if np.isfinite(vertical.disagreement_deg):
                    ctx.metric("disagreement_deg", vertical.disagreement_deg)
    return join_groups(levelled, order=poses.names, rejected=poses.rejected)


def _turned_over(level_group: Poses) -> list[str]:
    """Return the images that are upside down in a level world; none unless most others are upright."""
    cosine = level_group.rotations[:, 1, 1]  # between up of a camera and of the world
    over = cosine < -0.8
    if over.all() or np.median(cosine[~over]) < 0.8:
        return []
    return [name for name, is_over in zip(level_group.names, over, strict=True) if is_over]


def _on_orientation(vertical: Vertical) -> str:
    """Return what to report about cameras that are, or may be, upside down; "" if they are upright."""
    why = f"probability {vertical.upside_down:.2f}, by brightness, texture and the floor below and above the cameras"
    if vertical.upside_down >= SURE:
        return (
            f"the panoramas are upside down ({why}), so the world was turned around. If they are not, set "
            f"`evidence: {vertical.source}` for poses.level"
        )
    if vertical.upside_down >= 1 - SURE:
        return f"the panoramas may be upside down ({why}). If they are, rotate the images by 180° and run again"
    return ""


class BaselineParams(Params):
    """A known distance between two cameras."""

    model_config = ConfigDict(populate_by_name=True)

    from_image: str = Field(alias="from", description="name of an image")
    to_image: str = Field(alias="to", description="name of another image")
    metres: float = Field(gt=0, description="distance between their centres")


class ScaleParams(Params):
    """Settings of poses.scale."""

    baseline: BaselineParams | None = Field(
        default=None, description="known distance between two images: {from: a.jpg, to: b.jpg, metres: 1.2}"
    )
    camera_height_m: float | None = Field(
        default=None, gt=0, description="median height of the cameras above the floor, in metres"
    )
    gps: bool = Field(default=False, description="scale by the GPS positions in the images' metadata")
    positions: PosesPath | None = Field(
        default=None, description="scale by surveyed positions in metres: a table with name, x, y, z"
    )
    factor: float | None = Field(default=None, gt=0, description="metres per unit of the poses")
    group: int = Field(default=0, ge=0, description="group of the poses that `factor` applies to; 0 is the largest")
    origin: str = Field(default="", description="where `factor` comes from, for run.json and the report")
    align: Literal["keep", "gps"] = Field(
        default="keep",
        description="gps also rotates the world: x east, y down, z north; with positions, along x and y of the survey",
    )
    gps_noise_m: float = Field(
        default=3.0, gt=0, description="standard deviation of GPS or surveyed positions along an axis, in metres"
    )
    vertical: Literal[Evidence, "world"] = Field(
        default="auto",
        description="vertical for gps and camera_height_m, as in poses.level; world: the world's y axis",
    )

    @model_validator(mode="after")
    def _one_origin(self) -> ScaleParams:
        lengths = (self.baseline, self.camera_height_m, self.positions, self.factor)
        if sum(given is not None for given in lengths) + self.gps != 1:
            raise ValueError("give exactly one of baseline, camera_height_m, gps: true, positions, factor")
        if self.align == "gps" and not (self.gps or self.positions):
            raise ValueError("align: gps requires gps: true or positions")
        return self


@stage("poses.scale", memory=one_panorama_bytes)
def scale(poses: One[Poses], images: All[Panorama], params: ScaleParams, ctx: Context) -> Poses:
    """Scale poses to metres by a known length.

    The length is the distance between two images, the height of the cameras above the floor, GPS or surveyed positions,
    or a factor. Everything computed from the poses is then in metres: ranges, cloud, COLMAP model. If there are several
    groups of poses, a distance between two images scales the group that contains both, a factor the largest group;
    height and GPS scale every group for which they can be determined. Other groups keep their unit, and the report says
    so.

    Raises:
        InputError: if no group can be scaled: an image is not registered, there is no floor, or the GPS positions are
            too close together for their noise.
    """
    groups = split_groups(poses)
    if params.baseline is not None:
        ends, metres = _ends(images, params.baseline), params.baseline.metres
        homes = [number for name in ends for number, group in enumerate(groups) if name in group.names]
        chosen = homes[0] if len(homes) == 2 else None  # None if one of them is in no group
        if chosen is not None and chosen != homes[1]:
            raise InputError(
                f"baseline: {ends[0]} and {ends[1]} are in groups {homes[0]} and {homes[1]} of the poses, which no "
                "reliable pair connects, so the distance between them gives no scale. Use two images of one group"
            )
        whole = poses if chosen is None else groups[chosen]
        return _scaled(
            poses, groups, [chosen or 0], scaled=lambda _: scaled_by_baseline(whole, *ends, metres=metres), ctx=ctx
        )
    if params.factor is not None:
        origin, factor = params.origin or f"the given factor {params.factor:g}", params.factor
        if params.group >= len(groups):
            raise InputError(f"group {params.group}: the poses have {len(groups)} groups, numbered from 0")
        return _scaled(
            poses, groups, [params.group], scaled=lambda group: scaled_poses(group, factor, origin=origin), ctx=ctx
        )
    every = list(range(len(groups)))
    if params.camera_height_m is not None:
        return _scaled(poses, groups, every, scaled=lambda group: _by_camera_height(group, images, params), ctx=ctx)
    return _scaled(poses, groups, every, scaled=lambda group: _by_gps(group, images, params, ctx=ctx), ctx=ctx)


class UnitTranslationsParams(Params):
    """Settings of poses.unit_translations."""

    enabled: bool = Field(default=True, description="false returns the poses unchanged")


@stage("poses.unit_translations")
def unit_translations(poses: One[Poses], params: UnitTranslationsParams) -> Poses:
    """Remove the translation scale factors: every camera is at distance 1 from the first. The paper's ablation."""
    return without_scale_factors(poses) if params.enabled else poses


def _scaled(
    poses: Poses, groups: list[Poses], chosen: list[int], *, scaled: Callable[[Poses], Poses], ctx: Context
) -> Poses:
    """Return all groups, with the chosen ones scaled if possible."""
    found, refused = list(groups), {}
    for number in chosen:
        try:
            found[number] = scaled(groups[number])
        except InputError as error:
            refused[number] = error
    if len(refused) == len(chosen):
        raise refused[chosen[0]]
    for number, group in enumerate(found):
        which = f"group {number}: " if len(groups) > 1 else ""
        if number in chosen and number not in refused:
            ctx.note(f"{which}unit of length: {group.scale}")
        else:
            why = str(refused.get(number, "the length that is known is of another group"))
            ctx.note(f"{which}keeps its own unit of length ({group.scale}): {why}")
    return join_groups(found, order=poses.names, rejected=poses.rejected)


def _by_camera_height(poses: Poses, images: All[Panorama], params: ScaleParams) -> Poses:
    assert params.camera_height_m is not None
    up = _up(poses, images, params.vertical)
    metric, floor = scaled_by_camera_height(poses, up, metres=params.camera_height_m)
    if not floor:
        raise InputError(f"camera_height_m gives no scale: {floor.reason}. Give a baseline instead")
    return metric


def _ends(images: All[Panorama], baseline: BaselineParams) -> tuple[str, str]:
    """Return the names in the capture of the two images of a baseline."""
    wanted = (baseline.from_image, baseline.to_image)
    known = match_image_names(wanted, images)
    for name in wanted:
        if name not in known:
            raise InputError(
                f"baseline: {name} is not one image of the capture, which has {', '.join(list(images)[:5])} …"
            )
    return known[wanted[0]], known[wanted[1]]


def _by_gps(poses: Poses, images: All[Panorama], params: ScaleParams, *, ctx: Context) -> Poses:
    up = _up(poses, images, params.vertical)
    if params.positions is not None:
        surveyed, notes = matched_positions(tuple(images), params.positions)
        for note in notes:
            if note not in ctx.notes:  # of an earlier group
                ctx.note(note)
        survey = params.positions.name
        fit = fit_survey(poses, surveyed, up, noise_m=params.gps_noise_m, rng=ctx.rng, survey=survey)
    else:
        positions = {name: image.position_lla for name, image in images.items() if image.position_lla is not None}
        fit = fit_gps(poses, positions, up, gps_noise_m=params.gps_noise_m, rng=ctx.rng)
    if not fit:
        raise InputError(
            f"no scale by {fit.source}: {fit.reason}. Give a baseline or camera_height_m instead, or set gps_noise_m "
            "if the positions are more accurate"
        )
    if "gps_residual_m" not in ctx.metrics:  # the largest group's
        ctx.metric("gps_residual_m", fit.residual_m)
        ctx.metric("gps_scale_error", fit.scale_error)
    return georeferenced_poses(poses, fit) if params.align == "gps" else scaled_by_gps(poses, fit)


def _up(poses: Poses, images: All[Panorama], evidence: Literal[Evidence, "world"]) -> NDArray[np.float64]:
    if evidence == "world":
        return np.array([0.0, -1.0, 0.0])
    vertical = find_vertical(poses, _up_in_cam(images), _pictures(images), evidence=evidence)
    if not vertical:
        raise InputError(f"the vertical is not known: {vertical.reason}. Level the poses and set vertical: world")
    return vertical.up_in_world


def _up_in_cam(images: All[Panorama]) -> dict[str, tuple[float, float, float]]:
    return {name: image.up_in_cam for name, image in images.items() if image.up_in_cam is not None}


def _pictures(images: All[Panorama]) -> dict[str, Picture]:
    """Return functions that load the panoramas, since most of them may not be needed."""
    return {name: partial(_picture, image) for name, image in images.items()}


def _picture(image: Panorama) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    return image.load(), image.load_mask()
