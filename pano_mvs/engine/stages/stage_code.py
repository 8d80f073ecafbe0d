"""The code and the libraries that a stage uses, as they count towards the cache keys of its units.

The code is the module of the stage and all modules that it imports, and those that these import, inside of its package
(for a plugin file: beside it) and of pano_mvs. Comments, layout and docstrings do not count. Imports by a name that is
computed at run time are not found.
"""

from __future__ import annotations

import ast
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from pathlib import Path
from typing import TypeAlias

import pano_mvs
from pano_mvs.core.digest import digest_from_bytes, digest_from_value
from pano_mvs.core.doors import own_packages
from pano_mvs.core.errors import StoreError
from pano_mvs.core.files import checked_body, write_checked
from pano_mvs.core.kernel_cache import user_cache_folder
from pano_mvs.core.paths import below, children
from pano_mvs.engine.stages.params import Params, registered_files
from pano_mvs.engine.stages.stage import StageCode, StageSpec

_OURS = Path(pano_mvs.__file__).resolve().parent
_LEFT_OUT = (
    *(f"pano_mvs/{name}/" for name in ("cli", "report", "viewer")),  # show results, but make none
    "pano_mvs/engine/",  # counts by planning.unit_keys.KEY_SCHEMA, which is raised by hand
    "pano_mvs/core/kernel_cache.py",  # affects only speed
    "pano_mvs/__init__.py",  # these only collect names
    "pano_mvs/stages/__init__.py",
)
_KEPT = "pano_mvs/engine/stages/context.py"
_DYNAMIC_IMPORTS = frozenset({"import_module", "find_spec", "__import__"})
_DISTRIBUTIONS: Mapping[str, tuple[str, ...]] = {
    "cv2": ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python"),
    "PIL": ("pillow",),
    "ruamel": ("ruamel.yaml",),
}
_SHOWN_AS = {"cv2": "OpenCV"}
_IGNORED = frozenset(
    {
        "pydantic",  # settings count by value
        "pillow_heif",  # only reads HEIC, as OpenEXR only reads EXR: updates must not invalidate other captures
        "OpenEXR",
        "typing_extensions",
    }
)

_Import: TypeAlias = tuple[int, str, Sequence[str]]  # level, module ("" for `from .`), and names
# digest of what a module executes, its imports, and digests of its functions by their names; "" for what is outside
_Parsed: TypeAlias = tuple[str, Sequence[_Import], Mapping[str, str]]


def stage_code(spec: StageSpec, params: Params) -> StageCode:
    """Return the code of a stage with given settings, which may hold names that plugins registered."""
    if spec.remote is not None:
        return spec.remote.code()
    module = spec.function.__module__
    file = Path(getattr(sys.modules.get(module), "__file__", None) or "")
    if file.suffix != ".py":  # compiled, or entered interactively: only its version is known
        return StageCode("", library_versions([module.partition(".")[0]]))
    found = [_code_of(file, spec.code_digest)]
    digests: dict[str, str] = {"": found[0][0]}
    for setting, path in registered_files(params).items():
        found.append(_code_of(path, code_digest(path)))
        digests[setting] = found[-1][0]
    libraries = library_versions(name for _, names in found for name in names)
    return StageCode(digest_from_value(digests) if len(digests) > 1 else digests[""], libraries)


def code_functions(spec: StageSpec, params: Params) -> dict[str, Mapping[str, str]]:
    """Return the files whose code counts for a stage, each with the digests of its functions, for a reason in words.

    Nothing is returned for a stage whose code is compiled or in another environment.
    """
    file = Path(getattr(sys.modules.get(spec.function.__module__), "__file__", None) or "")
    if spec.remote is not None or file.suffix != ".py":
        return {}
    paths: dict[str, Path] = {}
    for path, own_digest in ((file, spec.code_digest), *((path, "") for path in registered_files(params).values())):
        found, roots = _local_code(path), _Roots.of(path.resolve())
        paths |= found.paths
        if roots.package != _OURS:
            ours, inner = _Roots(None, _OURS), _Code()
            outer = _outer_of(found, roots, own_digest)
            inner.collect([one for name in outer for one in ours.files(name)], ours)
            paths |= inner.paths
    return {name: _parsed_file(path)[2] for name, path in sorted(paths.items())}


@dataclass(frozen=True, slots=True)
class PackageCode:
    """The code of a module of an installed package, without that of pano_mvs, which another process may look up."""

    files: Mapping[str, str]  # files of the package to the digests of what they execute
    outer: tuple[str, ...]  # dotted names that these import from elsewhere


