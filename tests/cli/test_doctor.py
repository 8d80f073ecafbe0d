"""The doctor finds what is wrong, says what to do about it, and tells by its exit code whether a run can work."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Iterable, Mapping
from functools import partial
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

import pano_mvs
from pano_mvs.cli.doctor import checks, command, libraries
from pano_mvs.cli.doctor.checks import (
    Finding,
    folder_finding,
    is_older,
    kernel_cache_finding,
    machine_findings,
    package_findings,
    plugin_findings,
)
from pano_mvs.cli.doctor.libraries import library_findings, run_probe
from pano_mvs.core.kernel_cache import kernel_cache_folder
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.session.session import presets_folder
from tests.cli.conftest import Command
from tests.permissions import permissions_hold

NEEDS = [
    "numba>=0.60",
    "opencv-python-headless>=4.10",
    "mkdocs<2,>=1.6; extra == 'docs'",
    "pillow-heif>=0.18; extra == 'heic'",
    "colorama; sys_platform == 'win32'",
]


def by_what(findings: Iterable[Finding]) -> dict[str, Finding]:
    found = list(findings)
    assert all(finding.remedy for finding in found if finding.state in ("warning", "failed"))
    assert len({finding.what for finding in found}) == len(found)
    return {finding.what: finding for finding in found}


@pytest.mark.parametrize(
    ("found", "least", "older"),
    [
        ("4.9", "4.10", True),
        ("4.10.0.84", "4.10", False),
        ("5.0rc1", "5.0", False),
        ("2", "2.0.1", True),
        ("x", "1", True),
    ],
)
def test_versions_compare_by_their_numbers(found: str, least: str, older: bool) -> None:
    assert is_older(found, least) is older


def test_packages_are_held_against_the_metadata() -> None:
    sound = {"numba": "0.61.2", "opencv-python-headless": "4.11.0.86", "pillow-heif": "1.0"}
    found = by_what(package_findings(NEEDS, sound.get))
    assert {finding.state for finding in found.values()} == {"ok"}
    assert "extra docs" not in found
    assert "colorama" not in found

    found = by_what(package_findings(NEEDS, {"numba": "0.59.1", "opencv-python": "4.9.0"}.get))
    assert (found["numba"].state, found["numba"].remedy) == ("failed", "pip install -U numba")
    assert found["opencv-python-headless"].detail == "opencv-python 4.9.0; 4.10 or newer is needed"
    assert (found["extra heic"].state, found["extra heic"].remedy) == ("note", "pip install -U 'pano-mvs[heic]'")

    found = by_what(package_findings(NEEDS, {"opencv-python": "5.0", "opencv-python-headless": "5.0"}.get))
    assert found["opencv-python-headless"].state == "ok"
    assert found["numba"].detail == "is not installed"
    assert found["OpenCV"].state == "warning"
    assert "more than once" in found["OpenCV"].detail


def test_this_installation_has_what_it_needs() -> None:
    found = by_what(package_findings())
    assert "numba" in found
    assert not [finding for finding in found.values() if finding.state == "failed"]


GOOD: dict[str, dict[str, Any]] = {
    "numba": {"version": "1", "disabled": False},
    "pycolmap": {"version": "2"},
    "cv2": {"version": "3", "video": True, "avif": True},
    "onnxruntime": {"version": "6"},
    "pyvista": {"version": "4"},
    "torch": {"version": "5", "devices": ["Card 7, 24 GB"], "built_for": "12.4"},
}


def answering(monkeypatch: pytest.MonkeyPatch, answers: Mapping[str, object], *, torch: bool = True) -> None:
    """Let the probes answer as given, else that all works, as if the sweep on PyTorch were installed or not."""

    def probe(code: str) -> object:
        name = next(name for name in GOOD if f"import {name}" in code or f", {name}" in code)
        return answers.get(name, GOOD[name])

    monkeypatch.setattr(libraries, "run_probe", probe)
    plugin = ModuleType("pano_mvs_torch")
    plugin.__spec__ = ModuleSpec("pano_mvs_torch", None)
    monkeypatch.setitem(sys.modules, "pano_mvs_torch", plugin if torch else None)


def test_libraries_that_work_are_ok(monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, {})
    found = by_what(library_findings())
    assert {what: finding.state for what, finding in found.items()} == dict.fromkeys(
        ["numba", "pycolmap", "OpenCV", "ONNX Runtime", "PyVista", "torch"], "ok"
    )
    assert "Card 7" in found["torch"].detail
    assert found["OpenCV"].detail == "3, reads images"
    answering(monkeypatch, {}, torch=False)
    assert by_what(library_findings())["torch"].state == "note"


@pytest.mark.parametrize(
    ("answers", "what", "state", "text"),
    [
        ({"numba": "ImportError: llvmlite"}, "numba", "failed", "llvmlite"),
        ({"numba": {"version": "1", "disabled": True}}, "numba", "warning", "unset NUMBA_DISABLE_JIT"),
        ({"pycolmap": "the process died of signal 6"}, "pycolmap", "failed", "died of signal 6"),
        ({"cv2": "AssertionError"}, "OpenCV", "failed", "opencv-python-headless"),
        ({"cv2": {**GOOD["cv2"], "video": False}}, "OpenCV video", "warning", "reads no videos"),
        ({"cv2": {**GOOD["cv2"], "avif": False}}, "OpenCV AVIF", "note", "reads no AVIF"),
        ({"onnxruntime": "UsageError: damaged"}, "ONNX Runtime", "failed", "damaged"),
        ({"pyvista": "gave no answer within 180 s"}, "PyVista", "warning", "libgl1"),
        ({"torch": {"version": "5", "devices": [], "built_for": None}}, "torch", "note", "built without CUDA"),
        ({"torch": "ImportError: libcuda"}, "torch", "warning", "backend: numba"),
    ],
)
def test_a_library_that_does_not_work_is_told_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch, answers: dict[str, object], what: str, state: str, text: str
) -> None:
    answering(monkeypatch, answers)
    finding = by_what(library_findings())[what]
    assert finding.state == state
    assert text in f"{finding.detail} {finding.remedy}"


def test_a_probe_that_dies_or_hangs_ends_nothing_else() -> None:
    assert run_probe("print('noise'); print('{\"a\": 1}')") == {"a": 1}
    assert run_probe("import os; os.abort()") == "the process died of signal 6"
    assert run_probe("raise ValueError('broken')") == "ValueError: broken"
    assert run_probe("import time; time.sleep(60)", timeout_s=0.3) == "gave no answer within 0 s"


def on_a_machine(monkeypatch: pytest.MonkeyPatch, *, memory_bytes: int) -> None:
    monkeypatch.setattr(checks, "available_threads", lambda: 8)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(checks, "free_memory_bytes", lambda: memory_bytes)


def test_the_machine_and_slips_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    on_a_machine(monkeypatch, memory_bytes=16 * 10**9)
    found = by_what(machine_findings({}))
    assert {finding.state for finding in found.values()} == {"ok"}
    assert found["processors"].detail.startswith("8 of 64")
    on_a_machine(monkeypatch, memory_bytes=10**9)
    slips = {"NUMBA_NUM_THREADS": "2", "OMP_NUM_THREADS": "8", "PANO_MVS_PLUGIN": "/x", "PANO_MVS_CACHE": "/y"}
    found = by_what(machine_findings(slips))
    assert found["NUMBA_NUM_THREADS"].remedy == "unset NUMBA_NUM_THREADS"
    assert "OMP_NUM_THREADS" not in found
    assert found["memory"].state == "warning"
    assert found["PANO_MVS_PLUGIN"].remedy == "did you mean PANO_MVS_PLUGINS?"
    assert "PANO_MVS_CACHE" not in found


def test_every_variable_that_the_program_reads_is_known() -> None:
    import re

    package = Path(pano_mvs.__file__).parent
    read = {
        name
        for path in package.rglob("*.py")
        if "doctor" not in path.parts
        for name in re.findall(r'"(PANO_MVS_[A-Z_]+)"', path.read_text(encoding="utf-8"))
    }
    assert read <= set(checks.KNOWN_VARIABLES)


def test_a_folder_for_kernels_that_cannot_be_written(tmp_path: Path) -> None:
    package = Path(pano_mvs.__file__).parent
    assert kernel_cache_finding(package, {"NUMBA_CACHE_DIR": str(tmp_path / "new")}).state == "ok"
    (tmp_path / "file").write_text("x")
    finding = kernel_cache_finding(package, {"NUMBA_CACHE_DIR": str(tmp_path / "file")})
    assert finding.state == "warning"
    assert "NUMBA_CACHE_DIR" in finding.remedy


def test_folders_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = tmp_path / "not" / "yet"
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**11))
    found = folder_finding("cache", deep, "--cache DIR")
    assert (found.state, "100.0 GB free" in found.detail) == ("ok", True)
    assert not deep.exists()
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**9))
    found = folder_finding("cache", deep, "--cache DIR")
    assert (found.state, "--cache DIR" in found.remedy) == ("warning", True)
    (tmp_path / "file").write_text("x")
    found = folder_finding("cache", tmp_path / "file" / "below", "--cache DIR")
    assert found.state == "failed"
    assert "is not a folder" in found.detail
    tmp_path.chmod(0o500)
    with permissions_hold():
        found = folder_finding("results", tmp_path / "out", "--out DIR")
    assert (found.state, "--out DIR" in found.remedy) == ("failed", True)


def test_plugins_that_fail_clash_or_are_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "bad.py").write_text('from pano_mvs.api import stage\n1 / 0\n@stage("filters.mine")\ndef f(): ...\n')
    environment = {"PANO_MVS_PLUGINS": os.pathsep.join([str(folder), str(tmp_path / "gone")])}
    monkeypatch.setattr("pano_mvs.engine.stages.registry.user_plugin_folders", lambda: [folder])
    found = by_what(plugin_findings(Registry.installed(), presets_folder(), environment))
    bad = found[str(folder / "bad.py")]
    assert "ZeroDivisionError" in bad.detail
    assert "pano-mvs plugins" in bad.remedy
    assert found["PANO_MVS_PLUGINS"].detail == f"{tmp_path / 'gone'} is not a folder"
    assert found["stages"].state == found["presets"].state == "ok"
    nothing = by_what(plugin_findings(Registry(), tmp_path, {}))
    assert nothing["stages"].state == nothing["presets"].state == "failed"


def test_the_command_shows_the_remedies_and_ends_with_2_if_a_run_cannot_work(
    pano_mvs: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: dict[str, object] = {"pyvista": "no libGL.so.1"}
    answering(monkeypatch, answers)
    on_a_machine(monkeypatch, memory_bytes=16 * 10**9)  # of this one it may warn, too
    monkeypatch.setattr(checks, "machine_findings", partial(machine_findings, {}))
    result = pano_mvs("doctor", "--cache", "c", "--out", "o")
    assert result.code == 0, result.text
    assert "a run can work; 1 warning" in result.flat
    assert "warning: PyVista: install the system's OpenGL libraries" in result.flat
    answers["pycolmap"] = "the process died of signal 11"
    result = pano_mvs("doctor", "--json")
    assert result.code == 2
    said = json.loads(result.text)
    assert said["ok"] is False
    assert {
        "group": "libraries",
        "what": "pycolmap",
        "state": "failed",
        "detail": "the process died of signal 11",
        "remedy": "pip install --force-reinstall --no-deps pycolmap",
    } in said["findings"]
    assert not Path("c").exists()


@pytest.mark.slow
def test_the_real_libraries_work_here() -> None:
    findings = list(command.all_findings())
    found = {finding.what: finding.state for finding in findings}
    assert found["numba"] == found["pycolmap"] == found["OpenCV"] == found["ONNX Runtime"] == "ok"
    assert str(kernel_cache_folder()) in next(
        finding.detail for finding in findings if finding.what == "compiled kernels"
    )
    assert sys.version_info >= (3, 11)
