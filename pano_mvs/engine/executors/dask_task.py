"""What runs inside a dask worker: each of its threads keeps a worker process of ours, and hands it units.

The process, rather than the dask worker itself, computes: so its threads are bounded, its output is captured, a unit
that takes too long can be ended, and one that crashes takes nothing else with it, exactly as on a single host.
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
    """Compute a unit in this thread's process.

    Args:
        run: names the run; its processes end with it.
        text: the request as JSON, or the path of a file in the store that holds it.
    """
    request = json.loads(text if text.startswith("{") else Path(text).read_bytes())
    worker = _workers.setdefault((run, threading.get_ident()), _new_worker(request["cores"]))
    return json.dumps(worker.run(request).to_json())


def end_workers(run: str) -> None:
    """End the processes of a run, whatever they are doing."""
    for key in [key for key in _workers if key[0] == run]:
        _workers.pop(key).kill()


def introduce(store: str, token: str) -> dict[str, Any]:
    """Return what the scheduler wants to know of a worker before it trusts it.

    Args:
        store: folder of the store.
        token: name of a file in its folder for temporary files; an answer is left beside it.
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
    """Return the versions of all that can change a result."""
    found = {"python": ".".join(platform.python_version_tuple()[:2]), "pano_mvs": _own_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _own_version() -> str:
    """Return the version with a digest of the code: two checkouts of the same version may differ."""
    package = Path(pano_mvs.__file__).parent
    sources = {path.relative_to(package).as_posix(): path.read_bytes() for path in below(package, "*.py")}
    return f"{pano_mvs.__version__}+{digest_from_value(sources)[:12]}"


def _new_worker(threads: int) -> WorkerProcess:
    return WorkerProcess(threads, Path(gettempdir()) / f"pano-mvs-worker-{os.getpid()}-{uuid.uuid4().hex}.txt")


def differences(ours: Mapping[str, str], theirs: Mapping[str, str]) -> list[str]:
    """Return what is not the same, in words."""
    names = [name for name in ours if theirs.get(name) != ours[name]]
    return [f"{name} is {theirs.get(name)} there and {ours[name]} here" for name in names]
