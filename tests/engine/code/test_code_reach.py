"""What a function reaches: everything that can change its result, and as little else as can be."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from pano_mvs.engine.code.reach import CodeGraph, Reach
from pano_mvs.engine.code.sources import Sources
from pano_mvs.engine.code.summary import summarize_module

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
    graph = CodeGraph(Sources({"pack": folder / "pack"}))
    return graph.reach_of([f"pack.{start}"], with_annotations=True)


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


def test_a_name_that_a_function_defines_itself_is_not_that_of_its_module(tmp_path: Path) -> None:
    assert set(reach(tmp_path, "start:local_names").definitions) - {"pack.more:<import>", "pack.chosen:<import>"} == {
        "pack.start:local_names",
        "pack.registry:register",
        "pack.registry:KNOWN",
        "pack.chosen:plus",
        "pack.chosen:TABLE",
    }


def uses(text: str) -> set[str]:
    return set(summarize_module(text, "pack.m").definitions["f"].uses)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("def f():\n    return [g(x) for x in h]", {"g", "h"}),
        ("def f():\n    return [x for x in x]", {"x"}),
        ("def f():\n    [g for g in ()]\n    return g()", {"g"}),
        ("def f():\n    if (g := h()):\n        return g", {"h"}),
        ("def f():\n    return lambda a, b=c: a + b + d", {"c", "d"}),
        ("def f(a=g):\n    def inner():\n        return a + h\n    return inner", {"g", "h"}),
        ("def f():\n    global g\n    g = 1", {"g"}),
        ("def f():\n    try:\n        pass\n    except g as h:\n        raise h", {"g"}),
        ("def f(x):\n    match x:\n        case [a, *b]:\n            return a, b, c", {"c"}),
        ("def f():\n    import a.b as c\n    return c.d", {"/a.b.d"}),
        ("def f():\n    from . import a\n    return a.g()", {"/pack:a.g"}),
        ("def f():\n    return import_module('a.b')", {"import_module", "/a.b"}),
        ("class f(g):\n    h = i\n    def j(self):\n        return h", {"g", "h", "i"}),
        ("f = g = {'a': h}", {"f", "g", "h"}),
    ],
)
def test_names_from_outside(text: str, expected: set[str]) -> None:
    assert uses(text) == expected


def test_a_module_that_is_handed_on_counts_whole(tmp_path: Path) -> None:
    found = reach(tmp_path, edits={"pack/start.py": ("tools.one()", "getattr(tools, x)()")})
    assert "pack.tools:two" in found.definitions


def test_an_import_in_another_spelling_finds_the_same(tmp_path: Path) -> None:
    same = {"pack.kernels:add", "pack.kernels:twice"}
    for spelling in ("from . import kernels", "import pack.kernels as kernels", "from .kernels import *"):
        edit = ("from pack import kernels  # late", spelling)
        found = set(reach(tmp_path, edits={"pack/start.py": edit}).definitions)
        assert found >= same, spelling
        assert ("pack.kernels:other" in found) == ("*" in spelling)


def test_a_name_that_comes_by_a_star_is_found(tmp_path: Path) -> None:
    edit = ("from pack.tools import scale as by_scale", "from pack.tools import *\nby_scale = scale")
    found = reach(tmp_path, edits={"pack/start.py": edit})
    assert "pack.tools:scale" in found.definitions
    assert "pack.tools:two" not in found.definitions


def test_summaries_are_kept_and_made_anew_where_a_file_has_changed(tmp_path: Path) -> None:
    file = tmp_path / "alone.py"
    digests = []
    for text in ("def f():\n    return 1\n", "def f():\n    return 1  # one\n", "def f():\n    return 2\n"):
        file.write_text(text)
        graph = CodeGraph(Sources({"alone": file}, tmp_path / "kept"))
        digests.append(graph.reach_of(["alone:f"]).digest)
        graph.sources.save()
        again = CodeGraph(Sources({"alone": file}, tmp_path / "kept"))
        assert again.reach_of(["alone:f"]).digest == digests[-1]
    assert digests[0] == digests[1] != digests[2]
    (kept,) = (tmp_path / "kept").iterdir()
    kept.write_text('{"alone": 3}')
    assert CodeGraph(Sources({"alone": file}, tmp_path / "kept")).reach_of(["alone:f"]).digest == digests[2]


def test_left_out_packages_do_not_count(tmp_path: Path) -> None:
    reach(tmp_path)
    sources = Sources({"pack": tmp_path / "copy0" / "pack"})
    found = CodeGraph(sources, left_out=["pack.kernels", "pack.more"]).reach_of(["pack.start:start"])
    assert not [name for name in found.definitions if name.startswith(("pack.kernels", "pack.more"))]
    assert "numba" not in found.libraries
