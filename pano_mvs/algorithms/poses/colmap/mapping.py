"""Run COLMAP's mappers quietly and reproducibly, and read their results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.colmap.database import Cameras, DatabaseImage
from pano_mvs.geometry import Rigid3, angle_between
from pano_mvs.scene import Features, Poses

Mapper = Literal["incremental", "global"]

THREADS = 1
"""With more, the order of Ceres' sums, and thus the last digits, and the numbers of images depend on the scheduler."""


def colmap_seed(rng: np.random.Generator) -> int:
    """Return a seed for COLMAP's random numbers, positive."""
    return int(rng.integers(1, 2**31 - 1))


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's progress log off the terminal; errors are still shown."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def run_mapper(
    database: Path, folder: Path, *, mapper: Mapper, cameras: Cameras, seed: int, width_px: float
) -> list[Any]:
    """Run a mapper on a database and return its models, the one with most panoramas first.

    Args:
        database: a database from `write_database`.
        folder: an empty folder for COLMAP's own files.
        mapper: COLMAP's incremental or global mapper (GLOMAP).
        cameras: the kind of cameras in the database.
        seed: seed of COLMAP's random numbers, positive.
        width_px: width of the panoramas, to which COLMAP's limits in pixels are adapted.
    """
    import pycolmap

    with quiet_colmap():
        if mapper == "incremental":
            options = _incremental_options(cameras=cameras, seed=seed, width_px=width_px)
            models = pycolmap.incremental_mapping(database, folder, folder, options)
        else:
            models = pycolmap.global_mapping(database, folder, folder, _global_options(cameras=cameras, seed=seed))
    return [model for _, model in sorted(models.items(), key=_largest_first)]


def extend_model(
    database: Path,
    folder: Path,
    known: Mapping[int, Rigid3],
    *,
    images: Mapping[int, DatabaseImage],
    cameras: Cameras,
    seed: int,
    width_px: float,
) -> Any:
    """Add panoramas to a model of known ones by COLMAP's incremental mapper, and return the model.

    Known panoramas do not move relative to each other; the world as a whole may be moved and scaled.

    Args:
        database: a database from `write_database`.
        folder: an empty folder for COLMAP's own files.
        known: cam_from_world by position of the panorama, at least two.
        images: the content of each COLMAP image.
        cameras: the kind of cameras in the database.
        seed: seed of COLMAP's random numbers, positive.
        width_px: width of the panoramas, to which COLMAP's limits in pixels are adapted.

    Returns:
        The model, or None if the known panoramas give no point that a new panorama could see.
    """
    import pycolmap

    options = _incremental_options(cameras=cameras, seed=seed, width_px=width_px)
    options.fix_existing_frames = options.mapper.fix_existing_frames = True
    with quiet_colmap():
        begun = _posed_reconstruction(database, known, images)
        begun = pycolmap.triangulate_points(begun, database, folder, folder, clear_points=True, options=options)
        if not begun.num_points3D():
            return None
        begun.write(folder)
        models = pycolmap.incremental_mapping(database, folder, folder, options, input_path=folder)
    return min(models.items(), key=_largest_first)[1] if models else begun


def _posed_reconstruction(database: Path, known: Mapping[int, Rigid3], images: Mapping[int, DatabaseImage]) -> Any:
    """Return a model without points in which the known panoramas are registered."""
    import pycolmap

    opened = pycolmap.Database.open(database)
    try:
        model = pycolmap.Reconstruction()
        model.load(pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions()))
    finally:
        opened.close()
    for image_id, image in images.items():
        pose = known.get(image.panorama_idx)
        frame = model.frames[model.images[image_id].frame_id] if model.exists_image(image_id) else None
        if pose is not None and frame is not None and not frame.has_pose():
            frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
            model.register_frame(frame.frame_id)
    return model


def poses_from_model(
    model: Any,
    features: Mapping[str, Features],
    images: Mapping[int, DatabaseImage],
    *,
    rejected: Mapping[str, str],
) -> Poses:
    """Return the panoramas of a COLMAP model with its points, using the rays and colours of our key points.

    Args:
        model: a reconstruction from the database that `images` belongs to.
        features: key points by image name, in the capture's order.
        images: the content of each COLMAP image.
        rejected: reasons for the panoramas that are not in the model.
    """
    names = tuple(features)
    cameras = registered_panoramas(model, images)
    registered = sorted(cameras)
    poses = Poses.without_points(
        {names[idx]: cameras[idx] for idx in registered},
        rejected=rejected,
        frame="the first registered camera",
        scale="the first reference–neighbour baseline is 1",
        metric=False,
    )
    point_ids = sorted(model.points3D)
    points = np.array([model.points3D[point_id].xyz for point_id in point_ids], np.float64).reshape(-1, 3)
    seen = _observations(model, images, point_ids)
    position = np.full(len(names), -1)
    position[registered] = np.arange(len(registered))
    return with_observations(
        poses, points, features, point_idx=seen[:, 0], image_idx=position[seen[:, 1]], keypoint_idx=seen[:, 2]
    )


