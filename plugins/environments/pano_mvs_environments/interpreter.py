"""Call the interpreter of an environment: with a question to `inside`, or as a worker that computes units."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pano_mvs.core.errors import PluginError
from pano_mvs.core.kernel_cache import VARIABLE as KERNEL_VARIABLE
from pano_mvs.core.paths import reason_of
from pano_mvs.core.plugin_folders import PLUGINS_VARIABLE

# Neither variables such as PYTHONPATH nor the current folder add anything to the path of the environment.
OPTIONS = ("-I",)
_COMPILERS = ("numba", "llvmlite", "numpy")  # on which compiled kernels depend
_MOST_LINES = 12
_NOISE = (
    *("[notice]", "WARNING: You are using pip", "WARNING: Location"),
    *("note: This ", "hint: See above", "╰─> See above", "[end of output]"),
)


def variables(folder: Path, libraries: Mapping[str, str]) -> dict[str, str]:
    """Return what is different in the variables of processes of an environment.

    Args:
        libraries: module to version, of the libraries in the environment itself.
    """
    found = {PLUGINS_VARIABLE: ""}  # files in the user's folder are for the interpreter of pano_mvs
    if any(name in libraries for name in _COMPILERS):  # else both would replace each other's kernels
        found[KERNEL_VARIABLE] = str(folder / "kernels")
    return found


def ask(python: str, question: Mapping[str, Any], *, folder: Path, libraries: Mapping[str, str]) -> dict[str, Any]:
    """Return the answer of `inside`, which takes about two seconds.

    Raises:
        PluginError: if there is none; the message is the reason.
    """
    with tempfile.TemporaryDirectory(prefix="pano-mvs-") as name:
        request, answer = Path(name, "request.json"), Path(name, "answer.json")
        request.write_text(json.dumps(question), encoding="utf-8")
        command = [python, *OPTIONS, "-m", f"{__package__}.inside", str(request), str(answer)]
        said = run_command(command, variables(folder, libraries))
        try:
            answered: dict[str, Any] = json.loads(answer.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise PluginError(f"{python} gave no answer: {last_lines(said) or error}") from error
    return answered


def run_command(command: Sequence[str], more: Mapping[str, str] | None = None) -> str:
    """Run a command without input, and return what it printed.

    Raises:
        PluginError: if it cannot be started, or fails; the message holds the last lines that it printed.
    """
    try:
        done = subprocess.run(  # noqa: S603  # our own commands
            list(command),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, **(more or {})},
            check=False,
        )
    except OSError as error:
        raise PluginError(f"{command[0]} cannot be started: {reason_of(error)}") from error
    said = done.stdout.decode(errors="replace")
    if done.returncode:
        raise PluginError(last_lines(said) or f"{command[0]} ended with code {done.returncode}")
    return said


def last_lines(text: str) -> str:
    """Return the last lines that a command printed, without empty ones and what pip says about itself."""
    lines = [line.rstrip() for line in text.replace("\r", "\n").splitlines()]
    return "\n".join([line for line in lines if line and not line.strip().startswith(_NOISE)][-_MOST_LINES:])
