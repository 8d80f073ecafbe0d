"""Check processors, memory, the environment, and the folders that a run writes to."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from difflib import get_close_matches
from functools import partial
from pathlib import Path

from pano_mvs.cli.doctor.finding import Finding
from pano_mvs.core.kernel_cache import PACKAGE, kernel_cache_folder
from pano_mvs.core.kernel_cache import VARIABLE as KERNEL_VARIABLE
from pano_mvs.core.memory import free_memory_bytes, size_text
from pano_mvs.core.paths import below, exists, is_folder
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.stages.plugin_files import PLUGINS_VARIABLE
from pano_mvs.results.summary import CACHE_VARIABLE

KNOWN_VARIABLES = (CACHE_VARIABLE, PLUGINS_VARIABLE, "PANO_MVS_EXECUTOR", "PANO_MVS_MIN_FREE", "PANO_MVS_RENDERER")
_MIN_MEMORY_BYTES, _MIN_DISK_BYTES = 3_000_000_000, 5_000_000_000
_finding = partial(Finding, "machine")


def machine_findings(
    environment: Mapping[str, str] = os.environ,
    *,
    threads: int | None = None,
    processors: int | None = None,
    memory_bytes: int | None = None,
) -> Iterator[Finding]:
    """Yield the processors, the memory, and the environment variables that limit a run or that nothing reads.

    Args:
        environment: the environment variables.
        threads: processors that this process may use; by default the actual number, as below.
        processors: processors of the machine.
        memory_bytes: free memory, 0 if it is not known.
    """
    threads = available_threads() if threads is None else threads
    processors = (os.cpu_count() or threads) if processors is None else processors
    if threads < processors:
        detail = f"{threads} of {processors}: a container or a scheduler limits this process"
        yield _finding("processors", "note", detail)
    else:
        yield _finding("processors", "ok", str(threads))
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        value = environment.get(name, "")
        if value.isdigit() and 0 < int(value) < threads:
            yield _finding(name, "warning", f"limits threads to {value} of {threads}", f"unset {name}")
    free = free_memory_bytes() if memory_bytes is None else memory_bytes
    if free and free < _MIN_MEMORY_BYTES:
        remedy = "close other programs, or set a smaller images.max_width: a sweep of 2048 px takes up to 3 GB"
        yield _finding("memory", "warning", f"{size_text(free)} free", remedy)
    else:
        yield _finding("memory", "ok", f"{size_text(free)} free" if free else "not known")
    for name in sorted(environment):
        if name.startswith(("PANO_MVS", "PANOMVS")) and name not in KNOWN_VARIABLES:
            close = get_close_matches(name, KNOWN_VARIABLES, n=1, cutoff=0.6)
            remedy = f"did you mean {close[0]}?" if close else f"unset it; known are {', '.join(KNOWN_VARIABLES)}"
            yield _finding(name, "warning", "is set, but nothing reads it", remedy)


def kernel_cache_finding(package: Path = PACKAGE, environment: Mapping[str, str] = os.environ) -> Finding:
    """Return whether compiled kernels can be cached; otherwise every process compiles them again."""
    chosen = environment.get(KERNEL_VARIABLE)
    try:
        folder = Path(chosen) if chosen else kernel_cache_folder(package)
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".doctor-{os.getpid()}"
        probe.write_bytes(b"")
        probe.unlink()
    except (OSError, RuntimeError) as error:
        detail = f"cannot be cached ({error}): every process compiles them again"
        return _finding("compiled kernels", "warning", detail, f"set {KERNEL_VARIABLE} to a folder that is writable")
    count = len(below(folder, "*.nbc"))
    first = f"none yet in {folder}: the first run compiles them in a minute or two"
    return _finding("compiled kernels", "ok", f"{count} in {folder}" if count else first)


def folder_findings(
    what: str, folder: Path, option: str, *, free_bytes_of: Callable[[Path], int] | None = None
) -> Iterator[Finding]:
    """Yield whether a folder, which need not exist, can be written, and how much space its disk has.

    Args:
        what: the use of the folder: "cache" or "results".
        folder: the folder.
        option: the command line option that chooses another one.
        free_bytes_of: returns the free space of a folder's disk; by default the actual one.
    """
    finding = partial(Finding, "disk", what)
    path = folder.absolute()
    existing = next((place for place in (path, *path.parents) if os.path.lexists(place)), folder)
    if not is_folder(existing):
        yield finding("failed", f"{folder}: {existing} is not a folder", f"choose another with {option}")
        return
    try:
        with tempfile.TemporaryDirectory(dir=existing, prefix=".pano-mvs-doctor-") as name:
            old, new = Path(name, "old"), Path(name, "new")
            old.write_bytes(b"old")
            new.write_bytes(b"new")
            new.replace(old)
            if old.read_bytes() != b"new":
                detail = f"{existing}: a file cannot replace another in one step"
                yield finding("failed", detail, f"choose a folder on a local disk with {option}")
            if exists(Path(name, "OLD")):
                yield finding("note", f"{existing}: file names that differ only in case are the same file")
        free = free_bytes_of(existing) if free_bytes_of else shutil.disk_usage(existing).free
    except OSError as error:
        detail = f"{folder} cannot be written: {error.strerror or error}"
        yield finding("failed", detail, f"correct its permissions, or choose another folder with {option}")
        return
    text = f"{folder}: {size_text(free)} free"
    remedy = f"free space, or choose another folder with {option}; a panorama of 2048 px takes about 60 MB in the cache"
    yield finding("ok", text) if free >= _MIN_DISK_BYTES else finding("warning", text, remedy)
