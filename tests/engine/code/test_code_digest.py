"""What counts as the code of a part that comes from an installed package.

Which changes of a definition change its digest. What a stage executes is in its key: every function of ours that is
called while it runs is one that it reaches.
"""

from __future__ import annotations

import inspect
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
import pytest

import pano_mvs
from pano_mvs.core.errors import PanoMvsError
from pano_mvs.engine.code.plugin_digest import code_digest
from pano_mvs.engine.code.reach import CodeGraph
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.testing.stage_calls import StageCase
from tests.engine.code.test_stage_code import as_it_is, functions
from tests.testing.test_builtin_stages import INPUTS, SETTINGS, SIZES_HW


def package(folder: Path, *, constant: int = 1, beside: int = 1) -> Path:
    """Write a package whose module imports another of its own, relative and absolute, and what is beside it."""
    files = {
        "mine/__init__.py": "from mine.inner.work import x\n",
        "mine/inner/__init__.py": "import beside\nfrom mine import numbers\n",
        "mine/inner/work.py": "x = 1\n",
        "mine/numbers.py": f"constant = {constant}\n",
        "beside/__init__.py": f"other = {beside}\n",
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder / "mine" / "__init__.py"


def test_all_of_a_package_that_is_used_counts_and_nothing_beside_it(tmp_path: Path) -> None:
    before = code_digest(package(tmp_path / "a"))
    assert code_digest(package(tmp_path / "a", beside=2)) == before
    assert code_digest(package(tmp_path / "a", constant=2)) != before


def test_the_folder_into_which_a_package_is_installed_does_not_count(tmp_path: Path) -> None:
    assert code_digest(package(tmp_path / "a")) == code_digest(package(tmp_path / "elsewhere" / "b"))


def test_a_module_inside_a_package_finds_what_it_imports_by_its_full_name(tmp_path: Path) -> None:
    inner = package(tmp_path / "a").parent / "inner" / "__init__.py"
    before = code_digest(inner)
    package(tmp_path / "a", constant=2)
    assert code_digest(inner) != before


STAGE = "from pano_mvs.api import stage, source\n"
FIELD = "class f:\n    x: int = Field(1, description='a', title='b', examples=[1], ge=0)\n"


def digest(text: str) -> str:
    return CodeGraph({}, texts={"m": (text, False)}).reach_of(["m:f"]).definitions["m:f"]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("def f():\n    '''Doc.'''\n    return 1", "def f():\n    return 1"),
        ("def f():\n    x = 1\n    'a note'\n    return x", "def f():\n    x = 1\n    return x"),
        ("def f():\n    if x:\n        pass\n        y()", "def f():\n    if x:\n        y()"),
        ("def f():\n    if x:\n        y()\n    else:\n        pass", "def f():\n    if x:\n        y()"),
        (
            "def f():\n    try:\n        y()\n    finally:\n        'a'\n        z()",
            "def f():\n    try:\n        y()\n    finally:\n        z()",
        ),
        ("def f(a: int, *b: int, c: int = 1, **d: int) -> int: ...", "def f(a, *b, c=1, **d): ..."),
        ("async def f(a: int) -> int: ...", "async def f(a): ..."),
        ("def f():\n    x: int\n    x = 1", "def f():\n    x = 1"),
        ("def f():\n    x: int = 1", "def f():\n    x = 1"),
        ("f: int = 1", "f = 1"),
        ("def f():\n    return (1 +\n        2)  # three", "def f(): return 1 + 2"),
        ("def f(): return 'a'", 'def f(): return "a"'),
        ("def f(): return u'a'", "def f(): return 'a'"),
        ("def f(): return f'a{x}b'", "def f(): return 'a' f'{x}b'"),
        ("def f(): return f'{x}' 'ab'", "def f(): return f'{x}' 'a' 'b'"),
        ("def f(): return f'{x}' ''", "def f(): return f'{x}'"),
        (FIELD, FIELD.replace("description='a', ", "")),
        (FIELD, FIELD.replace("title='b'", "title='c'")),
        (FIELD, FIELD.replace("examples=[1]", "examples=[2]")),
        (FIELD.replace("Field", "pydantic.Field"), FIELD.replace("Field", "pydantic.Field").replace("'a'", "'b'")),
        (STAGE + "@stage('a')\ndef f(): ...", STAGE + "@stage('b', memory='2GB')\ndef f(): ..."),
        (STAGE + "@source('a')\ndef f(): ...", STAGE + "def f(): ..."),
        ("import pano_mvs.engine.stages.stage as s\n@s.stage('a')\ndef f(): ...", "def f(): ..."),
        ("from pano_mvs import api\n@api.stage('a')\nasync def f(): ...", "async def f(): ..."),
    ],
)
def test_what_changes_no_result_changes_no_digest(first: str, second: str) -> None:
    assert digest(first) == digest(second)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("f = 1", "f = 1.0"),
        ("f = 1", "f = True"),
        ("f = 'a'", "f = b'a'"),
        ("f = 'None'", "f = None"),
        ("f = [1, 2]", "f = [12]"),
        ("f = [1, 2]", "f = [2, 1]"),
        ("f = [1, 2]", "f = (1, 2)"),
        ("f = [[1], 2]", "f = [[1, 2]]"),
        ("f = a + b", "f = a - b"),
        ("f = a[1:]", "f = a[:1]"),
        ("f = g(a=b)", "f = g(b=b)"),
        ("f = g(a)", "f = g(*a)"),
        ("f = 1", "f = 1\nf = 2"),
        ("f = 1\nf = 2", "f = 2\nf = 1"),
        ("f = 1", "f = 1\nf += 1"),
        ("f = f'{x}'", "f = f'{x!r}'"),
        ("f = f'{x:3}'", "f = f'{x:4}'"),
        ("f = f'{x}{y}'", "f = f'{y}{x}'"),
        ("f = f'a{x}'", "f = f'{x}a'"),
        ("f = f'{x}'", "f = f'{x} '"),
        ("def f(): a()", "async def f(): a()"),
        ("def f(a): ...", "def f(*, a): ..."),
        ("def f(a, b): ...", "def f(b, a): ..."),
        ("def f(a=1): ...", "def f(a=2): ..."),
        ("def f(): return 1", "def f(): 1"),
        ("def f():\n    if x:\n        y()", "def f():\n    y()"),
        ("def f():\n    if x:\n        y()\n        z()", "def f():\n    if x:\n        y()\n    z()"),
        ("def f():\n    x = 'a'", "def f():\n    'a'"),
        ("class f:\n    x: int = 1", "class f:\n    x: float = 1"),
        ("class f:\n    x: int", "class f: ..."),
        (FIELD, FIELD.replace("ge=0", "ge=1")),
        (FIELD, FIELD.replace("Field(1", "Field(2")),
        (FIELD.replace("Field", "Other"), FIELD.replace("Field", "Other").replace("'a'", "'b'")),
        ("@g\ndef f(): ...", "def f(): ..."),
        ("@stage('a')\ndef f(): ...", "@stage('b')\ndef f(): ..."),  # not ours
        ("from other import stage\n@stage('a')\ndef f(): ...", "def f(): ..."),
        (STAGE + "@stage('a')\n@g\ndef f(): ...", STAGE + "@stage('a')\ndef f(): ..."),
    ],
)
def test_what_may_change_a_result_changes_the_digest(first: str, second: str) -> None:
    assert digest(first) != digest(second)


