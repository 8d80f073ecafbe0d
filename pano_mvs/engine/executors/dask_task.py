"""The code that runs inside a dask worker: each of its threads keeps a worker process and passes units to it.

Units are computed in that process rather than in the dask worker, exactly as on a single host: threads are limited,
output is captured, a unit that takes too long can be ended, and a crash affects only its unit.
"""

from __future__ import annotations

import json
import os
import platform
import socket
import threading
import uuid
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import pano_mvs
from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.paths import below
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.executors.worker_process import WorkerProcess

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
