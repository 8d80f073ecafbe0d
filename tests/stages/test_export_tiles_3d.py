"""Clouds as 3D Tiles: read as the specification says, by Khronos's validator, and by a viewer in a browser."""

from __future__ import annotations

import json
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from pano_mvs.api import Context, Poses, WorldAxes
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import PointCloud
from pano_mvs.stages.exports.files import Tiles3dParams, tiles_3d
from tests.browsers.chromium import chromium
from tests.browsers.server import served
from tests.foreign import npm_packages

COUNT, TILE_POINTS, SMALL_TILE = 20_000, 1000, 500


def a_cloud(count: int = COUNT) -> PointCloud:
    """Return points on the walls of a box, in all colours."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-1, 1], count)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    colors = rng.integers(0, 256, (count, 3)).astype(np.uint8)
    points = points * (4, 1.5, 6)
    return PointCloud(points.astype(np.float32), normals.astype(np.float32), colors, np.full(count, 3, np.uint8))


def the_poses() -> Poses:
    return Poses.without_points({"a.jpg": Rigid3.identity()}, frame="", scale="", metric=True)


def written(folder: Path, cloud: PointCloud, poses: Poses | None, **settings: object) -> Path:
    """Write the tiles, and return the folder that the tileset and its tiles are in."""
    params = Tiles3dParams.model_validate({"tile_points": TILE_POINTS} | settings)
    made = tiles_3d(cloud, poses, params, Context(np.random.default_rng(0), folder))
    made.check()
    assert set(made.files) == {str(path.relative_to(folder)) for path in folder.rglob("*.*")}
    return folder / "tiles_3d"


def tiles_of(tile: dict[str, Any], depth: int = 0) -> Iterator[tuple[dict[str, Any], int]]:
    yield tile, depth
    for child in tile.get("children", []):
        yield from tiles_of(child, depth + 1)


def content(folder: Path, tile: dict[str, Any], transform: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return places (N, 3) of a tile as trimesh reads them, and its linear colours (N, 3): glTF has y up.

    Colours are read here, by section 4.4 of glTF's specification: trimesh keeps eight of their sixteen bits.
    """
    path = folder / tile["content"]["uri"]
    loaded: Any = trimesh.load(path)
    (points,) = loaded.geometry.values()
    x, y, z = np.asarray(points.vertices, float).T
    moved = np.stack([x, -z, y], axis=-1)
    if transform is not None:
        moved = moved @ transform[:3, :3].T + transform[:3, 3]
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    head = json.loads(data[20 : 20 + length])
    accessor = head["accessors"][head["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    start = 20 + length + 8 + head["bufferViews"][accessor["bufferView"]]["byteOffset"]
    return moved, np.frombuffer(data, "<u2", 4 * accessor["count"], start).reshape(-1, 4)[:, :3] / 65535


def rows(*columns: np.ndarray) -> np.ndarray:
    table = np.hstack(columns)
    return np.asarray(table[np.lexsort(table.T[::-1])])


def test_the_tiles_have_all_points_once(tmp_path: Path) -> None:
    cloud = a_cloud()
    folder = written(tmp_path, cloud, the_poses())
    tileset = json.loads((folder / "tileset.json").read_text())
    assert tileset["asset"]["version"] == "1.1"
    assert tileset["root"]["refine"] == "ADD"
    assert "transform" not in tileset["root"]
    found = [content(folder, tile) for tile, _ in tiles_of(tileset["root"])]
    assert max(len(points) for points, _ in found) <= TILE_POINTS + 8 * SMALL_TILE
    x, y, z = cloud.points_in_world.T
    # The electro-optical transfer function of sRGB, since the colours of glTF are linear (section 3.7.2.1).
    linear = np.where(cloud.colors_rgb <= 10, cloud.colors_rgb / 3294.6, ((cloud.colors_rgb + 14.025) / 269.025) ** 2.4)
    expected = rows(np.stack([x, z, -y], axis=-1), linear)
    read = rows(*(np.concatenate(part) for part in zip(*found, strict=True)))
    np.testing.assert_array_equal(read[:, :3], expected[:, :3].astype(np.float32))
    np.testing.assert_allclose(read[:, 3:], expected[:, 3:], atol=1e-5)


def test_boxes_hold_what_is_below_them_and_errors_shrink(tmp_path: Path) -> None:
    folder = written(tmp_path, a_cloud(), the_poses())
    tileset = json.loads((folder / "tileset.json").read_text())
    tiles = list(tiles_of(tileset["root"]))
    assert max(depth for _, depth in tiles) >= 2
    assert tileset["geometricError"] >= tileset["root"]["geometricError"] > 0
    for tile, _ in tiles:
        box = np.array(tile["boundingVolume"]["box"])
        center, half = box[:3], np.diag(box[3:].reshape(3, 3))
        assert (half > 0).all()
        below = np.concatenate([content(folder, inner)[0] for inner, _ in tiles_of(tile)])
        assert (np.abs(below - center) <= half + 1e-5).all()
        assert half == pytest.approx(np.ptp(below, axis=0) / 2, abs=1e-4)
        for child in tile.get("children", []):
            assert child["geometricError"] < tile["geometricError"]
        assert bool(tile.get("children")) == (tile["geometricError"] > 0)


@pytest.mark.parametrize(
    ("lla", "expected"),
    [
        ((0.0, 0.0, 0.0), (6378137.0 + 3, 10.0, 20.0)),
        ((0.0, 90.0, 5.0), (-10.0, 6378137.0 + 8, 20.0)),
        ((90.0, 0.0, 0.0), (-20.0, 10.0, 6356752.314245 + 3)),
    ],
)
def test_gps_puts_the_tiles_on_the_earth(
    tmp_path: Path, lla: tuple[float, float, float], expected: tuple[float, float, float]
) -> None:
    """10 m east, 20 m north and 3 m up of the origin, in WGS 84's Earth-centred, Earth-fixed coordinates."""
    cloud = PointCloud(
        np.array([[10, -3, 20]] * 2, np.float32),
        np.array([[0, -1, 0]] * 2, np.float32),
        np.zeros((2, 3), np.uint8),
        np.ones(2, np.uint8),
    )
    folder = written(tmp_path, cloud, replace(the_poses(), axes=WorldAxes.NORTH, origin_lla=lla))
    root = json.loads((folder / "tileset.json").read_text())["root"]
    transform = np.array(root["transform"]).reshape(4, 4).T  # by columns, as the specification says
    np.testing.assert_allclose(content(folder, root, transform)[0], [expected] * 2, atol=1e-5)


def test_points_are_selected_and_groups_apart(tmp_path: Path) -> None:
    cloud = replace(a_cloud(3000), group_sizes=(2000, 1000))
    params = Tiles3dParams.model_validate({"tile_points": TILE_POINTS, "max_points": 500})
    files = tiles_3d(cloud, None, params, Context(np.random.default_rng(0), tmp_path)).files
    assert set(files) == {
        f"{folder}/{name}" for folder in ("tiles_3d", "tiles_3d_1") for name in ("r.glb", "tileset.json")
    }
    for number, folder in enumerate(("tiles_3d", "tiles_3d_1")):
        points, _ = content(tmp_path / folder, {"content": {"uri": "r.glb"}})
        assert 350 < len(points) <= 500
        known = cloud.groups()[number].points_in_world[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)
        assert set(map(tuple, points.astype(np.float32))) <= set(map(tuple, known))


@pytest.mark.slow
def test_the_validator_of_khronos_accepts_the_tiles(tmp_path: Path) -> None:
    folder = written(tmp_path, a_cloud(), the_poses())
    modules = npm_packages(tmp_path / "npm", "gltf-validator@2.0.0-dev.3.10")
    script = """
    const fs = require("fs"), validator = require(process.argv[1] + "/gltf-validator");
    const reports = process.argv.slice(2).map((file) => validator.validateBytes(new Uint8Array(fs.readFileSync(file))));
    Promise.all(reports).then((done) => console.log(JSON.stringify(done)));
    """
    tiles = sorted(map(str, folder.glob("*.glb")))
    done = subprocess.run(["node", "-e", script, str(modules), *tiles], check=True, capture_output=True, text=True)
    reports = json.loads(done.stdout)
    assert len(reports) == len(tiles) > 8
    for report in reports:
        assert report["issues"]["messages"] == []
        assert report["info"]["totalVertexCount"] > 0


VIEWER = """<!doctype html><script type="importmap">{"imports": {
"three": "./node_modules/three/build/three.module.js", "three/addons/": "./node_modules/three/examples/jsm/",
"3d-tiles-renderer": "./node_modules/3d-tiles-renderer/build/index.three.js"}}</script>
<body style="margin:0"><script type="module">
import * as THREE from "three";
import {TilesRenderer} from "3d-tiles-renderer";
const renderer = new THREE.WebGLRenderer({preserveDrawingBuffer: true});
renderer.setSize(400, 300);
document.body.append(renderer.domElement);
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(60, 4 / 3, 0.01, 1000);
camera.up.set(0, 0, 1);
camera.position.set(14, -12, 9);
camera.lookAt(0, 0, 0);
const tiles = new TilesRenderer("tiles_3d/tileset.json");
window.failures = [];
tiles.addEventListener("load-error", (event) => failures.push(String(event.error)));
tiles.addEventListener("load-model", ({scene}) => scene.traverse((part) => {
  if (part.isPoints) { part.material.size = 3; part.material.sizeAttenuation = false; }
}));
tiles.errorTarget = ERROR_TARGET;
tiles.setCamera(camera);
scene.add(tiles.group);
window.points = () => {
  const found = [];
  tiles.group.updateMatrixWorld(true);
  tiles.group.traverse((part) => {
    if (!part.isPoints) return;
    const place = new THREE.Vector3(), places = part.geometry.attributes.position;
    for (let idx = 0; idx < places.count; idx++)
      found.push(place.fromBufferAttribute(places, idx).applyMatrix4(part.matrixWorld).toArray());
  });
  return found;
};
renderer.setAnimationLoop(() => {
  tiles.setResolutionFromRenderer(camera, renderer);
  camera.updateMatrixWorld();
  tiles.update();
  renderer.render(scene, camera);
});
</script>"""


@pytest.mark.browser
def test_a_viewer_loads_the_tiles_that_it_needs(tmp_path: Path) -> None:
    """The 3D Tiles renderer of NASA's Jet Propulsion Laboratory, for three.js."""
    cloud = a_cloud()
    cloud = replace(cloud, colors_rgb=np.full_like(cloud.colors_rgb, (200, 90, 30)))
    written(tmp_path, cloud, the_poses())
    npm_packages(tmp_path, "3d-tiles-renderer@0.5.3", "three@0.187.0")
    for name, target in (("all", "0.01"), ("far", "100000")):
        (tmp_path / f"{name}.html").write_text(VIEWER.replace("ERROR_TARGET", target))
    with served(tmp_path) as server, chromium(width=400, height=300) as browser:
        browser.open(f"{server.address}far.html")
        browser.wait("window.points && points().length")
        assert len(browser.evaluate("points()")) < 0.3 * COUNT
        browser.open(f"{server.address}all.html")
        browser.wait(f"window.points && points().length == {COUNT}")
        found = np.array(browser.evaluate("points()"), np.float32)
        shown = browser.screenshot().astype(int)
        assert browser.evaluate("failures") == []
    x, y, z = cloud.points_in_world.T
    np.testing.assert_allclose(rows(found), rows(np.stack([x, z, -y], axis=-1)), atol=1e-5)
    lit = shown[shown.max(axis=2) > 150]
    assert len(lit) > 3000
    assert np.abs(np.median(lit, axis=0) - (200, 90, 30)).max() <= 2
