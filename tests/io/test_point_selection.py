"""Which points of a cloud are written: thresholds, voxels, a number of points, in bounded memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import pyvista
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.api import Context, PointCloud
from pano_mvs.core.errors import UsageError
from pano_mvs.io import point_selection
from pano_mvs.io.ply import read_ply, write_ply
from pano_mvs.io.point_selection import Selection, select_points
from pano_mvs.stages.exports.files import PlyParams, ply


def surface_cloud(count: int, seed: int = 0) -> PointCloud:
    """Return points on a sphere of radius 3 around (1, 2, 3), denser on one side."""
    rng = np.random.default_rng(seed)
    rays = rng.normal(size=(count, 3))
    rays[:, 0] += 0.5
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = (rays * 3 + (1, 2, 3)).astype(np.float32)
    counts = rng.integers(1, 6, count).astype(np.uint8)
    confidence = rng.integers(1, 256, count).astype(np.uint8)
    return PointCloud(
        points, -rays.astype(np.float32), rng.integers(0, 256, (count, 3)).astype(np.uint8), counts, confidence
    )


def kept_idx(cloud: PointCloud, selection: Selection, folder: Path) -> list[int]:
    kept = select_points(cloud, selection, folder)
    if kept is None:
        return list(range(len(cloud)))
    whole = kept.within(slice(0, len(cloud)))
    assert kept.count == whole.sum()
    assert not list(folder.iterdir())
    return np.flatnonzero(whole).tolist()


def plainly_kept(cloud: PointCloud, selection: Selection) -> list[int]:
    """One voxel after the other, by a dictionary."""
    best: dict[tuple[int, ...], tuple[float, ...]] = {}
    for idx, point in enumerate(cloud.points_in_world.astype(np.float64)):
        confidence = 0 if cloud.confidence is None else int(cloud.confidence[idx])
        views = int(cloud.view_counts[idx])
        if views < selection.min_views or (cloud.confidence is not None and confidence < selection.min_confidence):
            continue
        place = tuple(np.floor(point / selection.voxel).astype(int)) if selection.voxel else (idx,)
        off = (
            np.float32(((point / selection.voxel - np.floor(point / selection.voxel) - 0.5) ** 2).sum())
            if (selection.voxel)
            else 0
        )
        rank = (-confidence, -views, float(off), idx)
        best[place] = min(best.get(place, rank), rank)
    return sorted(int(rank[-1]) for rank in best.values())


@pytest.mark.parametrize("voxel", [0.0, 0.05, 0.4, 50.0])
@pytest.mark.parametrize("thresholds", [(0, 0), (100, 3), (255, 6)])
def test_it_keeps_what_a_dictionary_keeps(tmp_path: Path, voxel: float, thresholds: tuple[int, int]) -> None:
    cloud = surface_cloud(3000)
    selection = Selection(*thresholds, voxel=voxel)
    assert kept_idx(cloud, selection, tmp_path) == plainly_kept(cloud, selection)


@pytest.mark.slow
@pytest.mark.parametrize(("chunk", "bucket"), [(8, 16), (64, 100), (1 << 18, 3)])
def test_how_the_work_is_cut_up_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int, bucket: int
) -> None:
    cloud = surface_cloud(2001)
    selection = Selection(voxel=0.3)
    whole = kept_idx(cloud, selection, tmp_path)
    write_ply(tmp_path / "whole.ply", cloud, kept=select_points(cloud, selection, tmp_path), quality=True)
    reference = (tmp_path / "whole.ply").read_bytes()
    (tmp_path / "whole.ply").unlink()
    monkeypatch.setattr(point_selection, "CHUNK_POINTS", chunk)
    monkeypatch.setattr(point_selection, "_BUCKET_POINTS", bucket)
    assert kept_idx(cloud, selection, tmp_path) == whole
    write_ply(tmp_path / "again.ply", cloud, kept=select_points(cloud, selection, tmp_path), quality=True)
    assert (tmp_path / "again.ply").read_bytes() == reference
    back = read_ply(tmp_path / "again.ply")
    np.testing.assert_array_equal(back.points_in_world, cloud.points_in_world[whole])
    np.testing.assert_array_equal(back.colors_rgb, cloud.colors_rgb[whole])
    assert cloud.confidence is not None
    np.testing.assert_array_equal(back.confidence, cloud.confidence[whole])


@given(seed=st.integers(0, 2**32 - 1), edge=st.floats(0.01, 3))
def test_no_voxel_holds_two_and_none_that_was_full_is_empty(
    tmp_path_factory: pytest.TempPathFactory, seed: int, edge: float
) -> None:
    cloud = surface_cloud(300, seed)
    kept = kept_idx(cloud, Selection(voxel=edge), tmp_path_factory.mktemp("scratch"))
    places = np.floor(cloud.points_in_world.astype(np.float64) / edge)
    assert len(np.unique(places[kept], axis=0)) == len(kept) == len(np.unique(places, axis=0))


@pytest.mark.parametrize("wanted", [100, 5000, 40_000, 99_000])
def test_a_number_of_points_is_met_from_below(tmp_path: Path, wanted: int) -> None:
    cloud = surface_cloud(100_000)
    kept = select_points(cloud, Selection(max_points=wanted), tmp_path)
    assert kept is not None
    assert 0.85 * wanted < kept.count <= wanted
    assert kept.voxel > 0


def test_a_cloud_that_is_small_enough_is_left_alone(tmp_path: Path) -> None:
    cloud = surface_cloud(500)
    assert kept_idx(cloud, Selection(max_points=500), tmp_path) == list(range(500))
    kept = select_points(cloud, Selection(voxel=0.2, max_points=500), tmp_path)
    assert kept is not None
    assert kept.voxel == 0.2
    few = PointCloud(cloud.points_in_world[:0], cloud.normals_in_world[:0], cloud.colors_rgb[:0], cloud.view_counts[:0])
    assert select_points(few, Selection(voxel=0.1, max_points=3), tmp_path) is None
    same = PointCloud(
        np.ones((50, 3), np.float32), np.ones((50, 3), np.float32), np.zeros((50, 3), np.uint8), np.ones(50, np.uint8)
    )
    assert kept_idx(same, Selection(max_points=10), tmp_path) == [0]


def test_voxels_that_cannot_be_counted_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"voxels of 1e-07 are too small for a cloud that reaches 5.97"):
        select_points(surface_cloud(100), Selection(voxel=1e-7), tmp_path)


def test_other_programs_read_the_points_with_their_qualities(tmp_path: Path) -> None:
    """VTK, by way of pyvista; it gives colours as an array RGB and keeps what else each point has."""
    cloud = surface_cloud(400)
    params = PlyParams.model_validate({"quality": True, "min_views": 2, "voxel": 0.3, "frame": "world"})
    ctx = Context(np.random.default_rng(0), tmp_path)
    path = ply(cloud, None, params, ctx).files["cloud.ply"]
    kept = plainly_kept(cloud, Selection(min_views=2, voxel=0.3))
    assert ctx.metrics == {"points": len(kept), "voxel": 0.3}
    read = pyvista.read(path)
    np.testing.assert_array_equal(read.points, cloud.points_in_world[kept])
    np.testing.assert_array_equal(read["RGB"], cloud.colors_rgb[kept])
    np.testing.assert_array_equal(read["Normals"], cloud.normals_in_world[kept])


MEASURE = """
import sys
import tracemalloc
import numpy as np
from pathlib import Path
from pano_mvs.io.ply import write_ply
from pano_mvs.io.point_selection import Selection, select_points
from pano_mvs.scene import PointCloud

