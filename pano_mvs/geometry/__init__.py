"""Mathematics on the sphere, and the conventions of the whole product.

Frames
    Camera frame: x right, y DOWN, z forward, right-handed (COLMAP's). A transform is named
    `target_from_source` (`cam_from_world`), coordinates `x_in_frame`; inner words cancel:
    `x_in_cam = cam_from_world.apply(x_in_world)`, that is R x + t.

Pixels
    Pixel coordinates are (x, y) with (0, 0) at the image's upper-left CORNER, so that the first
    pixel's centre is (0.5, 0.5). Sizes are given as `size_hw = (height, width)`.

Sphere
    azimuth   θ = 2π (x / w − ½)      from −π at the left edge, 0 straight ahead, growing to the right
    elevation φ = π (½ − y / h)       from +π/2 at the zenith (up) to −π/2 at the nadir
    ray       (cos φ sin θ, −sin φ, cos φ cos θ)
    inverse   θ = atan2(X, Z), φ = atan2(−Y, hypot(X, Z))
    This is exactly COLMAP's EQUIRECTANGULAR camera model.

Range
    `range` is the distance along the ray, from the camera's centre; `z_depth` exists for pinhole views
    only. Invalid is NaN in memory and in float files, never 0 or −1.

Borders
    There are none. The horizontal axis wraps; beyond a pole the picture goes on, mirrored, half a turn
    further on: the row y < 0 at column x is the row −y at column x + w/2.

Units
    Angles are radians unless the name ends in `_deg`; pixels end in `_px`, seconds in `_s`, bytes in
    `_bytes`; `_m` is written only where the scale is metric.
"""

from pano_mvs.core import kernel_cache
from pano_mvs.geometry.lens_rig import FisheyeLens, LensRig
from pano_mvs.geometry.pinhole import PinholeView
from pano_mvs.geometry.resample import (
    pad_panorama,
    roll_panorama,
    rotate_panorama,
    sample_panorama,
)
from pano_mvs.geometry.sphere import (
    UP,
    angle_between,
    pixel_from_ray,
    pixel_solid_angle,
    ray_from_pixel,
    ray_grid,
    sines_of_grid,
    spiral_rays,
)
from pano_mvs.geometry.transforms import (
    Rigid3,
    Similarity3,
    geodesic_angle,
    nearest_rotation,
    quat_wxyz_from_rotation,
    rotation_from_quat_wxyz,
    rotation_from_rotvec,
    rotation_from_two_vectors,
    rotvec_from_rotation,
    similarity_from_points,
    skew,
)
from pano_mvs.geometry.triangulation import ranges_from_bearings, triangulate_bearings

kernel_cache.use_kernel_cache()

__all__ = [
    "UP",
    "FisheyeLens",
    "LensRig",
    "PinholeView",
    "Rigid3",
    "Similarity3",
    "angle_between",
    "geodesic_angle",
    "nearest_rotation",
    "pad_panorama",
    "pixel_from_ray",
    "pixel_solid_angle",
    "quat_wxyz_from_rotation",
    "ranges_from_bearings",
    "ray_from_pixel",
    "ray_grid",
    "roll_panorama",
    "rotate_panorama",
    "rotation_from_quat_wxyz",
    "rotation_from_rotvec",
    "rotation_from_two_vectors",
    "rotvec_from_rotation",
    "sample_panorama",
    "similarity_from_points",
    "sines_of_grid",
    "skew",
    "spiral_rays",
    "triangulate_bearings",
]
