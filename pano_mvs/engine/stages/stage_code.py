"""The code and the libraries that a stage uses, as they count towards the cache keys of its units."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePath

import pano_mvs
from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.kernel_cache import user_cache_folder
from pano_mvs.core.paths import is_folder
from pano_mvs.engine.code.libraries import library_versions
from pano_mvs.engine.code.plugin_digest import code_digest, code_texts
from pano_mvs.engine.code.reach import CodeGraph, Reach
from pano_mvs.engine.code.sources import Sources
from pano_mvs.engine.code.summary import summarize_module
from pano_mvs.engine.stages.params import Params, registered_files
from pano_mvs.engine.stages.stage import StageSpec

_OURS = pano_mvs.__name__
_LEFT_OUT = (
    *(f"{_OURS}.{name}" for name in ("cli", "report", "viewer")),  # show results, but make none
    f"{_OURS}.engine",  # counts by planning.resolve.KEY_SCHEMA, which is raised by hand
    f"{_OURS}.core.kernel_cache",  # affects only speed
)
_KEPT = (f"{_OURS}.engine.stages.context",)


@dataclass(frozen=True, slots=True)
class StageCode:
    """What the results of a stage depend on beside its settings and inputs.

    Attributes:
        digest: of the code that the stage reaches.
        libraries: name to version of the libraries that this code uses.
    """

    digest: str
    libraries: Mapping[str, str]


def stage_code(spec: StageSpec, params: Params) -> StageCode:
    """Return the code of a stage with given settings, which may hold names that plugins registered.

    For a built-in stage, or one of an installed package, this is every function, class and constant of its package and
    of pano_mvs that it reaches. For a plugin file, it is the whole file and the files beside it that it imports.
    """
    if spec.code_digest:
        reached = [_reach_of_file(Path(str(sys.modules[spec.function.__module__].__file__)), spec.code_digest)]
    else:
        reached = [_reach_in_package(spec.function.__module__, spec.function.__qualname__)]
    digests: dict[str, str] = {"": reached[0].digest}
    for setting, path in registered_files(params).items():
        reached.append(_reach_of_file(path, code_digest(path)))
        digests[setting] = reached[-1].digest
    libraries = library_versions(name for one in reached for name in one.libraries)
    return StageCode(digest_from_value(digests) if len(digests) > 1 else digests[""], libraries)


def reach_of_function(module: str, name: str, graph: CodeGraph) -> Reach:
    """Return what a function reaches, including the kinds and settings in its annotations.

    Args:
        module: dotted name of its module.
        name: its qualified name there.
        graph: of its package and pano_mvs.
    """
    if "." in name:
        # It is made by another function with unknown arguments: its whole package counts.
        return graph.reach_of([f"{module}:", f"{module.partition('.')[0]}:"], with_annotations=True)
    return graph.reach_of([f"{module}:{name}"], with_annotations=True)


def code_graph(sources: Sources) -> CodeGraph:
    """Return the graph of some packages, without the code that only shows results or runs stages."""
    return CodeGraph(sources, left_out=_LEFT_OUT, kept=_KEPT)


@cache
def _reach_in_package(module: str, name: str) -> Reach:
    top = module.partition(".")[0]
    root = _root_of(top)
    if root is None:  # compiled, or entered interactively: only its version is known
        return Reach("", {}, frozenset({top}))
    graph = _graph_of(top, root)
    reach = reach_of_function(module, name, graph)
    graph.sources.save()
    return reach


@cache
def _reach_of_file(path: Path, digest: str) -> Reach:
    """Return what a plugin file reaches in pano_mvs, with a digest that includes its own code."""
    _, texts = code_texts(path)
    modules = {_module_name(name): (text, name.endswith("__init__.py")) for name, text in texts.items()}
    own = {name: summarize_module(text, name, is_package=is_package) for name, (text, is_package) in modules.items()}
    graph = _graph_of(_OURS, _our_root())
    reach = graph.with_modules(own).reach_of([f"{name}:" for name in own], with_annotations=True)
    graph.sources.save()
    return Reach(digest_from_value([digest, reach.digest]), reach.definitions, reach.libraries)


def _module_name(name: str) -> str:
    parts = PurePath(name).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


@cache
def _graph_of(top: str, root: Path) -> CodeGraph:
    return code_graph(Sources({top: root, _OURS: _our_root()}, _kept_in()))


def _our_root() -> Path:
    return Path(pano_mvs.__file__).parent


def _root_of(top: str) -> Path | None:
    """Return the folder of a loaded package, or the file of a loaded module."""
    module = sys.modules.get(top)
    folders = list(getattr(module, "__path__", ()))
    file = str(folders[0]) if folders else str(getattr(module, "__file__", None) or "")
    path = Path(file)
    return path if file and (is_folder(path) if folders else path.suffix == ".py") else None


def _kept_in() -> Path | None:
    try:
        return user_cache_folder() / "pano-mvs" / "code"
    except (OSError, RuntimeError):  # a user without a home
        return None
