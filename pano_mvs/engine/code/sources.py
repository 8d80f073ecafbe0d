"""The summaries of the modules of some packages, cached on disk by the digest of their files."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

from pano_mvs.core.digest import digest_from_bytes, digest_from_value
from pano_mvs.core.paths import below as files_below
from pano_mvs.core.paths import is_file
from pano_mvs.engine.code.summary import ModuleSummary, summarize_module

_PYTHON = f"{sys.version_info.major}.{sys.version_info.minor}"  # it determines the valid syntax


class Sources:
    """The modules of some packages, read on demand.

    Reading a file takes microseconds, but analysing it takes milliseconds, so the summaries are cached.
    """

    def __init__(self, packages: Mapping[str, Path], kept_in: Path | None = None) -> None:
        """Prepare to read modules.

        Args:
            packages: name of each top-level package or module, to its folder or file.
            kept_in: folder of the cached summaries; None to cache none.
        """
        self._packages = dict(packages)
        self._kept_in = kept_in
        self._tops = set(packages)
        self._summaries: dict[str, ModuleSummary | None] = {}
        self._kept: dict[str, dict[str, tuple[str, ModuleSummary]]] = {}
        self._changed: set[str] = set()

    def with_modules(self, known: Mapping[str, ModuleSummary]) -> Sources:
        """Return these modules and some others, given the summaries of those by dotted name."""
        more = Sources(self._packages, self._kept_in)
        more._tops |= {module.partition(".")[0] for module in known}
        more._summaries = {**self._summaries, **known}
        more._kept, more._changed = self._kept, self._changed
        return more

    def __contains__(self, path: str) -> bool:
        """Return whether a dotted path begins with one of the packages."""
        return path.partition(".")[0] in self._tops

    def summary(self, module: str) -> ModuleSummary | None:
        """Return the summary of a module, or None if it does not exist or cannot be read."""
        if module not in self._summaries:
            self._summaries[module] = self._read(module)
        return self._summaries[module]

    def save(self) -> None:
        """Store new summaries for later processes, if possible."""
        for top in sorted(self._changed):
            path = self._kept_path(top)
            if path is None:
                continue
            kept = {module: [digest, one.to_json()] for module, (digest, one) in self._kept[top].items()}
            with suppress(OSError):
                path.parent.mkdir(parents=True, exist_ok=True)
                handle, temporary = tempfile.mkstemp(prefix=".tmp-", dir=path.parent)
                with os.fdopen(handle, "w", encoding="utf-8") as stream:
                    json.dump(kept, stream, separators=(",", ":"))
                Path(temporary).replace(path)
        self._changed.clear()

    def _read(self, module: str) -> ModuleSummary | None:
        path, is_package = self._file(module)
        if path is None:
            return None
        try:
            text = path.read_bytes()
        except OSError:
            return None
        top = module.partition(".")[0]
        digest = digest_from_bytes(text)
        kept = self._kept_of(top)
        if module in kept and kept[module][0] == digest:
            return kept[module][1]
        try:
            summary = summarize_module(text, module, is_package=is_package)
        except (SyntaxError, ValueError):
            return None
        kept[module] = digest, summary
        self._changed.add(top)
        return summary

    def _file(self, module: str) -> tuple[Path | None, bool]:
        top, *below = module.split(".")
        root = self._packages.get(top)
        if root is None:
            return None, False
        if root.suffix == ".py":
            return (None if below else root), False
        folder = root.joinpath(*below)
        if is_file(folder / "__init__.py"):
            return folder / "__init__.py", True
        file = folder.with_name(f"{folder.name}.py")
        return (file if below and is_file(file) else None), False

    def _kept_of(self, top: str) -> dict[str, tuple[str, ModuleSummary]]:
        if top not in self._kept:
            path = self._kept_path(top)
            self._kept[top] = _load(path) if path is not None else {}
        return self._kept[top]

    def _kept_path(self, top: str) -> Path | None:
        if self._kept_in is None:
            return None
        place = digest_from_value([_PYTHON, str(self._packages[top]), _our_texts()])
        return self._kept_in / f"{top}-{place[:16]}.json"


@cache
def _our_texts() -> dict[str, bytes]:
    """Return the source of this package: when it changes, cached summaries become invalid."""
    return {path.name: path.read_bytes() for path in files_below(Path(__file__).parent, "*.py")}


def _load(path: Path) -> dict[str, tuple[str, ModuleSummary]]:
    try:
        kept = json.loads(path.read_bytes())
        return {module: (digest, ModuleSummary.from_json(one)) for module, (digest, one) in kept.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}  # missing or damaged
