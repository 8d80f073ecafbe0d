"""The key of a built-in stage changes with the code that it reaches, and only with that."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import pytest

import pano_mvs
from pano_mvs.core.errors import UsageError
from pano_mvs.engine.code.reach import Reach
from pano_mvs.engine.executors.unit_json import require_same_code
from pano_mvs.engine.stages import stage_code as stage_code_module
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage_code import code_graph, library_versions, reach_of_function, stage_code
from tests.engine.code.package_copy import copied_package

PACKAGE = Path(pano_mvs.__file__).parent
SWEEPS = {"depth.sweep", "poses.scaled_translation", "poses.verify"}


@cache
def functions() -> Mapping[str, tuple[str, str]]:
    specs = Registry.installed().stages
    found = {name: (spec.function.__module__, spec.function.__qualname__) for name, spec in specs.items()}
    return {name: place for name, place in found.items() if place[0].startswith("pano_mvs.stages.")}


def reaches(edited: Mapping[str, str] | None = None) -> dict[str, Reach]:
    """Return what each built-in stage reaches in a package in which some modules have other texts."""
    graph = code_graph({"pano_mvs": PACKAGE}, {module: (text, False) for module, text in (edited or {}).items()})
    return {name: reach_of_function(*place, graph) for name, place in functions().items()}


@cache
def as_it_is() -> dict[str, Reach]:
    return reaches()


def changed_by(module: str, old: str, new: str) -> set[str]:
    """Return the stages whose keys change when a text in a module is replaced."""
    path = PACKAGE.parent.joinpath(*module.split(".")).with_suffix(".py")
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1, f"{module} holds {old!r} {text.count(old)} times"
    edited = reaches({module: text.replace(old, new)})
    return {name for name, reach in edited.items() if reach.digest != as_it_is()[name].digest}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "old", "new", "stages"),
    [
        (
            "algorithms.poses.adjustment.kernels_patch_alignment",
            "= 12, 0.003",
            "= 12, 0.004",
            {"poses.refine", "poses.localise"},
        ),
        ("algorithms.features.kernels_sphorb", "ARC = 10", "ARC = 9", {"features.sphorb"}),
        (
            "algorithms.patchmatch.kernels_refine",
            "_MIN_WEIGHT, _MIN_SPREAD = 5.0",
            "_MIN_WEIGHT, _MIN_SPREAD = 6.0",
            {"depth.full_size", "depth.patchmatch", "depth.plain_surfaces"},
        ),
        (
            "geometry.kernels_sphere",
            "2 * math.pi * (x / width - 0.5)",
            "2 * math.pi * (x / width - 1.5)",
            {"depth.full_size", "depth.patchmatch", "depth.plain_surfaces"},
        ),
        ("algorithms.sweep.numba.kernels_sgm_rows", "_BLOCK = ", "_BLOCK = 1 * ", SWEEPS),
        ("algorithms.filters.kernels_fill", "_DIRECTIONS = ", "_DIRECTIONS = 1 * ", {"filters.fill"}),
        (
            "algorithms.two_view.kernels_five_point",
            "_MAX_INTERVALS = ",
            "_MAX_INTERVALS = 1 + ",
            {"matches.brute_force", "matches.lightglue"},
        ),
    ],
)
def test_a_kernel_s_constant_changes_the_keys_of_exactly_the_stages_that_depend_on_it(
    module: str, old: str, new: str, stages: set[str]
) -> None:
    assert changed_by(f"pano_mvs.{module}", old, new) == stages


@pytest.mark.parametrize("name", sorted(path.stem for path in PACKAGE.rglob("kernels_*.py")))
def test_every_kernel_that_a_stage_can_run_is_in_its_key(name: str) -> None:
    reached = {
        found.rpartition(".")[2].partition(":")[0] for reach in as_it_is().values() for found in reach.definitions
    }
    assert name in reached


def test_comments_docstrings_help_texts_and_memory_estimates_change_no_key() -> None:
    edited = {}
    for module, old, new in (
        ("algorithms.sweep.sweep", '"""', '"""Anew. '),
        ("algorithms.sweep.numba.kernels_sgm_rows", "_BLOCK = ", "# how many\n_BLOCK = "),
        ("algorithms.sweep.settings", 'doc="number of depth hypotheses"', 'doc="how many hypotheses"'),
        ("stages.depth", "_PICTURE_BYTES, _RESULT_BYTES = 16", "_PICTURE_BYTES, _RESULT_BYTES = 17"),
    ):
        text = PACKAGE.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8")
        edited[f"pano_mvs.{module}"] = text.replace(old, new, 1)
        assert edited[f"pano_mvs.{module}"] != text
    assert reaches(edited) == as_it_is()


def test_what_shows_results_or_drives_stages_is_in_no_key() -> None:
    shown = ("pano_mvs.cli", "pano_mvs.report", "pano_mvs.viewer", "pano_mvs.engine", "pano_mvs.testing")
    modules = {found.partition(":")[0] for reach in as_it_is().values() for found in reach.definitions}
    assert {module for module in modules if module.startswith(shown)} == {"pano_mvs.engine.stages.context"}
    assert len(modules) > 150


@pytest.mark.parametrize(
    ("stage", "libraries"),
    [
        ("poses.unit_translations", {"numpy"}),
        ("export.mesh", {"numpy", "scipy"}),
        ("filters.median", {"numpy", "OpenCV"}),
        ("filters.speckle", {"numpy", "numba"}),
        ("poses.colmap", {"numpy", "scipy", "pycolmap"}),
        ("depth.sweep", {"numpy", "scipy", "OpenCV", "numba", "llvmlite"}),
    ],
)
def test_the_libraries_that_a_stage_computes_with_are_in_its_key(stage: str, libraries: set[str]) -> None:
    spec = Registry.installed().stages[stage]
    found = stage_code(spec, spec.params_type())
    assert set(found.libraries) == libraries
    assert found.libraries["numpy"] == importlib.import_module("numpy").__version__
    assert all(version[0].isdigit() for version in found.libraries.values())


def test_the_key_is_that_of_the_installed_package() -> None:
    specs = Registry.installed().stages
    assert {name: stage_code(specs[name], specs[name].params_type()).digest for name in SWEEPS} == {
        name: as_it_is()[name].digest for name in SWEEPS
    }


@pytest.mark.slow
def test_a_copy_elsewhere_has_the_same_keys(tmp_path: Path) -> None:
    graph = code_graph({"pano_mvs": copied_package(tmp_path)})
    for name in ("poses.unit_translations", "filters.speckle"):
        assert reach_of_function(*functions()[name], graph) == as_it_is()[name]


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


def test_what_is_known_of_code_is_kept_until_a_file_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_code_module, "user_cache_folder", lambda: tmp_path / "kept")
    (tmp_path / "alone.py").write_text("def f(): ...\n")
    calls: list[int] = []

    def known() -> tuple[str, tuple[str, ...]]:
        stage_code_module._sources_of.cache_clear()
        return stage_code_module._known(tmp_path / "alone.py", "f", found)

    def found() -> Reach:
        calls.append(len(calls))
        return Reach(f"{len(calls)}", {}, frozenset({"numpy"}))

    assert [known(), known()] == [("1", ("numpy",))] * 2
    (tmp_path / "alone.py").write_text("def f(): return 1\n")
    assert [known(), known()] == [("2", ("numpy",))] * 2
    for damage in ("{", "[]", '{"sources": 1}'):
        next((tmp_path / "kept").rglob("*.json")).write_text(damage)
        assert known()[0] == str(len(calls))
    assert len(calls) == 5
    stage_code_module._sources_of.cache_clear()
