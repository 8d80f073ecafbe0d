"""Examples in docstrings do what they say."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import pano_mvs

PACKAGE = Path(pano_mvs.__file__).parent
# Each runs the sample, or needs what the one before has left.
COMPUTING = (
    "pano_mvs.session.captures",
    "pano_mvs.session.planning",
    "pano_mvs.results.run_output",
    "pano_mvs_page.share",
    "pano_mvs_viewer.view",
)


def modules() -> list[str]:
    """Return the modules with an example."""
    paths = [path for path in PACKAGE.rglob("*.py") if ">>> " in path.read_text(encoding="utf-8")]
    return sorted(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in paths)


def examples(module: str) -> doctest.TestResults:
    return doctest.testmod(importlib.import_module(module))


@pytest.mark.parametrize("module", [name for name in modules() if name not in COMPUTING])
def test_examples_of_a_module(module: str) -> None:
    failed, tried = examples(module)
    assert (failed, tried > 0) == (0, True)


@pytest.mark.slow
def test_examples_that_run_the_sample(tmp_path: Path, sample: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PANO_MVS_CACHE", str(sample / "cache"))
    for module in COMPUTING:
        failed, tried = examples(module)
        assert (failed, tried > 0) == (0, True), module
