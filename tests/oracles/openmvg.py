"""A scene that `write_openmvg` has written, in openMVG's own reader, camera and writer.

    python -m tests.oracles.openmvg OPENMVG

needs a checkout of openMVG, g++, and the headers of Eigen and cereal 1.3 (Debian: libeigen3-dev, libcereal-dev). It
compiles openMVG's `sfm_data_io*.cpp`, asserts that its `Load` takes the file, that its camera projects every point on
the pixel that the file states, and writes `tests/io/foreign/openmvg_sfm_data.json` by its `Save`, against which the
tests compare. Run with openMVG's develop branch of 2024-03-17 (6d6b1dd) on 2026-11-26.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from pano_mvs.io.poses.other_json import write_openmvg
from pano_mvs.scene import Poses
from pano_mvs.testing.room import capture_poses

SAVED_BY_OPENMVG = Path(__file__).parents[1] / "io" / "foreign" / "openmvg_sfm_data.json"
SIZES_HW = {"1.jpg": (512, 1024), "rooms/2.jpg": (256, 512), "10.jpg": (512, 1024)}
PROGRAM = r"""
#include <cereal/archives/json.hpp>
#include "openMVG/cameras/cameras.hpp"
#include "openMVG/sfm/sfm_data.hpp"
#include "openMVG/sfm/sfm_data_io.hpp"
#include <cstdio>
int main(int, char **argv) {
  openMVG::sfm::SfM_Data scene;
  if (!Load(scene, argv[1], openMVG::sfm::ALL)) return 1;
  for (const auto &[id, point] : scene.structure)
    for (const auto &[view_id, seen] : point.obs) {
      const auto &view = scene.views.at(view_id);
      const openMVG::Vec3 in_camera = scene.poses.at(view->id_pose)(point.X);
      const openMVG::Vec2 pixel = scene.intrinsics.at(view->id_intrinsic)->project(in_camera);
      std::printf("%.17g %.17g %.17g %.17g\n", pixel[0], pixel[1], seen.x[0], seen.x[1]);
    }
  return !Save(scene, argv[2], openMVG::sfm::ALL);
}
"""


def scene() -> Poses:
    """Return three cameras in a room and twelve points that all of them see, without noise."""
    cameras = dict(zip(SIZES_HW, capture_poses(3, seed=5), strict=True))
    points = np.random.default_rng(2).uniform(-3, 3, (12, 3))
    rays = np.concatenate([pose.apply(points) for pose in cameras.values()])
    bare = Poses.without_points(cameras, frame="the room's", scale="the room's", metric=False)
    return Poses(
        names=bare.names,
        rotations=bare.rotations,
        translations=bare.translations,
        points_in_world=points,
        point_colors_rgb=np.full((len(points), 3), 128, np.uint8),
        point_errors_rad=np.zeros(len(points), np.float32),
        track_point_idx=np.tile(np.arange(len(points), dtype=np.int32), len(cameras)),
        track_image_idx=np.repeat(np.arange(len(cameras), dtype=np.int32), len(points)),
        track_bearings=rays / np.linalg.norm(rays, axis=1, keepdims=True),
        rejected={},
    )


def main() -> None:
    """Load and save a scene by openMVG, and compare its projections with the pixels of the file."""
    sources = Path(sys.argv[1]) / "src"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_openmvg(folder / "ours.json", scene(), SIZES_HW)
        (folder / "reader.cpp").write_text(PROGRAM)
        parts = [sources / f"openMVG/sfm/sfm_data_io{part}.cpp" for part in ("", "_cereal")]
        parts += (sources / "third_party/stlplus3/filesystemSimplified").glob("*.cpp")
        includes = [f"-I{sources}", "-I/usr/include/eigen3"]
        compiler = ["g++", "-std=c++17", "-O1", "-w", "-DNDEBUG", *includes]
        subprocess.run([*compiler, folder / "reader.cpp", *parts, "-o", folder / "reader"], check=True)
        reader = [folder / "reader", folder / "ours.json", SAVED_BY_OPENMVG]
        printed = subprocess.run(reader, check=True, capture_output=True, text=True).stdout
    pixels = np.array([line.split() for line in printed.splitlines()], float)
    errors = np.abs(pixels[:, :2] - pixels[:, 2:])
    print(f"{len(pixels)} observations, at most {errors.max():.1e} px from the projections of openMVG's camera")
    assert len(pixels) == 36
    assert errors.max() < 1e-6


if __name__ == "__main__":
    main()
