"""Pose solvers: estimate where the images were taken."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.poses.adjustment.refine import fitted_elevation_range, refine_poses
from pano_mvs.algorithms.poses.adjustment.tracks import triangulate_tracks
from pano_mvs.algorithms.poses.loop_closures import find_false_closures
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.belief.doubts import with_later_evidence
from pano_mvs.algorithms.poses.verification.confirmation import Picture
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.api import (
    All,
    Context,
    Features,
    InputError,
    One,
    Panorama,
    Params,
    Poses,
    TwoView,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.core.text import plural, shortened_list
from pano_mvs.io.images.names import match_image_names, without_shared
from pano_mvs.io.poses.files import match_images, read_groups, recorded_pictures
from pano_mvs.scene.pose_groups import CLOSER, join_groups, require_two_cameras, split_groups
from pano_mvs.stages.pose_paths import PosesPath


@params_from(solve_scaled_translation, own_last=True)
class ScaledTranslationParams(Params):
    """Settings of poses.scaled_translation."""

    ask_images: bool = Field(
        default=True,
        description="use the images to weigh relative poses that the matches support about equally",
    )
    check_closures: bool = Field(
        default=True, description="of a walk, leave out pairs that join places far apart along the path"
    )


# Measured: most of it for the test of loop closures.
@stage("poses.scaled_translation", expected_memory=lambda _params, _images, stored_bytes: 12 * stored_bytes)
def scaled_translation(
    features: All[Features],
    matches: All[TwoView],
    images: All[Panorama],
    params: ScaledTranslationParams,
    ctx: Context,
) -> Poses:
    """Solve poses by the paper's method for any capture: join relative poses by translation scale factors.

    Each image is placed by all of its pairs together; if many pairs agree with several relative poses, the images weigh
    these. Images that cannot be placed reliably are left out, each with a reason. Groups of images without a
    reliable pair between them are solved separately. If the images were taken along a path, it is solved from the pairs
    in sequence first; pairs of places that look the same, but are far apart along the path, are left out.
    """
    poses = solve_scaled_translation(
        features,
        _without_false_closures(features, matches, ctx) if params.check_closures else matches,
        **arguments_from(solve_scaled_translation, params),
        load=panorama_loader(images) if params.ask_images else None,
        rng=ctx.rng,
    )
    return reported_poses(poses, ctx)


def _without_false_closures(
    features: Mapping[str, Features], matches: Mapping[tuple[str, str], TwoView], ctx: Context
) -> Mapping[tuple[str, str], TwoView]:
    """Return the pairs without those that contradict the path of a walk, which are reported."""
    found = find_false_closures(features, matches)
    if not found:
        return matches
    worst = max(found, key=lambda closure: closure.steps)
    ctx.note(
        f"{len(found)} {plural(len(found), 'pair')} of images that look alike but are far apart along the path "
        f"{plural(len(found), 'was', 'were')} left out, such as {worst.pair[0]} and {worst.pair[1]}, {worst.steps:.0f} "
        "steps apart. If they do show the same place, the path has drifted: set check_closures: false"
    )
    ctx.metric("false_closures", len(found))
    left_out = {closure.pair for closure in found}
    return {pair: view for pair, view in matches.items() if pair not in left_out}


@stage("poses.verify", settings=verify_poses)
def verify(
    poses: One[Poses],
    images: All[Panorama],
    features: All[Features] | None,
    matches: All[TwoView] | None,
    params: Params,
    ctx: Context,
) -> Poses:
    """Check poses of any origin against the images, and correct errors caused by repeated structure.

    Each camera is swept with its neighbours at 256 columns. The result is the share of its textured pixels that they
    confirm, and the share to be expected. These and the pairs give the probability that the camera is right. A doubtful
    one is moved if the images confirm more of all cameras with another pose that its matches suggest, left out if it is
    surely wrong, or reported. Two or more cameras that one left out alone connected to the others become a group of
    their own. Without features and matches the stage only reports.
    """
    verified = verify_poses(
        poses, panorama_loader(images), features=features, two_views=matches, **arguments_from(verify_poses, params)
    )
    moved, split_off = changed_places(poses, verified)
    if moved:
        were = plural(len(moved), "was", "were")
        ctx.note(f"{shortened_list(moved)} {were} moved to another place, where the images confirm more of all cameras")
    for names in split_off:
        ctx.note(f"{shortened_list(names)} are a group of their own, since a camera that was left out held them")
    return reported_poses(verified, ctx) if only_links_place(verified, images) else checked_poses(verified, ctx)


def changed_places(before: Poses, after: Poses) -> tuple[list[str], list[list[str]]]:
    """Return the cameras that stand elsewhere in their world, and the groups whose world is new."""
    moved: list[str] = []
    split_off: list[list[str]] = []
    cameras, groups = before.cameras, split_groups(after)
    grew = len(groups) > len(split_groups(before))
    for group in groups:
        own = {name: camera for name, camera in group.cameras.items() if name in cameras}
        elsewhere = [name for name, camera in own.items() if not np.array_equal(cameras[name].center, camera.center)]
        # In a new world, one camera may have the centre that it had: the origin.
        if grew and elsewhere and len(elsewhere) >= max(1, len(own) - 1):
            split_off.append([*own])
        else:
            moved += elsewhere
    return moved, split_off


def panorama_loader(images: Mapping[str, Panorama]) -> Callable[[str], Picture]:
    """Return a function that loads the panorama and the mask of an image by its name."""

    def load(name: str) -> Picture:
        return images[name].load(), images[name].load_mask()

    return load


@params_from(refine_poses, own_last=True)
class RefineParams(Params):
    """Settings of poses.refine."""

    align: bool = Field(default=True, description="refine observations by aligning image patches, and adjust once more")


@stage("poses.refine", expected_memory=lambda _params, _images, stored_bytes: 6 * stored_bytes)
def refine(poses: One[Poses], images: All[Panorama], params: RefineParams, ctx: Context) -> Poses:
    """Refine all poses and points by angular bundle adjustment, with errors in degrees on the sphere instead of pixels.

    Between two adjustments, patches of the images are aligned, which locates the observations more precisely than the
    detector and estimates their precision. Groups of poses are adjusted one by one. For panoramas of
    source.dual_fisheye, the ray of each observation starts at the centre of its lens. If the distance of the lenses
    determines the unit of length to 3 %, the poses are in metres.
    """
    if only_links_place(poses, images):
        return reported_poses(poses, ctx)
    rigs = {name: image.rig for name, image in images.items() if image.rig is not None}
    refined = refine_poses(
        poses,
        **arguments_from(refine_poses, params),
        load=panorama_loader(images) if params.align else None,
        rigs=rigs,
    )
    if refined.metric and not poses.metric:
        ctx.note(f"unit of length: {refined.scale}")
    elif rigs and not refined.metric and not all(rig.metric for rig in rigs.values()):
        ctx.note(
            "the poses are not in metres: the distance between the lenses is only assumed in the calibration. Measure "
            "it and give it to pano-mvs calibrate with --distance"
        )
    elif rigs and not refined.metric:
        ctx.note(
            "the distance between the lenses does not determine the unit of length here, so their offsets were "
            "ignored; if it matters, add poses.scale before poses.refine"
        )
    largest = split_groups(refined)[0]
    if largest.center_stds is not None and largest.rotation_stds_rad is not None:
        ctx.metric("center_std_median", np.nanmedian(largest.center_stds))
        ctx.metric("rotation_std_median_deg", np.rad2deg(np.nanmedian(largest.rotation_stds_rad)))
    return checked_poses(refined if rigs else _checked_projection(poses, refined, ctx=ctx, params=params), ctx)


def _checked_projection(poses: Poses, refined: Poses, *, params: RefineParams, ctx: Context) -> Poses:
    """Return refined poses whose cameras are hardly right if their panoramas do not cover the full sphere."""
    settings = arguments_from(refine_poses, params)
    found = fitted_elevation_range(poses, refined, loss=settings["loss"], loss_scale_deg=settings["loss_scale_deg"])
    if found is None or found.is_full:
        return refined
    reason = (
        f"the images do not cover the full sphere: their rays fit elevations from {found.bottom_deg:.0f}° to "
        f"{found.top_deg:.0f}°. They were probably cropped above or below and stretched to twice as wide as high, "
        "which makes the result wrong. Use the original images, or undo the stretching and state the crop as GPano "
        "metadata"
    )
    ctx.note(reason)
    # The range differs from the full one by more than three standard deviations.
    return with_later_evidence(refined, dict.fromkeys(refined.names, (float(np.exp(-(3.0**2) / 2)), reason)))


class FromModelParams(Params):
    """Settings of poses.from_model."""

    path: PosesPath = Field(
        description="model folder (COLMAP, SphereSfM), poses.json, transforms.json, reconstruction.json, "
        "sfm_data.json, cameras.sfm, XML of Metashape, CSV, or a trajectory (.txt, .tum)"
    )


@stage("poses.from_model")
def from_model(images: All[Panorama], params: FromModelParams, ctx: Context) -> Poses:
    """Read known poses from a COLMAP model, poses.json, nerfstudio's transforms.json, or CSV.

    Image names are compared with and without their folders and extensions. If the file contains the SHA-256 of its
    images, the hashes are compared too: poses of other images with the same names are rejected. Several models, such as
    reconstructions of OpenSfM or components of Metashape, are groups of poses. Photographs in the file are named.
    """
    recorded = recorded_pictures(params.path)
    matched = {
        name: there
        for name, there in match_image_names(images, recorded).items()
        if PurePosixPath(name).suffix == PurePosixPath(there).suffix
    }
    others = [name for name, there in matched.items() if images[name].image.sha256() != recorded[there]]
    if others and len(others) == len(matched):
        raise InputError(
            f"{params.path}: records other images under these names: not one of {len(others)} ({others[0]} …) has the "
            "SHA-256 in the file. Give the poses of these images: --set poses.path=FILE. If they are the same images, "
            "saved again, remove the sha256 from the file"
        )
    for name in others:
        ctx.note(f"{name} is not the image whose pose {params.path.name} records: the files differ")
    notes: list[str] = []
    known = known_groups(params.path, tuple(images), notes)
    for note in notes:
        ctx.note(note)
    return checked_poses(known, ctx, remedy=f"{params.path} must contain poses of at least two images of the capture")


@stage("poses.triangulate", settings=triangulate_tracks)
def triangulate(
    poses: One[Poses], features: All[Features], matches: All[TwoView], params: Params, ctx: Context
) -> Poses:
    """Triangulate sparse points from known poses, which stay exactly as they are."""
    points = triangulate_tracks(poses, features, matches, **arguments_from(triangulate_tracks, params))
    return checked_poses(points, ctx)


def only_links_place(poses: Poses, images: Mapping[str, Panorama]) -> bool:
    """Return whether no two images are registered, but links of a virtual tour may say where they stand."""
    return len(poses.names) < 2 and any(
        link.direction_deg is not None for image in images.values() for link in image.links
    )


def checked_poses(poses: Poses, ctx: Context, *, remedy: str = CLOSER) -> Poses:
    """Report images that were left out; stop the run if fewer than two are registered.

    Raises:
        RunStoppedError: if fewer than two images are registered.
    """
    reported_poses(poses, ctx)
    require_two_cameras(poses, remedy=remedy)
    return poses


def reported_poses(poses: Poses, ctx: Context) -> Poses:
    """Report images that were left out.

    For solvers, which may place none: learned matches, or photographs, may still place more.
    """
    for name, reason in poses.rejected.items():
        ctx.reject(name, reason)
    registered = len(poses.names)
    ctx.metric("registered", registered / max(1, registered + len(poses.rejected)))
    ctx.metric("points", len(poses.points_in_world))
    if poses.confirmed_shares is not None and np.isfinite(poses.confirmed_shares).any():
        ctx.metric("confirmed_share_median", np.nanmedian(poses.confirmed_shares))
    if poses.right_probabilities is not None and np.isfinite(poses.right_probabilities).any():
        ctx.metric("p_right_lowest", np.nanmin(poses.right_probabilities))
        rightly = float(np.nansum(poses.right_probabilities))
        ctx.metric("registered_rightly", rightly / max(1, registered + len(poses.rejected)))
    ctx.metric("groups", len(poses.worlds))
    return poses


def known_poses(path: Path, images: tuple[str, ...]) -> Poses:
    """Return the largest group of what `known_groups` returns, with the other groups' images rejected."""
    poses = known_groups(path, images, [])
    largest, *others = split_groups(poses)
    elsewhere = f"{path.name} has it in another group, which has a different frame: give the model of that group alone"
    return replace(largest, rejected=poses.rejected | {name: elsewhere for group in others for name in group.names})


