"""Functions are short, have few parameters, and take at most three of them by position.

Compiled code may take more by position, because numba compiles calls with positional arguments to less code. The engine
passes the inputs of a stage by port, and typer the options of a command by name, so these two are exempt as well.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "pano_mvs"
MAX_POSITIONAL = 3
MAX_PARAMETERS = 12
MAX_LINES = 60
CALLED_BY_NAME = {"command", "stage"}
# Each option of a command is a parameter of its function.
MANY_PARAMETERS = {"cli/app.py:run", "cli/app.py:view_results", "cli/evaluate/app.py:depth"}


@dataclass(frozen=True)
class Function:
    """What a function looks like.

    Attributes:
        place: its module and name, such as `cli/app.py:run`.
        decorators: the last part of each decorator's name: `command` for `@app.command(...)`.
        positional: number of parameters that may be given by position, without `self` and `cls`.
        parameters: number of all parameters.
        lines: number of lines of its body, without the docstring.
    """

    place: str
    decorators: frozenset[str]
    positional: int
    parameters: int
    lines: int

    @property
    def is_compiled(self) -> bool:
        return "/numba/" in self.place or "/kernels_" in self.place


def functions_of(module: str, source: str) -> Iterator[Function]:
    """Yield the functions of a module; their syntax trees take too much memory to keep."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            names = (one.func if isinstance(one, ast.Call) else one for one in node.decorator_list)
            given = [*node.args.posonlyargs, *node.args.args]
            positional = sum(one.arg not in {"self", "cls"} for one in given)
            others = len(node.args.kwonlyargs) + bool(node.args.vararg) + bool(node.args.kwarg)
            body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
            yield Function(
                f"{module}:{node.name}",
                frozenset(ast.unparse(name).rpartition(".")[-1] for name in names),
                positional,
                positional + others,
                (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0,
            )


@pytest.fixture(scope="module")
def functions() -> list[Function]:
    """All functions of the package."""
    found: list[Function] = []
    for module in sorted(PACKAGE.rglob("*.py")):
        found += functions_of(module.relative_to(PACKAGE).as_posix(), module.read_text(encoding="utf-8"))
    return found


def test_at_most_three_parameters_are_positional(functions: list[Function]) -> None:
    checked = [one for one in functions if not one.is_compiled and not one.decorators & CALLED_BY_NAME]
    assert [one.place for one in checked if one.positional > MAX_POSITIONAL] == []


def test_no_function_has_many_parameters(functions: list[Function]) -> None:
    assert {one.place for one in functions if one.parameters > MAX_PARAMETERS} == MANY_PARAMETERS


def test_no_function_is_long(functions: list[Function]) -> None:
    assert [one.place for one in functions if one.lines > MAX_LINES] == []


@pytest.mark.parametrize(
    ("source", "counts"),
    [
        ("def f(a, b, /, c, *d, e=1, **g): pass", (3, 6, 1)),
        ("async def f(self, a): pass", (1, 1, 1)),
        ('def f(\n    a,\n):\n    """Return\n\n    a.\n    """\n    return (\n        a\n    )', (1, 1, 3)),
        ('def f() -> int:\n    """Return."""', (0, 0, 0)),
    ],
)
def test_parameters_and_lines_are_counted(source: str, counts: tuple[int, int, int]) -> None:
    (found,) = functions_of("module.py", source)
    assert (found.positional, found.parameters, found.lines) == counts


def test_exempt_functions_are_recognised() -> None:
    source = "@guarded\n@app.command('x')\ndef f(a, b, c, d): pass"
    (command,) = functions_of("algorithms/sweep/sweep.py", source)
    assert command.decorators == {"guarded", "command"}
    assert not command.is_compiled
    for module in ("algorithms/sweep/numba/tiles.py", "geometry/kernels_sphere.py"):
        assert [one.is_compiled for one in functions_of(module, source)] == [True]
