"""What a module's text says: which definitions it has, what each refers to, and what changes its digest."""

from __future__ import annotations

import ast
import json
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from pano_mvs.engine.code import libraries, sources
from pano_mvs.engine.code.canonical import canonical_text
from pano_mvs.engine.code.libraries import library_versions
from pano_mvs.engine.code.reach import CodeGraph
from pano_mvs.engine.code.sources import Sources
from pano_mvs.engine.code.summary import ModuleSummary, summarize_module

STAGE = "from pano_mvs.api import stage, source\n"
FIELD = "class f:\n    x: int = Field(1, description='a', title='b', examples=[1], ge=0)\n"


def digest(text: str) -> str:
    return summarize_module(text, "pack.m").definitions["f"].digest


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


def uses(text: str, name: str = "f") -> set[str]:
    return set(summarize_module(text, "pack.m").definitions[name].uses)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("def f(): return a.b.c", {"a.b.c"}),
        ("def f(): return a().b.c", {"a"}),
        ("def f(): return a[b].c", {"a", "b"}),
        ("@d\ndef f(): ...", {"d"}),
        ("async def f(a=b): return c", {"b", "c"}),
        ("def f(*, a=b, c): return c", {"b"}),
        ("def f(a, /, b, *c, d, **e): return a, b, c, d, e, g", {"g"}),
        ("def f():\n    for a in b:\n        c = a\n    return c", {"b"}),
        ("def f():\n    with a as b:\n        return b", {"a"}),
        ("def f():\n    import a\n    return a.b", {"/a.b"}),
        ("def f():\n    import a.b\n    return a.b.c()", {"/a.b.c"}),
        ("def f():\n    from a import b as c\n    return c.d", {"/a:b.d"}),
        ("def f():\n    from a import *\n    return b", {"/a", "b"}),
        ("def f():\n    from .a import b\n    return b", {"/pack.a:b"}),
        ("def f():\n    from ..a import b\n    return b", {"/a:b"}),
        ("def f():\n    def g(): return a\n    return g", {"a"}),
        ("def f():\n    class g(a): b = c\n    return g", {"a", "c"}),
        ("def f():\n    x = 1\n    def g():\n        nonlocal x\n        x = a\n    return x", {"a"}),
        ("def f():\n    del a\n    return b", {"b"}),
        ("def f():\n    match a:\n        case {'b': c, **d}: return c, d, e", {"a", "e"}),
        ("def f():\n    match a:\n        case B(x=c) as d: return c, d", {"a", "B"}),
        ("def f(): return {a: b for a, b in c if d}", {"c", "d"}),
        ("def f(): return {a for a in b for c in a if e(c)}", {"b", "e"}),
        ("def f(): return sum(a for a, (b, *c) in d if b and c)", {"sum", "d"}),
        ("def f(): return [a for b in c for a in b], a", {"c", "a"}),
        ("def f(): return [(x := a) for a in b], x", {"b"}),
        ("def f():\n    return __import__('a.b')", {"__import__", "/a.b"}),
        ("def f():\n    return importlib.import_module('a')", {"importlib.import_module", "/a"}),
        ("def f():\n    return import_module(name)", {"import_module", "name"}),
        ("def f():\n    return import_module()", {"import_module"}),
        ("def f():\n    return find_spec(3)", {"find_spec"}),
        ("def f():\n    return other('a.b')", {"other"}),
        ("f = lambda a=b: a + c", {"b", "c", "f"}),
        ("f = lambda: d", {"d", "f"}),
        ("class f(a, metaclass=b):\n    x: c = d\n    def g(self): return e, x", {"a", "b", "c", "d", "e", "x"}),
        ("@d(1)\nclass f: ...", {"d"}),
        ("class f:\n    x: 'a.b' = 1", {"a.b"}),
        ("class f:\n    x: Annotated[int, 'of the grid'] = 1", {"Annotated", "int"}),
        ("f: a = b", {"b", "f"}),
        ("def f():\n    x: a = b\n    return x", {"b"}),
        ("def f():\n    class g: ...\n    x: a = b\n    return x", {"b"}),
    ],
)
def test_names_that_a_definition_uses(text: str, expected: set[str]) -> None:
    assert uses(text) == expected