def known_groups(path: Path, images: tuple[str, ...], notes: list[str]) -> Poses:
    """Return the poses that a file has for the images of a capture, in the capture's order, without points.

    Images without a pose, and images that match the same name in the file, are rejected with the reason. Several models
    in a file are groups. `notes` receives what else in the file is not used, and how a trajectory was matched.

    Raises:
        InputError: if the file cannot be used, contains none of the images, or has all of them at the same place.
    """
    models = read_groups(path)
    homes = {name: number for number, model in enumerate(models) for name in model.names}
    known, how = match_images(images, list(homes), path)
    notes += [how] if how else []
    if not known:
        raise InputError(
            f"{path}: none of its {len(homes)} {plural(len(homes), 'image')} is one of this "
            f"capture (it has {', '.join(list(homes)[:3])} …, the capture "
            f"{', '.join(images[:3])} …)"
        )
    clear = without_shared(known)
    rejected = {
        name: f"{path.name} has one pose, {there!r}, that matches several images" for name, there in known.items()
    }
    unusable = models[0].rejected
    seen = match_image_names([name for name in images if name not in known], unusable)
    rejected |= {name: f"in {path.name}, {unusable[there]}" for name, there in seen.items()}
    groups = []
    for number, model in enumerate(models):
        cameras = model.cameras
        poses = {name: cameras[there] for name, there in clear.items() if homes[there] == number}
        groups.append(Poses.without_points(poses, **model.worlds[0]._asdict()))
    apart = [group for group in groups if not _in_one_place(group)]
    if not apart:
        raise InputError(f"{path}: all {len(clear)} cameras are in the same place; depth needs different places")
    rejected |= {
        name: f"{path.name} has all cameras of its group in the same place"
        for group in groups
        if _in_one_place(group)
        for name in group.names
    }
    missing = {name: f"{path.name} has no pose for it" for name in images if name not in rejected}
    others = [f"{name} ({why})" for name, why in unusable.items() if name not in seen.values()]
    if others:
        notes.append(f"not used of {path.name}, since only panoramas can be: {shortened_list(others, 5)}")
    return join_groups(apart, order=images, rejected=rejected | missing)


def _in_one_place(poses: Poses) -> bool:
    centers = poses.centers
    return len(centers) > 1 and bool(np.ptp(centers, axis=0).max() <= 1e-9 * max(1.0, float(np.abs(centers).max())))
