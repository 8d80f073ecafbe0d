"""The digest of a plugin file: what its code and that of the files beside it does, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.engine.stages.stage_code import code_digest, code_texts

PLUGIN = '''"""What it is for."""
import helper


class A:
    """A class."""

    def method(self):
        """A method."""
        return helper.one(1)


async def late():
    """Later."""
    return "a"
'''


def written(folder: Path, files: dict[str, str]) -> Path:
    """Write files and return the first."""
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder / next(iter(files))


def digest(folder: Path, plugin: str = PLUGIN, **others: str) -> str:
    files = {"plug.py": plugin, "helper.py": "def one(x):\n    return x\n"}
    return code_digest(written(folder, files | {f"{name}.py": text for name, text in others.items()}))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"""What it is for."""', '"""Something else."""'),
        ('"""What it is for."""', "# a comment"),
        ('"""A class."""', '"""One more."""'),
        ('"""A method."""', '"""Other."""'),
        ('        """A method."""\n', ""),
        ('"""Later."""', '"""Sooner."""'),
        ("helper.one(1)", "(helper\n            .one(1))"),
    ],
)
def test_comments_docstrings_and_layout_do_not_count(tmp_path: Path, old: str, new: str) -> None:
    assert old in PLUGIN
    assert digest(tmp_path, PLUGIN.replace(old, new)) == digest(tmp_path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("one(1)", "one(2)"),
        ('return "a"', 'return "b"'),
        ("class A", "class B"),
        ('    """Later."""\n', '    f("""Later.""")\n'),
        ('    """A class."""\n', "    x = 1\n"),
    ],
)
def test_what_the_code_does_counts(tmp_path: Path, old: str, new: str) -> None:
    assert old in PLUGIN
    assert digest(tmp_path, PLUGIN.replace(old, new)) != digest(tmp_path)


def test_a_function_of_a_docstring_alone_is_an_empty_one(tmp_path: Path) -> None:
    assert digest(tmp_path, 'def f():\n    """Nothing."""\n') == digest(tmp_path, "def f():\n    pass\n")


def test_a_number_or_a_second_text_is_no_docstring(tmp_path: Path) -> None:
    assert digest(tmp_path, "def f():\n    1\n    return 2\n") != digest(tmp_path, "def f():\n    return 2\n")
    assert digest(tmp_path, '"""A."""\n"""B."""\n') != digest(tmp_path, '"""A."""\n')
    assert digest(tmp_path, '"""A."""\n"""B."""\n') == digest(tmp_path, '"""C."""\n"""B."""\n')


@pytest.mark.parametrize(
    ("start", "texts", "counted", "not_counted"),
    [
        ("import a", {}, {"a.py"}, {"b.py", "p/__init__.py"}),
        ("import a as b", {}, {"a.py"}, {"b.py"}),
        ("import a, b", {}, {"a.py", "b.py"}, {"p/__init__.py"}),
        ("def f():\n    import a", {}, {"a.py"}, {"b.py"}),
        ("from a import x", {}, {"a.py"}, {"b.py"}),
        ("import p.q", {}, {"p/__init__.py", "p/q.py"}, {"p/r.py"}),
        ("from p import q", {}, {"p/__init__.py", "p/q.py"}, {"p/r.py"}),
        ("from p.s import t", {}, {"p/__init__.py", "p/s/__init__.py", "p/s/t.py"}, {"p/q.py", "p/t.py"}),
        ("from p.s.t import u", {}, {"p/__init__.py", "p/s/__init__.py", "p/s/t.py"}, {"p/q.py"}),
        ("from . import a", {}, {"a.py"}, {"b.py"}),
        ("from .a import x", {}, {"a.py"}, {"b.py"}),
        ("import p", {"p/__init__.py": "from . import q"}, {"p/__init__.py", "p/q.py"}, {"p/r.py", "a.py"}),
        ("import p.s.t", {"p/s/t.py": "from .. import q"}, {"p/s/t.py", "p/q.py"}, {"p/r.py"}),
        ("import p.s.t", {"p/s/t.py": "from ..q import x"}, {"p/s/t.py", "p/q.py"}, {"p/r.py"}),
        ("import a", {"a.py": "import b", "b.py": "import a"}, {"a.py", "b.py"}, {"p/q.py"}),
        ("import os, numpy, no_such_module", {}, set(), {"a.py"}),
    ],
)
def test_the_local_files_that_are_imported_count(
    tmp_path: Path, start: str, texts: dict[str, str], counted: set[str], not_counted: set[str]
) -> None:
    files = ("a.py", "b.py", "p/__init__.py", "p/q.py", "p/r.py", "p/t.py", "p/s/__init__.py", "p/s/t.py")
    plugin = written(tmp_path, {"plug.py": start} | dict.fromkeys(files, "x = 1\n") | texts)
    name, found = code_texts(plugin)
    assert name == "plug.py"
    assert set(found) >= {"plug.py", *counted}
    assert not set(found) & not_counted
    assert found == {one: (tmp_path / one).read_text() for one in found}
    before = code_digest(plugin)
    for one in files:
        (tmp_path / one).write_text((tmp_path / one).read_text() + "\ny = 2\n")
        assert (code_digest(plugin) != before) == (one in found), one
        before = code_digest(plugin)


def test_the_folder_of_a_plugin_does_not_count_but_its_name_does(tmp_path: Path) -> None:
    assert digest(tmp_path / "a") == digest(tmp_path / "b" / "c")
    first, second = (written(tmp_path / name, {f"{name}.py": "x = 1\n"}) for name in ("one", "two"))
    assert code_digest(first) != code_digest(second)


def test_files_of_a_package_have_names_from_above_it(tmp_path: Path) -> None:
    empty = ("outer/__init__.py", "outer/inner/__init__.py", "outer/other.py", "outer/inner/near.py", "other.py")
    files = {"outer/inner/mod.py": "from outer import other\nfrom . import near\n"} | dict.fromkeys(empty, "")
    name, texts = code_texts(written(tmp_path, files))
    assert name == "outer/inner/mod.py"
    assert set(texts) == {
        "outer/inner/mod.py",
        "outer/__init__.py",
        "outer/other.py",
        "outer/inner/__init__.py",
        "outer/inner/near.py",
    }


def test_files_that_are_no_code_are_errors(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No such file"):
        code_digest(tmp_path / "none.py")
    with pytest.raises(SyntaxError, match=r"plug\.py"):
        digest(tmp_path, "def f(:\n")
    with pytest.raises(SyntaxError, match="was never closed"):
        digest(tmp_path, helper="x = (\n")


@pytest.mark.parametrize("spelling", ["from . import limit", "from .. import limit", "from ..inner import limit"])
def test_a_name_that_a_package_itself_defines_counts(tmp_path: Path, spelling: str) -> None:
    """An import from the package's own folder once found the modules in it and not its `__init__.py`."""
    module = written(tmp_path, {"outer/inner/mod.py": spelling, "outer/__init__.py": "", "outer/inner/__init__.py": ""})
    place = tmp_path / "outer" / ("__init__.py" if spelling.startswith("from .. ") else "inner/__init__.py")
    place.write_text("limit = 1")
    before = code_digest(module)
    place.write_text("limit = 2")
    assert code_digest(module) != before


def test_a_byte_order_mark_does_not_count(tmp_path: Path) -> None:
    plugin = written(tmp_path, {"plug.py": "x = 1\n"})
    found = code_digest(plugin), code_texts(plugin)
    plugin.write_text("x = 1\n", encoding="utf-8-sig")
    assert (code_digest(plugin), code_texts(plugin)) == found
