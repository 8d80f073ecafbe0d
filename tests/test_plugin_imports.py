"""Plugins that `plugin new` writes import public modules alone: stages the API for plugins."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest

from pano_mvs import api
from pano_mvs.api import sweep
from pano_mvs.cli.plugins.new import KINDS, rendered

ALLOWED = {"pano_mvs.api", "pano_mvs.api.sweep"}


# What plugins beside stages may import as well; docs/plugins.md lists these.
PUBLIC = {
    "pano_mvs",
    "pano_mvs.cli.commands",
    "pano_mvs.cli.console",
    "pano_mvs.engine.cache.store",
    "pano_mvs.engine.executors.choose",
    "pano_mvs.engine.executors.protocol",
    "pano_mvs.geometry",
    "pano_mvs.io.readers",
    "pano_mvs.scene",
    "pano_mvs.session.observers",
    "pano_mvs.session.progress",
}


def is_public(module: str) -> bool:
    """Return whether a plugin that is not a stage may import a module."""
    return module in ALLOWED | PUBLIC or module.startswith("pano_mvs.core.")


def imported(text: str) -> Iterator[str]:
    """Yield the modules of pano_mvs that a module imports."""
    for node in ast.walk(ast.parse(text)):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else names
        yield from (name for name in names if name.split(".")[0] == "pano_mvs")


@pytest.mark.parametrize("kind", KINDS)
def test_new_plugins_import_public_modules_alone(kind: str) -> None:
    plugin, test = rendered(kind, "mine")
    if KINDS[kind].in_workflow:
        assert set(imported(plugin)) <= ALLOWED
    assert [module for module in imported(plugin) if not is_public(module)] == []
    assert set(imported(test)) == {"pano_mvs.testing.conformance"}


def test_other_imports_are_seen() -> None:
    assert list(imported("import pano_mvs.io\nfrom pano_mvs.scene import Poses\nimport pano_mvs_las")) == [
        "pano_mvs.io",
        "pano_mvs.scene",
    ]


@pytest.mark.parametrize("module", [api, sweep])
def test_all_names_of_the_api_are_there(module: object) -> None:
    names = module.__all__  # type: ignore[attr-defined]  # a module's own list
    assert len(set(names)) == len(names)
    for name in names:
        assert getattr(module, name) is not None