folder, count = Path(sys.argv[1]), int(sys.argv[2])
def mapped(name, dtype, width):
    return np.lib.format.open_memmap(folder / name, "r", dtype=dtype, shape=(count, width) if width else (count,))
cloud = PointCloud(mapped("p.npy", np.float32, 3), mapped("n.npy", np.float32, 3), mapped("c.npy", np.uint8, 3),
                   mapped("v.npy", np.uint8, 0))
scratch = folder / "scratch"
scratch.mkdir(exist_ok=True)
tracemalloc.start()
kept = select_points(cloud, Selection(max_points=int(sys.argv[3])) if int(sys.argv[3]) else Selection(), scratch)
write_ply(folder / "out.ply", cloud, kept=kept)
print(tracemalloc.get_traced_memory()[1], count if kept is None else kept.count)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("max_points", "most_bytes"), [(0, 30e6), (500_000, 200e6)])
def test_memory_does_not_grow_with_the_cloud(tmp_path: Path, max_points: int, most_bytes: float) -> None:
    """Eight million points are 220 MB in arrays; numpy's memory is traced, mapped files are the system's."""
    count = 8_000_000
    rng = np.random.default_rng(0)
    for name, dtype, width in (("p", np.float32, 3), ("n", np.float32, 3), ("c", np.uint8, 3), ("v", np.uint8, 0)):
        shape = (count, width) if width else (count,)
        array = np.lib.format.open_memmap(tmp_path / f"{name}.npy", "w+", dtype=dtype, shape=shape)
        for start in range(0, count, 1_000_000):
            part = array[start : start + 1_000_000]
            part[:] = rng.normal(size=part.shape) if dtype is np.float32 else rng.integers(1, 9, part.shape)
        array.flush()
    command = [sys.executable, "-c", MEASURE, str(tmp_path), str(count), str(max_points)]
    peak, written = map(int, subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    assert peak < most_bytes
    assert 0.85 * (max_points or count) < written <= (max_points or count)
    assert (tmp_path / "out.ply").stat().st_size > 27 * written
