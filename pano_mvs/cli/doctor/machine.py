"""Processors, memory and environment."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path

from pano_mvs.cli.doctor.finding import Finding
from pano_mvs.core.kernel_cache import PACKAGE, kernel_cache_folder
from pano_mvs.core.kernel_cache import VARIABLE as KERNEL_VARIABLE
from pano_mvs.core.memory import free_memory_bytes, size_text
from pano_mvs.core.paths import below
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.stages.plugin_files import PLUGINS_VARIABLE
from pano_mvs.results.summary import CACHE_VARIABLE

KNOWN_VARIABLES = (CACHE_VARIABLE, PLUGINS_VARIABLE, "PANO_MVS_EXECUTOR", "PANO_MVS_MIN_FREE", "PANO_MVS_RENDERER")
_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")
_LITTLE_MEMORY_BYTES = 3_000_000_000


def machine_findings(
    environment: Mapping[str, str] = os.environ,
    *,
    threads: int | None = None,
    processors: int | None = None,
    memory_bytes: int | None = None,
) -> Iterator[Finding]:
    """Yield how many processors and how much memory there are, and what the environment says.

    Args:
        environment: the variables.
        threads: processors that this process may use; found by default.
        processors: of the machine; found by default.
        memory_bytes: free, 0 if it cannot be told; found by default.
    """
    threads = available_threads() if threads is None else threads
    processors = (os.cpu_count() or threads) if processors is None else processors
    yield _processors(threads, processors)
    for name in _THREADS:
        value = environment.get(name, "")
        if value.isdigit() and 0 < int(value) < threads:
            yield Finding("machine", name, "warning", f"holds threads to {value} of {threads}", f"unset {name}")
    free = free_memory_bytes() if memory_bytes is None else memory_bytes
    if free and free < _LITTLE_MEMORY_BYTES:
        remedy = "close other programs, or set a smaller images.max_width: a sweep of 2048 px takes up to 3 GB"
        yield Finding("machine", "memory", "warning", f"{size_text(free)} free", remedy)
    else:
        yield Finding("machine", "memory", "ok", f"{size_text(free)} free" if free else "cannot be told")
    yield from _variables(environment)


def kernel_cache_finding(package: Path = PACKAGE, environment: Mapping[str, str] = os.environ) -> Finding:
    """Return whether compiled kernels can be kept; if not, every process compiles them anew."""
    chosen = environment.get(KERNEL_VARIABLE)
    try:
        folder = Path(chosen) if chosen else kernel_cache_folder(package)
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".doctor-{os.getpid()}"
        probe.write_bytes(b"")
        probe.unlink()
    except (OSError, RuntimeError) as error:
        return Finding("machine", "compiled kernels", "warning", f"cannot be kept ({error}): every process compiles "
                       "them anew", f"set {KERNEL_VARIABLE} to a folder that you may write to")  # fmt: skip
    count = len(below(folder, "*.nbc"))
    return Finding("machine", "compiled kernels", "ok", f"{count} kept in {folder}" if count else
                   f"none yet in {folder}: the first run compiles them, a minute or two")  # fmt: skip


def _processors(threads: int, processors: int) -> Finding:
    if threads < processors:
        return Finding("machine", "processors", "note", f"{threads} of {processors}: a container or a scheduler holds "
                       "this process to them")  # fmt: skip
    return Finding("machine", "processors", "ok", str(threads))


def _variables(environment: Mapping[str, str]) -> Iterator[Finding]:
    """Yield the variables that nobody reads: a slip in a name would else go unnoticed."""
    for name in sorted(environment):
        if name.startswith(("PANO_MVS", "PANOMVS")) and name not in KNOWN_VARIABLES:
            close = get_close_matches(name, KNOWN_VARIABLES, n=1, cutoff=0.6)
            remedy = f"did you mean {close[0]}?" if close else f"unset it; known are {', '.join(KNOWN_VARIABLES)}"
            yield Finding("machine", name, "warning", "is set, but nothing reads it", remedy)