def test_what_only_annotations_name_is_kept_apart() -> None:
    found = summarize_module("def f(a: A, *b: 'B.C', c: D = d, **e: E) -> R:\n    x: X = A\n", "pack.m").definitions[
        "f"
    ]
    assert set(found.annotations) == {"B.C", "D", "E", "R", "X"}
    assert set(found.uses) == {"A", "d"}


def test_a_definition_knows_what_it_imports_when_it_runs() -> None:
    text = "def f():\n    import a.b, c\n    from d import e, g\n    from . import h\n    from i import *\n"
    assert summarize_module(text, "pack.m").definitions["f"].loads == ("a.b", "c", "d.e", "d.g", "i", "pack.h")


@pytest.mark.parametrize(
    ("module", "is_package", "text", "path"),
    [
        ("a.b.c", False, "from . import x", "a.b:x"),
        ("a.b.c", False, "from .d import x", "a.b.d:x"),
        ("a.b.c", False, "from .. import x", "a:x"),
        ("a.b.c", False, "from ..d import x", "a.d:x"),
        ("a.b", True, "from . import x", "a.b:x"),
        ("a.b", True, "from .. import x", "a:x"),
        ("a", False, "import x", "x"),
        ("a", False, "import x.y", "x"),
        ("a", False, "import y.z as x", "y.z"),
        ("a", False, "from y.z import w as x", "y.z:w"),
    ],
)
def test_imports_bind_names_to_paths_from_the_root(module: str, is_package: bool, text: str, path: str) -> None:
    assert summarize_module(text, module, is_package=is_package).bindings["x"] == path


def test_a_module_s_imports_load_modules_but_for_those_of_type_checkers() -> None:
    found = summarize_module(
        "import a.b\nfrom c import d\nfrom e import *\nimport typing\nif typing.TYPE_CHECKING:\n    import g\n"
        "if TYPE_CHECKING:\n    from h import i\ntry:\n    import j\nexcept ImportError:\n    import k\n",
        "m",
    )
    assert found.loads == ["a.b", "c.d", "e", "typing", "j", "k"]
    assert found.stars == ["e"]
    assert found.bindings == {
        "a": "a",
        "d": "c:d",
        "typing": "typing",
        "g": "g",
        "i": "h:i",
        "j": "j",
        "k": "k",
    }


@pytest.mark.parametrize(
    ("text", "names", "effects", "effect_names"),
    [
        ("def f(): ...\nasync def g(): ...\nclass h: ...", {"f", "g", "h"}, False, []),
        ("a = b = 1\nc: int = 2\nd: int\ne += 1", set("abcde"), False, []),
        ("a, (b, *c) = [d] = x", set("abcd"), False, []),
        ("a.b = 1", set(), True, []),
        ("a[0] = 1", set(), True, ["a"][:0]),
        ("a, b[0] = 1, 2", set(), True, ["a"]),
        ("f()", set(), True, []),
        ("'text'\n1\npass\n...", set(), False, []),
        ("for i in x:\n    j = i", set(), True, ["i", "j"]),
        ("try:\n    def f(): ...\nexcept E:\n    class f: ...", set(), True, ["f", "f"]),
        ("if x:\n    async def f(): ...", set(), True, ["f"]),
        ("@register\ndef f(): ...", {"f"}, True, []),
        ("@a.register(1)\nclass f: ...", {"f"}, True, []),
        ("@njit\n@a.b.cache\n@lru_cache(1)\ndef f(): ...", {"f"}, False, []),
        ("@dataclass(frozen=True)\nclass f: ...", {"f"}, False, []),
        ("@njit\n@register\ndef f(): ...", {"f"}, True, []),
        (STAGE + "@stage('a')\ndef f(): ...", {"f"}, False, []),
        ("@stage('a')\ndef f(): ...", {"f"}, True, []),
    ],
)
def test_definitions_and_what_a_module_does_on_import(
    text: str, names: set[str], effects: bool, effect_names: list[str]
) -> None:
    found = summarize_module(text, "m")
    assert set(found.definitions) == names
    assert (found.effects is not None) == effects
    assert sorted(found.effect_names) == effect_names


