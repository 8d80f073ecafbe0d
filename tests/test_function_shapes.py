"""Functions take at most three parameters by position, and have at most twelve.

Compiled code may take more by position, because numba compiles calls with positional arguments to less code. The engine
passes the inputs of a stage by port, and typer the options of a command by name, so these two are exempt as well.
"""

from __future__ import annotations

import ast
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "pano_mvs"
MAX_POSITIONAL = 3
MAX_PARAMETERS = 12
# `pano_mvs.run` has the options of the command `run`; the commands themselves take them as a record.
MANY_PARAMETERS = {"session/captures.py:run"}


def wrong_functions(module: str, source: str) -> tuple[list[str], set[str]]:
    """Return the functions with too many parameters by position, and those with too many of any kind."""
    by_position, many = [], set()
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        place, decorators = f"{module}:{node.name}", [ast.unparse(one) for one in node.decorator_list]
        given = [one.arg for one in (*node.args.posonlyargs, *node.args.args) if one.arg not in ("self", "cls")]
        others = len(node.args.kwonlyargs) + bool(node.args.vararg) + bool(node.args.kwarg)
        called_by_name = any("command" in one or one.startswith("stage(") for one in decorators)
        if len(given) > MAX_POSITIONAL and not called_by_name and "/numba/" not in module and "kernels_" not in module:
            by_position.append(place)
        if len(given) + others > MAX_PARAMETERS:
            many.add(place)
    return by_position, many


def test_functions_have_few_parameters() -> None:
    found = [
        wrong_functions(path.relative_to(PACKAGE).as_posix(), path.read_text(encoding="utf-8"))
        for path in sorted(PACKAGE.rglob("*.py"))
    ]
    assert [place for by_position, _ in found for place in by_position] == []
    assert {place for _, many in found for place in many} == MANY_PARAMETERS


def test_parameters_are_counted() -> None:
    source = "def f(self, a, b, /, c, *d, e=1, **g): pass\nasync def g(a, b, c, d): pass\n"
    assert wrong_functions("m.py", source) == (["m.py:g"], set())
    assert wrong_functions("m/kernels_x.py", source) == ([], set())
    assert wrong_functions("m.py", f"@app.command('x')\ndef f(a, b, c, d, *, {', '.join('efghijklm')}): pass") == (
        [],
        {"m.py:f"},
    )
