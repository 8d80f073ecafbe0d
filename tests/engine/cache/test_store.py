from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.core.errors import ContractError
from pano_mvs.core.files import CACHE_MARK
from pano_mvs.engine.cache.blobs import DamagedBlobError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.running import run as run_module
from pano_mvs.engine.running.events import RunEvent, StageStarted
from pano_mvs.scene import RangeMap, Record
from tests.engine.conftest import Toy
from tests.permissions import permissions_hold


@dataclass(frozen=True, eq=False)
class Sample(Record):
    """A kind for this test."""

    array: NDArray[np.float32]
    names: tuple[str, ...]
    nested: tuple[tuple[str, int], ...]
    share: float


def test_values_come_back_as_they_were(tmp_path: Path) -> None:
    store = Store(tmp_path)
    value = Sample(np.arange(6, dtype=np.float32).reshape(2, 3), ("a", "b"), (("x", 1),), 0.1)
    back = store.load(store.put_value(value), Sample)
    assert isinstance(back, Sample)
    np.testing.assert_array_equal(back.array, value.array)
    assert (back.names, back.nested, back.share) == (value.names, value.nested, value.share)
    assert not back.array.flags.writeable


@pytest.mark.parametrize("shape", [(0, 3), (), (3, 5), (3, 100_000)])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["uint8", "int32", "float64"])
def test_arrays_of_any_form_come_back_read_only(
    tmp_path: Path, shape: tuple[int, ...], order: Literal["C", "F"], dtype: str
) -> None:
    blobs = Store(tmp_path).blobs
    count = int(np.prod(shape))
    array: NDArray[Any] = np.asarray(np.arange(count).astype(np.dtype(dtype)).reshape(shape, order=order))
    ref = blobs.put(array)
    assert ref.is_mapped == (array.nbytes > 200_000)
    back = blobs.get(ref)
    assert isinstance(back, np.ndarray)
    assert isinstance(back, np.memmap) == ref.is_mapped
    assert back.dtype == array.dtype
    assert not back.flags.writeable
    assert back.flags.aligned
    np.testing.assert_array_equal(back, array)


def test_equal_values_share_blobs_and_digest(tmp_path: Path) -> None:
    first, second = Store(tmp_path / "a"), Store(tmp_path / "b")
    value = Sample(np.ones((2, 2), np.float32), (), (), 1.0)
    assert first.put_value(value) == second.put_value(value)


def test_value_that_breaks_its_kind_is_refused(tmp_path: Path) -> None:
    wrong = RangeMap(np.zeros((2, 4), np.float32), np.ones((2, 4), np.uint8))
    with pytest.raises(ContractError, match="invalid is NaN"):
        Store(tmp_path).put_value(wrong)


@pytest.mark.parametrize("damage", ["flip", "truncate", "delete"])
def test_damaged_blobs_are_noticed_and_computed_again(finished: Toy, damage: str) -> None:
    clean = finished.deliverables()
    blobs = sorted(p for p in (finished.folder / "cache" / "blobs").rglob("*") if p.is_file())
    for blob in blobs:
        data = blob.read_bytes()
        match damage:
            case "flip":
                blob.write_bytes(bytes([data[0] ^ 1]) + data[1:])
            case "truncate":
                blob.write_bytes(data[:-1])
            case "delete":
                blob.unlink()
    (finished.folder / "out" / "all.txt").unlink()
    finished.edit("wf.yaml", lambda text: text.replace("by: 3", "by: 3.0"))
    result = finished.run()
    assert result.exit_code == 0
    assert finished.deliverables() == clean
    for blob in blobs:
        assert blob.is_file()


def test_read_of_a_flipped_blob_is_refused_and_removes_it(tmp_path: Path) -> None:
    ref = Store(tmp_path).put_value(Sample(np.ones((2, 2), np.float32), (), (), 1.0))
    path = Store(tmp_path).blobs.path(ref.parts["array"])
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 128]))
    with pytest.raises(DamagedBlobError, match="damaged"):
        Store(tmp_path).load(ref, Sample)
    assert not path.exists()


def test_no_pickle_is_read(tmp_path: Path) -> None:
    ref = Store(tmp_path).put_value(Sample(np.ones((2, 2), np.float32), (), (), 1.0))
    store = Store(tmp_path)
    path = store.blobs.path(ref.parts["array"])
    np.save(path, np.array([{"an": "object"}], dtype=object), allow_pickle=True)
    store.blobs._verified.add(ref.parts["array"])
    with pytest.raises(DamagedBlobError, match="Python objects"):
        store.load(ref, Sample)


def test_caches_are_marked_also_those_of_earlier_versions(tmp_path: Path) -> None:
    Store(tmp_path / "a")
    mark = tmp_path / "a" / CACHE_MARK
    assert mark.read_bytes() == b""
    mark.unlink()
    tmp_path.joinpath("a").chmod(0o500)
    with permissions_hold():
        Store(tmp_path / "a")  # a cache that may only be read stays as it is
    assert not mark.exists()
    tmp_path.joinpath("a").chmod(0o700)
    Store(tmp_path / "a")
    assert mark.exists()


@pytest.mark.slow
def test_much_damage_takes_few_passes(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each damaged blob made the run start over: hundreds of them in a large capture took hours."""
    for number in range(6, 20):
        toy.number(f"{number}.txt", str(10 * number))
    toy.run()
    clean = toy.deliverables()
    root = toy.folder / "cache"
    for blob in (root / "blobs").rglob("*.*"):
        blob.write_bytes(b"x" * blob.stat().st_size)
    for record in (root / "records").rglob("*.json"):
        if b'"stage": "toy.mean"' in record.read_bytes() or b'"stage": "toy.write' in record.read_bytes():
            record.unlink()
    passes: list[str] = []

    def note(event: RunEvent | None) -> None:
        if isinstance(event, StageStarted):
            passes.append(event.stage)

    with monkeypatch.context() as listening:
        listening.setattr(run_module, "ignore", note)
        result = toy.run()
    assert result.exit_code == 0
    assert toy.deliverables() == clean
    assert len(result.warnings) > 19
    assert passes.count("images") < 8


def test_input_that_is_gone_while_a_stage_reads_it_is_no_fault_of_the_stage(toy: Toy) -> None:
    """As when somebody collects it in that very moment."""
    mark, blobs = toy.folder / "mark", toy.folder / "cache" / "blobs"
    toy.edit(
        "plug.py",
        lambda text: text.replace(
            '    """Multiply."""',
            f'''    """Multiply."""
    import pathlib, shutil
    if not (mark := pathlib.Path({str(mark)!r})).exists():
        mark.touch()
        shutil.rmtree({str(blobs)!r})
        raise FileNotFoundError("no such file")''',
        ),
    )
    result = toy.run()
    assert (result.exit_code, result.failures) == (0, [])
    assert any("is missing; the same command computes it again" in text for text in result.warnings)
    assert mark.exists()