def package_code(module: str) -> PackageCode:
    """Return the code of a module, which is imported, of an installed package that is a plugin's.

    A compiled module has no files: only its version is known.
    """
    file = Path(getattr(sys.modules.get(module), "__file__", None) or "")
    if file.suffix != ".py":
        return PackageCode({}, (module.partition(".")[0],))
    found = _local_code(file)
    return PackageCode(found.files, tuple(sorted(_outer_of(found, _Roots.of(file.resolve()), ""))))


def code_of_package(code: PackageCode, version_of: Callable[[str], str]) -> StageCode:
    """Return the code of a stage whose package this process does not import, with the code of pano_mvs in here.

    It equals that of `stage_code` in a process that imports the package, and has the same pano_mvs and libraries.

    Args:
        version_of: returns the version of the library that provides a module.
    """
    if not code.files:
        return StageCode("", library_versions(code.outer, version_of))
    digest, names = _with_ours("", code.files, code.outer)
    return StageCode(digest, library_versions(names, version_of))


def code_digest(path: Path) -> str:
    """Return the digest of the code in a Python file and the local files that it imports.

    Raises:
        OSError: if a file cannot be read.
        SyntaxError: if one is not Python.
    """
    return digest_from_value(_local_code(path).files)


def code_texts(path: Path) -> tuple[str, dict[str, str]]:
    """Return the name of a Python file, and by name the texts of it and the local files that it imports.

    The names are relative to a common folder, so that the files can be written to any other folder.

    Raises:
        OSError: if a file cannot be read.
        SyntaxError: if one is not Python.
    """
    roots = _Roots.of(path.resolve())
    texts = {name: (roots.base / name).read_text(encoding="utf-8-sig") for name in _local_code(path).files}
    return roots.name_of(path.resolve()), texts


def library_versions(modules: Iterable[str], version_of: Callable[[str], str] | None = None) -> dict[str, str]:
    """Return the version of each library that affects results, by its display name.

    Args:
        modules: top-level names of the imported modules.
        version_of: returns the version of the library that provides a module; by default `module_version`.
    """
    found = version_of or module_version
    return {_SHOWN_AS.get(module, module): found(module) for module in sorted(set(modules) - _IGNORED)}


@cache
def module_version(module: str) -> str:
    """Return the version of the distribution of a module; tries the module's name first, which is faster."""
    for names in (lambda: _DISTRIBUTIONS.get(module, (module,)), lambda: packages_distributions().get(module, ())):
        found = []
        for name in names():
            with suppress(PackageNotFoundError):
                found.append(version(name))
        if found:
            return " and ".join(dict.fromkeys(found))
    return "not installed"


@cache
def _code_of(path: Path, own_digest: str) -> tuple[str, frozenset[str]]:
    """Return the digest of the code that a file imports, and the libraries.

    Args:
        own_digest: of a plugin file, when it was loaded; empty for modules of installed packages.
    """
    found = _local_code(path)
    roots = _Roots.of(path.resolve())
    if roots.package == _OURS:
        return _digest_and_libraries(own_digest, found.files, found.outer)
    return _with_ours(own_digest, found.files, _outer_of(found, roots, own_digest))


def _outer_of(found: _Code, roots: _Roots, own_digest: str) -> set[str]:
    """Return the names that code imports from elsewhere, and its own package, if it is one of a plugin."""
    outer = set(found.outer)
    if roots.package is not None and not own_digest and roots.package.name not in own_packages():
        outer.add(roots.package.name)  # its version stands for its compiled modules
    return outer


def _with_ours(own_digest: str, files: Mapping[str, str], outer: Iterable[str]) -> tuple[str, frozenset[str]]:
    """Return the digest of some code and of that of pano_mvs which it imports, and the libraries of both."""
    ours, inner = _Roots(None, _OURS), _Code()
    inner.collect([file for name in outer for file in ours.files(name)], ours)
    return _digest_and_libraries(own_digest, {**files, **inner.files}, {*outer, *inner.outer})


def _digest_and_libraries(own_digest: str, files: Mapping[str, str], outer: set[str]) -> tuple[str, frozenset[str]]:
    libraries = {name.partition(".")[0] for name in outer} - own_packages() - sys.stdlib_module_names
    _keep_parsed()
    return digest_from_value([own_digest, dict(files)]), frozenset(libraries)


def _local_code(path: Path) -> _Code:
    code = _Code()
    code.collect([path.resolve()], _Roots.of(path.resolve()))
    return code