def registered_panoramas(model: Any, images: Mapping[int, DatabaseImage]) -> dict[int, Rigid3]:
    """Return the cam_from_world of each panorama in a COLMAP model, by its position among the features."""
    cameras: dict[int, Rigid3] = {}
    for image_id in sorted(model.reg_image_ids()):
        pose = model.images[image_id].frame.rig_from_world
        cameras[images[image_id].panorama_idx] = Rigid3(pose.rotation.matrix(), np.array(pose.translation))
    return cameras


def with_observations(
    poses: Poses,
    points: NDArray[np.float64],
    features: Mapping[str, Features],
    *,
    point_idx: NDArray[np.int64],
    image_idx: NDArray[np.int64],
    keypoint_idx: NDArray[np.int64],
) -> Poses:
    """Return poses with points, (P, 3), and their observations; of two in one image, the better one is kept."""
    count = len(points)
    bearings, colors = np.zeros((len(point_idx), 3)), np.zeros((len(point_idx), 3))
    for idx, name in enumerate(poses.names):
        rows = np.flatnonzero(image_idx == idx)
        bearings[rows] = features[name].bearings[keypoint_idx[rows]]
        colors[rows] = features[name].colors_rgb[keypoint_idx[rows]]
    towards = points[point_idx] - poses.centers[image_idx]
    in_cam = np.einsum("tij,tj->ti", poses.rotations[image_idx], towards)
    errors_rad = angle_between(in_cam, bearings) if len(in_cam) else np.zeros(0)
    order = np.lexsort((errors_rad, image_idx, point_idx))
    again = np.diff(point_idx[order], prepend=-1) == 0
    again &= np.diff(image_idx[order], prepend=-1) == 0
    kept = order[~again]
    sizes = np.maximum(np.bincount(point_idx[kept], minlength=count), 1)
    means = [np.bincount(point_idx[kept], column, count) / sizes for column in (*colors[kept].T, errors_rad[kept])]
    return replace(
        poses,
        points_in_world=points,
        point_colors_rgb=np.rint(np.stack(means[:3], axis=1)).astype(np.uint8),
        point_errors_rad=means[3].astype(np.float32),
        track_point_idx=point_idx[kept].astype(np.int32),
        track_image_idx=image_idx[kept].astype(np.int32),
        track_bearings=bearings[kept],
    )


def _observations(model: Any, images: Mapping[int, DatabaseImage], point_ids: list[int]) -> NDArray[np.int64]:
    """Return (point, panorama, key point) of all observations, (T, 3); points by their position in `point_ids`."""
    rows = [
        (number, images[element.image_id].panorama_idx, images[element.image_id].keypoint_idx[element.point2D_idx])
        for number, point_id in enumerate(point_ids)
        for element in model.points3D[point_id].track.elements
    ]
    return np.array(rows, np.int64).reshape(-1, 3)


def _largest_first(item: tuple[int, Any]) -> tuple[int, int, int]:
    number, model = item
    return -model.num_reg_frames(), -model.num_points3D(), number


def _incremental_options(*, cameras: Cameras, seed: int, width_px: float) -> Any:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = THREADS, seed
    options.mapper.num_threads, options.mapper.random_seed = THREADS, seed
    options.triangulation.random_seed = seed
    options.extract_colors = False
    options.min_model_size = 2
    # A verified match of two panoramas gives a reliable point, and few captures have many points seen three times.
    options.triangulation.ignore_two_view_tracks = False
    # A panorama's camera has no intrinsics to refine, and those of a face are exact.
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.ba_refine_sensor_from_rig = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    # COLMAP's limits are pixels of pinhole images. They are kept at their values for a panorama of 1024 columns, where
    # they correspond to angles: 4 px are 1.4°, and would be 4.5° with 320 columns.
    scale = width_px / 1024
    options.mapper.filter_max_reproj_error *= scale
    options.mapper.abs_pose_max_error *= scale
    options.mapper.init_max_error *= scale
    options.triangulation.merge_max_reproj_error *= scale
    options.triangulation.complete_max_reproj_error *= scale
    if cameras == "faces":
        # The verified matches of two panoramas are spread over many pairs of faces. Only one pair starts the model,
        # which then has few points for the next panorama.
        options.min_num_matches = 1
        options.mapper.abs_pose_min_num_inliers = 15
    return options


def _global_options(*, cameras: Cameras, seed: int) -> Any:
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = THREADS, seed
    mapper = options.mapper
    mapper.num_threads, mapper.random_seed = THREADS, seed
    mapper.rotation_averaging.random_seed = mapper.global_positioning.random_seed = seed
    mapper.retriangulation.random_seed = seed
    mapper.bundle_adjustment.ceres.solver_options.num_threads = THREADS
    mapper.bundle_adjustment.refine_focal_length = mapper.bundle_adjustment.refine_extra_params = False
    mapper.refine_sensor_from_rig = mapper.rotation_averaging.refine_sensor_from_rig = False
    mapper.global_positioning.refine_sensor_from_rig = mapper.bundle_adjustment.refine_sensor_from_rig = False
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    options.min_model_size = 2
    # A verified match of two panoramas gives a reliable point, and few captures have many points seen three times.
    mapper.retriangulation.ignore_two_view_tracks = False
    mapper.track_min_num_views_per_track = mapper.global_positioning.min_num_view_per_track = 2
    mapper.bundle_adjustment.min_track_length = 2
    # The pairs already have relative poses.
    options.decompose_relative_pose = False
    if cameras == "faces":
        options.min_num_matches = 1
    return options
