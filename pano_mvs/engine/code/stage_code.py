"""What of the code and of the libraries that a stage uses counts towards the keys of its units."""

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
from pano_mvs.engine.stages.params import Params, part_files
from pano_mvs.engine.stages.stage import StageSpec

_OURS = pano_mvs.__name__
_LEFT_OUT = (
    *(f"{_OURS}.{name}" for name in ("cli", "report", "viewer")),  # show results, and make none
    f"{_OURS}.engine",  # its own part in a key is raised by hand: resolve.KEY_SCHEMA
    f"{_OURS}.core.kernel_cache",  # a matter of speed
)
_KEPT = (f"{_OURS}.engine.stages.context",)


@dataclass(frozen=True, slots=True)
class StageCode:
    """What a stage's results depend on beside its settings and inputs.

    Attributes:
        digest: of the code that it reaches.
        libraries: versions of the libraries that this code uses, by name.
    """

    digest: str
    libraries: Mapping[str, str]


def stage_code(spec: StageSpec, params: Params) -> StageCode:
    """Return the code of a stage with those settings: they may name parts that plugins have added.

    A built-in stage, or one of an installed package, counts with each function, class and constant of its package and
    of ours that it reaches. A plugin file counts whole, with the files beside it that it imports.
    """
    if spec.code_digest:
        reached = [_reach_of_file(Path(str(sys.modules[spec.function.__module__].__file__)), spec.code_digest)]
    else:
        reached = [_reach_in_package(spec.function.__module__, spec.function.__qualname__)]
    digests: dict[str, str] = {"": reached[0].digest}
    for setting, path in part_files(params).items():
        reached.append(_reach_of_file(path, code_digest(path)))
        digests[setting] = reached[-1].digest
    libraries = library_versions(name for one in reached for name in one.libraries)
    return StageCode(digest_from_value(digests) if len(digests) > 1 else digests[""], libraries)


def reach_of_function(module: str, name: str, graph: CodeGraph) -> Reach:
    """Return what a function reaches, with the kinds and settings that its annotations name.

    Args:
        module: dotted name of its module.
        name: its qualified name there.
        graph: of its package and ours.
    """
    if "." in name:
        # Made by another function, with arguments from who knows where: all that is near it counts.
        return graph.reach_of([f"{module}:", f"{module.partition('.')[0]}:"], with_annotations=True)
    return graph.reach_of([f"{module}:{name}"], with_annotations=True)


def code_graph(sources: Sources) -> CodeGraph:
    """Return the graph of some packages, ours among them, without what only shows results or drives stages."""
    return CodeGraph(sources, left_out=_LEFT_OUT, kept=_KEPT)


@cache
def _reach_in_package(module: str, name: str) -> Reach:
    top = module.partition(".")[0]
    root = _root_of(top)
    if root is None:  # compiled, or typed in somewhere: its version is all that is known of it
        return Reach("", {}, frozenset({top}))
    graph = _graph_of(top, root)
    reach = reach_of_function(module, name, graph)
    graph.sources.save()
    return reach


@cache
def _reach_of_file(path: Path, digest: str) -> Reach:
    """Return what a plugin file reaches in our package, with the digest of its own code."""
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
    """Return the folder of a package that is loaded, or the file of a module."""
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
