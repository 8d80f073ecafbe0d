"""How a mesh looks where no panorama was used.

Leaves out one panorama of a rendered capture with true poses, computes ranges of the others by the dense stages of a
workflow that finds the planes of the place, and makes the mesh with coloured vertices (`export.mesh`) and the textured
one (`export.mesh_textured`). Both are rendered at the pose of the panorama left out and compared with it: PSNR and SSIM
of all pixels in which the place has a surface, where holes are black, and of those that the mesh covers. The first mesh
is also simplified to the triangles of the second, with the colours of the nearest vertices. `--out` keeps the pictures.
"""

from __future__ import annotations

import tempfile
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from held_out_meshes import HeldOutScores, held_out_scores
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.algorithms.mesh.surface import Mesh, decimated
from pano_mvs.algorithms.mesh.texture import TexturedMesh
from pano_mvs.algorithms.mesh.volume import most_certain
from pano_mvs.scene.surfaces import Structure
from pano_mvs.stages.exports.mesh import MeshParams, MeshView, TexturedParams, solved_mesh, textured_mesh
from tools.benchmarks.captures import Capture, read_capture
from tools.benchmarks.dense_chain import DenseChain, context


def meshes(capture: Capture, workflow: str, folder: Path, triangles: int) -> tuple[Mesh, TexturedMesh]:
    """Return the mesh with coloured vertices and the textured one, and print the CPU seconds of their parts."""
    chain = DenseChain(workflow)
    started = time.process_time()
    run = chain.run(capture)
    checked, last = run.range_maps["checked"], list(run.range_maps.values())[-1]
    structure = run.results["scene_planes"][""]
    assert isinstance(structure, Structure)
    cloud = chain.fused(capture, run)
    print(f"  ranges and fusion: {time.process_time() - started:.0f} s, {len(cloud)} points", flush=True)
    plain, _ = solved_mesh(cloud, MeshParams(), folder)
    started = time.process_time()
    views = [
        MeshView(capture.poses[name], capture.panoramas[name], partial(most_certain, last[name], checked[name]))
        for name in last
    ]
    planes = structure.normals_in_world, structure.offsets
    made = textured_mesh(views, planes, TexturedParams(triangles=triangles), ctx=context(folder))
    print(f"  textured mesh: {time.process_time() - started:.0f} s", flush=True)
    return plain, made


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """Return a mesh with coloured vertices and about a number of triangles; vertices have the nearest colours."""
    vertices, faces = decimated(mesh.vertices_in_world, mesh.faces, triangles=triangles)
    _, nearest = cKDTree(mesh.vertices_in_world).query(vertices)
    return Mesh(vertices, mesh.colors_rgb[nearest], faces)


def report(name: str, mesh: Mesh | TexturedMesh, scores: HeldOutScores, *, of_most: float) -> None:
    """Print the scores of one mesh."""
    whole, covered = scores.everywhere, scores.covered
    print(
        f"  {name:9}{len(mesh.faces):9} triangles  all: {whole.psnr_db:.2f} dB, SSIM {whole.ssim:.3f}  "
        f"best 95 %: {of_most:.2f} dB  covered: "
        + (f"{covered.psnr_db:.2f} dB, SSIM {covered.ssim:.3f}, {covered.share:.1%}" if covered else "none"),
        flush=True,
    )


def psnr_of_most(picture: NDArray[np.uint8], truth: NDArray[np.uint8], valid: NDArray[np.bool_]) -> float:
    """Return the PSNR without the twentieth of the pixels that differs most."""
    squared = np.sort(np.square(picture.astype(np.float64) - truth).mean(axis=-1)[valid])
    return float(10 * np.log10(255.0**2 / squared[: int(0.95 * len(squared))].mean()))


def main(
    folders: list[Path],
    left_out: str = "004.png",
    width: int = 1024,
    workflow: str = "quality",
    triangles: int = 100_000,
    out: Path | None = None,
) -> None:
    """Print the scores of each capture.

    Args:
        folders: rendered captures with poses.json and depth.npz.
        left_out: the panorama to render.
        width: of the panoramas.
        workflow: of the ranges.
        triangles: of the textured mesh.
        out: folder for the pictures.
    """
    for folder in folders:
        capture = read_capture(folder, width=width)
        print(f"{capture.name} at {left_out}, {width} px wide", flush=True)
        truth, pose = capture.panoramas[left_out].load(), capture.poses[left_out]
        valid = np.isfinite(capture.ranges[left_out])
        with tempfile.TemporaryDirectory() as scratch:
            used = capture.only([name for name in capture.panoramas if name != left_out])
            plain, made = meshes(used, workflow, Path(scratch), triangles)
        named: dict[str, Mesh | TexturedMesh] = {
            "vertices": plain,
            "as many": simplified(plain, len(made.faces)),
            "textured": made,
        }
        for name, mesh in named.items():
            scores = held_out_scores(mesh, pose, truth, valid=valid)
            report(name, mesh, scores, of_most=psnr_of_most(scores.picture, truth, valid))
            if out:
                out.mkdir(parents=True, exist_ok=True)
                path = out / f"{capture.name}_{name.replace(' ', '_')}.png"
                cv2.imwrite(str(path), scores.picture[..., ::-1])
