"""Run tests as on other processors.

Each variant sets environment variables that make numba, numpy or OpenBLAS leave instructions of this processor unused,
or fixes the number of threads, and runs pytest in a process of its own. Without arguments for pytest the folders whose
results depend on arithmetic are run: tests/algorithms and tests/geometry.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from typing import Annotated, Any

import typer

NUMERIC = ("tests/algorithms", "tests/geometry")


def dispatched_features() -> list[str]:
    """Return the instruction sets of this processor that numpy chooses at run time."""
    numpy: Any = importlib.import_module("numpy._core._multiarray_umath")  # no public function returns them
    return [name for name in numpy.__cpu_dispatch__ if numpy.__cpu_features__.get(name, False)]


def threads(count: int) -> dict[str, str]:
    """Return the variables that fix the number of threads."""
    return {f"{library}_NUM_THREADS": str(count) for library in ("NUMBA", "OPENBLAS", "OMP")}


def variants() -> dict[str, dict[str, str]]:
    """Return the environment variables of each variant, by its name."""
    return {
        "numba-generic": {"NUMBA_CPU_NAME": "generic"},
        "numpy-baseline": {"NPY_DISABLE_CPU_FEATURES": " ".join(dispatched_features())},
        "openblas-nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
        "openblas-haswell": {"OPENBLAS_CORETYPE": "Haswell"},
        "one-thread": threads(1),
        "two-threads": threads(2),
        "oldest": {
            "NUMBA_CPU_NAME": "generic",
            "NPY_DISABLE_CPU_FEATURES": " ".join(dispatched_features()),
            "OPENBLAS_CORETYPE": "Nehalem",
        }
        | threads(1),
    }


def main(pytest_arguments: Annotated[list[str] | None, typer.Argument()] = None, only: list[str] | None = None) -> int:
    """Run the tests under each variant, or some only, print which of them fail, and return the exit code."""
    failed = []
    for name in only or variants():
        print(f"== {name}", flush=True)
        command = [sys.executable, "-m", "pytest", "-q", *(pytest_arguments or NUMERIC)]
        if subprocess.run(command, env=os.environ | variants()[name], check=False).returncode:
            failed.append(name)
    print(f"FAILED: {', '.join(failed)}" if failed else "passed under all variants")
    return 1 if failed else 0
