"""The installed versions of the libraries that results depend on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version

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


def library_versions(modules: Iterable[str]) -> dict[str, str]:
    """Return the version of each library that affects results, by its display name.

    Args:
        modules: top-level names of the imported modules.
    """
    counted = sorted(set(modules) - _IGNORED)
    return {_SHOWN_AS.get(module, module): _version(module) for module in counted}


@cache
def _version(module: str) -> str:
    """Return the version of the distribution of a module; tries the module's name first, which is faster."""
    for names in _candidates(module):
        found = [one for name in names if (one := _version_of(name))]
        if found:
            return " and ".join(dict.fromkeys(found))
    return "not installed"


def _version_of(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return ""


def _candidates(module: str) -> Iterator[Sequence[str]]:
    yield _DISTRIBUTIONS.get(module, (module,))
    yield packages_distributions().get(module, ())
