"""A store into which somebody has planted things: nothing of it is executed, nothing outside is written.

What is planted bears right names and right digests, which anybody can compute.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import shutil
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.lib import format as npy

from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.core.errors import StoreError, UsageError
from pano_mvs.engine.cache.blobs import BlobRef, DamagedBlobError
from pano_mvs.engine.cache.latest_runs import _read as read_run
from pano_mvs.engine.cache.maintenance import collect, usage_of, verify
from pano_mvs.engine.cache.store import Store, UnitRecord, record_from_bytes
from pano_mvs.engine.running.events import RunResult
from tests.engine.conftest import Toy, ran
from tools.stress.captures import deliverables
from tools.stress.damage import Patient, make_patient


class Bomb:
    """Whoever unpickles it leaves a trace."""

    def __init__(self, trace: Path) -> None:
        self._trace = trace

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self._trace,)


def pickled_array(trace: Path) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.array([Bomb(trace)], dtype=object), allow_pickle=True)
    return buffer.getvalue()


def zipped_arrays(trace: Path) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, rows=np.array([Bomb(trace)], dtype=object))
    return buffer.getvalue()


def with_header(text: str) -> bytes:
    header = text.encode() + b"\n"
    return npy.magic(1, 0) + len(header).to_bytes(2, "little") + header + bytes(64)


PLANTED: dict[str, Callable[[Path], bytes]] = {
    "pickle": lambda trace: pickle.dumps(Bomb(trace)),
    "array of objects": pickled_array,
    "zip of arrays": zipped_arrays,
    "huge shape": lambda _: with_header(f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({10**30}, 2)}}"),
    "negative shape": lambda _: with_header("{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 2)}"),
    "overflow": lambda _: with_header(f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({2**62}, 16)}}"),
    "code": lambda trace: with_header(f"__import__('pathlib').Path({str(trace)!r}).touch()"),
    "nesting": lambda _: with_header("(" * 5000),
    "cut": lambda _: with_header("{'descr': '<f4', 'fortran_order': False, 'shape': (300, 500)}"),
    "nothing": lambda _: b"",
}


def plant(store: Store, data: bytes, suffix: str) -> list[Any]:
    """Write a blob under its right name and return its reference."""
    ref = BlobRef(digest_from_bytes(data), len(data), suffix)
    path = store.blobs.path(ref)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return ref.to_json()


def rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a record and give it a right checksum."""
    value = json.loads(path.read_bytes().partition(b"\n")[2])
    change(value)
    body = json.dumps(value).encode()
    path.write_bytes(digest_from_bytes(body).encode() + b"\n" + body)


def records(root: Path, stage: str) -> list[Path]:
    found = {path: json.loads(path.read_bytes().partition(b"\n")[2]) for path in (root / "records").rglob("*.json")}
    return sorted(path for path, value in found.items() if value["identity"]["stage"] == stage)


def forget(root: Path, stage: str) -> None:
    for path in records(root, stage):
        path.unlink()


@pytest.fixture(scope="module")
def patient(tmp_path_factory: pytest.TempPathFactory) -> Patient:
    """A toy that each test leaves whole."""
    return make_patient(tmp_path_factory.mktemp("patient") / "toy", numbers=2)


@pytest.mark.parametrize("what", PLANTED)
def test_planted_arrays_are_not_executed_and_are_computed_again(patient: Patient, tmp_path: Path, what: str) -> None:
    trace = tmp_path / "trace"
    ref = plant(Store(patient.root), PLANTED[what](trace), ".npy")
    for path in records(patient.root, "toy.table"):
        rewrite(path, lambda record: record["output"]["parts"].update(rows=ref))
    forget(patient.root, "toy.write_table")
    shutil.rmtree(patient.out)
    result = patient.run()
    assert result.exit_code == 0
    assert deliverables(patient.out) == patient.expected
    assert not trace.exists()
    assert any("has content that pano_mvs does not write" in text for text in result.warnings)