@pytest.mark.parametrize(
    "decorator",
    [
        "kernel",
        "inlined",
        "njit",
        "jit",
        "vectorize",
        "guvectorize",
        "intrinsic",
        "dataclass",
        "cache",
        "lru_cache",
        "contextmanager",
        "total_ordering",
        "wraps",
        "runtime_checkable",
        "final",
        "unique",
    ],
)
def test_decorators_that_register_nothing_cost_no_other_stage_its_cache(decorator: str) -> None:
    for spelling in (decorator, f"{decorator}(1)", f"lib.sub.{decorator}"):
        assert summarize_module(f"@{spelling}\ndef f(): ...", "m").effects is None
    assert summarize_module(f"@{decorator}.register\ndef f(): ...", "m").effects is not None


def test_all_definitions_of_a_name_count() -> None:
    found = summarize_module("f = a\nf += b\ndef f():\n    import c\n    x: D = e\n", "m").definitions["f"]
    assert found.uses == ("a", "b", "e", "f")
    assert found.annotations == ("D",)
    assert found.loads == ("c",)


def test_a_summary_comes_back_from_json() -> None:
    text = (
        STAGE
        + "from a import *\nimport b\nx = b.c\n@stage('s')\ndef f(y: K) -> R:\n    import d\n    return x\nprint(x)\n"
    )
    for found in (summarize_module(text, "m"), summarize_module("x = 1", "m")):
        assert ModuleSummary.from_json(json.loads(json.dumps(found.to_json()))) == found


@pytest.mark.parametrize(("text", "error"), [("def f(:", SyntaxError), ("a\0", (SyntaxError, ValueError))])
def test_text_that_is_no_python_is_refused(text: str, error: type[Exception]) -> None:
    with pytest.raises(error, match=r"syntax|null"):
        summarize_module(text, "m")


def graph_of(folder: Path, files: dict[str, str], **options: list[str]) -> CodeGraph:
    for name, text in files.items():
        (folder / "pack" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "pack" / name).write_text(text)
    return CodeGraph(Sources({"pack": folder / "pack"}), **options)


def reached(folder: Path, files: dict[str, str], *paths: str) -> tuple[set[str], set[str]]:
    found = graph_of(folder, {"__init__.py": "", **files}).reach_of([f"pack.{path}" for path in paths or ("m:f",)])
    return {name.removeprefix("pack.") for name in found.definitions}, set(found.libraries)


