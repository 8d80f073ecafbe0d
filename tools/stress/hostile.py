"""Meet whatever is hostile: a list of at least 150 tries, or damaged files of every kind.

The list has five groups: files that are read, what somebody put into the cache, plugins, commands, and outputs of runs
that are shown in a page. Each try is a test of this package, which says what must hold: no traceback, the documented
exit code, an error that names the file and the remedy, other results kept, nothing written outside.

With a number, so many files are read instead: mutations, seeded, of good files (lost ends, flipped bits, numbers at
their extremes, text that is none), and beside them all files that were crafted by hand: headers that promise more than
there is, compressed bombs, counts of thousands of digits, poses that are no numbers. Each is read in a process whose
memory is limited. It must be read, or refused with an error of ours that names the file in few words: no traceback, no
warning, no crash, no endless reading. Then all hostile pictures are given to a run, which must lose these and nothing
else.
"""

from __future__ import annotations

import json
import random
import resource
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import typer

from pano_mvs.core.errors import PanoMvsError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.running.run import Run
from pano_mvs.scene.image_file import write_png
from pano_mvs.session.session import open_session
from tools.stress.hostile_crafted import crafted
from tools.stress.hostile_samples import Sample, samples

_LONGEST_MESSAGE = 4500
_SECONDS_EACH = 120.0
_SERVE = """
import sys
from pathlib import Path
from tools.stress.hostile import serve
count, seed, scratch, first, extra_bytes = sys.argv[1:]
serve(int(count), int(seed), Path(scratch), int(first), int(extra_bytes))
"""
_EXTREMES = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**40, 2**63, 2**64 - 1)
_TEXTS = (
    b"nan",
    b"-inf",
    b"1e999",
    b"-1",
    b"9" * 5000,
    b"",
    b"null",
    b"[]",
    b"{}",
    b'"',
    b"\0",
    b"\xff\xfe",
    b"\x1b[2J",
    b"0",
    b"true",
    b"[" * 2000,
)


@dataclass(frozen=True)
class Case:
    """One hostile input: the kind of its sample, what was done to it, and its files."""

    name: str
    kind: str
    files: Mapping[str, bytes]


def cases(count: int, seed: int, scratch: Path) -> list[Case]:
    """Return all crafted inputs, and as many mutations, spread over the kinds."""
    good = samples(scratch)
    found = [Case(f"crafted: {name}", kind, dict(good[kind].files) | files) for name, kind, files in crafted(good)]
    rng, kinds = random.Random(seed), list(good)
    for number in range(count):
        kind = kinds[number % len(kinds)]
        sample = good[kind]
        file = rng.choice(list(sample.files)[: sample.mutated])
        data, what = mutated(sample.files[file], rng)
        found.append(Case(f"{number}: {kind}/{file}: {what}", kind, dict(sample.files) | {file: data}))
    return found


