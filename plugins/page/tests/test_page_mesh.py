"""The mesh of a shared page: read from the files of a run, and cut into pieces."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from box_run import POINT_SIGMA, box_mesh, box_run, frame_of_page, wall_color
from pano_mvs_page.encoding import PIECE_FACES, VertexFacts, mesh_pieces, z_order
from pano_mvs_page.mesh_file import SharedMesh, coarser, run_mesh, thinned
from pano_mvs_page.scene_parts import outline
from pano_mvs_page.share import share_run
from test_share import value_of

from pano_mvs.core.errors import InputError
from pano_mvs.io.meshes import TexturedArrays, encoded_texture, read_glb, write_glb
from pano_mvs.results.run_output import load
from tests.synthetic.viewed_scenes import HALF

GLB_FROM_WORLD = np.diag([1.0, -1.0, -1.0])


def written_glb(path: Path, mesh: SharedMesh) -> Path:
    """Write a mesh as `export.mesh_textured` does: y up, the origin of uv in the upper-left corner."""
    assert mesh.uv is not None
    assert mesh.texture is not None
    positions = (mesh.vertices @ GLB_FROM_WORLD.T).astype(np.float32)
    arrays = TexturedArrays(positions, np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], axis=-1), mesh.faces)
    write_glb(path, arrays, encoded_texture(mesh.texture, "png", quality=90), form="png")
    return path


def textured_box() -> SharedMesh:
    """Return the walls, with a texture whose left half is red and whose lower right quarter is blue."""
    vertices, _, faces = box_mesh()
    texture = np.zeros((16, 32, 3), np.uint8)
    texture[:, :16], texture[8:, 16:] = (200, 30, 20), (20, 30, 200)
    uv = np.random.default_rng(0).random((len(vertices), 2)).astype(np.float32)
    return SharedMesh(vertices, faces, uv=uv, texture=texture)


def test_a_coarser_mesh_keeps_the_shape_and_the_colours_and_has_no_cracks() -> None:
    vertices, colors, faces = box_mesh(60)
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:, :32], texture[:, 32:] = (200, 30, 20), (20, 30, 200)
    uv = np.where(vertices[:, :1] < 0, 0.2, 0.8) * [[1, 1]]
    for mesh, left in (
        (SharedMesh(vertices, faces, uv=uv.astype(np.float32), texture=texture), (200, 30, 20)),
        (SharedMesh(vertices, faces, colors_rgb=colors), None),
    ):
        coarse = coarser(mesh, 2_000)
        assert coarse is not None
        assert coarse.colors_rgb is not None
        assert 1_000 < len(coarse.faces) < 2_500
        assert coarse.texture is None
        assert np.ptp(coarse.vertices, axis=0) == pytest.approx(2 * HALF, rel=0.01)
        edges = np.sort(coarse.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}  # closed
        clear = np.abs(coarse.vertices[:, 0]) > 0.2
        expected = wall_color(coarse.vertices.astype(float))
        if left is not None:
            expected = np.where(coarse.vertices[:, :1] < 0, [left], [(20, 30, 200)])
        assert np.abs(coarse.colors_rgb[clear].astype(int) - expected[clear]).max() < 40
    assert coarser(SharedMesh(vertices, faces, colors_rgb=colors), len(faces)) is None


def test_the_outline_leaves_out_strays_alone() -> None:
    points = box_mesh()[0] + np.float32(0)
    strays = np.array([[100.0, 0, 0]], np.float32)
    hull = np.array(outline(np.concatenate([np.repeat(points, 10, axis=0), strays])))
    assert len(hull) <= 64
    assert np.abs(hull).max(axis=0) == pytest.approx(HALF)
    assert outline(points[:0]) == []


def test_a_textured_mesh_comes_before_a_coloured_one(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=500, mesh=True)
    colored, note = run_mesh(run)
    assert colored is not None
    assert (colored.texture, note) == (None, "")
    expected = textured_box()
    written_glb(run.out / "mesh_textured.glb", expected)
    mesh, note = run_mesh(load(run.out))
    assert mesh is not None
    assert note == ""
    assert mesh.vertices == pytest.approx(expected.vertices)
    assert np.array_equal(mesh.faces, expected.faces)
    assert mesh.uv == pytest.approx(expected.uv, abs=1e-6)
    assert mesh.texture is not None
    assert expected.texture is not None
    assert np.array_equal(mesh.texture, expected.texture)


@pytest.mark.parametrize(("frame", "sign"), [("upright", 1), ("world", -1)])
def test_the_frame_of_the_textured_mesh_is_the_one_that_the_run_was_asked_for(
    tmp_path: Path, frame: str, sign: int
) -> None:
    run = box_run(tmp_path, points=500)
    expected = textured_box()
    written_glb(run.out / "mesh_textured.glb", expected)
    summary = json.loads((run.out / "run.json").read_text())
    summary["stages"].append({"name": "textured", "use": "export.mesh_textured", "params": {"frame": frame}})
    (run.out / "run.json").write_text(json.dumps(summary))
    mesh, _ = run_mesh(load(run.out))
    assert mesh is not None
    assert mesh.vertices[:, 1] == pytest.approx(sign * expected.vertices[:, 1])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:-8], "not that of a complete GLB file"),
        (lambda data: data.replace(b"TEXCOORD_0", b"TEXCOORD_9"), "TEXCOORD_0"),
        (lambda data: data.replace(b"\x89PNG", b"\x89PNX"), "its texture or its triangles are damaged"),
    ],
)
def test_a_damaged_file_is_named_and_the_coloured_mesh_shown(tmp_path: Path, damage: Any, message: str) -> None:
    run = box_run(tmp_path, points=500, mesh=True)
    path = written_glb(run.out / "mesh_textured.glb", textured_box())
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError, match=message):
        read_glb(path)
    mesh, note = run_mesh(load(run.out))
    assert mesh is not None
    assert mesh.colors_rgb is not None
    assert "mesh_textured.glb" in note


def test_the_mesh_of_an_earlier_run_is_not_shown(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=500, mesh=True)
    summary = json.loads((run.out / "run.json").read_text())
    (run.out / "run.json").write_text(json.dumps(summary | {"left_over": {"mesh.ply": "0"}}))
    assert run_mesh(load(run.out)) == (None, "")


def decoded(described: dict[str, Any], text: str, *, textured: bool) -> dict[str, np.ndarray]:
    """Return the arrays of a piece, as the page reads them."""
    data, offset, arrays = base64.b64decode(text), 0, {}
    count, faces = described["vertices"], described["faces"]
    layout = [("places", "<u2", 3 * count), ("uv", "<u2", 2 * count), ("faces", "<u2", 3 * faces)]
    layout += [("colors", "u1", 3 * count), ("sigmas", "u1", count), ("views", "u1", count)]
    for name, dtype, length in layout:
        if name != ("colors" if textured else "uv"):
            arrays[name] = np.frombuffer(data, dtype, length, offset)
            offset += arrays[name].nbytes
    assert offset == len(data)
    return arrays


@pytest.mark.parametrize("textured", [True, False])
def test_pieces_hold_all_triangles_once(textured: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pano_mvs_page.encoding.PIECE_FACES", 300)
    vertices, colors, faces = box_mesh()
    mesh = textured_box() if textured else SharedMesh(vertices, faces, colors_rgb=colors)
    steps, views = (np.arange(len(vertices)) % 251).astype(np.uint8), (np.arange(len(vertices)) % 9).astype(np.uint8)
    corners, seen = [], 0
    for described, text in mesh_pieces(mesh, VertexFacts(steps, views)):
        arrays = decoded(described, text, textured=textured)
        places = arrays["places"].reshape(-1, 3) / 65535 * described["size"] + described["lower"]
        assert described["faces"] <= 300
        corners.append(places[arrays["faces"].reshape(-1, 3)].reshape(-1, 9))
        original = np.argmin(np.linalg.norm(vertices[:, None] - places[None, :5], axis=-1), axis=0)
        if not textured:
            assert np.abs(arrays["colors"].reshape(-1, 3).astype(int) - wall_color(places)).max() <= 1
        seen += len(original)
        assert np.isin(arrays["views"], views).all()
    found, expected = np.concatenate(corners), vertices[mesh.faces].reshape(-1, 9)
    assert found.shape == expected.shape
    order, wanted = (np.lexsort(np.round(each, 3).T) for each in (found, expected))
    assert np.abs(found[order] - expected[wanted]).max() < 2e-3
    assert seen > 0


def test_indices_of_a_piece_fit_two_bytes() -> None:
    assert 3 * PIECE_FACES < 65536


def test_a_z_order_curve_visits_each_octant_once() -> None:
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    points = np.repeat(corners, 5, axis=0) + np.random.default_rng(0).uniform(0, 0.4, (40, 3))
    octants = np.repeat(np.arange(8), 5)[np.argsort(z_order(points))]
    assert octants.tolist() == sorted(octants.tolist())
    assert z_order(np.zeros((0, 3))).tolist() == []


def test_many_triangles_are_thinned_and_keep_their_colours() -> None:
    vertices, colors, faces = box_mesh()
    mesh, note = thinned(SharedMesh(vertices, faces, colors_rgb=colors), 400)
    assert note == ""
    assert 300 <= len(mesh.faces) <= 440
    assert mesh.colors_rgb is not None
    assert np.abs(mesh.colors_rgb.astype(int) - wall_color(mesh.vertices.astype(float))).max() < 60
    assert thinned(textured_box(), 10)[0].texture is not None


def test_the_page_has_the_mesh_in_its_own_frame_with_the_uncertainty_of_the_cloud(tmp_path: Path) -> None:
    shared = share_run(box_run(tmp_path, points=3_000, mesh=True), tmp_path / "page")
    data = tmp_path / "page" / "data"
    scene = value_of(data / "scene.js")
    assert shared.triangles == len(box_mesh()[2])
    assert sum(piece["faces"] for piece in scene["mesh"]["pieces"]) == shared.triangles
    piece = scene["mesh"]["pieces"][0]
    arrays = decoded(piece, value_of(data / "mesh" / "0.js"), textured=False)
    places = arrays["places"].reshape(-1, 3) / 65535 * piece["size"] + piece["lower"]
    in_world = frame_of_page().inverse().apply(places)
    assert np.abs(arrays["colors"].reshape(-1, 3).astype(int) - wall_color(in_world)).max() <= 1
    low, high = scene["sigmas"]
    sigmas = low * np.exp((arrays["sigmas"] - 1.0) * np.log(high / low) / 254)
    assert sigmas == pytest.approx(POINT_SIGMA, rel=1e-3)
    assert arrays["views"].min() >= 1


def test_a_large_texture_is_reduced(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=500)
    mesh = textured_box()
    assert mesh.texture is not None
    large = SharedMesh(mesh.vertices, mesh.faces, uv=mesh.uv, texture=np.zeros((8, 5000, 3), np.uint8))
    written_glb(run.out / "mesh_textured.glb", large)
    share_run(load(run.out), tmp_path / "page")
    data = base64.b64decode(value_of(tmp_path / "page" / "data" / "mesh" / "texture.js"))
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape[:2] == (7, 4096)
