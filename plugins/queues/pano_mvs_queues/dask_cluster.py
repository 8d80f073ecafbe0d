"""Compute units on a dask cluster: a new one on this host, or an existing one that shares the cache.

dask passes requests and answers, in JSON, and selects the workers; values are passed only through the cache. A bounded
number of units is submitted at a time. Retries are made by the dispatcher, not by dask.
"""

from __future__ import annotations

import importlib
import json
import os
import queue
import socket
import threading
import uuid
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from pano_mvs.core.errors import UsageError
from pano_mvs.core.extras import import_extra
from pano_mvs.core.files import make_folder, temporary_prefix
from pano_mvs.core.paths import children, is_file
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.processes import WorkerProcess
from pano_mvs.engine.executors.protocol import Executor, Job, JobOutcome
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.executors.unit_requests import request_to_json
from pano_mvs.engine.stages.stage_code import code_texts

_CONNECT_S = 20.0
# Without an address, the scheduler's web server asks for one port on all interfaces, which a second run finds taken.
NO_DASHBOARD = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}


class DaskExecutor(Executor):
    """Submits units to a dask scheduler."""

    name = "dask"
    enforces_timeouts = True

    def __init__(self, store: Store, *, workers: int = 1, threads: int = 0, scheduler: str = "") -> None:
        """Connect to the cluster, and check every worker.

        Args:
            store: the cache; for an existing cluster, in a folder with the same path on all hosts.
            threads: threads of each worker; 0 for an equal share of the cores of its host.

        Raises:
            UsageError: if dask is not installed, the scheduler does not answer, or a worker does not see the cache.
        """
        distributed = import_extra("distributed", "--executor dask", "dask")
        if scheduler:
            parts = urlsplit(scheduler if "://" in scheduler else f"tcp://{scheduler}")
            try:
                is_complete = bool(parts.hostname and parts.port) or parts.scheme in {"inproc", "ucx"}
            except ValueError:
                is_complete = False
            if not is_complete:
                raise UsageError(f"--scheduler {scheduler}: must be an address such as tcp://host:8786")
            self._connect(store, scheduler)
        else:
            # Threads suffice for dask workers, because each starts one of our worker processes. They cannot be lost,
            # but after minutes of sleep dask takes them for lost, and nothing would start them again.
            with importlib.import_module("dask").config.set({"distributed.scheduler.worker-ttl": None}):
                cluster = distributed.LocalCluster(
                    n_workers=1, threads_per_worker=workers, processes=False, scheduler_kwargs=NO_DASHBOARD
                )
            self._connect(store, cluster)
        try:
            places, share, cores = self._check_workers()
        except UsageError:
            self.close()
            raise
        self.capacity = with_waiting(places) if scheduler else places
        self.threads = threads or share
        self.cores = max(self.threads, cores)

    def _connect(self, store: Store, cluster: Any) -> None:
        """Connect to a cluster, or to a scheduler by its address."""
        self._store = store
        self._run = uuid.uuid4().hex
        self._ended: queue.SimpleQueue[tuple[int, int, Any]] = queue.SimpleQueue()
        self._out: dict[int, tuple[int, Any]] = {}  # job to its attempt and its future
        self._attempts = 0
        self._sources: dict[str, Any] = {}
        self._cluster = None if isinstance(cluster, str) else cluster
        try:
            self._client = importlib.import_module("distributed").Client(
                cluster, timeout=_CONNECT_S, set_as_default=False
            )
        except (OSError, ValueError, TimeoutError) as error:
            raise UsageError(f"--scheduler {cluster}: it does not answer ({error})") from error
        self._token = store.blobs.temporary / f"{temporary_prefix()}hello-{uuid.uuid4().hex}"
        self._expected = str(store.root.absolute()), self._token.name  # what each worker has to see
        try:
            make_folder(self._token.parent)
            self._token.write_text(self._token.name, encoding="ascii")
        except OSError as error:
            self.close()
            raise self._store.cannot_write(error) from error

    def submit(self, job: Job) -> None:
        """Submit a job."""
        request = request_to_json(job, self._store)
        request["cores"] = self.cores
        request["plugin_texts"] = {str(path.absolute()): self._texts(path) for path in job.plugins}
        text = json.dumps(request)  # large inputs are in a file of their own
        self._attempts += 1
        number, attempt = job.number, self._attempts
        key = f"pano-mvs-{job.unit.key}-{self._run}-{attempt}"
        with suppress(OSError):
            os.utime(self._token)  # an old one might be removed
        future = self._client.submit(
            run_unit, self._run, text, self._expected, key=key, pure=False, retries=0, resources=self._resources(job)
        )
        self._out[number] = attempt, future
        future.add_done_callback(lambda done: self._ended.put((number, attempt, done)))

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        """Return the number and the outcome of a job that has ended; see `Executor`."""
        while self._out:
            try:
                number, attempt, future = self._ended.get(timeout=0.5 if timeout_s is None else timeout_s or 0.0)
            except queue.Empty:
                if timeout_s is None:
                    continue
                return None
            if number in self._out and self._out[number][0] == attempt:
                del self._out[number]
                return number, _outcome(future)
        return None

    def free_memory_bytes(self) -> int:
        """Return the free memory of this host, or, for a remote cluster, the smallest limit times the workers."""
        if self._cluster is not None:
            return super().free_memory_bytes()
        limits = [worker["memory_limit"] for worker in self._client.scheduler_info(n_workers=-1)["workers"].values()]
        return int(min(limits, default=0)) * len(limits)

    def places(self) -> int:
        """Return the number of threads of the workers, each of which computes a unit."""
        return sum(self._client.nthreads().values())

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
        for path in children(self._token.parent, f"{self._token.name}*"):
            path.unlink(missing_ok=True)

    def _resources(self, _job: Job) -> dict[str, float] | None:
        """Return what a job takes of the resources that workers declare."""
        return None

    def _texts(self, path: Path) -> Any:
        key = str(path)
        if key not in self._sources:
            self._sources[key] = code_texts(path)
        return self._sources[key]

    def _check_workers(self) -> tuple[int, int, int]:
        """Return the number of units at a time, the threads for each, and the threads for a unit that runs alone."""
        found = self._client.run(introduce, *self._expected, on_error="return")
        for worker, answer in found.items():
            if isinstance(answer, BaseException):
                raise UsageError(f"dask worker {worker} cannot run pano_mvs: {answer}. Install it there") from answer
            if not is_file(self._token.with_name(answer["answer"])):
                answer["token"] = ""
            if problem := objection(answer, self._expected):
                raise UsageError(problem)
        if not found:
            raise UsageError("--scheduler: it has no workers; start some with `dask worker`")
        places = self._client.nthreads()
        on_host: Counter[str] = Counter()
        for worker, answer in found.items():
            on_host[answer["host"]] += places[worker]
        cores = {answer["host"]: answer["cores"] for answer in found.values()}
        share = max(1, min(cores[host] // count for host, count in on_host.items()))
        return sum(places.values()), share, min(cores.values())


def _outcome(future: Any) -> JobOutcome:
    if future.status == "finished":
        return JobOutcome.from_json(json.loads(future.result()))
    if future.status == "error":
        return JobOutcome("failed", cause=f"its dask worker failed: {future.exception()}", died=True)
    return JobOutcome("failed", cause=f"the dask cluster lost it ({future.status})", died=True)


def with_waiting(places: int) -> int:
    """Return the number of units to submit for a number of places, so that none stays empty between two units."""
    return places + (places + 1) // 2


_workers: dict[tuple[str, int], WorkerProcess] = {}
_accepted: set[str] = set()  # runs whose cache this dask worker sees


def run_unit(run: str, text: str, expected: tuple[str, str]) -> str:
    """Compute a unit in the worker process of this thread, if this dask worker fits; it may have joined a minute ago.

    Args:
        run: id of the run, to end its processes later.
        text: the request as JSON.
        expected: as for `objection`.
    """
    if run not in _accepted:
        if problem := objection(introduce(*expected), expected):
            return json.dumps(JobOutcome("stopped", cause=problem, error="UsageError", exit_code=2).to_json())
        _accepted.add(run)
    request = json.loads(text)
    worker = _workers.setdefault((run, threading.get_ident()), _new_worker(request["cores"]))
    return json.dumps(worker.run(request).to_json())


def end_workers(run: str) -> None:
    """End the worker processes of a run at once."""
    for key in [key for key in _workers if key[0] == run]:
        worker = _workers.pop(key)
        worker.kill()
        worker.stop()  # so that its pipes are closed


def introduce(store: str, token: str) -> dict[str, Any]:
    """Return what is checked about a worker before it gets units.

    Args:
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
        "token": content,
        "answer": answer.name,
        "reason": reason,
    }


def objection(answer: Mapping[str, Any], expected: tuple[str, str]) -> str:
    """Return why a worker must not compute units; empty if it may.

    Args:
        answer: of `introduce`, on the worker.
        expected: the folder of the cache, and the content of the token there.
    """
    root, token = expected
    if answer["token"] != token:
        reason = answer["reason"] or "it is another folder there"
        return (
            f"dask worker on {answer['host']} does not see the cache {root} ({reason}). Choose a cache with "
            "--cache DIR that all hosts share under the same path"
        )
    return ""


def _new_worker(threads: int) -> WorkerProcess:
    """Return a worker process whose messages lie in the folder of the dask worker, which dask removes after a crash."""
    from distributed import get_worker

    return WorkerProcess(threads, Path(get_worker().local_directory) / f"pano-mvs-{uuid.uuid4().hex}.txt")