def mutated(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """Return bytes that were damaged in one to three ways, and how."""
    how = []
    for _ in range(rng.randint(1, 3)):
        change = rng.choice([_cut, _flip, _extreme, _text, _double, _drop, _noise, _empty])
        if change is _empty and rng.random() < 0.8:
            change = _flip
        data = change(data, rng) if data else data
        how.append(change.__name__.strip("_"))
    return data, "+".join(how)


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _flip(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        changed[_place(data, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _extreme(data: bytes, rng: random.Random) -> bytes:
    size, value = rng.choice([1, 2, 4, 8]), rng.choice(_EXTREMES)
    place = _place(data, rng)
    number = (value & (256**size - 1)).to_bytes(size, rng.choice(["little", "big"]))
    return bytes(data[:place] + number + data[place + size :])


def _text(data: bytes, rng: random.Random) -> bytes:
    place = _place(data, rng)
    return data[:place] + rng.choice(_TEXTS) + data[place + rng.randrange(12) :]


def _double(data: bytes, rng: random.Random) -> bytes:
    first, second = sorted(rng.choices(range(len(data) + 1), k=2))
    return data[:second] + data[first:]


def _drop(data: bytes, rng: random.Random) -> bytes:
    first = _place(data, rng)
    return data[:first] + data[first + rng.randrange(1, 64) :]


def _noise(data: bytes, rng: random.Random) -> bytes:
    place = _place(data, rng)
    return data[:place] + rng.randbytes(rng.randrange(1, 200)) + data[place:]


def _empty(_data: bytes, _rng: random.Random) -> bytes:
    return b""


def _place(data: bytes, rng: random.Random) -> int:
    """Return a place, in every second case near the beginning, where headers are."""
    return rng.randrange(min(len(data), 400) if rng.random() < 0.5 else len(data))


def fault(case: Case, sample: Sample, folder: Path) -> str:
    """Read an input; return what is wrong with how that ended, empty if nothing is."""
    folder.mkdir(parents=True)
    for name, data in case.files.items():
        (folder / name).write_bytes(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            sample.read(folder)
    except PanoMvsError as error:
        text = str(error)
        if case.kind == "workflow":
            return ""
        if len(text) > _LONGEST_MESSAGE:
            return f"a message of {len(text)} characters: {text[:200]}"
        return "" if str(folder) in text else f"the file is not named: {text[:200]}"
    except Exception:
        return traceback.format_exc()
    return ""


def faults_in_process(count: int, seed: int, scratch: Path) -> list[str]:
    """Read a part of all inputs in this process, whose memory is not limited; return the faults."""
    good, drawn = samples(scratch), random.Random(seed).sample(cases(count, seed, scratch), count)
    return [
        f"{case.name}\n{text}"
        for number, case in enumerate(drawn)
        if (text := fault(case, good[case.kind], scratch / f"{number}"))
    ]


def faults_of_kind(kind: str, count: int, scratch: Path) -> list[str]:
    """Read some mutations of a kind in this process; return the faults. `main` reads the crafted inputs."""
    sample, drawn = _samples_once()[kind], list(_mutations(_samples_once(), count, kind))
    found = [(case.name, fault(case, sample, scratch / f"{number}")) for number, case in enumerate(drawn)]
    return [f"{name}\n{text}" for name, text in found if text]


@cache
def _samples_once() -> dict[str, Sample]:
    with tempfile.TemporaryDirectory(prefix="pano-mvs-hostile-") as name:
        return samples(Path(name))


def _mutations(good: Mapping[str, Sample], count: int, kind: str) -> Iterator[Case]:
    """Yield as many mutations of one kind, which do not depend on the other kinds."""
    rng, sample = random.Random(kind), good[kind]
    for number in range(count):
        file = rng.choice(list(sample.files)[: sample.mutated])
        data, what = mutated(sample.files[file], rng)
        yield Case(f"{number}: {kind}/{file}: {what}", kind, dict(sample.files) | {file: data})


def serve(count: int, seed: int, scratch: Path, first: int, extra_bytes: int) -> None:
    """Read the inputs from one on with limited memory, and print the outcome of each in a line."""
    good, found = samples(scratch), cases(count, seed, scratch)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + extra_bytes, used + extra_bytes))
    for number in range(first, len(found)):
        print(json.dumps({"begun": number}), flush=True)
        text = fault(found[number], good[found[number].kind], scratch / f"in-{number}")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        print(json.dumps({"number": number, "fault": text, "peak": peak}), flush=True)


def outcomes(count: int, seed: int, extra_bytes: int) -> Iterator[tuple[str, int]]:
    """Yield for each input what is wrong, or nothing, and the peak of memory; a process that dies is started anew."""
    with tempfile.TemporaryDirectory(prefix="pano-mvs-hostile-") as name:
        scratch = Path(name)
        found, first, started = cases(count, seed, scratch), 0, 0
        while first < len(found):
            started += 1
            folder = scratch / f"process-{started}"
            folder.mkdir()
            arguments = [str(count), str(seed), str(folder), str(first), str(extra_bytes)]
            process = subprocess.Popen(
                [sys.executable, "-c", _SERVE, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            try:
                out, errors = process.communicate(timeout=_SECONDS_EACH + (len(found) - first) * 2)
            except subprocess.TimeoutExpired:
                process.kill()
                out, errors = process.communicate()
            begun = first - 1
            for line in out.splitlines():
                answer = json.loads(line) if line.startswith("{") else {}
                begun = answer.get("begun", begun)
                if "number" in answer:
                    text = answer["fault"]
                    yield f"{found[answer['number']].name}\n{text}" if text else "", answer["peak"]
                    first = answer["number"] + 1
            if first < len(found):
                how = f"the process ended with {process.returncode}: {errors[-500:]}"
                yield f"{found[max(begun, first)].name}\n{how}", 0
                first = max(begun, first) + 1


def faults_of_run(count: int, seed: int, folder: Path) -> tuple[int, list[str]]:
    """Give all hostile pictures to a run beside two good ones; return how many there were, and what was wrong."""
    images, number = folder / "images", 0
    images.mkdir(parents=True)
    for name in ("good 1.png", "good 2.png"):  # of other places, since the hostile ones count as copies of each other
        write_png(
            images / name, np.random.default_rng(len(list(images.iterdir()))).integers(0, 256, (16, 32, 3), np.uint8)
        )
    for case in cases(count, seed, folder):
        if "picture.img" in case.files:
            number += 1
            (images / f"bad {number}.jpg").write_bytes(case.files["picture.img"])
    workflow = folder / "w.yaml"
    workflow.write_text(f"pano_mvs: 1\nstages:\n  images: {{use: source.folder, path: {images}}}\n")
    session = open_session(str(workflow), cache=folder / "cache", out=folder / "out")
    store = Store(session.store_root, min_free_bytes=0)
    executor = SerialExecutor(store)
    try:
        result = Run(session.workflow, session.graph, store, out=session.out, executor=executor).execute()
    finally:
        executor.close()
    wrong = [f"{failure.item}: {failure.trace}" for failure in result.failures if failure.trace]
    wrong += [f"{failure.item} failed" for failure in result.failures if failure.item.startswith("good")]
    wrong += [f"{failure.item}: a long cause" for failure in result.failures if len(failure.cause) > _LONGEST_MESSAGE]
    if result.exit_code != 3 or result.stopped:
        wrong.append(f"exit code {result.exit_code}: {result.stopped}")
    return number, wrong


@dataclass(frozen=True)
class Group:
    """Tries of one kind: the tests whose names begin with one of some texts, in this order."""

    least: int  # number of tries, fewer than which must not be left by a change of names
    tests: tuple[str, ...]


_READ, _STORE = "tests/cli/test_bad_input.py::test_", "tests/engine/cache/test_hostile_store.py::test_"
_OUTPUTS, _EXECUTORS = (
    "tests/session/merging/test_hostile_outputs.py::",
    "tests/engine/running/test_executors.py::test_",
)
GROUPS = {
    "inputs": Group(
        60,
        (
            "tests/tools/test_stress.py::test_hostile_files_of_a_kind",
            "tests/io/images/test_hostile_metadata.py",
            *(f"{_READ}{name}" for name in ("input_that", "names", "linked", "two_id", "a_f")),
            *(f"{_OUTPUTS}test_{name}" for name in ("hostile_names_in_run_json", "commands", "links")),
            f"{_OUTPUTS}test_arrays",
        ),
    ),
    "cache": Group(
        20,
        (
            *(f"{_STORE}{name}" for name in ("planted_targets", "link", "what_stands", "record_that", "output_folder")),
            f"{_STORE}planted_arrays",
        ),
    ),
    "plugins": Group(
        30,
        (
            "tests/engine/running/test_isolation.py",
            *(f"{_EXECUTORS}{name}" for name in ("a_unit_that_ends", "an_import", "unit_that_kills", "whatever")),
            "tests/core/test_process_state.py::test_changes",
        ),
    ),
    "commands": Group(20, tuple(f"{_READ}{name}" for name in ("path_that", "an_empty_path"))),
    "page": Group(20, ("plugins/page/tests/test_hostile_page.py",)),
}
MOST_FAULTS = 2


class _Outcomes:
    """Selects the tests of a group and records how they end; a plugin of pytest."""

    def __init__(self, group: Group) -> None:
        self.survived: dict[str, bool] = {}
        self._group = group

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Keep the tries."""
        ordered = [item for start in self._group.tests for item in items if item.nodeid.startswith(start)]
        items[:] = dict.fromkeys(ordered).keys()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Record an outcome; a test that is skipped has not been survived."""
        self.survived[report.nodeid] = report.passed and self.survived.get(report.nodeid, True)


def make_tries() -> int:
    """Make all tries, print how many of each group were survived, and return the exit code."""
    lost: list[str] = []
    counts: dict[str, tuple[int, int]] = {}
    for name, group in GROUPS.items():
        outcomes = _Outcomes(group)
        files = dict.fromkeys(start.partition("::")[0] for start in group.tests)
        pytest.main([*files, "-q", "-m", "", "--tb=short", "-p", "no:cacheprovider"], plugins=[outcomes])
        lost += [f"{name}: {test}" for test, survived in outcomes.survived.items() if not survived]
        missing = max(0, group.least - len(outcomes.survived))
        lost += [f"{name}: one more try is missing"] * missing
        counts[name] = sum(outcomes.survived.values()), len(outcomes.survived) + missing
    for name, (survived, tried) in counts.items():
        print(f"{name:9} {survived:4} of {tried}")
    print(f"{'all':9} {sum(survived for survived, _ in counts.values()):4} of {sum(n for _, n in counts.values())}")
    print(*lost, sep="\n")
    return 1 if len(lost) > MOST_FAULTS else 0


def main(count: Annotated[int, typer.Argument()] = 0, seed: int = 0, memory_mb: int = 1500) -> int:
    """Make the tries of the list, or read `count` mutations; print what came of it, and return the exit code.

    Reading may take `memory_mb` beyond the program itself.
    """
    if not count:
        return make_tries()
    started, total, peak, wrong = time.monotonic(), 0, 0, list[str]()
    for text, bytes_used in outcomes(count, seed, memory_mb * 1_000_000):
        total, peak = total + 1, max(peak, bytes_used)
        if text:
            wrong.append(text)
            print(text, flush=True)
    with tempfile.TemporaryDirectory(prefix="pano-mvs-hostile-") as name:
        pictures, faults = faults_of_run(count, seed, Path(name))
    print(*faults, sep="\n")
    kinds = Counter(text.partition(":")[0] == "crafted" for text in wrong)
    print(
        f"{total} inputs read, {len(wrong)} faults ({kinds[True]} crafted), at most {peak / 1e6:.0f} MB; a run with "
        f"{pictures} hostile pictures: {len(faults)} faults; {time.monotonic() - started:.0f} s"
    )
    return 1 if wrong or faults else 0