def plant_number(patient: Patient, data: bytes) -> RunResult:
    """Plant the value of a number, and run so that it is read."""
    ref = plant(Store(patient.root), data, ".json")
    path = records(patient.root, "toy.scale")[0]
    rewrite(path, lambda record: record["output"]["parts"].update(meta=ref))
    for stage in ("toy.table", "toy.difference", "toy.mean", "toy.shifted"):
        forget(patient.root, stage)
    return patient.run()


@pytest.mark.parametrize(
    "data", [b"[" * 100_000, b"[]", b"null", b"\xff\xfe", b'{"value": ' + b"9" * 5000 + b"}", b"{}"]
)
def test_planted_json_is_computed_again(patient: Patient, data: bytes) -> None:
    result = plant_number(patient, data)
    assert (result.exit_code, result.failures) == (0, [])
    assert deliverables(patient.out) == patient.expected


@pytest.mark.parametrize("data", [b'{"value": "1"}', b'{"value": {"a": []}}'])
def test_planted_value_of_another_type_fails_the_units_that_read_it(tmp_path: Path, data: bytes) -> None:
    result = plant_number(make_patient(tmp_path / "toy", numbers=2), data)
    assert result.exit_code == 3
    assert {failure.stage for failure in result.failures} >= {"table", "difference", "mean"}


TARGETS = [
    ["../outside.txt"],
    ["/tmp/outside.txt"],
    ["a/../../outside.txt"],
    ["..\\outside.txt"],
    ["C:outside.txt"],
    ["a\0b"],
    [""],
    [5],
    [None],
    [["a"]],
    [],
    5,
    None,
    "abc",
]


@pytest.mark.parametrize("targets", TARGETS)
def test_planted_targets_write_nothing_outside(patient: Patient, targets: object) -> None:
    ref = plant(Store(patient.root), json.dumps({"targets": targets}).encode(), ".json")
    (path,) = records(patient.root, "toy.write")
    honest = path.read_bytes()
    rewrite(path, lambda record: record["output"]["parts"].update(meta=ref))
    before = {path for path in patient.folder.rglob("*") if not path.is_relative_to(patient.root)}
    result = patient.run()
    path.write_bytes(honest)
    assert result.exit_code == 0
    assert deliverables(patient.out) == patient.expected
    assert result.computed == (1 if targets != [] else 0)  # to write no file at all is what a stage may do
    assert {path for path in patient.folder.rglob("*") if not path.is_relative_to(patient.root)} == before


@pytest.mark.parametrize(
    "change",
    [
        lambda record: record["output"]["parts"].clear(),
        lambda record: record["output"]["parts"].pop("0"),
        lambda record: record["output"].update(parts={"0": record["output"]["parts"]["meta"]}),
        lambda record: record["output"]["parts"].update({"0": ["../../../../etc/passwd", 5, ".txt", False]}),
        lambda record: record["output"]["parts"].update({"0": [f"{'0' * 32}", 5, "/../../x", False]}),
        lambda record: record["output"]["parts"].update({"0": [f"{'0' * 32}", 5, ".txt", True]}),
        lambda record: record["output"]["parts"].update({"0": [f"{'0' * 32}", 1e30, ".txt", False]}),
        lambda record: record["output"]["parts"].update({"0": [f"{'0' * 32}", 10**400, ".txt", False]}),
        lambda record: record.update(metrics={"a": float("nan")}),
        lambda record: record.update(metrics={"a": 10**400}),
        lambda record: record.update(seconds=float("inf")),
        lambda record: record.update(items=[]),
        lambda record: record.update(identity="x"),
        lambda record: record.update(key="0" * 32),
        lambda record: record.update(notes=5),
        lambda record: record.clear(),
    ],
)
def test_planted_records_are_computed_again(patient: Patient, change: Callable[[dict[str, Any]], object]) -> None:
    (path,) = records(patient.root, "toy.write")
    honest = path.read_bytes()
    rewrite(path, change)
    usage_of(Store(patient.root))
    planted = path.read_bytes()
    damage = verify(Store(patient.root))
    assert len(damage.removed) + len(damage.incomplete) <= 1
    path.write_bytes(planted)
    result = patient.run()
    assert (result.exit_code, result.computed) == (0, 1)
    assert deliverables(patient.out) == patient.expected
    path.write_bytes(honest)


