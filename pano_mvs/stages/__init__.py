"""The built-in stages, one module per kind; each connects its settings to an algorithm.

They are registered through the entry point `pano_mvs.plugins`, like stages of plugins.
"""

from pano_mvs.stages.depth import exchange, full_size, known_floors, patchmatch, plain_surfaces, sweep
from pano_mvs.stages.depth_planes import scale_planes, scene_planes, structure
from pano_mvs.stages.exports.colmap import colmap, colmap_dense, colmap_dense_init, colmap_faces, colmap_masks
from pano_mvs.stages.exports.colmap_lenses import colmap_lenses
from pano_mvs.stages.exports.files import ply, poses_files, previews, ranges, tiles_3d
from pano_mvs.stages.exports.mesh import mesh, mesh_textured
from pano_mvs.stages.features import aliked, orb_tangent, sift_tangent, sphorb
from pano_mvs.stages.features_rooms import ceilings, room_lines, rooms
from pano_mvs.stages.filters import (
    bilateral_solver,
    confidence,
    consistency,
    fill,
    free_space,
    gaussian,
    guided,
    median,
    planes,
    scale_ranges,
    sky,
    speckle,
)
from pano_mvs.stages.fusion import scale_cloud, vote
from pano_mvs.stages.global_descriptors import vlad
from pano_mvs.stages.masks import apply, color, moving, operator, static
from pano_mvs.stages.matches import brute_force, lightglue, merge
from pano_mvs.stages.matches_weak import weak
from pano_mvs.stages.pairs import automatic, exhaustive, learned, position, retrieval, sequential
from pano_mvs.stages.points import surface, tracked
from pano_mvs.stages.poses import from_model, refine, scaled_translation, triangulate, verify
from pano_mvs.stages.poses_colmap import colmap_poses, colmap_sift_poses, extend
from pano_mvs.stages.poses_frame import level, scale, unit_translations
from pano_mvs.stages.source import folder
from pano_mvs.stages.views import nearest