@pytest.mark.parametrize(
    ("files", "expected", "used"),
    [
        ({"m.py": "import os\ndef f(): return os.path, len"}, {"m:f"}, set()),
        ({"m.py": "import lib.sub as s\ndef f(): return s.x"}, {"m:f"}, {"lib"}),
        ({"m.py": "import lib\ndef f(): return 1"}, {"m:f"}, set()),
        ({"m.py": "def f(): return g()\ndef g(): return f()"}, {"m:f", "m:g"}, set()),
        ({"m.py": "from pack.n import *\ndef f(): return g()", "n.py": "def g(): ...\nh = 1"}, {"m:f", "n:g"}, set()),
        ({"m.py": "from lib import *\ndef f(): return g()"}, {"m:f"}, {"lib"}),
        ({"m.py": "from lib import *\ndef f(): return len()"}, {"m:f"}, {"lib"}),
        (
            {"m.py": "from pack.n import *\ndef f(): return g()", "n.py": "from pack.o import *", "o.py": "g = 1"},
            {"m:f", "o:g"},
            set(),
        ),
        ({"m.py": "from pack import n\ndef f(): return n.g", "n.py": "g = 1\nh = 2"}, {"m:f", "n:g"}, set()),
        ({"m.py": "from pack import n\ndef f(): return n", "n.py": "g = 1\nh = 2"}, {"m:f", "n:g", "n:h"}, set()),
        ({"m.py": "import pack.n\ndef f(): return pack.n.g", "n.py": "g = 1\nh = 2"}, {"m:f", "n:g"}, set()),
        (
            {"m.py": "from pack.s import g\nf = g", "s/__init__.py": "from pack.s.t import g", "s/t.py": "g = 1"},
            {"m:f", "s.t:g"},
            set(),
        ),
        ({"m.py": "from pack.n import h\ndef f(): return h", "n.py": "for h in x: pass"}, {"m:f", "n:<import>"}, set()),
        ({"m.py": "from pack.n import h\nf = h", "n.py": "print(1)\ng = 2"}, {"m:f", "n:<import>", "n:g"}, set()),
        ({"m.py": "from pack.n import h\ndef f(): ...", "n.py": "print(1)\ng = 2"}, {"m:f", "n:<import>"}, set()),
        ({"m.py": "def f():\n    import pack.n", "n.py": "print(1)\ng = 2"}, {"m:f", "n:<import>"}, set()),
        ({"m.py": "from pack.gone import h\ndef f(): return h"}, {"m:f"}, {"pack"}),
        ({"m.py": "from pack.m import f as g\ndef f(): return g"}, {"m:f"}, set()),
        ({"m.py": "g: K = 1\ndef f(x: K): return g\nclass K: ..."}, {"m:f", "m:g"}, set()),
    ],
)
def test_what_a_function_reaches(tmp_path: Path, files: dict[str, str], expected: set[str], used: set[str]) -> None:
    assert reached(tmp_path, files) == (expected, used)


def test_annotations_of_what_is_asked_for_count_if_wanted(tmp_path: Path) -> None:
    files = {
        "__init__.py": "",
        "m.py": "def f(x: K, y: 'L') -> R: return g\ndef g(z: M): ...\n"
        "class K: ...\nclass L: ...\nclass R: ...\nclass M: ...\n",
    }
    graph = graph_of(tmp_path, files)
    assert set(graph.reach_of(["pack.m:f"], with_annotations=True).definitions) == {
        "pack.m:f",
        "pack.m:g",
        "pack.m:K",
        "pack.m:L",
        "pack.m:R",
    }
    assert set(graph.reach_of(["pack.m:f"]).definitions) == {"pack.m:f", "pack.m:g"}
    assert len(graph.reach_of(["pack.m:"]).definitions) == 6


def test_left_out_packages_count_nothing_but_what_is_kept_of_them(tmp_path: Path) -> None:
    files = {
        "__init__.py": "",
        "m.py": "from pack.a.b import x\nfrom pack.a.c import y\nimport pack.a.d\ndef f(): x, y",
        "a/__init__.py": "print(0)",
        "a/b.py": "print(1)\nx = 1",
        "a/c.py": "print(2)\ny = 1",
        "a/d.py": "print(3)",
    }
    graph = graph_of(tmp_path, files, left_out=["pack.a"], kept=["pack.a.c"])
    assert set(graph.reach_of(["pack.m:f"]).definitions) == {"pack.m:f", "pack.a.c:y", "pack.a.c:<import>"}


def test_equal_code_under_other_names_has_another_digest(tmp_path: Path) -> None:
    files = {"__init__.py": "", "m.py": "def f(): return 1\ndef g(): return 1\n", "n.py": "def f(): return 1\n"}
    graph = graph_of(tmp_path, files)
    assert len({graph.reach_of([f"pack.{path}"]).digest for path in ("m:f", "m:g", "n:f")}) == 3


