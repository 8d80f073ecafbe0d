"""The fisheye pictures behind panoramas are a rig of two cameras that COLMAP reads, with true reprojections."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import LensRig
from pano_mvs.io.colmap.writer import LensPictures, rig_configuration, write_lens_rig_model
from pano_mvs.scene import Poses
from tests.algorithms.poses.rig_capture import RigCapture, rig_capture
from tests.synthetic.fisheye_rig import example_rig


def pictures(poses: Poses, rig: LensRig) -> dict[str, LensPictures]:
    return {name: LensPictures(rig, (f"front/{name}", f"back/{name}")) for name in poses.names}


def true_poses(capture: RigCapture) -> Poses:
    return replace(
        capture.poses,
        rotations=np.array([pose.rotation for pose in capture.true]),
        translations=np.array([pose.translation for pose in capture.true]),
        points_in_world=capture.points,
        metric=True,
    )


def reprojection_errors(model: pycolmap.Reconstruction) -> list[float]:
    errors = []
    for image in model.images.values():
        for keypoint in image.points2D:
            if keypoint.has_point3D():
                world = model.points3D[keypoint.point3D_id].xyz
                errors.append(float(np.linalg.norm(image.project_point(world) - keypoint.xy)))
    return errors


@pytest.mark.parametrize("distance", [2.0, np.inf])
def test_true_points_are_where_both_lenses_see_them(tmp_path: Path, distance: float) -> None:
    capture = rig_capture(noise_deg=0.0, stitch_distance_m=distance, points=200, count=3)
    poses = true_poses(capture)
    seen = write_lens_rig_model(tmp_path, poses, pictures(poses, capture.rig))
    model = pycolmap.Reconstruction(str(tmp_path))
    assert {image.name: image.num_points3D for image in model.images.values()} == seen
    assert sum(seen.values()) > 0.97 * len(poses.track_point_idx)  # all but those at 89° and more
    # COLMAP undoes nothing of the stitching: it projects the points with the lens centres of the rig.
    assert max(reprojection_errors(model)) < 1e-6


def test_a_refined_capture_reprojects_within_half_a_pixel(tmp_path: Path) -> None:
    capture = rig_capture(offset_m=0.05)
    poses = refine_poses(capture.poses, rigs=capture.rigs)
    write_lens_rig_model(tmp_path, poses, pictures(poses, capture.rig))
    errors = reprojection_errors(pycolmap.Reconstruction(str(tmp_path)))
    assert np.median(errors) < 0.1
    assert np.percentile(errors, 99) < 0.5


def test_cameras_rig_and_frames_are_those_of_the_calibration(tmp_path: Path) -> None:
    capture = rig_capture(noise_deg=0.0, points=50, count=3)
    poses = true_poses(capture)
    write_lens_rig_model(tmp_path, poses, pictures(poses, capture.rig), form="both")
    assert {path.name for path in tmp_path.iterdir()} >= {"rigs.bin", "frames.bin", "rigs.txt", "frames.txt"}
    model = pycolmap.Reconstruction(str(tmp_path))
    assert (model.num_rigs(), model.num_cameras(), model.num_frames(), model.num_images()) == (1, 2, 3, 6)
    for camera_id, lens in zip((1, 2), capture.rig.lenses, strict=True):
        camera = model.cameras[camera_id]
        assert camera.model.name == "OPENCV_FISHEYE"
        assert camera.params == pytest.approx([*lens.focal_xy, *lens.principal_xy, *lens.distortion])
        assert (camera.height, camera.width) == lens.size_hw
    for image in model.images.values():
        lens_idx = ("front", "back").index(image.name.partition("/")[0])
        panorama = poses.names.index(image.name.partition("/")[2])
        expected = capture.rig.lens_from_rig[lens_idx] @ capture.true[panorama]
        assert image.cam_from_world().matrix()[:, :3] == pytest.approx(expected.rotation, abs=1e-9)
        assert image.projection_center() == pytest.approx(expected.center, abs=1e-9)


def test_different_calibrations_are_different_rigs(tmp_path: Path) -> None:
    capture = rig_capture(noise_deg=0.0, points=50, count=4)
    poses = true_poses(capture)
    mixed = pictures(poses, capture.rig)
    other = example_rig(offset_m=0.08, stitch_distance_m=3.0)
    mixed["003.png"] = LensPictures(other, ("front/003.png", "back/003.png"))
    del mixed["000.png"]
    write_lens_rig_model(tmp_path, poses, mixed)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert (model.num_rigs(), model.num_cameras(), model.num_frames()) == (2, 4, 3)
    centers = {image.name: image.projection_center() for image in model.images.values()}
    for name, offset_m in (("001.png", 0.03), ("003.png", 0.08)):
        assert np.linalg.norm(centers[f"front/{name}"] - centers[f"back/{name}"]) == pytest.approx(offset_m)


def test_poses_of_an_unknown_unit_are_refused(tmp_path: Path) -> None:
    capture = rig_capture(points=20, count=3)
    with pytest.raises(UsageError, match=r"must be in metres.*add poses\.scale"):
        write_lens_rig_model(tmp_path, capture.poses, pictures(capture.poses, capture.rig))


def test_colmap_reads_the_rig_configuration(tmp_path: Path) -> None:
    rig = example_rig(offset_m=0.05)
    (tmp_path / "rig_config.json").write_text(rig_configuration(rig))
    (config,) = pycolmap.read_rig_config(str(tmp_path / "rig_config.json"))
    first, second = config.cameras
    assert first.ref_sensor
    assert (first.image_prefix, second.image_prefix) == ("front/", "back/")
    assert second.camera.params == pytest.approx(
        [*rig.lenses[1].focal_xy, *rig.lenses[1].principal_xy, *rig.lenses[1].distortion]
    )
    expected = rig.lens_from_rig[1] @ rig.lens_from_rig[0].inverse()
    assert second.cam_from_rig.matrix()[:, :3] == pytest.approx(expected.rotation)
    assert second.cam_from_rig.translation == pytest.approx(expected.translation)
