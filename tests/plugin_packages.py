"""Installed packages with plugins, as tests make them: a distribution in a folder on the path, and its modules."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import invalidate_caches
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from pano_mvs.core.doors import FUNCTIONS, installed
from pano_mvs.core.named_registry import set_unavailable


@dataclass
class Packages:
    """Packages that are installed for one test."""

    folder: Path  # on the path

    def add(self, name: str, groups: Mapping[str, Mapping[str, str]], **modules: str) -> None:
        """Install a distribution.

        Args:
            name: of the distribution; its version is 1.
            groups: its entry points, by group without `pano_mvs.` and by name.
            modules: name to text.
        """
        for module, text in modules.items():
            (self.folder / f"{module}.py").write_text(text)
        info = self.folder / f"{name.replace('-', '_')}-1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
        lines = [
            line
            for group, entries in groups.items()
            for line in (f"[pano_mvs.{group}]", *(f"{entry} = {value}" for entry, value in entries.items()))
        ]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
        invalidate_caches()
        installed.cache_clear()


@contextmanager
def empty_doors(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let every door forget in this context what other tests have brought through it, and afterwards what this one."""
    from pano_mvs.cli.commands import COMMANDS
    from pano_mvs.engine.executors.choose import EXECUTORS
    from pano_mvs.io.readers import CAPTURE_READERS, POSE_READERS
    from pano_mvs.session.observers import OBSERVERS

    for door in (CAPTURE_READERS, COMMANDS, EXECUTORS, FUNCTIONS, OBSERVERS, POSE_READERS):
        monkeypatch.setattr(door, "_added", {})
        monkeypatch.setattr(door, "_loaded", {})
    monkeypatch.setattr("pano_mvs.engine.stages.registry.entry_points", entry_points)
    installed.cache_clear()
    yield
    installed.cache_clear()
    set_unavailable({}, [])


@contextmanager
def packages_in(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Packages]:
    """Put a folder on the path in this context."""
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    with empty_doors(monkeypatch):
        yield Packages(folder)
        monkeypatch.undo()
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None) or "").startswith(str(folder)):
            del sys.modules[name]
