"""The code and the libraries of a stage, as they count towards keys."""

from __future__ import annotations

import importlib
import inspect
import os
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
import pytest

import pano_mvs
from pano_mvs.core.errors import PanoMvsError, UsageError
from pano_mvs.engine.executors.unit_requests import require_same_code
from pano_mvs.engine.stages import stage_code as stage_code_module
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage_code import code_digest, code_texts, library_versions, stage_code
from pano_mvs.testing.stage_calls import StageCase
from tests.testing.test_builtin_stages import INPUTS, SETTINGS, SIZES_HW, few_views

__all__ = ["few_views"]

PACKAGE = Path(pano_mvs.__file__).parent


@cache
def built_in() -> list[str]:
    stages = Registry.installed().stages
    return [name for name in sorted(stages) if stages[name].function.__module__.startswith("pano_mvs.stages.")]


@cache
def files_of(stage: str) -> set[str]:
    """Return the files that count for a stage, without the name of the package."""
    module = sys.modules[Registry.installed().stages[stage].function.__module__]
    code = stage_code_module._local_code(Path(str(module.__file__)))
    return {name.removeprefix("pano_mvs/") for name in code.files}


@pytest.mark.parametrize(
    ("file", "stages", "others"),
    [
        ("algorithms/poses/adjustment/kernels_patch_alignment.py", {"poses.refine"}, {"fusion.vote"}),
        ("algorithms/features/kernels_sphorb.py", {"features.sphorb"}, {"poses.verify", "depth.sweep"}),
        ("algorithms/sweep/numba/kernels_sgm_rows.py", {"depth.sweep", "poses.verify"}, {"fusion.vote", "export.ply"}),
        ("algorithms/two_view/kernels_five_point.py", {"matches.brute_force"}, {"depth.sweep", "masks.moving"}),
        ("geometry/kernels_sphere.py", {"depth.sweep", "fusion.vote", "poses.verify"}, set()),
        ("engine/stages/context.py", {"depth.sweep"}, set()),
    ],
)
def test_an_edit_changes_the_keys_of_the_stages_that_import_it(file: str, stages: set[str], others: set[str]) -> None:
    found = {name for name in built_in() if file in files_of(name)}
    assert found >= stages
    assert not found & others


@pytest.mark.parametrize("name", sorted(path.name for path in PACKAGE.rglob("kernels_*.py")))
def test_every_kernel_is_in_a_key(name: str) -> None:
    assert any(file.endswith(f"/{name}") for stage in built_in() for file in files_of(stage))


def test_what_shows_results_or_drives_stages_is_in_no_key() -> None:
    counted = set().union(*map(files_of, built_in()))
    assert not {file for file in counted if file.startswith(("cli/", "report/", "viewer/", "testing/"))}
    assert {file for file in counted if file.startswith("engine/")} == {"engine/stages/context.py"}
    assert len(counted) > 150


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


@pytest.mark.slow
@pytest.mark.parametrize("stage", built_in())
def test_the_modules_that_a_stage_calls_count(stage: str, tmp_path: Path) -> None:
    spec = Registry.installed().stages[stage]
    case = StageCase(spec, SETTINGS.get(stage, {}), INPUTS.get(stage, {}), SIZES_HW.get(stage, (32, 64)))
    params, arguments = case.params(case.capture), case.arguments(case.capture)
    offered: dict[str, Any] = {"params": params, "ctx": Context(np.random.default_rng(0), tmp_path)}
    if spec.list_items is not None:
        offered["item"] = next(iter(spec.list_items(params)))
    extras = {name: offered[role] for name, role in spec.extras.items()}
    # The first kernels of a process look for their cache; some are imported only when a stage runs.
    importlib.import_module("pano_mvs.algorithms.ranges.kernels_agreement")
    with recorded_calls() as called, suppress(PanoMvsError):
        spec.function(**arguments, **extras)
    paths = {Path(code.co_filename) for code in called if code.co_name != "<module>"}
    found = {path.relative_to(PACKAGE).as_posix() for path in paths if path.is_relative_to(PACKAGE)}
    not_counted = ("engine/", "testing/", "core/kernel_cache.py")
    assert {file for file in found if not file.startswith(not_counted)} - files_of(stage) == set()


@pytest.mark.parametrize(
    ("stage", "libraries", "others"),
    [
        ("poses.unit_translations", {"numpy"}, {"pycolmap"}),
        ("filters.speckle", {"numpy", "numba"}, {"pycolmap"}),
        ("poses.colmap", {"numpy", "scipy", "pycolmap"}, {"onnxruntime"}),
        ("depth.sweep", {"numpy", "scipy", "OpenCV", "numba", "llvmlite"}, {"pycolmap"}),
    ],
)
def test_the_libraries_that_a_stage_imports_are_in_its_key(stage: str, libraries: set[str], others: set[str]) -> None:
    spec = Registry.installed().stages[stage]
    found = stage_code(spec, spec.params_type()).libraries
    assert found.keys() >= libraries
    assert not found.keys() & {*others, "pydantic", "pano_mvs", "json"}
    assert found["numpy"] == importlib.import_module("numpy").__version__


