"""Which packages are installed, against what the program's own metadata ask for."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import PackageNotFoundError, requires, version

from pano_mvs.cli.doctor.finding import Finding

DISTRIBUTION = "pano-mvs"
_NAME, _LEAST = re.compile(r"[A-Za-z0-9._-]+"), re.compile(r">=\s*([0-9.]+)")
_EXTRA = re.compile(r"extra\s*==\s*['\"]([\w-]+)")
_FOR_DEVELOPERS = frozenset({"dev", "docs"})
_USES = {"dask": "--executor dask", "heic": "HEIC pictures", "exr": "OpenEXR files"}
_OPENCV = ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python")

VersionOf = Callable[[str], str | None]


def installed_version(name: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def package_findings(
    requirements: Sequence[str] | None = None, version_of: VersionOf = installed_version
) -> Iterator[Finding]:
    """Yield how each package that the program needs, and each extra, is installed.

    Args:
        requirements: as in the metadata of a distribution; by default the program's own.
        version_of: finds the version of a distribution.
    """
    yield Finding("packages", "Python", "ok", sys.version.split()[0])
    if requirements is None:
        requirements = requires(DISTRIBUTION) or [] if installed_version(DISTRIBUTION) else None
    if requirements is None:
        remedy = "pip install pano-mvs, or pip install . in the checkout: stages are found through that"
        yield Finding("packages", DISTRIBUTION, "warning", "runs from a folder, without being installed", remedy)
        return
    extras: dict[str, list[tuple[str, str]]] = {}
    for name, least, extra in filter(None, map(_parsed, requirements)):
        if extra:
            extras.setdefault(extra, []).append((name, least))
        else:
            yield _required(name, least, version_of)
    yield from _opencv_twice(version_of)
    for extra, needed in extras.items():
        if extra not in _FOR_DEVELOPERS:
            yield _extra(extra, needed, version_of)


def is_older(found: str, least: str) -> bool:
    """Return whether a version lies before another; what follows the numbers (rc1, .post2) is not looked at."""
    return _numbers(found) < _numbers(least)


def _numbers(text: str) -> list[int]:
    leading = re.match(r"\d+(?:\.\d+)*", text)
    numbers = [int(number) for number in leading[0].split(".")] if leading else []
    return [*numbers, *[0] * (4 - len(numbers))]


def _parsed(requirement: str) -> tuple[str, str, str] | None:
    """Return a requirement's name, its lower bound and the extra that it belongs to; None for other systems' alone."""
    wanted, _, marker = requirement.partition(";")
    name, least, extra = _NAME.match(wanted), _LEAST.search(wanted), _EXTRA.search(marker)
    if name is None or (marker.strip() and extra is None):
        return None
    return name[0], least[1] if least else "", extra[1] if extra else ""


def _required(name: str, least: str, version_of: VersionOf) -> Finding:
    found = version_of(name)
    wanted = f"{name}>={least}" if least else name
    if found is None and name in _OPENCV:
        other = next((other for other in _OPENCV if version_of(other)), None)
        if other is not None:
            return Finding("packages", name, "ok", f"{other} {version_of(other)} in its place")
    if found is None:
        return Finding("packages", name, "failed", "is not installed", f"pip install '{wanted}'")
    if least and is_older(found, least):
        return Finding("packages", name, "failed", f"{found}; {least} or newer is needed", f"pip install -U '{wanted}'")
    return Finding("packages", name, "ok", found)


def _opencv_twice(version_of: VersionOf) -> Iterator[Finding]:
    found = [name for name in _OPENCV if version_of(name)]
    if len(found) > 1:
        shown = f"installed more than once ({', '.join(found)}): their files lie over each other"
        remedy = f"pip uninstall {' '.join(found)}; pip install opencv-python-headless"
        yield Finding("packages", "OpenCV", "warning", shown, remedy)


def _extra(extra: str, needed: Sequence[tuple[str, str]], version_of: VersionOf) -> Finding:
    what = f"extra {extra}"
    remedy = f"pip install 'pano-mvs[{extra}]'"
    shown = []
    for name, least in needed:
        found = version_of(name)
        if found is None:
            return Finding("packages", what, "note", f"not installed; for {_USES.get(extra, extra)}", remedy)
        if least and is_older(found, least):
            return Finding("packages", what, "warning", f"{name} {found}; {least} or newer is needed", remedy)
        shown.append(f"{name} {found}")
    return Finding("packages", what, "ok", ", ".join(shown))
