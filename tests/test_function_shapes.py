"""Functions are short, have few parameters, and take at most three of them by position; modules are not split finely.

A kernel may be as long as its formula. A module that serves only one module beside it belongs there, unless it is an
idea of its own, because a reader should open at most three files for one question.

Compiled code may take more by position, because numba compiles calls with positional arguments to less code. The engine
passes the inputs of a stage by port, and typer the options of a command by name, so these two are exempt as well.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "pano_mvs"
MAX_POSITIONAL = 3
MAX_PARAMETERS = 12
MAX_LINES = 60
SMALL_MODULE_LINES = 120
MAX_SHARE_OF_SMALL_MODULES = 1 / 8
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
    assert [one.place for one in functions if one.lines > MAX_LINES and not one.is_compiled] == []


def serving_only_one_beside_them(texts: Mapping[str, str]) -> list[str]:
    """Return the small modules that a single other module, of their folder, imports.

    A folder that imports its modules in its `__init__` to register them, as that of the stages, does not split them.

    Args:
        texts: dotted names of all modules of a package, to their sources.
    """
    users = defaultdict[str, set[str]](set)
    for user, text in texts.items():
        for module, names in re.findall(r"^ *from ([\w.]+) import ([^(\n]*)", text, re.MULTILINE):
            for found in (module, *(f"{module}.{name.split()[0]}" for name in names.split(",") if name.strip())):
                users[found].add(user)
    small = [module for module in texts if texts[module].count("\n") <= SMALL_MODULE_LINES]
    folders = {module: module.rpartition(".")[0] for module in texts}
    return [
        module
        for module in small
        if [folders[user] for user in users[module] - {f"{folders[module]}.__init__"}] == [folders[module]]
    ]


def test_few_modules_serve_only_a_module_beside_them() -> None:
    places = {path: path.relative_to(PACKAGE.parent).with_suffix("").parts for path in PACKAGE.rglob("*.py")}
    texts = {".".join(parts): path.read_text(encoding="utf-8") for path, parts in places.items()}
    small = serving_only_one_beside_them(texts)
    assert len(small) > 20, "they are not recognised"
    assert len(small) < MAX_SHARE_OF_SMALL_MODULES * len(texts), small


def test_a_module_that_serves_only_one_beside_it_is_recognised() -> None:
    texts = {
        "p.a": "from p.b import x\nfrom p.q.c import y\nfrom p import d, e\n",
        "p.b": "x = 1\n",
        "p.d": "z = 1\n",
        "p.e": "w = 1\n" * 200,
        "p.f": "from p.g import (\n    one,\n)\n",
        "p.g": "one = 1\n",
        "p.h": "from p.g import one\n",
        "p.q.c": "y = 1\n",
    }
    assert serving_only_one_beside_them(texts) == ["p.b", "p.d"]


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
    for module in ("algorithms/sweep/numba/arguments.py", "geometry/kernels_sphere.py"):
        assert [one.is_compiled for one in functions_of(module, source)] == [True]
