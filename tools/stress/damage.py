"""Damage a store at random and see that all of it is noticed.

N times a random blob or record of a toy's store gets one random bit flipped, or loses its end. Each must be noticed
when it is read, by `cache verify`, and by a run that has to read it; and a run must make the store whole again, with
the files that it delivers the same to the byte.
"""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from pano_mvs.core.files import remove_whole
from pano_mvs.engine.cache.blobs import BlobRef, DamagedBlobError
from pano_mvs.engine.cache.maintenance import verify
from pano_mvs.engine.cache.store import Store, UnitRecord, record_from_bytes
from pano_mvs.engine.executors.choose import ExecutorRequest, make_executor
from pano_mvs.engine.running.events import RunResult
from pano_mvs.engine.running.run import Run
from pano_mvs.session.session import open_session
from tools.stress.captures import deliverables, write_toy

_BATCH = 25
Check: TypeAlias = "Callable[[Patient, int, random.Random], list[str]]"


@dataclass
class Patient:
    """A toy's folder with its store, and what it delivers."""

    folder: Path
    executor: str = "serial"
    expected: dict[str, bytes] = field(default_factory=dict)

    @property
    def root(self) -> Path:
        return self.folder / "cache"

    @property
    def out(self) -> Path:
        return self.folder / "out"

    def run(self) -> RunResult:
        session = open_session(str(self.folder / "wf.yaml"), cache=self.root, out=self.out)
        store = Store(session.store_root, min_free_bytes=0)
        executor = make_executor(store, ExecutorRequest(self.executor, 0 if self.executor == "serial" else 2))
        try:
            return Run(session.workflow, session.graph, store, out=session.out, executor=executor).execute()
        finally:
            executor.close()

    def files(self) -> list[Path]:
        """Return all blobs and records."""
        return sorted(path for name in ("blobs", "records") for path in (self.root / name).rglob("*") if path.is_file())

    def refs(self) -> dict[Path, BlobRef]:
        """Return what each blob is known as."""
        store = Store(self.root)
        return {store.blobs.path(ref): ref for record in self.records() for ref in record.blobs() if not ref.external}

    def records(self) -> Iterator[UnitRecord]:
        for path in sorted((self.root / "records").rglob("*.json")):
            record = record_from_bytes(path.read_bytes())
            assert record is not None
            yield record


def make_patient(folder: Path, *, executor: str = "serial", numbers: int = 8) -> Patient:
    """Return a toy that has been run once."""
    write_toy(folder, numbers=numbers)
    patient = Patient(folder, executor)
    assert patient.run().exit_code == 0
    patient.expected = deliverables(patient.out)
    return patient


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return bytes with one bit flipped, or without their end."""
    if rng.random() < 0.5 and data:
        return data[: rng.randrange(len(data))]
    place = rng.randrange(len(data))
    return data[:place] + bytes([data[place] ^ (1 << rng.randrange(8))]) + data[place + 1 :]


def unnoticed_when_read(patient: Patient, count: int, rng: random.Random) -> list[str]:
    """Damage one file at a time, read it, and mend it; return what was not noticed."""
    found: list[str] = []
    refs, files = patient.refs(), patient.files()
    for _ in range(count):
        path = rng.choice(files)
        data = path.read_bytes()
        path.write_bytes(worse := damaged(data, rng))
        store = Store(patient.root)
        if path in refs:
            try:
                store.blobs.get(refs[path])
                found.append(f"{path.name}: {len(data)} bytes to {len(worse)}")
            except DamagedBlobError:
                if path.exists():
                    found.append(f"{path.name} was left there")
        elif store.find(path.stem) is not None:
            found.append(f"{path.name}: {len(data)} bytes to {len(worse)}")
        path.write_bytes(data)
    return found


def not_healed_after_verification(patient: Patient, count: int, rng: random.Random) -> list[str]:
    """Damage many files, verify, and run; return what was not found, or not mended."""
    return _in_batches(patient, count, rng, _verify_and_run)


def not_healed_by_running(patient: Patient, count: int, rng: random.Random) -> list[str]:
    """Damage many files and run so that everything is read; return what was not mended."""
    return _in_batches(patient, count, rng, _run_afresh)


def _in_batches(
    patient: Patient, count: int, rng: random.Random, heal: Callable[[Patient, list[Path]], list[str]]
) -> list[str]:
    found: list[str] = []
    for _ in range(0, count, _BATCH):
        paths = rng.sample(patient.files(), _BATCH)
        for path in paths:
            path.write_bytes(damaged(path.read_bytes(), rng))
        found.extend(heal(patient, paths))
        if deliverables(patient.out) != patient.expected:
            found.append("the deliverables are not the same after healing")
    return found


def _verify_and_run(patient: Patient, paths: list[Path]) -> list[str]:
    removed = set(verify(Store(patient.root)).removed)
    found = [f"{path.name} was not noticed" for path in paths if str(path) not in removed]
    found.extend(f"{name} was taken for damaged" for name in removed - {str(path) for path in paths})
    return found + _run(patient) + _whole(patient, paths)


def _run_afresh(patient: Patient, paths: list[Path]) -> list[str]:
    """Let the last stages run again and the files be written again, so that all between is read."""
    remove_whole(patient.out)
    for path in (patient.root / "records").rglob("*.json"):
        record = record_from_bytes(path.read_bytes())
        if record is not None and "write" in record.identity["stage"]:
            path.unlink()
    found = _run(patient)
    verify(Store(patient.root))  # what nobody had to read may be damaged still
    return found + _run(patient) + _whole(patient, paths)


def _run(patient: Patient) -> list[str]:
    result = patient.run()
    return [f"exit code {result.exit_code}: {result.failures}"] if result.exit_code else []


def _whole(patient: Patient, paths: list[Path]) -> list[str]:
    damage = verify(Store(patient.root))
    return [*damage.removed, *damage.incomplete, *(f"{path} is not back" for path in paths if not path.exists())]


def main(count: Annotated[int, typer.Argument()] = 500, executor: str = "processes", seed: int = 0) -> int:
    """Damage `count` blobs and records, print what came of it, and return the exit code."""
    rng, started, wrong = random.Random(seed), time.monotonic(), 0
    checks = {
        "read": unnoticed_when_read,
        "verified and run": not_healed_after_verification,
        "run": not_healed_by_running,
    }
    with tempfile.TemporaryDirectory(prefix="pano-mvs-damage-") as folder:
        patient = make_patient(Path(folder) / "toy", executor=executor)
        for what, check in checks.items():
            found = check(patient, count, rng)
            wrong += len(found)
            print(f"{what}: {count} damaged, {len(found)} faults", *found[:10], sep="\n  ", flush=True)
    print(f"{time.monotonic() - started:.0f} s")
    return 1 if wrong else 0
