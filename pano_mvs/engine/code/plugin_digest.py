"""Digest of a user's plugin file, which does not depend on comments and layout."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

from pano_mvs.core.digest import digest_from_value

_Import: TypeAlias = tuple[int, str, tuple[str, ...]]  # level, module ("" for `import` and `from .`), and names


def code_digest(path: Path) -> str:
    """Return the digest of the syntax trees of a Python file and the local files that it imports.

    Raises:
        OSError: if the file cannot be read.
        SyntaxError: if it is not Python.
    """
    trees: dict[str, str] = {}
    _collect(path.resolve(), _Roots.of(path.resolve()), trees)
    return digest_from_value(trees)


def code_texts(path: Path) -> tuple[str, dict[str, str]]:
    """Return the name of a Python file, and by name the texts of it and the local files that it imports.

    The names are relative to a common folder, so that the files can be written to any other folder.

    Raises:
        OSError: if a file cannot be read.
        SyntaxError: if one is not Python.
    """
    path = path.resolve()
    roots, trees = _Roots.of(path), dict[str, str]()
    _collect(path, roots, trees)
    base = roots.package.parent if roots.package is not None else roots.folder
    return roots.name_of(path), {name: (base / name).read_text(encoding="utf-8") for name in trees}


@dataclass(frozen=True, slots=True)
class _Roots:
    """The folders in which absolute imports are looked up."""

    folder: Path  # folder of the file, which is on the path while a plugin file is imported
    # the outermost package that contains the file, if any; other packages beside it are ignored
    package: Path | None

    @staticmethod
    def of(path: Path) -> _Roots:
        package = None
        for folder in path.parents:
            if not (folder / "__init__.py").is_file():
                break
            package = folder
        return _Roots(path.parent, package)

    def name_of(self, path: Path) -> str:
        """Return a file's name without the folder into which its package is installed."""
        base = self.package.parent if self.package is not None else self.folder
        return path.relative_to(base).as_posix() if path.is_relative_to(base) else str(path)

    def files(self, dotted: str) -> list[Path]:
        found = _module_files(self.folder, dotted)
        if self.package is not None and dotted.partition(".")[0] == self.package.name:
            found.extend(_module_files(self.package.parent, dotted))
        return found


def _collect(path: Path, roots: _Roots, trees: dict[str, str]) -> None:
    name = roots.name_of(path)
    if name in trees:
        return
    try:
        trees[name], imports = _parsed(path.read_text(encoding="utf-8"))
    except SyntaxError as error:
        error.filename = str(path)
        raise
    for imported in _imported_files(imports, path.parent, roots):
        _collect(imported, roots, trees)


@lru_cache(maxsize=64)  # a command asks for the digest of a plugin more than once
def _parsed(text: str) -> tuple[str, tuple[_Import, ...]]:
    """Return the syntax tree of a module as text, and its imports."""
    tree = ast.parse(text)
    imports: list[_Import] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            relative = (node.level, node.module or "") if isinstance(node, ast.ImportFrom) else (0, "")
            imports.append((*relative, tuple(alias.name for alias in node.names)))
    return ast.dump(_without_docstrings(tree), include_attributes=False), tuple(imports)


def _imported_files(imports: Sequence[_Import], folder: Path, roots: _Roots) -> list[Path]:
    """Return the local files that a module imports anywhere; absolute names are looked up from the roots."""
    files: list[Path] = []
    for level, module, names in imports:
        dotted = [module, *(f"{module}.{name}" if module else name for name in names)]
        base = folder.joinpath(*[".."] * (level - 1)).resolve() if level else None
        if base is not None and (base / "__init__.py").is_file():
            files.append(base / "__init__.py")  # the names may be its own
        for name in dotted:
            files.extend(roots.files(name) if base is None else _module_files(base, name))
    return files


def _module_files(base: Path, dotted: str) -> list[Path]:
    """Return the files that run when a dotted name is imported, with the __init__.py of every package above it."""
    parts = [part for part in dotted.split(".") if part]
    candidates = [base.joinpath(*parts[: depth + 1], "__init__.py") for depth in range(len(parts))]
    if parts:
        candidates.append(base.joinpath(*parts).with_suffix(".py"))
    return [candidate for candidate in candidates if candidate.is_file()]


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            match node.body:
                case [ast.Expr(value=ast.Constant(value=str())), *rest]:
                    node.body = rest or [ast.Pass()]
    return tree
