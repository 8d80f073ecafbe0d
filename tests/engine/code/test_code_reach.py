"""What a function reaches: everything that can change its result, and as little else as can be."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from pano_mvs.engine.code.reach import CodeGraph, Reach

FILES = {
    "pack/__init__.py": "",
    "pack/start.py": """
from dataclasses import dataclass
from typing import TYPE_CHECKING
import numpy as np
from pack import tools
from pack.tools import scale as by_scale
from pack.chosen import TABLE
if TYPE_CHECKING:
    from pack.kinds import Kind

LIMIT = 3
UNUSED = 4


@dataclass
class Settings:
    \"\"\"How.\"\"\"
    width: int = 2
    kind: "Kind | None" = None

    def area(self):
        return helped(self.width)


def helped(x):
    return x * LIMIT


def start(x: Kind) -> int:
    \"\"\"Begin.\"\"\"
    from pack import kernels  # late
    settings = Settings(x)
    return kernels.add(settings.area(), tools.one()) + by_scale(x) + TABLE["plus"](x) + np.int64(1)


def local_names(scale, UNUSED):
    by_scale = [scale for scale in UNUSED]
    return by_scale


def unused():
    return tools.two()
""",
    "pack/tools.py": """
import math

def one():
    return 1

def two():
    return math.pi

def scale(x):
    return x * 2
""",
    "pack/chosen.py": """
from pack import more
TABLE = {}

def plus(x):
    return x + 1

TABLE["plus"] = plus
""",
    "pack/more.py": """
from pack.registry import register

@register
def registered():
    return 7

def not_registered():
    return 8
""",
    "pack/registry.py": """
KNOWN = []

def register(function):
    KNOWN.append(function)
    return function
""",
    "pack/kernels.py": """
from numba import njit

@njit(fastmath=False)
def add(a, b):
    return a + twice(b)

@njit
def twice(b):
    return 2 * b

@njit
def other(b):
    return 3 * b
""",
    "pack/kinds.py": """
class Kind:
    size = 1

class OtherKind:
    size = 2
