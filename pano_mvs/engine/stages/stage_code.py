"""The code and the libraries that a stage uses, as they count towards the cache keys of its units."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from pathlib import Path, PurePath

import pano_mvs
from pano_mvs.core.digest import digest_from_bytes, digest_from_value
from pano_mvs.core.errors import StoreError
from pano_mvs.core.files import write_text
from pano_mvs.core.kernel_cache import user_cache_folder
from pano_mvs.core.paths import below, is_folder
from pano_mvs.engine.code.plugin_digest import code_digest, code_texts
from pano_mvs.engine.code.reach import CodeGraph, Reach
from pano_mvs.engine.stages.params import Params, registered_files
from pano_mvs.engine.stages.stage import StageSpec

_OURS = pano_mvs.__name__
_OUR_ROOT = Path(pano_mvs.__file__).parent
_LEFT_OUT = (
    *(f"{_OURS}.{name}" for name in ("cli", "report", "viewer")),  # show results, but make none
    f"{_OURS}.engine",  # counts by planning.resolve.KEY_SCHEMA, which is raised by hand
    f"{_OURS}.core.kernel_cache",  # affects only speed
)
_KEPT = (f"{_OURS}.engine.stages.context",)
_DISTRIBUTIONS: Mapping[str, tuple[str, ...]] = {
    "cv2": ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python"),
    "PIL": ("pillow",),
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


@dataclass(frozen=True, slots=True)
class StageCode:
    """What the results of a stage depend on beside its settings and inputs."""

    digest: str  # of the code that the stage reaches
    libraries: Mapping[str, str]  # name to version of the libraries that this code uses


def stage_code(spec: StageSpec, params: Params) -> StageCode:
    """Return the code of a stage with given settings, which may hold names that plugins registered.

    For a built-in stage, or one of an installed package, this is every function, class and constant of its package and
    of pano_mvs that it reaches. For a plugin file, it is the whole file and the files beside it that it imports.
    """
    if spec.code_digest:
        reached = [_code_of_file(Path(str(sys.modules[spec.function.__module__].__file__)), spec.code_digest)]
    else:
        reached = [_code_in_package(spec.function.__module__, spec.function.__qualname__)]
    digests: dict[str, str] = {"": reached[0][0]}
    for setting, path in registered_files(params).items():
        reached.append(_code_of_file(path, code_digest(path)))
        digests[setting] = reached[-1][0]
    libraries = library_versions(name for _, names in reached for name in names)
    return StageCode(digest_from_value(digests) if len(digests) > 1 else digests[""], libraries)


def reach_of_function(module: str, name: str, graph: CodeGraph) -> Reach:
    """Return what a function reaches, including the kinds and settings in its annotations.

    Args:
        module: dotted name of its module.
        name: its qualified name there.
    """
    if "." in name:
        # It is made by another function with unknown arguments: its whole package counts.
        return graph.reach_of([f"{module}:", f"{module.partition('.')[0]}:"])
    return graph.reach_of([f"{module}:{name}"])


def code_graph(packages: Mapping[str, Path], texts: Mapping[str, tuple[str, bool]] | None = None) -> CodeGraph:
    """Return the graph of some packages, without the code that only shows results or runs stages."""
    return CodeGraph(packages, texts=texts, left_out=_LEFT_OUT, kept=_KEPT)


def library_versions(modules: Iterable[str]) -> dict[str, str]:
    """Return the version of each library that affects results, by its display name.

    Args:
        modules: top-level names of the imported modules.
    """
    return {_SHOWN_AS.get(module, module): _version(module) for module in sorted(set(modules) - _IGNORED)}


@cache
def _version(module: str) -> str:
    """Return the version of the distribution of a module; tries the module's name first, which is faster."""
    for names in (lambda: _DISTRIBUTIONS.get(module, (module,)), lambda: packages_distributions().get(module, ())):
        found = []
        for name in names():
            with suppress(PackageNotFoundError):
                found.append(version(name))
        if found:
            return " and ".join(dict.fromkeys(found))
    return "not installed"


_Code = tuple[str, tuple[str, ...]]  # a digest, and the libraries that the code uses


@cache
def _code_in_package(module: str, name: str) -> _Code:
    top = module.partition(".")[0]
    root = _root_of(top)
    if root is None:  # compiled, or entered interactively: only its version is known
        return "", (top,)
    return _known(root, [module, name], lambda: reach_of_function(module, name, _graph_of(top, root)))


@cache
def _code_of_file(path: Path, digest: str) -> _Code:
    """Return what a plugin file reaches in pano_mvs, with a digest that includes its own code."""
    texts = {_module_name(name): (text, name.endswith("__init__.py")) for name, text in code_texts(path)[1].items()}

    def reach() -> Reach:
        return code_graph({_OURS: _OUR_ROOT}, texts).reach_of([f"{name}:" for name in texts])

    reached, libraries = _known(_OUR_ROOT, [digest, {name: list(text) for name, text in texts.items()}], reach)
    return digest_from_value([digest, reached]), libraries


def _module_name(name: str) -> str:
    parts = PurePath(name).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


def _known(root: Path, what: object, reach: Callable[[], Reach]) -> _Code:
    """Return what `reach` finds, from the user's cache if no file of the package has changed since.

    Hashing all files takes a twentieth of a second, and following names some seconds.
    """
    sources, key = _sources_of(root), digest_from_value(what)
    try:
        place = user_cache_folder() / "pano-mvs" / "code" / f"{root.stem}-{digest_from_value(str(root))[:16]}.json"
    except (OSError, RuntimeError):  # a user without a home
        place = None
    codes = {} if place is None else _codes_in(place, sources)
    if key not in codes:
        found = reach()
        codes = _codes_in(place, sources) if place is not None else {}  # others may have added theirs meanwhile
        codes[key] = found.digest, sorted(found.libraries)
        with suppress(StoreError):
            if place is not None:
                write_text(place, json.dumps({"sources": sources, "codes": codes}))
    digest, libraries = codes[key]
    return digest, tuple(libraries)


def _codes_in(place: Path, sources: str) -> dict[str, tuple[str, list[str]]]:
    """Return what a file says about code with these sources; nothing if it is missing or damaged."""
    try:
        kept = json.loads(place.read_bytes())
        found = kept["codes"] if kept["sources"] == sources else {}
        return {str(key): (str(digest), list(map(str, libraries))) for key, (digest, libraries) in found.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {}


@cache
def _sources_of(root: Path) -> str:
    """Return the digest of the source of a package and of pano_mvs, and of the version of Python, which parses them."""
    files = {path for top in (root, _OUR_ROOT) for path in ([top] if top.suffix == ".py" else below(top, "*.py"))}
    return digest_from_value([sys.version, {str(path): digest_from_bytes(path.read_bytes()) for path in files}])


@cache
def _graph_of(top: str, root: Path) -> CodeGraph:
    return code_graph({top: root, _OURS: _OUR_ROOT})


def _root_of(top: str) -> Path | None:
    """Return the folder of a loaded package, or the file of a loaded module."""
    module = sys.modules.get(top)
    folders = list(getattr(module, "__path__", ()))
    file = str(folders[0]) if folders else str(getattr(module, "__file__", None) or "")
    path = Path(file)
    return path if file and (is_folder(path) if folders else path.suffix == ".py") else None
