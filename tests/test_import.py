"""What `import pano_mvs` offers, and that it costs next to nothing."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import pano_mvs

SLOW_LIBRARIES = {"cv2", "jinja2", "matplotlib", "numba", "numpy", "pycolmap", "pydantic", "pyvista", "scipy"}


@pytest.mark.parametrize("module", ["pano_mvs", "pano_mvs.cli.app"])
def test_no_library_is_imported_before_it_is_needed(module: str) -> None:
    """`pano-mvs --help` took 0.6 s of which numpy, scipy and pydantic were all but a tenth."""
    code = f"import sys, {module}; print(*({SLOW_LIBRARIES} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("module", ["pano_mvs.api", "pano_mvs.cli.watch_command"])
def test_nobody_waits_for_the_libraries_of_solvers(module: str) -> None:
    code = f"import sys, {module}; print(*({{'numba', 'pycolmap', 'pyvista', 'scipy'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_all_stages_are_known_without_the_libraries_that_they_compute_with() -> None:
    """One module that imported parts of scipy made every command wait half a second longer."""
    slow = {"numba", "onnxruntime", "pycolmap", "pyvista", "trimesh"}
    code = (
        "import sys; from pano_mvs.engine.stages.registry import Registry; Registry.installed(); "
        f"print(*(name for name in sys.modules if name in {slow} or name.startswith(('scipy.s', 'scipy.o'))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_all_names_are_there_and_type_checkers_see_the_same() -> None:
    tree = ast.parse(Path(pano_mvs.__file__).read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    declared = {alias.name: node.module for node in imports for alias in node.names}
    assert declared == {name: f"pano_mvs.{home}" for name, home in pano_mvs._HOMES.items()}
    assert sorted([*declared, "__version__"]) == sorted(pano_mvs.__all__)
    assert set(pano_mvs.__all__) <= set(dir(pano_mvs))
    for name in pano_mvs.__all__:
        assert getattr(pano_mvs, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        pano_mvs.nothing  # noqa: B018  # the attribute is asked for


def test_tests_of_the_core_import_no_plugin() -> None:
    """They pass where the folder plugins was deleted; those in docs and tools are about the whole distribution."""
    tests = Path(__file__).parent
    helpers = {path.stem for path in tests.parent.glob("plugins/*/tests/*.py")}
    found = {}
    for path in sorted(tests.rglob("*.py")):
        if path.relative_to(tests).parts[0] not in ("docs", "tools"):
            text = path.read_text(encoding="utf-8")
            is_suspect = any(name in text for name in ("pano_mvs_", *helpers))
            modules = list(imported_modules(text)) if is_suspect else []
            packages = {module.partition(".")[0] for module in modules}
            found[path] = {name for name in packages if name.startswith("pano_mvs_") or name in helpers}
    assert len(found) > 200
    assert {path: names for path, names in found.items() if names} == {}


def imported_modules(text: str) -> Iterator[str]:
    """Yield the modules that a module imports from elsewhere, also within its functions."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module or ""
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