@dataclass(frozen=True, slots=True)
class _Roots:
    """The folders in which absolute imports are looked up."""

    folder: Path | None  # folder of a plugin file, which is on the path while the file is imported
    # the outermost package that contains the file, if any; other packages beside it are ignored
    package: Path | None

    @staticmethod
    def of(path: Path) -> _Roots:
        package = None
        for folder in path.parents:
            if not (folder / "__init__.py").is_file():
                break
            package = folder
        return _Roots(None if package == _OURS else path.parent, package)

    @property
    def base(self) -> Path:
        """The folder from which the names of files start."""
        base = self.package.parent if self.package is not None else self.folder
        assert base is not None
        return base

    def name_of(self, path: Path) -> str:
        """Return a file's name without the folder into which its package is installed."""
        return _name_below(path, self.base)

    def files(self, dotted: str) -> list[Path]:
        top = dotted.partition(".")[0]
        # pano_mvs is loaded before any plugin, so a checkout of it beside a plugin is not what the plugin gets.
        found = [] if self.folder is None or top == _OURS.name else _module_files(self.folder, dotted)
        if self.package is not None and top == self.package.name:
            ours = self.package == _OURS
            found += _our_files(dotted) if ours else _module_files(self.package.parent, dotted)
        return found


@cache
def _name_below(path: Path, base: Path) -> str:
    return path.relative_to(base).as_posix() if path.is_relative_to(base) else str(path)


@dataclass(slots=True)
class _Code:
    """Files that import each other."""

    files: dict[str, str] = field(default_factory=dict)  # name to the digest of what it executes
    outer: set[str] = field(default_factory=set)  # dotted names that they import from elsewhere
    paths: dict[str, Path] = field(default_factory=dict)  # name to path

    def collect(self, pending: list[Path], roots: _Roots) -> None:
        """Add some files and what they import from the roots."""
        seen: set[Path] = set()
        while pending:
            path = pending.pop()
            if path in seen:
                continue
            seen.add(path)
            name = roots.name_of(path)
            if not name.startswith(_LEFT_OUT) or name == _KEPT:
                self.paths[name] = path
                self.files[name], files, outer = (_our_module if roots.package == _OURS else _module)(path, roots)
                pending += files - seen
                self.outer |= outer


def _module(path: Path, roots: _Roots) -> tuple[str, set[Path], set[str]]:
    """Return the digest of a module, the files that it imports from the roots, and the names that it imports beside."""
    try:
        digest, imports, _ = _parsed_file(path)
    except SyntaxError as error:
        error.filename = str(path)
        raise
    files: set[Path] = set()
    outer: set[str] = set()
    for level, module, names in imports:
        dotted = [module, *(f"{module}.{name}" if module else name for name in names)]
        if module == "pano_mvs.api" and names:
            homes = [_homes_in_api().get(name, module) for name in names]
            dotted = [*homes, *(f"{home}.{name}" for home, name in zip(homes, names, strict=True))]
        if level:
            base = path.parent.joinpath(*[".."] * (level - 1)).resolve()
            files.update([base / "__init__.py"] if (base / "__init__.py").is_file() else [])  # names may be its own
            files.update(file for name in dotted for file in _module_files(base, name))
        elif found := [file for name in dotted for file in roots.files(name)]:
            files.update(found)
        else:
            outer.update(dotted)
    return digest, files, outer


@cache
def _homes_in_api() -> dict[str, str]:
    """Return the modules of the names that `pano_mvs.api` passes on, most of which a stage does not use."""
    imports = _parsed_file(_OURS / "api" / "__init__.py")[1]
    return {name: module for _, module, names in imports for name in names}


_our_module = cache(_module)  # these do not change while a process runs


def _module_files(base: Path, dotted: str) -> list[Path]:
    """Return the files that run when a dotted name is imported, with the __init__.py of every package above it."""
    parts = [part for part in dotted.split(".") if part]
    candidates = [base.joinpath(*parts[: depth + 1], "__init__.py") for depth in range(len(parts))]
    if parts:
        candidates.append(base.joinpath(*parts).with_suffix(".py"))
    return [candidate for candidate in candidates if candidate.is_file()]


@cache
def _our_files(dotted: str) -> list[Path]:
    """Return what `_module_files` does for a name in pano_mvs, without asking the disk for each."""
    parts = dotted.split(".")
    above = (".".join(parts[:depth]) for depth in range(1, len(parts) + 1))
    found = ((name, path) for name in above if (path := _our_modules().get(name)) is not None)
    return [path for name, path in found if name == dotted or path.name == "__init__.py"]


@cache
def _our_modules() -> Mapping[str, Path]:
    """Return all modules of pano_mvs by their dotted names, packages with their __init__.py."""
    paths = {path: path.relative_to(_OURS.parent).with_suffix("").parts for path in _our_paths()}
    return {".".join(parts[:-1] if parts[-1] == "__init__" else parts): path for path, parts in paths.items()}


