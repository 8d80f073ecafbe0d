"""Run a script of this folder: `python -m tools GROUP NAME [options]`, for example `benchmarks depth.thin`.

`--help` behind the name describes a script and its options, which are the parameters of its function `main`. Without a
name, all scripts are listed; with a group such as `benchmarks` or `benchmarks poses`, those of the group.
"""

from __future__ import annotations

import ast
import functools
import inspect
import sys
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import Any

import typer

HERE = Path(__file__).parent


@functools.cache
def scripts() -> dict[str, str]:
    """Return the names of all scripts, such as "benchmarks depth.thin", each with the first line of its docstring."""
    found = {}
    for path in sorted(HERE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if path != Path(__file__) and "\ndef main(" in text:
            parts = path.relative_to(HERE).with_suffix("").parts
            name = ".".join(parts).removesuffix(".__init__").replace(".", " ", 1)
            found[name] = str(ast.get_docstring(ast.parse(text))).split("\n")[0]
    return found


def run(name: str, arguments: list[str]) -> None:
    """Run a script with the arguments of its command line."""
    script = import_module(f"{HERE.name}.{name.replace(' ', '.')}")
    called = f"python -m {HERE.name} {name}"
    if not inspect.signature(script.main).parameters:  # it reads the command line itself
        sys.argv = [called, *arguments]
        script.main()
        return
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

    @functools.wraps(script.main)
    def command(**options: Any) -> None:
        raise typer.Exit(script.main(**options) or 0)

    app.command(help=f"\b\n{script.__doc__}\n\b\n{inspect.getdoc(script.main)}")(command)
    app(arguments, prog_name=called)


def main(words: list[str]) -> None:
    """Run the script that the first words name, or list those of a group.

    Raises:
        SystemExit: if there is neither a script nor a group of the name.
    """
    known = scripts()
    for count in (2, 1):
        if (name := " ".join(words[:count])) in known:
            run(name, words[count:])
            return
    if group := " ".join(takewhile(lambda word: not word.startswith("-"), words)):
        known = {name: text for name, text in known.items() if name.startswith((f"{group} ", f"{group}."))}
        if not known:
            raise SystemExit(f"there is no script {group}; `python -m {HERE.name}` lists all")
    print(f"{__doc__}\n" + "\n".join(f"{name:36} {summary}" for name, summary in known.items()))


if __name__ == "__main__":
    sys.path.insert(0, str(HERE.parent))  # as `python PATH/tools` in another folder puts only tools/ there
    main(sys.argv[1:])