""",
}


def reach(tmp_path: Path, start: str = "start:start", edits: Mapping[str, tuple[str, str]] | None = None) -> Reach:
    folder = tmp_path / f"copy{len(list(tmp_path.iterdir()))}"
    for name, text in FILES.items():
        old, new = (edits or {}).get(name, ("", ""))
        assert old in text, f"{name} does not hold {old!r}"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text.replace(old, new) if old else text)
    return CodeGraph({"pack": folder / "pack"}).reach_of([f"pack.{start}"])


def test_what_is_used_is_reached_and_nothing_else(tmp_path: Path) -> None:
    found = reach(tmp_path)
    assert set(found.definitions) == {
        "pack.start:start",
        "pack.start:Settings",
        "pack.start:helped",
        "pack.start:LIMIT",
        "pack.tools:one",
        "pack.tools:scale",
        "pack.chosen:TABLE",
        "pack.chosen:plus",
        "pack.chosen:<import>",
        "pack.more:<import>",
        "pack.registry:register",
        "pack.registry:KNOWN",
        "pack.kernels:add",
        "pack.kernels:twice",
        "pack.kinds:Kind",
    }
    assert found.libraries == {"numpy", "numba"}


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("pack/start.py", "LIMIT = 3", "LIMIT = 4"),
        ("pack/start.py", "width: int = 2", "width: float = 2"),
        ("pack/start.py", "return helped(self.width)", "return -helped(self.width)"),
        ("pack/start.py", "import scale as by_scale", "import one as by_scale"),
        ("pack/start.py", "import numpy as np", "import torch as np"),
        ("pack/kernels.py", "return 2 * b", "return 2.0 * b"),
        ("pack/kernels.py", "fastmath=False", "fastmath=True"),
        ("pack/chosen.py", "x + 1", "x + 2"),
        ("pack/chosen.py", 'TABLE["plus"] = plus', 'TABLE["plus"] = abs'),
        ("pack/more.py", "return 7", "return 70"),
        ("pack/registry.py", "KNOWN.append(function)", "KNOWN.insert(0, function)"),
        ("pack/kinds.py", "size = 1", "size = 3"),
    ],
)
def test_what_may_change_the_result_changes_the_digest(tmp_path: Path, name: str, old: str, new: str) -> None:
    assert reach(tmp_path, edits={name: (old, new)}).digest != reach(tmp_path).digest


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("pack/start.py", '"""Begin."""', '"""Go."""'),
        ("pack/start.py", '    """How."""\n', ""),
        ("pack/start.py", "def start(x: Kind) -> int:", "def start(x: 'Kind') -> float:  # so"),
        ("pack/start.py", "settings = Settings(x)", "settings: Settings = (\n        Settings(x)\n    )"),
        ("pack/start.py", "LIMIT = 3", "LIMIT: int = 3"),
        ("pack/start.py", "UNUSED = 4", "UNUSED = 5"),
        ("pack/start.py", "return tools.two()", "return 2"),
        ("pack/tools.py", "return math.pi", "return 3"),
        ("pack/more.py", "return 8", "return 80"),
        ("pack/kernels.py", "return 3 * b", "return 4 * b"),
        ("pack/kinds.py", "size = 2", "size = 4"),
    ],
)
def test_what_changes_nothing_does_not(tmp_path: Path, name: str, old: str, new: str) -> None:
    assert reach(tmp_path, edits={name: (old, new)}).digest == reach(tmp_path).digest


def test_a_module_that_is_handed_on_counts_whole(tmp_path: Path) -> None:
    found = reach(tmp_path, edits={"pack/start.py": ("tools.one()", "getattr(tools, x)()")})
    assert "pack.tools:two" in found.definitions


def test_an_import_in_another_spelling_finds_the_same(tmp_path: Path) -> None:
    same = {"pack.kernels:add", "pack.kernels:twice"}
    for spelling in ("from . import kernels", "import pack.kernels as kernels"):
        edit = ("from pack import kernels  # late", spelling)
        found = set(reach(tmp_path, edits={"pack/start.py": edit}).definitions)
        assert found >= same, spelling
        assert "pack.kernels:other" not in found


def test_a_module_whose_names_come_by_a_star_counts_whole(tmp_path: Path) -> None:
    edit = ("from pack.tools import scale as by_scale", "from pack.tools import *\nby_scale = scale")
    assert {"pack.tools:scale", "pack.tools:two"} <= reach(tmp_path, edits={"pack/start.py": edit}).definitions.keys()


def reach_of_text(text: str) -> Reach:
    """Return what `f` reaches in a module with some variables, beside another module."""
    names = "".join(f"{name} = 0\n" for name in "ghi")
    texts = {"pack": ("", True), "pack.m": (f"{names}{text}", False), "pack.k": ("h = 1\ng = 2\nprint()\n", False)}
    return CodeGraph({}, texts=texts).reach_of(["pack.m:f"])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("def f():\n    return [g(x) for x in h]", {"g", "h"}),
        ("def f(a=g):\n    def inner():\n        return lambda b=h: a + b\n    return inner", {"g", "h"}),
        ("def f():\n    try:\n        pass\n    except g as h:\n        raise h", {"g", "h"}),
        ("class f(g):\n    h = i\n    def j(self):\n        return h", {"g", "h", "i"}),
        ("class f:\n    x: 'g' = 1", {"g"}),
        ("class f:\n    x: Annotated[h, 'of the grid'] = 1", {"h"}),
        ("f = j = {'a': h}", {"h", "j"}),
        ("f = 1\nf += g", {"g"}),
        ("f: int = g", {"g"}),
        ("if g:\n    f = h\nelse:\n    f = i", {"g", "h", "i", "<import>"}),
        ("def f(a: h, *b: 'i') -> int:\n    x: g = 1", {"h", "i"}),
        ("def f():\n    match x:\n        case {'b': c, **d}:\n            return g(c)", {"g"}),
        ("def f():\n    return a().b[g].h", {"g"}),
        ("def f():\n    import pack.k as c\n    return c.h", {"/pack.k:h", "/pack.k:<import>"}),
        ("def f():\n    import pack.k\n    return pack.k.h", {"/pack.k:h", "/pack.k:<import>"}),
        ("def f():\n    import pack.k", {"/pack.k:<import>"}),
        ("def f():\n    from . import k\n    return k.h()", {"/pack.k:h", "/pack.k:<import>"}),
        ("def f():\n    return import_module('pack.k').h", {"/pack.k:h", "/pack.k:g", "/pack.k:<import>"}),
        (
            "class f:\n    def a(self):\n        from .k import h\n    def b(self):\n        return h",
            {"h", "/pack.k:h", "/pack.k:<import>"},
        ),
        (
            "def f():\n    def a():\n        from .k import g as c\n    from .k import h as c\n    return c",
            {"/pack.k:g", "/pack.k:h", "/pack.k:<import>"},
        ),
        ("def f(): ...\n@g.register\ndef j(): ...", {"g", "<import>"}),
        ("from functools import cache\n@cache\ndef f(): ...\n@staticmethod\ndef j(): ...", set()),
    ],
)
def test_names_that_code_uses(text: str, expected: set[str]) -> None:
    found = reach_of_text(text).definitions.keys()
    own = {name.removeprefix("pack.m:") for name in found if name.startswith("pack.m:")} - {"f"}
    others = {f"/{name}" for name in found if not name.startswith("pack.m:")}
    assert own | others == expected


@pytest.mark.parametrize("text", ["from torch import *\ndef f(): ...", "def f():\n    import_module('torch')"])
def test_libraries_that_a_star_or_a_call_imports(text: str) -> None:
    assert reach_of_text(text).libraries == {"torch"}


def test_a_file_in_another_encoding_counts(tmp_path: Path) -> None:
    text = "# -*- coding: latin-1 -*-\ndef f():\n    return 'Grün'\n"
    (tmp_path / "one.py").write_bytes(text.encode("latin-1"))
    assert CodeGraph({"one": tmp_path / "one.py"}).reach_of(["one:f"]).definitions.keys() == {"one:f"}


def test_left_out_packages_do_not_count(tmp_path: Path) -> None:
    reach(tmp_path)
    packages = {"pack": tmp_path / "copy0" / "pack"}
    found = CodeGraph(packages, left_out=["pack.kernels", "pack.more"]).reach_of(["pack.start:start"])
    assert not [name for name in found.definitions if name.startswith(("pack.kernels", "pack.more"))]
    assert "numba" not in found.libraries
