"""The scripts that kill runs, damage stores and read hostile files, with small numbers; larger in CI's second step."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from pano_mvs.scene.exr import has_exr
from tools.stress import damage, faults, hostile, kills, load
from tools.stress.captures import TOY_STAGES
from tools.stress.world import ImpossibleHereError


@pytest.mark.slow
@pytest.mark.parametrize(
    "check", [damage.unnoticed_when_read, damage.not_healed_after_verification, damage.not_healed_by_running]
)
def test_what_is_flipped_or_cut_short_is_noticed_and_healed(tmp_path: Path, check: damage.Check) -> None:
    patient = damage.make_patient(tmp_path / "toy", numbers=5)
    assert check(patient, 50, random.Random(0)) == []


@pytest.mark.slow
def test_hostile_files_are_read_or_refused_by_name(tmp_path: Path) -> None:
    assert hostile.faults_in_process(25, 1, tmp_path) == []


PICTURES = ("jpeg", "jpeg_progressive", "jpeg_restarts", "png", "png16", "tiff", "tiff16", "webp", "webp_lossless")
RANGES = ("range_tiff", "range_png", "range_npy", "range_npz", "range_exr", "normals", "colmap_map", "truth")
MODELS = ("colmap_bin", "colmap_txt", "sphere_bin", "poses_json", "transforms_json", "reconstruction_json", "poses_csv")
OTHERS = ("mask_png", "mask_jpeg", "ply", "ply_text", "ply_mesh", "workflow")


@pytest.mark.slow
@pytest.mark.parametrize("kind", PICTURES + RANGES + MODELS + OTHERS)
def test_hostile_files_of_a_kind(tmp_path: Path, kind: str) -> None:
    """Each is read, or refused by an error of ours that names the file in few words."""
    if kind == "range_exr" and not has_exr():
        pytest.skip("OpenEXR is not installed")
    assert hostile.faults_of_kind(kind, 8, tmp_path) == []


@pytest.mark.slow
def test_hostile_files_take_little_memory_and_end_no_run() -> None:
    assert hostile.main(31) == 0


@pytest.mark.slow
def test_much_damage_is_healed_by_processes() -> None:
    assert damage.main(25) == 0


def test_half_written_files_of_a_store_are_found(tmp_path: Path) -> None:
    (tmp_path / "tmp" / "unit").mkdir(parents=True)
    (tmp_path / "blobs" / "ab").mkdir(parents=True)
    assert kills.half_written(tmp_path) == ["tmp/unit"]
    (tmp_path / "blobs" / "ab" / ".tmp-0123abcd-7-x.json").touch()
    assert kills.half_written(tmp_path) == ["blobs/ab/.tmp-0123abcd-7-x.json", "tmp/unit"]


@pytest.mark.slow
def test_killed_runs_lose_nothing() -> None:
    assert kills.main(3, executor="serial") == 0


def test_a_hundred_tries_meet_each_fault_and_each_stage() -> None:
    tries = faults.schedule(100)
    assert len(tries) + faults.LONG.tries == 100
    assert {fault.kind for fault, _ in tries} == {fault.kind for fault in faults.FAULTS}
    full = next(fault for fault in faults.FAULTS if "in each stage" in fault.kind)
    assert [number for fault, number in tries if fault is full] == list(range(len(TOY_STAGES)))


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> faults.Clean:
    return faults.Clean.make(tmp_path_factory.mktemp("clean"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "executor"),
    [
        ("a second run starts", "serial"),
        ("SIGSTOP of all", "processes"),
        ("stalls", "processes"),
        ("becomes read-only", "serial"),
        ("ulimit", "processes"),
        ("output folder is removed", "serial"),
    ],
)
def test_nothing_is_lost_whatever_happens_around_a_run(
    clean: faults.Clean, tmp_path: Path, kind: str, executor: str
) -> None:
    fault = next(fault for fault in faults.FAULTS if kind in fault.kind)
    number = fault.executors.index(executor)
    try:
        assert faults.attempt(fault, clean, number, folder=tmp_path / "try", pause_s=3) == []
    except ImpossibleHereError as error:
        pytest.skip(str(error))


@pytest.mark.slow
def test_bad_items_killed_workers_and_a_full_disk_cost_the_bad_items_alone(tmp_path: Path) -> None:
    """Without the bad items that end their workers, each of which costs three more: see test_executors.py."""
    verdict = load.load(tmp_path, count=14, bad=7, kills=1, every_s=1.0)
    assert verdict.wrong == []
    assert verdict.runs >= 2  # the first one found the disk full
