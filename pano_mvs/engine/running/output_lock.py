"""Allow one run at a time in an output folder, by a lock file that names its owner.

The lock is created by linking a complete file, which is atomic on network file systems too. A run that was killed
leaves its lock behind. The next run on the same host sees that the process has ended, or that its id now belongs to a
process with another start time, and takes over the lock. Processes on other hosts cannot be checked, so the user has to
decide.
"""

from __future__ import annotations

import json
import os
import socket
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pano_mvs.core.errors import StoreError
from pano_mvs.core.files import temporary_prefix
from pano_mvs.core.processes import boot_id, machine_id, process_place, start_of

if os.name == "posix":
    import fcntl

LOCK_NAME = ".pano-mvs-lock"
_PAUSE_S = 0.02


@contextmanager
def output_lock(out: Path) -> Iterator[None]:
    """Hold the lock of an existing output folder inside the context.

    Raises:
        StoreError: if another run holds it or may hold it, or the folder cannot be written.
    """
    owner = {
        "host": socket.gethostname(),
        "process": os.getpid(),
        "process_started": start_of(os.getpid()),
        "place": process_place(),
        "boot": boot_id().strip(),
        "machine": machine_id(),
        "since": datetime.now(UTC).isoformat(timespec="seconds"),
        "token": uuid.uuid4().hex,
    }
    path, own = out / LOCK_NAME, json.dumps(owner, indent=1).encode() + b"\n"
    try:
        _acquire(path, own)
    except OSError as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(
            f"{path} cannot be written: {error.strerror or error}. Choose another folder with --out DIR, "
            "or mend its permissions"
        ) from error
    try:
        yield
    finally:
        with suppress(OSError):
            if path.read_bytes() == own:
                path.unlink()


def is_run_gone(out: Path) -> bool:
    """Return whether a run in an output folder was killed: it left its lock, and its process is known to have ended."""
    owner = _owner(_read(out / LOCK_NAME))
    return owner is not None and _is_gone(owner)


def _acquire(path: Path, own: bytes) -> None:
    for _ in range(50):
        if _create(path, own):
            return
        text = _read(path)
        owner = _owner(text)
        if owner is not None and _is_gone(owner):
            _remove_stale(path, text)
        elif owner is not None:
            who = f"process {owner['process']} on {owner.get('host')}, since {owner.get('since')}"
            remedy = "Wait until it has ended, or choose another folder with --out DIR"
            if owner.get("place") != process_place() or os.name != "posix":
                remedy += f". If that process has ended, which cannot be checked from here, delete {path}"
            raise StoreError(f"another run is writing into {path.parent}: {who}. {remedy}")
        elif text is not None:
            time.sleep(_PAUSE_S)  # it may be incomplete on file systems without links
    raise StoreError(
        f"{path} does not name the run that writes into the output folder. If there is none, delete that file; "
        "else choose another folder with --out DIR"
    )


def _create(path: Path, text: bytes) -> bool:
    """Create the lock file atomically; return False if it exists."""
    temporary = path.with_name(f"{temporary_prefix()}lock-{uuid.uuid4().hex}")
    temporary.write_bytes(text)
    try:
        os.link(temporary, path)
        return True
    except OSError as error:
        if temporary.stat().st_nlink > 1:  # it was linked, but the reply of a file server was lost
            return True
        if isinstance(error, FileExistsError):
            return False
    finally:
        temporary.unlink(missing_ok=True)
    try:  # a file system without links
        with path.open("xb") as stream:
            stream.write(text)
    except FileExistsError:
        return False
    return True


def _read(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None


def _remove_stale(path: Path, stale: bytes | None) -> None:
    """Remove a lock whose owner has ended, unless another run has replaced it in the meantime."""
    try:
        handle = os.open(path, os.O_RDWR if os.access(path, os.W_OK) else os.O_RDONLY)
    except FileNotFoundError:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with suppress(FileNotFoundError):
            if os.read(handle, 1 << 16) == stale and os.path.samestat(os.fstat(handle), path.stat()):
                path.unlink()
    finally:
        os.close(handle)


def _owner(text: bytes | None) -> dict[str, Any] | None:
    try:
        owner = json.loads(text or b"")
    except (ValueError, RecursionError):
        return None
    if not isinstance(owner, dict) or type(owner.get("process")) is not int or owner["process"] <= 0:
        return None
    return owner


def _is_gone(owner: dict[str, Any]) -> bool:
    """Return whether the owner of a lock is known to have ended."""
    if owner.get("place") == process_place():
        start = start_of(owner["process"])
        return start is None or bool(start and owner.get("process_started") and start != owner["process_started"])
    # The machine has been restarted since then.
    same = (socket.gethostname(), machine_id()) == (owner.get("host"), owner.get("machine") or None)
    return same and bool(owner.get("boot")) and owner["boot"] != boot_id().strip()