def _parsed_file(path: Path) -> _Parsed:
    """Return what `_parsed` does, of a file; ours do not change while a process runs."""
    return _our_parsed(path) if path in _our_paths() else _parsed(path.read_text(encoding="utf-8-sig"))


@cache
def _our_parsed(path: Path) -> _Parsed:
    return _parsed(path.read_text(encoding="utf-8-sig"))  # editors on Windows write a mark


@cache
def _our_paths() -> frozenset[Path]:
    return frozenset(below(_OURS, "*.py"))


@lru_cache(maxsize=4096)
def _parsed(text: str) -> _Parsed:
    """Return the digest and the imports of a module; parsing takes a second for all modules, so it is kept."""
    key = digest_from_bytes(text.encode())
    known = _known_parsed()
    if key not in known:
        tree = ast.parse(text)
        imports = tuple(_imports_in(tree))
        for node in ast.walk(tree):
            match node:
                case (ast.Module() | ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef()) as block:
                    if ast.get_docstring(block, clean=False) is not None:
                        block.body = block.body[1:] or [ast.Pass()]
        known[key] = digest_from_bytes(ast.unparse(tree).encode()), imports, _function_digests(tree)
    return known[key]


def _function_digests(tree: ast.Module) -> dict[str, str]:
    """Return a short digest of each function and method in a module, and of its other statements under "".

    Functions with the same name, such as the getter and the setter of a property, have one digest.
    """
    found: dict[str, list[ast.AST]] = {"": []}
    for node in tree.body:
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                found.setdefault(name, []).append(node)
            case ast.ClassDef(name=name, body=body):
                methods = [one for one in body if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)]
                for method in methods:
                    found.setdefault(f"{name}.{method.name}", []).append(method)
                others = [one for one in body if one not in methods]
                found.setdefault(name, []).extend([*node.decorator_list, *node.bases, *node.keywords, *others])
            case _:
                found[""].append(node)
    return {name: _short_digest(nodes) for name, nodes in found.items()}


def _short_digest(nodes: Sequence[ast.AST]) -> str:
    return digest_from_bytes("\n".join(map(ast.unparse, nodes)).encode())[:12]


def _imports_in(tree: ast.AST) -> Iterator[_Import]:
    """Yield the imports in code, also those that run later, but not those for type checkers."""
    for node in ast.iter_child_nodes(tree):
        match node:
            case ast.Import(names=names):
                yield from ((0, alias.name, ()) for alias in names)
            case ast.ImportFrom(module=module, names=names, level=level):
                yield level, module or "", tuple(alias.name for alias in names)
            case ast.If(test=ast.Name(id="TYPE_CHECKING") | ast.Attribute(attr="TYPE_CHECKING"), orelse=others):
                yield from _imports_in(ast.Module(others, []))
            case ast.Call(
                func=ast.Name(id=name) | ast.Attribute(attr=name), args=[ast.Constant(value=str(module)), *_]
            ) if name in _DYNAMIC_IMPORTS:
                yield 0, module, ()
            case _:
                yield from _imports_in(node)


def _kept_place() -> Path:
    """Return the file of this version, so that two versions in turn do not parse all modules again and again."""
    return user_cache_folder() / "pano-mvs" / "code" / f"{_parser()[:16]}.json"


@cache
def _parser() -> str:
    """Return a digest of what decides how a module is parsed: results of another version are not read."""
    return digest_from_value([sys.version, Path(__file__).read_bytes()])


@cache
def _known_parsed() -> dict[str, _Parsed]:
    """Return what earlier processes have parsed; nothing if the file is missing, damaged or of another version."""
    known: dict[str, _Parsed] = {}
    with suppress(OSError, ValueError, RuntimeError):
        parser, kept = json.loads(checked_body(_kept_place().read_bytes()))
        known = dict(kept) if parser == _parser() else {}
    _kept_counts.append(len(known))
    return known


def _keep_parsed() -> None:
    """Write what this process has parsed."""
    known = _known_parsed()
    if len(known) > _kept_counts[-1]:
        _kept_counts.append(len(known))
        with suppress(StoreError, OSError, RuntimeError):  # a user without a home
            place, body = _kept_place(), json.dumps([_parser(), dict(list(known.items())[-4000:])])
            write_checked(place, body.encode(), temporary_in=place.parent)
            for other in children(place.parent, "*.json"):
                if time.time() - other.stat().st_mtime > _FORGOTTEN_S:
                    other.unlink(missing_ok=True)


_FORGOTTEN_S = 60 * 24 * 3600.0  # after which what a version has parsed is removed; it can be parsed again
_kept_counts: list[int] = []
