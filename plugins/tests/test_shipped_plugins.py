"""Plugins that we ship separately import nothing of ours but the API for plugins."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from pano_mvs import api
from pano_mvs.api import sweep
from tests.test_plugin_imports import ALLOWED, imported

PLUGINS = Path(__file__).parents[1]
FILES = sorted([*PLUGINS.glob("pano_mvs_*/pano_mvs_*/**/*.py"), *PLUGINS.glob("examples/*.py")])


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_shipped_plugins_import_the_api_alone(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert set(imported(text)) <= ALLOWED
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module in ALLOWED:
            module = sweep if node.module.endswith("sweep") else api
            assert {alias.name for alias in node.names} <= set(module.__all__)


def test_there_are_plugins() -> None:
    assert {path.parent.name for path in FILES} >= {"examples", "pano_mvs_example", "pano_mvs_las", "pano_mvs_torch"}
