"""Check the packages, the plugins, the machine, and the folders that a run writes to."""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from importlib.metadata import requires
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from pano_mvs.core.extras import installed_version
from pano_mvs.core.kernel_cache import PACKAGE, kernel_cache_folder
from pano_mvs.core.kernel_cache import VARIABLE as KERNEL_VARIABLE
from pano_mvs.core.memory import free_memory_bytes, size_text
from pano_mvs.core.paths import below, children, is_folder
from pano_mvs.core.plugin_folders import PLUGINS_VARIABLE, plugin_files_in, user_plugin_folders
from pano_mvs.core.text import plural
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.stages.registry import Plugin, PluginProblem, Registry
from pano_mvs.results.summary import CACHE_VARIABLE

State: TypeAlias = Literal["ok", "note", "warning", "failed"]
"""`note`: nothing is wrong. `warning`: something is slower or missing. `failed`: a run cannot work."""


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check."""

    group: str  # packages, libraries, machine, disk or plugins
    what: str
    state: State
    detail: str
    remedy: str = ""  # what to do; given with every warning and failure


KNOWN_VARIABLES = (
    *(CACHE_VARIABLE, PLUGINS_VARIABLE, "PANO_MVS_EXECUTOR", "PANO_MVS_MIN_FREE", "PANO_MVS_ENVIRONMENTS"),
    "PANO_MVS_WORKER",  # marks what a worker starts
)


def machine_findings(environment: Mapping[str, str] = os.environ) -> Iterator[Finding]:
    """Yield the processors, the memory, and the environment variables that limit a run or that nothing reads."""
    threads = available_threads()
    yield Finding(
        "machine", "processors", "ok", f"{threads} of {os.cpu_count() or threads} may be used by this process"
    )
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        value = environment.get(name, "")
        if value.isdigit() and 0 < int(value) < threads:
            yield Finding("machine", name, "warning", f"limits threads to {value} of {threads}", f"unset {name}")
    free = free_memory_bytes()
    if free and free < 3_000_000_000:
        remedy = "close other programs, or set a smaller images.max_width: a sweep of 2048 px takes up to 3 GB"
        yield Finding("machine", "memory", "warning", f"{size_text(free)} free", remedy)
    else:
        yield Finding("machine", "memory", "ok", f"{size_text(free)} free" if free else "not known")
    for name in sorted(environment):
        if name.startswith(("PANO_MVS", "PANOMVS")) and name not in KNOWN_VARIABLES:
            close = get_close_matches(name, KNOWN_VARIABLES, n=1, cutoff=0.6)
            remedy = f"did you mean {close[0]}?" if close else f"unset it; known are {', '.join(KNOWN_VARIABLES)}"
            yield Finding("machine", name, "warning", "is set, but nothing reads it", remedy)


def kernel_cache_finding(package: Path = PACKAGE, environment: Mapping[str, str] = os.environ) -> Finding:
    """Return whether compiled kernels can be cached; otherwise every process compiles them again."""
    chosen = environment.get(KERNEL_VARIABLE)
    try:
        folder = Path(chosen) if chosen else kernel_cache_folder(package)
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".doctor-{os.getpid()}"
        probe.write_bytes(b"")
        probe.unlink()
    except (OSError, RuntimeError) as error:
        detail = f"cannot be cached ({error}): every process compiles them again"
        return Finding(
            "machine", "compiled kernels", "warning", detail, f"set {KERNEL_VARIABLE} to a folder that is writable"
        )
    count = len(below(folder, "*.nbc"))
    first = f"none yet in {folder}: the first run compiles them in a minute or two"
    return Finding("machine", "compiled kernels", "ok", f"{count} in {folder}" if count else first)


def folder_finding(what: str, folder: Path, option: str) -> Finding:
    """Return whether a folder, which need not exist, can be written, and how much space its disk has.

    Args:
        what: the use of the folder: "cache" or "results".
        option: the command line option that chooses another one.
    """
    finding = partial(Finding, "disk", what)
    path = folder.absolute()
    existing = next((place for place in (path, *path.parents) if os.path.lexists(place)), folder)
    if not is_folder(existing):
        return finding("failed", f"{folder}: {existing} is not a folder", f"choose another with {option}")
    try:
        with tempfile.TemporaryDirectory(dir=existing, prefix=".pano-mvs-doctor-") as name:
            old, new = Path(name, "old"), Path(name, "new")
            old.write_bytes(b"old")
            new.write_bytes(b"new")
            new.replace(old)
        free = shutil.disk_usage(existing).free
    except OSError as error:
        detail = f"{folder} cannot be written: {error.strerror or error}"
        return finding("failed", detail, f"correct its permissions, or choose another folder with {option}")
    text = f"{folder}: {size_text(free)} free"
    remedy = f"free space, or choose another folder with {option}; a panorama of 2048 px takes about 60 MB in the cache"
    return finding("ok", text) if free >= 5_000_000_000 else finding("warning", text, remedy)


VersionOf: TypeAlias = Callable[[str], str | None]

_DISTRIBUTION = "pano-mvs"
_EXTRAS_FOR_DEVELOPERS = frozenset({"dev", "docs"})
_USES = {
    "dask": "--executor dask",
    "crate": "crate",
    "queues": "--executor slurm",
    "notify": "--notify",
    "otel": "--otel",
    "heic": "HEIC images",
    "exr": "OpenEXR files",
    "remote": "cache push and pull",
}
_OPENCV = ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python")


class _Requirement(NamedTuple):
    name: str
    minimum: str
    extra: str


def package_findings(
    requirements: Sequence[str] | None = None, version_of: VersionOf = installed_version
) -> Iterator[Finding]:
    """Yield the state of each required package and of each extra.

    Args:
        requirements: requirements as in a distribution's metadata; by default the program's own.
    """
    yield Finding("packages", "Python", "ok", sys.version.split()[0])
    if requirements is None and not installed_version(_DISTRIBUTION):
        remedy = "pip install pano-mvs, or pip install . in the checkout: stages are found through the installation"
        yield Finding("packages", _DISTRIBUTION, "warning", "runs from a folder, without being installed", remedy)
        return
    needed = [_parsed(text) for text in (requires(_DISTRIBUTION) or [] if requirements is None else requirements)]
    parsed = [requirement for requirement in needed if requirement is not None]
    for requirement in parsed:
        name = requirement.name
        if not requirement.extra:
            state, detail = _state([requirement], version_of)
            remedy = "" if state == "ok" else f"pip install -U {name}"
            yield Finding(
                "packages", name, "ok" if state == "ok" else "failed", detail.removeprefix(f"{name} "), remedy
            )
    opencv = [name for name in _OPENCV if version_of(name)]
    if len(opencv) > 1:
        detail = f"installed more than once ({', '.join(opencv)}): the packages overwrite each other's files"
        remedy = f"pip uninstall {' '.join(opencv)}; pip install opencv-python-headless"
        yield Finding("packages", "OpenCV", "warning", detail, remedy)
    for extra in dict.fromkeys(requirement.extra for requirement in parsed):
        if extra and extra not in _EXTRAS_FOR_DEVELOPERS:
            state, detail = _state([requirement for requirement in parsed if requirement.extra == extra], version_of)
            detail = f"{detail}; for {_USES.get(extra, extra)}" if state == "note" else detail
            remedy = "" if state == "ok" else f"pip install -U 'pano-mvs[{extra}]'"
            yield Finding("packages", f"extra {extra}", "warning" if state == "failed" else state, detail, remedy)


def is_older(found: str, minimum: str) -> bool:
    """Return whether a version is older than another; suffixes of the numbers (rc1, .post2) are ignored."""
    return _numbers(found) < _numbers(minimum)


def _numbers(text: str) -> list[int]:
    leading = re.match(r"\d+(?:\.\d+)*", text)
    numbers = [int(number) for number in leading[0].split(".")] if leading else []
    return [*numbers, *[0] * (4 - len(numbers))]


def _parsed(text: str) -> _Requirement | None:
    """Return a requirement, or None if it is only for other systems."""
    wanted, _, marker = text.partition(";")
    name, minimum = re.match(r"[A-Za-z0-9._-]+", wanted), re.search(r">=\s*([0-9.]+)", wanted)
    extra = re.search(r"extra\s*==\s*['\"]([\w-]+)", marker)
    if name is None or (marker.strip() and extra is None):
        return None
    return _Requirement(name[0], minimum[1] if minimum else "", extra[1] if extra else "")


def _state(needed: Sequence[_Requirement], version_of: VersionOf) -> tuple[State, str]:
    """Return the state of required packages: ok with their versions, or what is missing or too old."""
    versions = []
    for name, minimum, _ in needed:
        used = next((other for other in (name, *_OPENCV) if version_of(other)), name) if name in _OPENCV else name
        found = version_of(used)
        if found is None:
            return "note", f"{name} is not installed"
        if is_older(found, minimum):
            return "failed", f"{used} {found}; {minimum} or newer is needed"
        versions.append(f"{used} {found}")
    return "ok", ", ".join(versions)


def environment_finding(plugin: Plugin, problem: PluginProblem | None) -> Finding:
    """Return whether the stages of a plugin can be computed in its own environment."""
    if problem is not None:
        return Finding("plugins", plugin.origin, "warning", problem.text, problem.remedy)
    count = len(plugin.names)
    detail = f"{count} {plural(count, 'stage')} in an environment of its own, {plugin.environment}"
    return Finding("plugins", plugin.origin, "ok", detail)


_BUILTIN = "source.folder"
_REINSTALL = "pip install --force-reinstall pano-mvs"


def plugin_findings(
    registry: Registry, presets: Path, environment: Mapping[str, str] = os.environ
) -> Iterator[Finding]:
    """Yield the state of the stages, the presets, the plugins and the folders of plugins."""
    if _BUILTIN in registry.stages:
        count = len(registry.plugins)
        origins = f"{count} {plural(count, 'package or file', 'packages and files')}"
        yield Finding("plugins", "stages", "ok", f"{len(registry.stages)}, from {origins}")
    else:
        remedy = f"{_REINSTALL}, or pip install -e . in a checkout"
        yield Finding("plugins", "stages", "failed", "the built-in stages are not registered", remedy)
    workflows = [path.stem for path in children(presets, "*.yaml")]
    if "quickstart" in workflows:
        yield Finding("plugins", "presets", "ok", ", ".join(workflows))
    else:
        yield Finding("plugins", "presets", "failed", f"no workflows in {presets}", _REINSTALL)
    for plugin in registry.plugins:
        if plugin.check is not None:
            yield environment_finding(plugin, plugin.check())
        elif plugin.error:
            remedy = "correct or remove it; `pano-mvs plugins` shows more"
            yield Finding("plugins", plugin.origin, "warning", f"failed to load: {plugin.error}", remedy)
    for (kind, name), why in registry.clashes.items():
        yield Finding("plugins", f"{kind} {name}", "warning", why, "it cannot be used until this is resolved")
    for folder in user_plugin_folders(environment):
        files = len(plugin_files_in(folder))
        if is_folder(folder):
            yield Finding("plugins", str(folder), "ok" if files else "note", f"{files} plugin {plural(files, 'file')}")
        elif PLUGINS_VARIABLE in environment:  # the default folder is optional
            yield Finding(
                "plugins", PLUGINS_VARIABLE, "warning", f"{folder} is not a folder", f"correct {PLUGINS_VARIABLE}"
            )