def test_record_that_points_at_the_blobs_of_others_is_computed_again(finished: Toy) -> None:
    """A difference whose record names the blob of a list of pairs: the list, too, is computed again, not for ever."""
    clean, root = finished.deliverables(), finished.folder / "cache"
    (pairs,) = records(root, "toy.pairs")
    parts = json.loads(pairs.read_bytes().partition(b"\n")[2])["output"]["parts"]
    for path in records(root, "toy.difference"):
        rewrite(path, lambda record: record["output"].update(parts=parts))
    forget(root, "toy.write")
    result = finished.run()
    assert (result.exit_code, result.failures) == (0, [])
    assert finished.deliverables() == clean


@pytest.mark.parametrize("name", ["blobs", "records", "runs", "pins", "tmp"])
def test_links_in_place_of_folders_are_refused(tmp_path: Path, name: str) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    Store(tmp_path / "store")
    (tmp_path / "store" / name).symlink_to(outside)
    with pytest.raises(UsageError, match=f"{name} is a link"):
        Store(tmp_path / "store")


@pytest.mark.parametrize("kind", ["blobs", "records"])
def test_links_in_place_of_inner_folders_are_refused(finished: Toy, kind: str) -> None:
    """Whether what is behind them is there or not, sound or not: nothing is written or deleted behind them."""
    root, outside = finished.folder / "cache", finished.folder / "outside"
    outside.mkdir()
    for place in (root / kind).iterdir():
        shutil.move(place, outside / place.name)
        place.symlink_to(outside / place.name)
    for path in outside.rglob("*.json"):
        path.write_bytes(path.read_bytes()[:-1] + b"x")
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in outside.rglob("*") if path.is_file()}
    shutil.rmtree(finished.folder / "out")
    with pytest.raises(StoreError, match="is a link, but caches have no links"):
        finished.run("scaled.by=7")
    verify(Store(root))
    collect(Store(root), unused_s=0.0, forget_after_s=0.0, delete=True)
    after = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in outside.rglob("*") if path.is_file()}
    assert after == before


def test_link_in_place_of_a_blob_is_replaced_and_what_it_leads_to_stays(finished: Toy) -> None:
    clean, root = finished.deliverables(), finished.folder / "cache"
    precious = finished.folder / "precious"
    for path in [*(root / "blobs").rglob("*.*"), *(root / "records").rglob("*.json")]:
        size = path.stat().st_size
        precious.write_bytes(b"p" * size)
        target = precious.rename(finished.folder / f"precious-{path.name}")
        path.unlink()
        path.symlink_to(target)
    shutil.rmtree(finished.folder / "out")
    assert finished.run().exit_code == 0
    assert finished.deliverables() == clean
    assert all(set(path.read_bytes()) <= {ord("p")} for path in finished.folder.glob("precious-*"))


@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_what_stands_in_place_of_a_record_is_replaced(finished: Toy, kind: str) -> None:
    """A pipe in place of a record stopped the run for ever, and a folder ended it."""
    clean, root = finished.deliverables(), finished.folder / "cache"
    assert records(root, "toy.scale")
    for path in records(root, "toy.scale"):
        path.unlink()
        if kind == "folder":
            (path / "inside").mkdir(parents=True)
        elif kind == "device":
            path.symlink_to("/dev/null")
        else:
            os.mkfifo(path)
    verify(Store(root))
    assert finished.run().exit_code == 0
    assert finished.deliverables() == clean
    assert ran(finished.run()) == {}


def test_records_of_a_clock_that_was_wrong_are_collected(finished: Toy) -> None:
    root = finished.folder / "cache"
    future = time.time() + 1e8
    for path in (root / "records").rglob("*.json"):
        os.utime(path, (future, future))
    found = collect(Store(root), unused_s=3600.0, forget_after_s=0.0)
    assert len(found.records) == len(list((root / "records").rglob("*.json")))


