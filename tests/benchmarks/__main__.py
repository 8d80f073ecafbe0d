"""Run a benchmark or another script of the tests: `python -m tests.benchmarks NAME [options]`.

NAME is a module of `tests.benchmarks`, such as `depth.thin`, or of `tests`, such as `stress.kills`. The parameters of
its function `main` are the options; `--help` describes the script. Without a name, all scripts are listed.
"""

from __future__ import annotations

import ast
import functools
import inspect
import runpy
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import typer

HERE = Path(__file__).parent


def scripts() -> dict[str, str]:
    """Return the names of all scripts, each with the first line of its docstring."""
    folders = {HERE: "", HERE.with_name("stress"): "stress."}
    found = {
        prefix + ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__main__"): text
        for folder, prefix in folders.items()
        for path in folder.rglob("*.py")
        if path != Path(__file__) and "\ndef main(" in (text := path.read_text(encoding="utf-8"))
    }
    return {name: str(ast.get_docstring(ast.parse(text))).split("\n")[0] for name, text in sorted(found.items())}


def module_of(name: str) -> str:
    """Return the full name of a script's module."""
    folder = "tests.benchmarks" if (HERE / name.partition(".")[0]).with_suffix(".py").exists() else "tests"
    folder = "tests.benchmarks" if (HERE / name.partition(".")[0]).is_dir() else folder
    return f"{folder}.{name}"


def run(name: str, arguments: list[str]) -> None:
    """Run a script with the arguments of its command line."""
    module = module_of(name)
    if find_spec(module) is None:
        raise SystemExit(f"{name} is not a script of the tests; these are: {', '.join(scripts())}")
    source = Path(str(find_spec(module).origin)) if find_spec(module) else HERE  # type: ignore[union-attr]
    if "argparse" in source.read_text(encoding="utf-8") or source.name == "__init__.py":
        sys.argv = [name, *arguments]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
        return
    script = import_module(module)
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

    @functools.wraps(script.main)
    def command(**options: Any) -> None:
        raise typer.Exit(script.main(**options) or 0)

    app.command(help=f"\b\n{script.__doc__}\n\b\n{inspect.getdoc(script.main)}")(command)
    app(arguments, prog_name=f"python -m tests.benchmarks {name}")


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1].startswith("-"):
        print(f"{__doc__}\n" + "\n".join(f"{name:24} {summary}" for name, summary in scripts().items()))
    else:
        run(sys.argv[1], sys.argv[2:])
