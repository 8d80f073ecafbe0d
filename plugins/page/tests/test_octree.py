"""The octree of a shared cloud."""

from __future__ import annotations

import base64

import numpy as np
from pano_mvs_page.encoding import encode_points

from pano_mvs.algorithms.points.octree import octree
from pano_mvs.scene import PointCloud


def cloud(count: int) -> PointCloud:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, 3)).astype(np.float32) * [5, 1, 2]
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    return PointCloud(
        points.astype(np.float32),
        normals.astype(np.float32),
        rng.integers(0, 256, (count, 3)).astype(np.uint8),
        rng.integers(1, 9, count).astype(np.uint8),
    )


def test_each_point_is_in_one_node_within_its_cube() -> None:
    points = cloud(20_000).points_in_world
    nodes = octree(points, node_points=1_000)
    assert np.array_equal(np.sort(np.concatenate([node.chosen for node in nodes])), np.arange(len(points)))
    for node in nodes:
        inside = points[node.chosen]
        assert (inside >= node.lower - 1e-9).all()
        assert (inside <= node.lower + node.size * (1 + 1e-9)).all()
    names = [node.name for node in nodes]
    assert names[0] == "r"
    assert len(names) > 8
    assert all(names.index(name[:-1]) < names.index(name) for name in names[1:])


def test_a_node_is_a_sample_of_everything_below_it() -> None:
    points = cloud(20_000).points_in_world
    root = octree(points, node_points=2_000)[0]
    assert np.abs(points[root.chosen].mean(axis=0) - points.mean(axis=0)).max() < 0.3
    assert np.abs(points[root.chosen].std(axis=0) / points.std(axis=0) - 1).max() < 0.1


def test_equal_points_end_the_division() -> None:
    nodes = octree(np.zeros((5_000, 3), np.float32), node_points=1_000)
    assert sum(len(node.chosen) for node in nodes) == 5_000
    assert octree(np.zeros((0, 3), np.float32)) == []


def test_encoded_points_have_the_precision_of_their_cube() -> None:
    given = cloud(3_000)
    node = octree(given.points_in_world)[0]
    sigmas = np.arange(3_000, dtype=np.int64).astype(np.uint8)
    data = base64.b64decode(encode_points(node, given, sigmas))
    count = len(node.chosen)
    assert len(data) == 14 * count
    places = np.frombuffer(data, "<u2", 3 * count).reshape(-1, 3) / 65535 * node.size + node.lower
    assert np.abs(places - given.points_in_world[node.chosen]).max() <= 0.51 * node.size / 65535 + 1e-6
    assert np.array_equal(np.frombuffer(data, np.uint8, 3 * count, 6 * count), given.colors_rgb[node.chosen].ravel())
    assert np.array_equal(np.frombuffer(data, np.uint8, count, 9 * count), given.view_counts[node.chosen])
    normals = np.frombuffer(data, np.int8, 3 * count, 10 * count).reshape(-1, 3) / 127
    assert np.abs(normals - given.normals_in_world[node.chosen]).max() < 0.005
    assert np.array_equal(np.frombuffer(data, np.uint8, count, 13 * count), sigmas[node.chosen])