def test_output_folder_with_a_link_is_not_left(toy: Toy) -> None:
    outside = toy.folder / "outside"
    outside.mkdir()
    (toy.folder / "out").mkdir()
    (toy.folder / "out" / "mean").symlink_to(outside)
    with pytest.raises(StoreError, match="a link leads outside"):
        toy.run()
    assert not list(outside.iterdir())


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just("0" * 32),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=8), inner, max_size=5),
    max_leaves=5,
)
fuzzing = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], max_examples=50)
digests = st.sampled_from(["0" * 32, "ab" * 16])
no_digests = st.sampled_from(["../" * 10 + "ab", "AB" * 16, "ab" * 15, "ab" * 16 + "\n", ""]) | anything
sizes = st.integers(0, 10_000)
no_sizes = st.sampled_from([-1, 2**70, 1.0, True, "1"]) | anything
suffixes = st.sampled_from([".npy", ".json", "", ".tar-1"])
no_suffixes = st.sampled_from(["/../../x", ".npy/x", "npy", ".", ".np y", "." + "a" * 40]) | anything


def blob_refs(wrong: bool) -> st.SearchStrategy[Any]:
    """References to blobs; wrong ones have one field, or the form, of something else."""
    if not wrong:
        return st.tuples(digests, sizes, suffixes, st.booleans())
    return (
        st.tuples(no_digests, sizes, suffixes, st.booleans())
        | st.tuples(digests, no_sizes, suffixes, st.booleans())
        | st.tuples(digests, sizes, no_suffixes, st.booleans())
        | st.tuples(digests, sizes, suffixes, anything)
        | anything
    )


def nearly_records(wrong: bool) -> st.SearchStrategy[Any]:
    names = st.text(max_size=4)
    parts: st.SearchStrategy[Any] = st.dictionaries(names, blob_refs(False), min_size=1, max_size=2)
    if wrong:
        parts = parts.flatmap(lambda some: blob_refs(True).map(lambda one: {**some, "wrong": one})) | anything
    refs = st.fixed_dictionaries({"kind": names, "digest": digests, "parts": parts})
    other = anything if wrong else st.nothing()
    return st.fixed_dictionaries(
        {
            "key": digests,
            "identity": st.dictionaries(names, anything, max_size=2) | other,
            "output": refs | other,
            "items": st.dictionaries(names, refs, max_size=2) | other,
            "metrics": st.dictionaries(names, st.floats(allow_nan=wrong, allow_infinity=wrong), max_size=2) | other,
            "notes": st.lists(names, max_size=2) | other,
            "rejected": st.dictionaries(names, names, max_size=1) | other,
            "doubts": st.dictionaries(names, names, max_size=1) | other,
            "seconds": st.floats(0, 1e6) | other,
        }
    )


def signed(value: object) -> bytes:
    body = json.dumps(value).encode()
    return digest_from_bytes(body).encode() + b"\n" + body


def require_in_store(record: UnitRecord) -> None:
    for ref in record.blobs():
        assert re.fullmatch("[0-9a-f]{32}", ref.digest)
        assert re.fullmatch(r"(\.[a-z0-9_+-]+)?", ref.suffix)
        assert 0 <= ref.size_bytes < 2**63
        assert type(ref.size_bytes) is int
        assert type(ref.external) is bool
    json.dumps(record.to_json(), allow_nan=True)
    assert all(np.isfinite([record.seconds, *record.metrics.values()]))


@given(nearly_records(wrong=False))
@fuzzing
def test_a_record_with_blobs_is_read_as_it_was_written(value: dict[str, Any]) -> None:
    record = record_from_bytes(signed(value))
    assert record is not None
    assert len(list(record.blobs())) == sum(len(ref["parts"]) for ref in (value["output"], *value["items"].values()))
    assert [ref.to_json() for ref in record.output.parts.values()] == [
        list(part) for part in value["output"]["parts"].values()
    ]
    require_in_store(record)


