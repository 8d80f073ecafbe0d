"""How a mesh looks where no panorama was used: `python -m tests.benchmarks.mesh_views FOLDER [FOLDER …]`.

Leaves out one panorama of a rendered capture with true poses, computes ranges of the others by the dense stages of a
workflow, and makes the mesh with coloured vertices (`export.mesh`) and the textured one (`export.mesh_textured`).
Both are rendered at the pose of the panorama left out and compared with it: PSNR and SSIM of all pixels in which the
place has a surface, where holes are black, and of those that the mesh covers. The first mesh is also simplified to the
triangles of the second, with the colours of the nearest vertices. `--out` keeps the pictures.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.algorithms.mesh.surface import Mesh, decimated
from pano_mvs.algorithms.mesh.texture import TexturedMesh
from pano_mvs.engine.stages.context import Context
from pano_mvs.scene import PointCloud, RangeMap
from pano_mvs.stages.exports.mesh import MeshParams, TexturedParams, solved_mesh, textured_mesh
from pano_mvs.stages.fusion import FusionParams, vote
from tests.benchmarks.captures import Capture, read_capture
from tests.benchmarks.dense_chain import DenseChain, given_records, true_poses
from tests.evaluation.held_out_meshes import HeldOutScores, held_out_scores


def without(capture: Capture, left_out: str) -> Capture:
    """Return a capture without one of its panoramas."""
    names = [name for name in capture.panoramas if name != left_out]
    return Capture(
        capture.name,
        {name: capture.panoramas[name] for name in names},
        {name: capture.poses[name] for name in names},
        {name: capture.ranges[name] for name in names},
        capture.outdoor,
    )


def meshes(capture: Capture, workflow: str, folder: Path, settings: dict[str, object]) -> tuple[Mesh, TexturedMesh]:
    """Return the mesh with coloured vertices and the textured one, and print the CPU seconds of their parts."""
    chain = DenseChain(workflow)
    started = time.process_time()
    maps = chain.run(capture).range_maps
    last = maps[list(maps)[-1]]
    poses = true_poses(capture)
    cloud = fused(chain, capture, maps)
    print(f"  ranges and fusion: {time.process_time() - started:.0f} s, {len(cloud)} points", flush=True)
    for name in ("plain", "textured"):
        (folder / name).mkdir()
    plain, _ = solved_mesh(cloud, MeshParams(), folder / "plain")
    started = time.process_time()
    ctx = Context(np.random.default_rng(0), folder)
    params = TexturedParams.model_validate(settings)
    made = textured_mesh(cloud, (poses, capture.panoramas, last), params, folder=folder / "textured", ctx=ctx)
    print(f"  texture: {time.process_time() - started:.0f} s without the solver", flush=True)
    return plain, made


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """Return a mesh with coloured vertices and about a number of triangles; vertices have the nearest colours."""
    vertices, faces = decimated(mesh.vertices_in_world, mesh.faces, triangles=triangles)
    _, nearest = cKDTree(mesh.vertices_in_world).query(vertices)
    return Mesh(vertices, mesh.colors_rgb[nearest], faces)


def fused(chain: DenseChain, capture: Capture, maps: dict[str, dict[str, RangeMap]]) -> PointCloud:
    """Return the cloud that the workflow's fusion makes."""
    name = next(name for name, entry in chain.stages.items() if entry.spec.name == "fusion.vote")
    params = chain.stages[name].params
    assert isinstance(params, FusionParams)
    given = given_records(capture, true_poses(capture))
    return vote(
        ranges=maps[chain.graph.edges[name]["ranges"].producer],
        poses=next(items for kind, items in given.items() if kind.__name__ == "Pose"),
        images=capture.panoramas,
        params=params,
        ctx=Context(np.random.default_rng(0), Path(tempfile.gettempdir())),
    )


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


def main() -> None:
    """Print the scores of each capture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folders", type=Path, nargs="+", help="rendered captures with poses.json and depth.npz")
    parser.add_argument("--left-out", default="004.png", help="the panorama to render")
    parser.add_argument("--width", type=int, default=1024, help="width of the panoramas")
    parser.add_argument("--workflow", default="quality", help="workflow of the ranges")
    parser.add_argument("--triangles", type=int, default=TexturedParams().triangles, help="of the textured mesh")
    parser.add_argument("--out", type=Path, help="folder for the pictures")
    options = parser.parse_args()
    for folder in options.folders:
        capture = read_capture(folder, width=options.width)
        print(f"{capture.name} at {options.left_out}, {options.width} px wide", flush=True)
        truth, pose = capture.panoramas[options.left_out].load(), capture.poses[options.left_out]
        valid = np.isfinite(capture.ranges[options.left_out])
        with tempfile.TemporaryDirectory() as scratch:
            used, settings = without(capture, options.left_out), {"triangles": options.triangles}
            pair = meshes(used, options.workflow, Path(scratch), settings)
        plain, made = pair
        named: dict[str, Mesh | TexturedMesh] = {
            "vertices": plain,
            "as many": simplified(plain, len(made.faces)),
            "textured": made,
        }
        for name, mesh in named.items():
            scores = held_out_scores(mesh, pose, truth, valid=valid)
            report(name, mesh, scores, of_most=psnr_of_most(scores.picture, truth, valid))
            if options.out:
                options.out.mkdir(parents=True, exist_ok=True)
                path = options.out / f"{capture.name}_{name.replace(' ', '_')}.png"
                cv2.imwrite(str(path), scores.picture[..., ::-1])


if __name__ == "__main__":
    main()
