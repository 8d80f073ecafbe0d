"""What depth.sweep says that it takes in memory."""

from pathlib import Path

from pano_mvs.engine.stage import spec_of
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.stages.depth import SweepParams, sweep, sweep_memory_bytes

PIXELS = 512 * 1024


def needed(**settings):
    panoramas = [Panorama(FilePart(Path("x")), (512, 1024), (512, 1024)) for _ in range(4)]
    return sweep_memory_bytes(SweepParams(**settings), {"ref": panoramas[0], "sources": panoramas[1:]})


def test_the_volume_of_semi_global_matching_is_what_counts():
    assert needed(planes=256) - needed(planes=128) == 3 * 128 * PIXELS
    assert needed(planes=128, backend="numpy") > 6 * needed(planes=128)
    assert needed(planes=128) < 0.4e9


def test_without_a_volume_planes_cost_nothing():
    assert needed(planes=256, aggregation="box") == needed(planes=128, aggregation="box") < 0.1e9


def test_from_coarse_to_fine_the_volume_is_the_coarsest():
    plain, box = needed(), needed(aggregation="box")
    assert needed(levels=3) - box == (plain - box) // 16


def test_the_engine_is_told():
    spec = spec_of(sweep)
    assert spec is not None
    assert spec.memory_needed is sweep_memory_bytes