@given(st.binary(max_size=200) | (anything | nearly_records(wrong=True)).map(signed))
@fuzzing
def test_any_bytes_are_a_record_or_none(data: bytes) -> None:
    record = record_from_bytes(data)
    if record is not None:
        require_in_store(record)


@given(
    st.tuples(no_digests, sizes, suffixes, st.booleans()).filter(lambda ref: ref[0] not in ("0" * 32, "ab" * 16))
    | st.tuples(digests, sizes, st.sampled_from(["/../../x", ".npy/x", "npy", "."]), st.booleans())
    | st.tuples(digests, st.sampled_from([-1, 2**70, 1.0, True, "1"]), suffixes, st.booleans())
    | st.tuples(digests, sizes, suffixes, st.sampled_from([0, 1, None, "yes"]))
)
@fuzzing
def test_a_record_with_a_reference_that_is_none_is_none(ref: tuple[Any, ...]) -> None:
    item = {"kind": "Range", "digest": "0" * 32, "parts": {"range": ref}}
    value = {
        "key": "0" * 32,
        "identity": {},
        "output": item,
        "items": {},
        "metrics": {},
        "notes": [],
        "rejected": {},
        "seconds": 1.0,
    }
    assert record_from_bytes(signed(value)) is None


names_of_units = st.dictionaries(st.text(max_size=4), st.dictionaries(st.text(max_size=4), st.text(max_size=4)))
TIME = "2026-11-21T08:00:00Z"


@given(
    data=st.binary(max_size=100)
    | (
        anything
        | st.fixed_dictionaries(
            {
                "workflow": anything,
                "out": anything,
                "when": anything | st.datetimes().map(str) | st.just(TIME),
                "keys": anything | names_of_units | st.dictionaries(st.text(max_size=4), anything),
            }
        )
    ).map(signed)
)
@fuzzing
def test_any_bytes_are_an_entry_of_the_book_or_none(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "entry.json"
    path.write_bytes(data)
    entry = read_run(path)
    if entry is not None:
        checksum, _, body = data.partition(b"\n")
        assert checksum == digest_from_bytes(body).encode()
        assert 1970 <= datetime.fromisoformat(entry.when).year < 9999
        assert abs(entry.age_s()) < 8100 * 366 * 86400
        assert all(type(text) is str for text in (entry.workflow, entry.out))
        told = [text for stage, units in entry.keys.items() for text in (stage, *units, *units.values())]
        assert all(type(text) is str for text in told)


@given(keys=names_of_units)
@fuzzing
def test_an_entry_of_the_book_is_read_as_it_was_written(tmp_path: Path, keys: dict[str, dict[str, str]]) -> None:
    path = tmp_path / "entry.json"
    path.write_bytes(signed({"workflow": "w", "out": "o", "when": TIME, "keys": keys}))
    entry = read_run(path)
    assert entry is not None
    assert (entry.workflow, entry.out, entry.when, entry.keys) == ("w", "o", TIME, keys)
    assert entry.units == sum(map(len, keys.values()))


@pytest.mark.parametrize(
    "wrong",
    [
        {"when": "2026-11-21T08:00:00"},
        {"when": "soon"},
        {"when": "0001-01-01T00:00:00Z"},
        {"keys": [1]},
        {"keys": {"depth": 1}},
        {"keys": None},
    ],
)
def test_an_entry_with_something_else_in_it_is_none(tmp_path: Path, wrong: dict[str, Any]) -> None:
    path = tmp_path / "entry.json"
    path.write_bytes(signed({"workflow": "w", "out": "o", "when": TIME, "keys": {}} | wrong))
    assert read_run(path) is None


@given(data=st.binary(max_size=200), header=st.text(max_size=60))
@fuzzing
def test_any_bytes_are_an_array_or_damage(tmp_path: Path, data: bytes, header: str) -> None:
    store = Store(tmp_path)
    for content in (data, npy.magic(1, 0) + data, with_header(header)):
        ref = BlobRef.from_json(plant(store, content, ".npy"))
        try:
            assert isinstance(store.blobs.get(ref), np.ndarray)
        except DamagedBlobError:
            assert not store.blobs.path(ref).exists()
