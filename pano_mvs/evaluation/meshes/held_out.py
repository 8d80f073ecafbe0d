"""Scores of a mesh at the pose of a panorama that was not used to make it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.surface import Mesh
from pano_mvs.algorithms.mesh.texture import TexturedMesh
from pano_mvs.algorithms.mesh.visibility import surface_view
from pano_mvs.algorithms.rendering import picture_from_texture, picture_from_vertices, reduced_picture
from pano_mvs.core.arrays import Picture
from pano_mvs.evaluation.meshes.picture_scores import PictureScores, picture_scores
from pano_mvs.geometry import Rigid3


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutScores:
    """The comparison of a rendered mesh with a panorama.

    Attributes:
        everywhere: of all valid pixels; the mesh is black where it has a hole.
        covered: of the valid pixels that the mesh covers; None if it covers none.
        picture: (H, W, 3) the rendered mesh.
    """

    everywhere: PictureScores
    covered: PictureScores | None
    picture: Picture


def rendered_panorama(
    mesh: Mesh | TexturedMesh,
    cam_from_world: Rigid3,
    *,
    size_hw: tuple[int, int],
    supersampling: int = 2,
    threads: int = 1,
) -> tuple[Picture, NDArray[np.bool_]]:
    """Return the picture (H, W, 3) of a mesh as a panorama, and the pixels (H, W) that it covers.

    Args:
        mesh: with coloured vertices or with a texture; it is visible from both sides.
        cam_from_world: pose of the panorama.
        size_hw: (height, width) of the panorama.
        supersampling: number of rays per pixel along each side.
        threads: number of threads; the result does not depend on it.
    """
    size = size_hw[0] * supersampling, size_hw[1] * supersampling
    view = surface_view(mesh.vertices_in_world, mesh.faces, cam_from_world, size_hw=size, threads=threads)
    if isinstance(mesh, TexturedMesh):
        picture = picture_from_texture(view, mesh.atlas, mesh.texture)
    else:
        picture = picture_from_vertices(view, mesh.faces, mesh.colors_rgb)
    return reduced_picture(picture, view.triangle >= 0, factor=supersampling)


def held_out_scores(
    mesh: Mesh | TexturedMesh,
    cam_from_world: Rigid3,
    panorama: Picture,
    *,
    valid: NDArray[np.bool_] | None = None,
    threads: int = 1,
) -> HeldOutScores:
    """Render a mesh at the pose of a panorama and compare both.

    Args:
        mesh: with coloured vertices or with a texture.
        cam_from_world: pose of the panorama.
        panorama: (H, W, 3) uint8 RGB.
        valid: (H, W) pixels of the panorama that count; None: all.
        threads: number of threads; the result does not depend on it.
    """
    size_hw = panorama.shape[0], panorama.shape[1]
    picture, covered = rendered_panorama(mesh, cam_from_world, size_hw=size_hw, threads=threads)
    counted = np.ones(size_hw, np.bool_) if valid is None else valid
    both = covered & counted
    everywhere = picture_scores(picture, panorama, compared=counted)
    return HeldOutScores(everywhere, picture_scores(picture, panorama, compared=both) if both.any() else None, picture)