def test_a_plugin_counts_with_what_it_imports_from_the_api(tmp_path: Path) -> None:
    digests = {}
    for name, start in (("two", "from pano_mvs.api import Pose"), ("more", "from pano_mvs.api import verify_pair")):
        path = tmp_path / name / "plug.py"
        path.parent.mkdir()
        path.write_text(f"{start}\nimport scipy\n")
        digests[name] = stage_code_module._code_of(path, "")
    assert {"numpy", "scipy"} <= digests["two"][1] < digests["more"][1]


def test_a_copy_elsewhere_has_the_same_code(tmp_path: Path) -> None:
    shutil.copytree(PACKAGE / "core", tmp_path / "pano_mvs" / "core")
    (tmp_path / "pano_mvs" / "__init__.py").touch()
    copy, original = (code_texts(place / "core" / "files.py")[1] for place in (tmp_path / "pano_mvs", PACKAGE))
    assert copy == {name: text for name, text in original.items() if name != "pano_mvs/__init__.py"} | {
        name: "" for name in copy if name == "pano_mvs/__init__.py"
    }


def test_a_worker_with_other_code_or_libraries_refuses() -> None:
    spec = Registry.installed().stages["filters.median"]
    params = spec.params_type()
    found = stage_code(spec, params)
    same = {"code": found.digest, "libraries": dict(found.libraries)}
    require_same_code(spec, params, same)
    with pytest.raises(UsageError, match=r"'filters\.median' is not the same in the worker"):
        require_same_code(spec, params, same | {"code": "0" * 32})
    with pytest.raises(UsageError, match=r"the worker has OpenCV .*, the run was started with 1\.2\.3"):
        require_same_code(spec, params, same | {"libraries": {"OpenCV": "1.2.3"}})


def test_a_library_that_is_not_there_and_one_under_another_name() -> None:
    assert library_versions(["cv2", "pydantic", "no_such_module"])["no_such_module"] == "not installed"
    assert set(library_versions(["cv2", "pydantic", "pillow_heif"])) == {"OpenCV"}
    assert library_versions(["ruamel"])["ruamel"][0].isdigit()


def test_what_was_parsed_is_kept_for_later_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_code_module, "user_cache_folder", lambda: tmp_path / "kept")

    def later_process() -> None:
        stage_code_module._known_parsed.cache_clear()
        stage_code_module._parsed.cache_clear()
        monkeypatch.setattr(stage_code_module, "_kept_counts", [])

    later_process()
    plugin = tmp_path / "plug.py"
    plugin.write_text("import json\nx = 1\n")
    before = code_digest(plugin)
    stage_code_module._keep_parsed()
    place = next((tmp_path / "kept").rglob("*.json"))
    whole = place.read_text()
    for text in (whole, "{", "[]", "1", whole.replace('[[0, "json", []]]', "7")):
        place.write_text(text)
        later_process()
        assert len(stage_code_module._known_parsed()) == (1 if text == whole else 0)
        assert code_digest(plugin) == before
    later_process()


def test_what_another_version_parsed_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_code_module, "user_cache_folder", lambda: tmp_path)
    monkeypatch.setattr(stage_code_module, "_kept_counts", [])
    known = stage_code_module._known_parsed
    known.cache_clear()
    known()["text"] = "digest", (), {}
    stage_code_module._keep_parsed()
    place, written = stage_code_module._kept_place(), stage_code_module._kept_place().stat().st_mtime_ns
    known.cache_clear()
    assert list(known()) == ["text"]
    stage_code_module._keep_parsed()
    assert place.stat().st_mtime_ns == written  # nothing is new
    os.utime(place, (0, 0))
    monkeypatch.setattr(stage_code_module, "_parser", lambda: "later")
    known.cache_clear()
    assert known() == {}
    known()["text"] = "digest", (), {}
    stage_code_module._keep_parsed()
    assert [path.name for path in place.parent.iterdir()] == ["later.json"]  # the other one was not used for long
    known.cache_clear()


def test_a_checkout_beside_a_plugin_is_not_what_the_plugin_imports(tmp_path: Path) -> None:
    plugin = tmp_path / "plug.py"
    plugin.write_text("from pano_mvs.scene import poses\n")
    before = stage_code_module._code_of.__wrapped__(plugin, "")
    (tmp_path / "pano_mvs" / "scene").mkdir(parents=True)
    for file in ("__init__.py", "scene/__init__.py", "scene/poses.py"):
        (tmp_path / "pano_mvs" / file).write_text("later = 1\n")
    assert list(code_texts(plugin)[1]) == ["plug.py"]
    assert stage_code_module._code_of.__wrapped__(plugin, "") == before


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
        ("if TYPE_CHECKING:\n    import a", {}, set(), {"a.py"}),
        ("if TYPE_CHECKING:\n    import a\nelse:\n    import b", {}, {"b.py"}, {"a.py"}),
        ("if typing.TYPE_CHECKING:\n    import a\nelif x:\n    import b", {}, {"b.py"}, {"a.py"}),
        ("if not TYPE_CHECKING:\n    import b", {}, {"b.py"}, {"a.py"}),
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