PACKAGE = Path(pano_mvs.__file__).parent
NOT_COUNTED = ("pano_mvs.engine.", "pano_mvs.testing.", "pano_mvs.core.kernel_cache")


@contextmanager
def recorded_calls() -> Iterator[set[CodeType]]:
    """Record the code of every Python function that is called, in all threads."""
    called: set[CodeType] = set()

    def record(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_flags & inspect.CO_OPTIMIZED:  # class bodies run at the first import
            called.add(frame.f_code)

    threading.setprofile(record)
    sys.setprofile(record)
    try:
        yield called
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


def definition_of(code: CodeType) -> str:
    """Return `module:name` of the top-level definition of ours that some code belongs to; empty for others' code."""
    path = Path(code.co_filename)
    if not path.is_relative_to(PACKAGE) or code.co_name == "<module>":
        return ""
    module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
    return f"{module}:{code.co_qualname.partition('.')[0]}"


@pytest.mark.slow
@pytest.mark.parametrize("stage", sorted(functions()))
def test_a_stage_reaches_what_it_calls(stage: str, tmp_path: Path) -> None:
    spec = Registry.installed().stages[stage]
    case = StageCase(spec, SETTINGS.get(stage, {}), INPUTS.get(stage, {}), SIZES_HW.get(stage, (32, 64)))
    params, arguments = case.params(case.capture), case.arguments(case.capture)
    context = Context(np.random.default_rng(0), tmp_path)
    offered: dict[str, Any] = {"params": params, "ctx": context}
    if spec.list_items is not None:
        offered["item"] = next(iter(spec.list_items(params)))
    extras = {name: offered[role] for name, role in spec.extras.items()}
    # The first kernels of a process look for their cache; some are imported only when a stage runs.
    import_module("pano_mvs.algorithms.ranges.kernels_agreement")
    with recorded_calls() as called, suppress(PanoMvsError):
        spec.function(**arguments, **extras)
    found = {definition_of(code) for code in called} - {""}
    found = {name for name in found if not name.startswith(NOT_COUNTED) and "<" not in name}
    own = f"{spec.function.__module__}:{spec.function.__name__}"
    assert own in found
    assert found - as_it_is()[stage].definitions.keys() == set()
