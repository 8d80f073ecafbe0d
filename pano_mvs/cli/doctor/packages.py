"""Compare the installed packages with the requirements in the program's own metadata."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.metadata import PackageNotFoundError, requires, version
from typing import NamedTuple, TypeAlias

from pano_mvs.cli.doctor.finding import Finding, State

VersionOf: TypeAlias = Callable[[str], str | None]

_DISTRIBUTION = "pano-mvs"
_EXTRAS_FOR_DEVELOPERS = frozenset({"dev", "docs"})
_USES = {"dask": "--executor dask", "heic": "HEIC images", "exr": "OpenEXR files", "remote": "cache push and pull"}
_OPENCV = ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python")
_finding = partial(Finding, "packages")


class _Requirement(NamedTuple):
    name: str
    minimum: str
    extra: str


def installed_version(name: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def package_findings(
    requirements: Sequence[str] | None = None, version_of: VersionOf = installed_version
) -> Iterator[Finding]:
    """Yield the state of each required package and of each extra.

    Args:
        requirements: requirements as in a distribution's metadata; by default the program's own.
        version_of: returns the version of a distribution.
    """
    yield _finding("Python", "ok", sys.version.split()[0])
    if requirements is None and not installed_version(_DISTRIBUTION):
        remedy = "pip install pano-mvs, or pip install . in the checkout: stages are found through the installation"
        yield _finding(_DISTRIBUTION, "warning", "runs from a folder, without being installed", remedy)
        return
    needed = [_parsed(text) for text in (requires(_DISTRIBUTION) or [] if requirements is None else requirements)]
    parsed = [requirement for requirement in needed if requirement is not None]
    for requirement in parsed:
        name = requirement.name
        if not requirement.extra:
            state, detail = _state([requirement], version_of)
            remedy = "" if state == "ok" else f"pip install -U {name}"
            yield _finding(name, "ok" if state == "ok" else "failed", detail.removeprefix(f"{name} "), remedy)
    opencv = [name for name in _OPENCV if version_of(name)]
    if len(opencv) > 1:
        detail = f"installed more than once ({', '.join(opencv)}): the packages overwrite each other's files"
        remedy = f"pip uninstall {' '.join(opencv)}; pip install opencv-python-headless"
        yield _finding("OpenCV", "warning", detail, remedy)
    for extra in dict.fromkeys(requirement.extra for requirement in parsed):
        if extra and extra not in _EXTRAS_FOR_DEVELOPERS:
            state, detail = _state([requirement for requirement in parsed if requirement.extra == extra], version_of)
            detail = f"{detail}; for {_USES.get(extra, extra)}" if state == "note" else detail
            remedy = "" if state == "ok" else f"pip install -U 'pano-mvs[{extra}]'"
            yield _finding(f"extra {extra}", "warning" if state == "failed" else state, detail, remedy)


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
