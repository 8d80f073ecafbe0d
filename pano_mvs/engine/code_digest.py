"""Digest of a user's plugin file: what the code does counts, comments and layout do not."""

from __future__ import annotations

import ast
from pathlib import Path

from pano_mvs.core.digest import digest_from_value


def code_digest(path: Path) -> str:
    """Return the digest of a Python file's syntax tree and of those of the local files that it imports.

    Raises:
        OSError: if the file cannot be read.
        SyntaxError: if it is not Python.
    """
    trees: dict[str, str] = {}
    _collect(path.resolve(), path.resolve().parent, trees)
    return digest_from_value(trees)


def local_imports(path: Path) -> list[Path]:
    """Return the files beside a Python file that it imports, directly."""
    tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    return _imported_files(tree, path.parent)


def _collect(path: Path, root: Path, trees: dict[str, str]) -> None:
    name = path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
    if name in trees:
        return
    tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    trees[name] = ast.dump(_without_docstrings(tree), include_attributes=False)
    for imported in _imported_files(tree, path.parent):
        _collect(imported, root, trees)


def _imported_files(tree: ast.Module, folder: Path) -> list[Path]:
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.extend(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.append(node.module)
            names.extend(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.extend(alias.name for alias in node.names)
    files: list[Path] = []
    for name in names:
        stem = folder.joinpath(*name.split("."))
        files.extend(candidate for candidate in (stem.with_suffix(".py"), stem / "__init__.py") if candidate.is_file())
    return files


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            first = node.body[0] if node.body else None
            is_doc = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
            if is_doc and isinstance(first.value.value, str):  # type: ignore[union-attr]
                node.body = node.body[1:] or [ast.Pass()]
    return tree
