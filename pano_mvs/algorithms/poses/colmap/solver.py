"""Register a capture by COLMAP's mappers, with our key points and verified matches."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np

from pano_mvs.algorithms.poses.colmap.database import Cameras, TwoViews, write_database
from pano_mvs.algorithms.poses.colmap.mapping import (
    Mapper,
    colmap_seed,
    extend_model,
    poses_from_model,
    registered_panoramas,
    run_mapper,
)
from pano_mvs.algorithms.poses.frame.gauge import moved_poses, no_poses, normalised_poses
from pano_mvs.algorithms.poses.placement.resection import best_pair, why_no_pair
from pano_mvs.core.settings import Setting
from pano_mvs.geometry import Similarity3
from pano_mvs.scene import Features, Poses
from pano_mvs.scene.pose_groups import join_groups, with_cameras

_CAMERAS = Setting("EQUIRECTANGULAR cameras, or a rig of six pinhole faces for each panorama")


def solve_colmap(
    features: Mapping[str, Features],
    two_views: TwoViews,
    *,
    mapper: Annotated[Mapper, Setting("COLMAP's mapper")] = "incremental",
    cameras: Annotated[Cameras, _CAMERAS] = "sphere",
    rng: np.random.Generator,
    scratch: Path,
) -> Poses:
    """Estimate the poses of a capture by COLMAP's incremental or global mapper.

    Schönberger & Frahm, "Structure-from-Motion Revisited", 2016; Pan et al., "Global Structure-from-Motion
    Revisited", 2024. The mapper runs on one thread with a seed, so that the same input gives the same poses.

    Args:
        features: key points by image name, in the capture's order.
        two_views: verified pairs; those without a general geometry are left out.
        cameras: "sphere": EQUIRECTANGULAR cameras; "faces": six pinhole faces, held together as one rig.
        rng: gives COLMAP's seed.
        scratch: an empty folder for COLMAP's files.

    Returns:
        Poses in the frame of the first registered camera, with a first baseline of length 1. Several models become
        several groups, each in its own frame; a panorama in two models is taken from the larger one. Panoramas that are
        in no model of two or more are in `rejected`, with the reason.
    """
    seed = colmap_seed(rng)
    (scratch / "models").mkdir()
    images = write_database(scratch / "database.db", features, two_views, cameras=cameras)
    try:
        models = run_mapper(
            scratch / "database.db",
            scratch / "models",
            mapper=mapper,
            cameras=cameras,
            seed=seed,
            width_px=_width_px(features),
        )
    except (RuntimeError, ValueError, IndexError) as error:
        return no_poses(dict.fromkeys(features, f"COLMAP's {mapper} mapper failed: {error}"))
    groups: list[Poses] = []
    registered: set[str] = set()
    for model in models:
        poses = poses_from_model(model, features, images, rejected={})
        group = with_cameras(poses, np.array([name not in registered for name in poses.names], np.bool_))
        if len(group.names) > 1:
            groups.append(normalised_poses(group))
            registered.update(group.names)
    if not groups:
        return no_poses(dict.fromkeys(features, f"COLMAP's {mapper} mapper found no model of two or more panoramas"))
    return join_groups(groups, order=tuple(features), rejected=_rejected(features, two_views, registered))


def extend_with_colmap(
    known: Poses,
    features: Mapping[str, Features],
    two_views: TwoViews,
    *,
    cameras: Annotated[Cameras, _CAMERAS],
    rng: np.random.Generator,
    scratch: Path,
) -> Poses:
    """Add images to known poses by COLMAP's incremental mapper; the known poses stay exactly as they are.

    Args:
        known: poses by the names in `features`; others are ignored. The points of these poses are replaced.
        features: key points by image name, in the capture's order.
        two_views: verified pairs; those without a general geometry are left out.
        cameras: see `solve_colmap`.
        rng: gives COLMAP's seed.
        scratch: an empty folder for COLMAP's files.

    Returns:
        Poses in the frame and unit of the known poses. Images that COLMAP does not add are in `rejected`, with the
        reason; so are known images without any reliable pair, which COLMAP does not load (`extend_poses` keeps them).
    """
    seed = colmap_seed(rng)
    (scratch / "models").mkdir()
    images = write_database(scratch / "database.db", features, two_views, cameras=cameras)
    position = {name: idx for idx, name in enumerate(features)}
    fixed = {position[name]: known.cam_from_world(idx) for idx, name in enumerate(known.names) if name in position}
    model, stopped = None, "the known images give no point that it could see"
    try:
        if len(fixed) > 1:
            model = extend_model(
                scratch / "database.db",
                scratch / "models",
                fixed,
                images=images,
                cameras=cameras,
                seed=seed,
                width_px=_width_px(features),
            )
    except (RuntimeError, ValueError, IndexError) as error:
        stopped = f"COLMAP's incremental mapper failed: {error}"
    if model is None:
        return Poses.without_points(
            {name: fixed[idx] for name, idx in position.items() if idx in fixed},
            rejected={
                name: why_no_pair(name, two_views) or stopped for name, idx in position.items() if idx not in fixed
            },
            **known.worlds[0]._asdict(),
        )
    names = tuple(features)
    registered = {names[idx] for idx in registered_panoramas(model, images)}
    rejected = _rejected(features, two_views, registered)
    poses = _in_world_of(known, poses_from_model(model, features, images, rejected=rejected))
    return replace(poses, **known.worlds[0]._asdict())


def _in_world_of(known: Poses, poses: Poses) -> Poses:
    """Return poses in the world frame of the known ones, with the known poses exactly as they were.

    COLMAP moves and scales the world of a model after a global adjustment, but does not rotate it.
    """
    common = [(idx, known.names.index(name)) for idx, name in enumerate(poses.names) if name in known.names]
    here, there = (np.array(column) for column in zip(*common, strict=True))
    old, new = poses.centers[here], known.centers[there]
    scale = float(np.linalg.norm(new - new.mean(axis=0)) / np.linalg.norm(old - old.mean(axis=0)))
    moved = moved_poses(poses, Similarity3(scale, np.eye(3), new.mean(axis=0) - scale * old.mean(axis=0)))
    moved.rotations[here], moved.translations[here] = known.rotations[there], known.translations[there]
    return moved


def _width_px(features: Mapping[str, Features]) -> float:
    return float(np.median([found.size_hw[1] for found in features.values()])) if features else 1024.0


def _rejected(features: Mapping[str, Features], two_views: TwoViews, registered: Collection[str]) -> dict[str, str]:
    """Return the reason for every panorama that is not registered."""
    return {name: _why_unregistered(name, two_views) for name in features if name not in registered}


def _why_unregistered(name: str, two_views: TwoViews) -> str:
    pair = best_pair(name, two_views)
    if pair is None or not two_views[pair]:
        return why_no_pair(name, two_views)
    partner = pair[1] if pair[0] == name else pair[0]
    return (
        f"COLMAP did not register it, although its best partner, {partner!r}, shares {len(two_views[pair])} "
        "verified matches"
    )
