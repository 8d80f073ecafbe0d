"""A dask cluster computes what a single process does, and a worker that cannot is told from one that can."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from pano_mvs_queues import dask_cluster
from pano_mvs_queues.dask_cluster import DaskExecutor

from pano_mvs.core.errors import UsageError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.stages.stage_code import code_texts, stage_code
from tests.engine.conftest import Toy, ran
from tests.engine.rows import KEPT, Rows
from tests.engine.running.test_executors import files_below, keys_and_outputs, run_with, told
from tests.engine.running.test_run import ALL_UNITS

# dask's own threads and loops leave sockets and loops to the collector.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore"),
]


@contextmanager
def existing_cluster(folder: Path, *, workers: int = 2) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Start a scheduler and workers as a person would, in a folder with nothing of ours in it."""
    folder.mkdir()
    address_file = folder / "scheduler.json"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    root = str(Path(__file__).parents[3])
    environment["PYTHONPATH"] = root
    quiet: dict[str, Any] = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "cwd": folder,
        "env": environment,
    }
    command = [
        sys.executable,
        *["-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"],
        *f"--scheduler-file {address_file}".split(),
    ]
    processes = [subprocess.Popen(command, **quiet)]
    try:
        deadline = time.monotonic() + 60
        while not address_file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        for _ in range(workers):
            command = [
                sys.executable,
                *f"-m distributed.cli.dask_worker --scheduler-file {address_file}".split(),
                *["--nthreads", "1", "--no-dashboard"],
            ]
            processes.append(subprocess.Popen(command, **quiet))
        address = json.loads(address_file.read_text())["address"]
        _wait_for_workers(address, workers)
        yield address, processes[1:]
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(20)
            process.kill()
            process.wait()


def _wait_for_workers(address: str, workers: int) -> None:
    from distributed import Client

    connect: Any = Client  # which has no types
    with connect(address, timeout=30, set_as_default=False) as client:
        client.wait_for_workers(workers, timeout=60)


def test_local_cluster_gives_the_bytes_of_serial(toy: Toy) -> None:
    toy.number("2.txt", "13")
    serial = run_with(toy, SerialExecutor, name="serial")
    cluster = run_with(toy, lambda store: DaskExecutor(store, workers=2, threads=1), name="dask")
    assert told(cluster) == told(serial)
    assert files_below(toy.folder / "out-dask") == files_below(toy.folder / "out-serial")
    assert keys_and_outputs(toy.folder / "cache-dask") == keys_and_outputs(toy.folder / "cache-serial")
    assert not list((toy.folder / "cache-dask" / "tmp").iterdir())


def test_two_clusters_run_side_by_side_in_silence(tmp_path: Path) -> None:
    store = Store(tmp_path / "cache")
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        first = DaskExecutor(store, workers=1, threads=1)
        try:
            DaskExecutor(store, workers=1, threads=1).close()
        finally:
            first.close()


def test_temporary_results_are_dropped_and_computed_again(tmp_path: Path) -> None:
    rows = Rows(tmp_path)
    store = rows.store
    for overrides, expected in (((), 25), (("last.value=6",), 20), (("last.value=6",), 0)):
        session = rows.session(*overrides)
        executor = DaskExecutor(store, workers=2, threads=1)
        try:
            result = Run(session.workflow, session.graph, store, out=session.out, executor=executor).execute()
        finally:
            executor.close()
        assert (result.exit_code, result.computed, result.warnings) == (0, expected, [])
        assert rows.kept() == KEPT


def test_existing_cluster_gives_the_bytes_of_serial_and_lives_on(toy: Toy) -> None:
    serial = run_with(toy, SerialExecutor, name="serial")
    with existing_cluster(toy.folder / "cluster", workers=1) as (address, workers):
        for name in ("first", "second"):
            result = run_with(toy, lambda store: DaskExecutor(store, scheduler=address), name=name)
            assert told(result) == told(serial)
            assert files_below(toy.folder / f"out-{name}") == files_below(toy.folder / "out-serial")
        assert all(worker.poll() is None for worker in workers)


def test_plugin_comes_along_as_text(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the plugin's file lies, the worker sees something else."""
    session = toy.session()
    texts = {path: code_texts(path) for path in session.workflow.plugins}
    monkeypatch.setattr(DaskExecutor, "_texts", lambda self, path: texts[path])
    for entry in session.workflow.stages.values():
        stage_code(entry.spec, entry.params)
    hidden = (toy.folder / "plug.py").rename(toy.folder / "hidden.py")
    store = Store(toy.folder / "cache")
    executor = DaskExecutor(store, workers=1, threads=1)
    try:
        result = Run(session.workflow, session.graph, store, out=toy.folder / "out", executor=executor).execute()
    finally:
        executor.close()
    assert hidden.exists()
    assert ran(result) == ALL_UNITS


def test_unit_whose_process_dies_is_tried_again(toy: Toy) -> None:
    mark = toy.folder / "died"
    toy.begin(f"""
if x.value == 30 and not os.path.exists({str(mark)!r}):
    open({str(mark)!r}, "w").close()
    os._exit(1)
""")
    assert ran(run_with(toy, lambda store: DaskExecutor(store, workers=2, threads=1))) == ALL_UNITS
    assert mark.exists()


def test_a_store_that_is_not_seen_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    introduce = dask_cluster.introduce
    with monkeypatch.context() as patch:
        patch.setattr(dask_cluster, "introduce", lambda root, token: introduce(str(tmp_path / "elsewhere"), token))
        with pytest.raises(UsageError, match="does not see the cache"):
            DaskExecutor(store, workers=1, threads=1)


@pytest.mark.parametrize("scheduler", ["host", "tcp://host", "tcp://host:port", "tcp://:8786"])
def test_scheduler_without_host_or_port_is_refused_before_dask_is_asked(tmp_path: Path, scheduler: str) -> None:
    with pytest.raises(UsageError, match="must be an address such as"):
        DaskExecutor(Store(tmp_path), scheduler=scheduler)


def test_scheduler_that_does_not_answer_is_a_usage_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_cluster, "_CONNECT_S", 1.0)
    with pytest.raises(UsageError, match="does not answer"):
        DaskExecutor(Store(tmp_path), scheduler="tcp://127.0.0.1:9")


def test_a_cluster_of_the_run_outlasts_sleep(tmp_path: Path) -> None:
    """After minutes without heartbeats, dask removes workers, and nothing would start that of our process again."""
    executor = DaskExecutor(Store(tmp_path))
    try:
        assert executor._cluster is not None
        assert executor._cluster.scheduler.worker_ttl is None
    finally:
        executor.close()
