"""Compute units on a dask cluster: a new one on this host, or an existing one that shares the cache.

dask passes requests and answers, in JSON, and selects the workers; values are passed only through the cache. A bounded
number of units is submitted at a time. Retries are made by the dispatcher, not by dask.
"""

from __future__ import annotations

import importlib
import json
import os
import platform
import queue
import socket
import threading
import uuid
from collections import Counter
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import gettempdir
from typing import Any
from urllib.parse import urlsplit

import pano_mvs
from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import UsageError
from pano_mvs.core.files import temporary_prefix
from pano_mvs.core.memory import free_memory_bytes
from pano_mvs.core.paths import below, children, is_file
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.code.plugin_digest import code_texts
from pano_mvs.engine.executors.processes import WorkerProcess
from pano_mvs.engine.executors.protocol import Job, JobOutcome
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.executors.unit_json import request_to_json

_LARGE_BYTES = 200_000
_CONNECT_S = 20.0
_LISTEN_S = 0.5


class DaskExecutor:
    """Submits units to a dask scheduler."""

    name = "dask"
    enforces_timeouts = True

    def __init__(self, store: Store, *, workers: int = 1, threads: int = 0, scheduler: str = "") -> None:
        """Connect to the cluster, and check every worker.

        Args:
            store: the cache; for an existing cluster, in a folder with the same path on all hosts.
            workers: number of workers, for a new cluster on this host.
            threads: threads of each worker; 0 for an equal share of the cores of its host.
            scheduler: address of an existing scheduler.

        Raises:
            UsageError: if dask is not installed, the scheduler does not answer, or a worker has other versions or does
                not see the cache.
        """
        distributed = _import_distributed()
        if scheduler:
            _check_address(scheduler)
        self._store = store
        self._run = uuid.uuid4().hex
        self._ended: queue.SimpleQueue[tuple[int, int, Any]] = queue.SimpleQueue()
        self._out: dict[int, tuple[int, Any]] = {}  # job to its attempt and its future
        self._attempts = 0
        self._requests: dict[int, Path] = {}  # job to the file with its request, for large requests
        self._sources: dict[str, Any] = {}
        self._cluster: Any = None
        if not scheduler:
            # Threads suffice for dask workers, because each starts one of our worker processes.
            self._cluster = distributed.LocalCluster(
                n_workers=1, threads_per_worker=workers, processes=False, dashboard_address=None
            )
        try:
            self._client = distributed.Client(scheduler or self._cluster, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise UsageError(f"--scheduler {scheduler}: it does not answer ({error})") from error
        try:
            places, share, cores = self._check_workers()
        except UsageError:
            self.close()
            raise
        self.capacity = places + (places + 1) // 2 if scheduler else places
        self.threads = threads or share
        self.cores = max(self.threads, cores)
        self._is_remote = bool(scheduler)

    def submit(self, job: Job) -> None:
        """Submit a job."""
        request = request_to_json(job, self._store)
        request["cores"] = self.cores
        request["plugin_texts"] = {str(path.absolute()): self._texts(path) for path in job.plugins}
        text = json.dumps(request)
        if len(text) > _LARGE_BYTES:
            path = job.log.with_suffix(".json").absolute()
            try:
                path.write_text(text, encoding="utf-8")
            except OSError as error:
                raise self._store.cannot_write(error) from error
            self._requests[job.number] = path
            text = str(path)
        self._attempts += 1
        number, attempt = job.number, self._attempts
        key = f"pano-mvs-{job.unit.key}-{self._run}-{attempt}"
        future = self._client.submit(run_unit, self._run, text, key=key, pure=False, retries=0)
        self._out[number] = attempt, future
        future.add_done_callback(lambda done: self._ended.put((number, attempt, done)))

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        """Return the number and the outcome of a job that has ended; see `Executor`."""
        while self._out:
            try:
                number, attempt, future = self._ended.get(timeout=_LISTEN_S if timeout_s is None else timeout_s or 0.0)
            except queue.Empty:
                if timeout_s is None:
                    continue
                return None
            if number in self._out and self._out[number][0] == attempt:
                del self._out[number]
                if number in self._requests:
                    self._requests.pop(number).unlink(missing_ok=True)
                return number, _outcome(future)
        return None

    def free_memory_bytes(self) -> int:
        """Return the free memory of this host, or, for a remote cluster, the smallest limit times the workers."""
        if not self._is_remote:
            return free_memory_bytes()
        limits = [worker["memory_limit"] for worker in self._client.scheduler_info(n_workers=-1)["workers"].values()]
        return int(min(limits, default=0)) * len(limits)

    def cancel(self) -> None:
        """Cancel all jobs and end their processes."""
        if self._out:
            self._client.cancel([future for _, future in self._out.values()], force=True)
            self._out.clear()
            self._client.run(end_workers, self._run, on_error="ignore")

    def close(self) -> None:
        """End the worker processes, and the cluster if this object has started it."""
        self._out.clear()
        self._client.run(end_workers, self._run, on_error="ignore")
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()

    def _texts(self, path: Path) -> Any:
        key = str(path)
        if key not in self._sources:
            self._sources[key] = code_texts(path)
        return self._sources[key]

    def _check_workers(self) -> tuple[int, int, int]:
        """Return the number of units at a time, the threads for each, and the threads for a unit that runs alone."""
        token = f"{temporary_prefix()}hello-{uuid.uuid4().hex}"
        folder = self._store.blobs.temporary
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / token).write_text(token, encoding="ascii")
        except OSError as error:
            self.close()
            raise self._store.cannot_write(error) from error
        try:
            found = self._client.run(introduce, str(self._store.root.absolute()), token, on_error="return")
            for worker, answer in found.items():
                self._check(worker, answer, token)
        finally:
            for path in children(folder, f"{token}*"):
                path.unlink(missing_ok=True)
        if not found:
            raise UsageError("--scheduler: it has no workers; start some with `dask worker`")
        places = self._client.nthreads()
        on_host: Counter[str] = Counter()
        for worker, answer in found.items():
            on_host[answer["host"]] += places[worker]
        cores = {answer["host"]: answer["cores"] for answer in found.values()}
        share = max(1, min(cores[host] // count for host, count in on_host.items()))
        return sum(places.values()), share, min(cores.values())

    def _check(self, worker: str, answer: Any, token: str) -> None:
        if isinstance(answer, BaseException):
            raise UsageError(f"dask worker {worker} cannot run pano_mvs: {answer}. Install it there") from answer
        place = f"dask worker {worker} on {answer['host']}"
        others = differences(versions(), answer["versions"])
        if others:
            raise UsageError(
                f"{place}: {'; '.join(others)}. Results would depend on the worker: install the same versions there"
            )
        if answer["token"] != token or not is_file(self._store.blobs.temporary / answer["answer"]):
            reason = answer["reason"] or "it is another folder there"
            raise UsageError(
                f"{place} does not see the cache {self._store.root.absolute()} ({reason}). Choose "
                "a cache with --cache DIR that all hosts share under the same path"
            )


def _outcome(future: Any) -> JobOutcome:
    if future.status == "finished":
        return JobOutcome.from_json(json.loads(future.result()))
    if future.status == "error":
        return JobOutcome("failed", cause=f"its dask worker failed: {future.exception()}", died=True)
    return JobOutcome("failed", cause=f"the dask cluster lost it ({future.status})", died=True)


def _check_address(scheduler: str) -> None:
    parts = urlsplit(scheduler if "://" in scheduler else f"tcp://{scheduler}")
    try:
        is_complete = bool(parts.hostname and parts.port) or parts.scheme in {"inproc", "ucx"}
    except ValueError:
        is_complete = False
    if not is_complete:
        raise UsageError(f"--scheduler {scheduler}: must be an address such as tcp://host:8786")


def _import_distributed() -> Any:
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise UsageError("--executor dask needs dask: pip install 'pano-mvs[dask]'") from error


_LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless", "pycolmap", "pydantic")
_workers: dict[tuple[str, int], WorkerProcess] = {}


def run_unit(run: str, text: str) -> str:
    """Compute a unit in the worker process of this thread.

    Args:
        run: id of the run, to end its processes later.
        text: the request as JSON, or the path of a file in the cache that contains it.
    """
    request = json.loads(text if text.startswith("{") else Path(text).read_bytes())
    worker = _workers.setdefault((run, threading.get_ident()), _new_worker(request["cores"]))
    return json.dumps(worker.run(request).to_json())


def end_workers(run: str) -> None:
    """End the worker processes of a run at once."""
    for key in [key for key in _workers if key[0] == run]:
        _workers.pop(key).kill()


def introduce(store: str, token: str) -> dict[str, Any]:
    """Return what is checked about a worker before it gets units.

    Args:
        store: folder of the cache.
        token: name of a file among the temporary files of the cache; an answer is written beside it.
    """
    path = Path(store) / "tmp" / token
    answer = path.with_name(f"{token}-{uuid.uuid4().hex}")
    try:
        content = path.read_text(encoding="ascii")
        answer.write_text(content, encoding="ascii")
        reason = ""
    except OSError as error:
        content, reason = "", error.strerror or str(error)
    return {
        "host": socket.gethostname(),
        "cores": available_threads(),
        "versions": versions(),
        "token": content,
        "answer": answer.name,
        "reason": reason,
    }


def versions() -> dict[str, str]:
    """Return the versions of everything that affects results."""
    found = {"python": ".".join(platform.python_version_tuple()[:2]), "pano_mvs": _own_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _own_version() -> str:
    """Return the version of pano_mvs with a digest of the code, as two checkouts of a version may differ."""
    package = Path(pano_mvs.__file__).parent
    sources = {path.relative_to(package).as_posix(): path.read_bytes() for path in below(package, "*.py")}
    return f"{pano_mvs.__version__}+{digest_from_value(sources)[:12]}"


def _new_worker(threads: int) -> WorkerProcess:
    return WorkerProcess(threads, Path(gettempdir()) / f"pano-mvs-worker-{os.getpid()}-{uuid.uuid4().hex}.txt")


def differences(ours: Mapping[str, str], theirs: Mapping[str, str]) -> list[str]:
    """Return the differences between two sets of versions, in words."""
    names = [name for name in ours if theirs.get(name) != ours[name]]
    return [f"{name} is {theirs.get(name)} there and {ours[name]} here" for name in names]
