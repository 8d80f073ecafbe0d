"""Every kernel module is compared with its plain counterpart by a test that carries the marker `kernel`.

The marker names the modules that a test compares, as `package.module` below `pano_mvs.algorithms` or `pano_mvs`. CI
runs these tests compiled with the others, and again as plain Python (`NUMBA_DISABLE_JIT=1 pytest -m kernel`).
"""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import pano_mvs

PACKAGE = Path(pano_mvs.__file__).parent
TESTS = Path(__file__).parent.parent


def marked_modules(source: str) -> set[str]:
    """Return the kernel modules that the markers in a test file name."""
    if "mark.kernel" not in source:
        return set()  # without parsing, which takes most of the time
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    marks = [call for call in calls if ast.unparse(call.func) == "pytest.mark.kernel"]
    return {ast.literal_eval(argument) for mark in marks for argument in mark.args}


def test_every_kernel_module_has_a_test_and_no_marker_names_another() -> None:
    kernels = {
        ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removeprefix("algorithms.")
        for path in PACKAGE.rglob("kernels_*.py")
        if "\n@" in path.read_text(encoding="utf-8")  # others hold constants and records of arguments
    }
    files_by_module = defaultdict(list)
    for path in TESTS.rglob("test_*.py"):
        for module in marked_modules(path.read_text(encoding="utf-8")):
            files_by_module[module].append(path.name)
    assert len(kernels) > 20
    assert sorted(kernels - set(files_by_module)) == [], "no test compares these with a plain counterpart"
    assert sorted(set(files_by_module) - kernels) == [], "there are no such kernel modules"


def test_markers_are_found_on_functions_and_on_files() -> None:
    marked = (
        '@pytest.mark.kernel("a.kernels_b", "a.kernels_c")\ndef test(): ...\npytestmark = pytest.mark.kernel("d")\n'
    )
    assert marked_modules(marked) == {"a.kernels_b", "a.kernels_c", "d"}
    assert marked_modules("@pytest.mark.slow\ndef test(): ...") == set()
