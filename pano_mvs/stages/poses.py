"""Pose solvers: where the pictures were taken."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.adjustment.tracks import triangulate_tracks
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.confirmation import Picture
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.api import (
    All,
    Context,
    Features,
    InputError,
    InputPath,
    One,
    Panorama,
    Params,
    Poses,
    RunStoppedError,
    TwoView,
    stage,
)
from pano_mvs.core.text import plural
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.files import read_groups, recorded_pictures
from pano_mvs.scene.pose_groups import split_groups


class ScaledTranslationParams(Params):
    """Settings of poses.scaled_translation."""

    scale_estimator: Literal["cauchy", "log_median", "kappa"] = Field(
        default="cauchy", description="how translation scale factors are estimated; kappa is the paper's"
    )
    kappa: float = Field(default=0.01, gt=0, description="width of the paper's clusters of scale factors")
    adjust: bool = Field(default=True, description="adjust all cameras and points together as the model grows")
    ask_images: bool = Field(
        default=True, description="let the images decide between places that the matches support about equally"
    )


@stage("poses.scaled_translation")
def scaled_translation(
    features: All[Features],
    matches: All[TwoView],
    images: All[Panorama],
    params: ScaledTranslationParams,
    ctx: Context,
) -> Poses:
    """The paper's solver for any capture: relative poses joined by translation scale factors, placed by all pairs.

    Every image is placed by all of its pairs together; where several places agree with the pairs about as well, the
    images decide. Images that cannot be placed reliably are left out, each with its reason. Groups of images that no
    reliable pair connects are solved separately.
    """
    poses = solve_scaled_translation(
        features,
        matches,
        scale_estimator=params.scale_estimator,
        kappa=params.kappa,
        adjust=params.adjust,
        load=panorama_loader(images) if params.ask_images else None,
        rng=ctx.rng,
    )
    return checked_poses(poses, ctx)


class VerifyParams(Params):
    """Settings of poses.verify."""

    correct: bool = Field(
        default=True, description="move or leave out cameras that the images contradict; false only reports"
    )


@stage("poses.verify")
def verify(
    poses: One[Poses],
    images: All[Panorama],
    features: All[Features] | None,
    matches: All[TwoView] | None,
    params: VerifyParams,
    ctx: Context,
) -> Poses:
    """Check poses of any origin against the images, and correct what repeated structure has put in the wrong place.

    Every camera is swept with its neighbours at 256 columns, and gets the share of its textured pixels that they
    confirm beside the share that is to be expected. A camera far below it is tried in the other places that its
    matches suggest, moved to one that the images confirm clearly better, left out if nothing supports it, or reported
    as doubtful. Without features and matches it only reports.
    """
    verified = verify_poses(
        poses, panorama_loader(images), features=features, two_views=matches, correct=params.correct
    )
    for name in poses.names:
        if name in verified.names and not np.array_equal(
            poses.cam_from_world(poses.names.index(name)).center,
            verified.cam_from_world(verified.names.index(name)).center,
        ):
            ctx.note(f"{name} was moved to another place, which the images confirm better")
    return checked_poses(verified, ctx)


def panorama_loader(images: Mapping[str, Panorama]) -> Callable[[str], Picture]:
    """Return a function that loads the panorama and the mask of an image by its name."""

    def load(name: str) -> Picture:
        return images[name].load(), images[name].load_mask()

    return load


class RefineParams(Params):
    """Settings of poses.refine."""

    loss: Literal["cauchy", "huber"] = Field(default="cauchy", description="robust loss of the angular residuals")
    loss_scale_deg: float = Field(default=0.1, gt=0, description="residual at which the loss starts to bend")
    max_error_deg: float = Field(default=0.4, gt=0, description="observations further off are dropped")
    max_iterations: int = Field(default=50, ge=1, description="of the optimiser, in each round")
    align: bool = Field(
        default=True, description="place observations anew by aligning patches of the images, and adjust once more"
    )


@stage("poses.refine")
def refine(poses: One[Poses], images: All[Panorama], params: RefineParams, ctx: Context) -> Poses:
    """Angular bundle adjustment: all poses and points together, in degrees on the sphere rather than in pixels.

    Between two adjustments patches of the images are aligned, which places the observations more precisely than the
    detector does and says how precise each is. Groups of poses are adjusted one by one.
    """
    refined = refine_poses(
        poses,
        loss=params.loss,
        loss_scale_deg=params.loss_scale_deg,
        max_error_deg=params.max_error_deg,
        max_iterations=params.max_iterations,
        load=panorama_loader(images) if params.align else None,
    )
    largest = split_groups(refined)[0]
    if largest.center_stds is not None and largest.rotation_stds_rad is not None:
        ctx.metric("center_std_median", np.nanmedian(largest.center_stds))
        ctx.metric("rotation_std_median_deg", np.rad2deg(np.nanmedian(largest.rotation_stds_rad)))
    return checked_poses(refined, ctx)


class FromModelParams(Params):
    """Settings of poses.from_model."""

    path: InputPath = Field(
        description="model folder (COLMAP, SphereSfM), poses.json, transforms.json, reconstruction.json or CSV"
    )


@stage("poses.from_model")
def from_model(images: All[Panorama], params: FromModelParams, ctx: Context) -> Poses:
    """Poses that are known already: a COLMAP model, poses.json, nerfstudio's transforms.json, or CSV.

    Image names are compared with and without their folders and extensions. Where the file records the SHA-256 of its
    pictures, they are compared too: poses of other pictures that happen to have the same names are refused.
    """
    _require_its_pictures(params.path, images, ctx)
    known = known_poses(params.path, tuple(images))
    return checked_poses(known, ctx, remedy=f"{params.path} must know two pictures of the capture at least")


def _require_its_pictures(path: Path, images: Mapping[str, Panorama], ctx: Context) -> None:
    """Raise InputError if a file of poses records other pictures under the names of the capture; note single ones."""
    recorded = recorded_pictures(path)
    matched = {name: there for name, there in match_image_names(images, recorded).items()
               if PurePosixPath(name).suffix == PurePosixPath(there).suffix}  # fmt: skip
    others = [name for name, there in matched.items() if images[name].image.sha256() != recorded[there]]
    if others and len(others) == len(matched):
        raise InputError(
            f"{path}: records other pictures under these names: not one of {len(others)} ({others[0]} …) has the "
            "SHA-256 that it states. Give the poses of these pictures: --set poses.path=FILE. If they are the same "
            "pictures, saved anew, take the sha256 out of the file"
        )
    for name in others:
        ctx.note(f"{name} is not the picture, byte for byte, whose pose {path.name} records")


class TriangulateParams(Params):
    """Settings of poses.triangulate."""

    max_error_deg: float = Field(default=0.4, gt=0, description="observations further off are dropped")
    min_angle_deg: float = Field(default=1.0, gt=0, description="rays of a point must meet at this angle or more")


@stage("poses.triangulate")
def triangulate(
    poses: One[Poses], features: All[Features], matches: All[TwoView], params: TriangulateParams, ctx: Context
) -> Poses:
    """Sparse points for poses that are kept exactly as they are."""
    points = triangulate_tracks(
        poses, features, matches, max_error_deg=params.max_error_deg, min_angle_deg=params.min_angle_deg
    )
    return checked_poses(points, ctx)


_CLOSER = "Take pictures closer together (0.5–1 m indoors) with more in common"


def checked_poses(poses: Poses, ctx: Context, *, remedy: str = _CLOSER) -> Poses:
    """Report what was left out; stop where less than two pictures are left.

    Raises:
        RunStoppedError: if fewer than two pictures are registered: there is nothing to sweep.
    """
    for name, reason in poses.rejected.items():
        ctx.reject(name, reason)
    registered = len(poses.names)
    ctx.metric("registered", registered / max(1, registered + len(poses.rejected)))
    ctx.metric("points", len(poses.points_in_world))
    if poses.confirmed_shares is not None and np.isfinite(poses.confirmed_shares).any():
        ctx.metric("confirmed_share_median", np.nanmedian(poses.confirmed_shares))
    ctx.metric("groups", len(poses.worlds))
    if registered < 2:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(poses.rejected.items())[:8])
        raise RunStoppedError(f"no two panoramas could be registered, so there is no model. {remedy}. {reasons}")
    return poses


def known_poses(path: Path, images: tuple[str, ...]) -> Poses:
    """Return the poses that a file has for the images of a capture, in the capture's order, without points.

    Images without a pose, and images that share one name of the file, are rejected with the reason. Of an output folder
    with several groups of poses the largest is read.

    Raises:
        InputError: if the file cannot be used, knows none of the images, or has all of them in one place.
    """
    model, *others = read_groups(path)
    known = match_image_names(images, model.names)
    if not known:
        raise InputError(f"{path}: none of its {len(model.names)} {plural(len(model.names), 'image')} is one of this "
                         f"capture (it has {', '.join(model.names[:3])} …, the capture "
                         f"{', '.join(images[:3])} …)")  # fmt: skip
    position = {name: idx for idx, name in enumerate(model.names)}
    claims = Counter(known.values())
    poses = {
        name: model.cam_from_world(position[known[name]])
        for name in images
        if name in known and (claims[known[name]] == 1 or known[name] == name)
    }
    centers = np.array([pose.center for pose in poses.values()])
    if len(centers) > 1 and np.ptp(centers, axis=0).max() <= 1e-9 * max(1.0, float(np.abs(centers).max())):
        raise InputError(f"{path}: all {len(centers)} cameras stand in one place; depth needs different places")
    rejected = {
        name: f"{path.name} has one pose, {known[name]!r}, that several pictures could mean"
        if name in known
        else _why_unknown(name, path, others)
        for name in images
        if name not in poses
    }
    return Poses.without_points(
        poses,
        rejected=rejected,
        frame=model.frame,
        scale=model.scale,
        metric=model.metric,
    )


def _why_unknown(name: str, path: Path, others: Sequence[Poses]) -> str:
    for number, group in enumerate(others, start=1):
        if match_image_names((name,), group.names):
            return (f"{path.name} has it in group {number}, whose frame is another: give the model sparse/{number} to "
                    "have that group")  # fmt: skip
    return f"{path.name} has no pose for it"