def test_summaries_are_kept_on_the_disk_for_the_same_text_and_the_same_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "alone.py"
    file.write_text("def f(): return 1\n")
    made: list[str] = []

    def summarized(text: str, module: str, *, is_package: bool = False) -> ModuleSummary:
        made.append(module)
        return summarize_module(text, module, is_package=is_package)

    monkeypatch.setattr(sources, "summarize_module", summarized)

    def read(kept_in: Path | None = tmp_path / "kept") -> ModuleSummary | None:
        some = Sources({"alone": file}, kept_in)
        found = some.summary("alone")
        assert some.summary("alone") is found
        some.save()
        return found

    first = read()
    assert read() == first
    assert made == ["alone"]
    file.write_text("def f(): return 2\n")
    assert read() != first
    assert made == ["alone"] * 2
    read(None)
    assert made == ["alone"] * 3
    monkeypatch.setattr(sources, "_PYTHON", "4.0")
    read()
    assert made == ["alone"] * 4
    assert len(list((tmp_path / "kept").iterdir())) == 2


def test_summaries_are_written_only_where_there_are_new_ones(tmp_path: Path) -> None:
    (tmp_path / "alone.py").write_text("x = 1")
    some = Sources({"alone": tmp_path / "alone.py"}, tmp_path / "kept")
    some.summary("alone")
    some.save()
    (kept,) = (tmp_path / "kept").iterdir()
    kept.unlink()
    some.save()
    assert not kept.exists()


def test_modules_that_cannot_be_read_are_none(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("def f(:")
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack" / "__init__.py").write_text("")
    (tmp_path / "pack" / "m.py").write_text("")
    some = Sources({"pack": tmp_path / "pack", "broken": tmp_path / "broken.py"})
    assert some.summary("pack") is not None
    assert some.summary("pack.m") is not None
    for module in ("broken", "broken.m", "pack.gone", "pack.m.n", "other", "other.m"):
        assert some.summary(module) is None, module
    assert "pack.gone" in some
    assert "broken" in some
    assert "other.m" not in some


def test_versions_of_libraries_are_those_of_what_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    known = {
        "numpy": "1",
        "opencv-python": "2",
        "opencv-contrib-python": "3",
        "pillow": "4",
        "x-1": "5",
        "x-2": "5",
    }

    def version(name: str) -> str:
        if name in known:
            return known[name]
        raise PackageNotFoundError(name)

    monkeypatch.setattr(libraries, "version", version)
    monkeypatch.setattr(libraries, "packages_distributions", lambda: {"x": ["x-1", "x-2"], "numpy": ["other"]})
    libraries._version.cache_clear()
    try:
        found = library_versions(iter(["x", "numpy", "cv2", "PIL", "pydantic", "OpenEXR", "gone", "numpy"]))
    finally:
        libraries._version.cache_clear()
    assert found == {"OpenCV": "2 and 3", "PIL": "4", "gone": "not installed", "numpy": "1", "x": "5"}


def test_pieces_of_text_in_an_f_string_are_one_however_python_splits_them() -> None:
    """As versions of Python do, each in its own way."""

    def text_of(*pieces: str | ast.expr) -> str:
        values = [ast.Constant(one) if isinstance(one, str) else one for one in pieces]
        return canonical_text(ast.JoinedStr(values=values))

    name = ast.FormattedValue(ast.Name("x", ast.Load()), -1)
    assert text_of("a", "b", name, "c", "", "d") == text_of("ab", name, "cd")
    assert text_of("", name, "") == text_of(name)
    assert text_of("a", name, "b") != text_of("ab", name)
    assert text_of("a", name) != text_of(name, "a")
    assert text_of(name, name) != text_of(name)
    assert text_of("a") != text_of("b")
