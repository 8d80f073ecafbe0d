"""The contract of commands that plugins bring.

A command must
  * belong to a group that exists, and not hide a built-in command;
  * describe itself and its parameters, without loading large libraries, as the help of all commands needs this;
  * end with a message and an exit code if its arguments cannot be used, without a traceback.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import chdir
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from typer.main import get_command
from typer.testing import CliRunner

from pano_mvs.testing.contract import ContractTest, registered_names

_LARGE = (
    "cv2",
    "dask",
    "distributed",
    "matplotlib",
    "numba",
    "onnxruntime",
    "open3d",
    "pandas",
    "pycolmap",
    "pyvista",
    "scipy",
    "sklearn",
    "tensorflow",
    "torch",
    "trimesh",
)
# pano_mvs loads some of these before any plugin file; what the help loads beyond that is counted.
_HELP = """
import importlib.util, sys
import pano_mvs.stages
from pano_mvs.cli.app import app
from typer.testing import CliRunner
before = set(sys.modules)
if sys.argv[2]:
    spec = importlib.util.spec_from_file_location("checked_plugin", sys.argv[2])
    sys.modules["checked_plugin"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
texts = [CliRunner().invoke(app, [*sys.argv[1].split("."), "--help"]).output for _ in range(2)]
assert texts[0] == texts[1], "the help differs when it is shown again"
print(*sorted({name.partition(".")[0] for name in set(sys.modules) - before}))
"""


def command_contract_tests(command: Path | str) -> list[ContractTest]:
    """Return the contract tests of a command, given by name (`cache.push`), or of all commands of a plugin file.

    Raises:
        UsageError: if the file registers no command.
        PluginError: if the file cannot be loaded.
    """
    file = command if isinstance(command, Path) else None
    checks: dict[str, Callable[[str], None]] = {
        "has a place of its own": _has_a_place,
        "describes itself and its parameters": _describes_itself,
        "shows its help without loading large libraries": partial(_is_light, file=file),
        "ends with a message if its arguments cannot be used": _refuses,
    }
    return [
        ContractTest(f"{name} {what}", partial(check, name))
        for name in registered_names("command", command)
        for what, check in checks.items()
    ]


def _has_a_place(name: str) -> None:
    from pano_mvs.cli.app import app

    *groups, own = name.split(".")
    known: Any = get_command(app)
    for group in groups:
        known = getattr(known, "commands", {}).get(group)
        assert known is not None, f"there is no group {group!r} for the command {name}"
    assert hasattr(known, "commands"), f"{groups[-1]} is not a group of commands"
    assert own not in known.commands, f"pano-mvs {' '.join([*groups, own])} is built in: choose another name"
    found = _run(name, "--help")
    assert found.exit_code == 0, f"{name} --help ends with exit code {found.exit_code}: {found.output}"
    assert "cannot be used" not in found.output, found.output


def _describes_itself(name: str) -> None:
    for words, command in _leaves(_command(name), name):
        assert command.help, f"{words} has no docstring"
        bare = [one.name for one in command.params if not getattr(one, "help", "")]
        assert not bare, f"parameters of {words} without help: {', '.join(bare)}"


def _is_light(name: str, file: Path | None) -> None:
    arguments = [sys.executable, "-c", _HELP, name, "" if file is None else str(file.absolute())]
    environment = {**os.environ, "PANO_MVS_PLUGINS": ""}
    done = subprocess.run(arguments, capture_output=True, text=True, env=environment)  # noqa: S603
    assert done.returncode == 0, f"the help of {name} cannot be shown: {done.stderr}"
    heavy = set(_LARGE) & set(done.stdout.split())
    assert not heavy, f"the help of {name} loads {', '.join(sorted(heavy))}: import them where they are used"


def _refuses(name: str) -> None:
    for words, command in _leaves(_command(name), name):
        needed = [one for one in command.params if one.required]
        assert _run(words, "--no-such-option").exit_code == 2, f"{words} accepts an unknown option"
        for value in ("no_such_thing", "1"):  # which may be of the right type, but name nothing that exists
            options = [text for one in needed if one.param_type_name == "option" for text in (one.opts[0], value)]
            arguments = [*options, *(value for one in needed if one.param_type_name == "argument")]
            with TemporaryDirectory() as folder, chdir(folder):
                found = _run(words, *arguments)
            call = f"{words} {' '.join(arguments)}"
            assert found.exit_code != 1, (
                f"{call} ends with an internal error; raise the errors of pano_mvs.api:\n{found.output}"
            )
            assert "Traceback" not in found.output, f"{call} ends with a traceback:\n{found.output}"


def _command(name: str) -> Any:
    from pano_mvs.cli.app import app

    command: Any = get_command(app)
    context = command.make_context("pano-mvs", [], resilient_parsing=True)
    for word in name.split("."):
        command = command.get_command(context, word)
        assert command is not None, f"there is no command {name}"
        context = command.make_context(word, [], parent=context, resilient_parsing=True)
    return command


def _leaves(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield the command itself, or those below it, with the words that call it, joined by dots."""
    below = getattr(command, "commands", None)
    if below is None:
        yield name, command
    for word, inner in (below or {}).items():
        yield from _leaves(inner, f"{name}.{word}")


def _run(name: str, *arguments: str) -> Any:
    from pano_mvs.cli.app import app

    return CliRunner().invoke(app, [*name.split("."), *arguments])
