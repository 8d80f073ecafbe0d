"""The installed versions of the libraries on which results depend."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, packages_distributions, version

_DISTRIBUTIONS: Mapping[str, tuple[str, ...]] = {
    "cv2": ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python"),
    "PIL": ("pillow",),
}
_SHOWN_AS = {"cv2": "OpenCV"}
_WITHOUT_INFLUENCE = frozenset(
    {
        "pydantic",  # settings count by their values
        "pillow_heif",  # reads HEIC alone, and OpenEXR reads EXR: to add or update one must not cost all other captures
        "OpenEXR",
        "typing_extensions",
    }
)


def library_versions(modules: Iterable[str]) -> dict[str, str]:
    """Return the version of each library that counts, by the name under which it is shown.

    Args:
        modules: top-level names of the modules that are imported.
    """
    counted = sorted(set(modules) - _WITHOUT_INFLUENCE)
    return {_SHOWN_AS.get(module, module): _version(module) for module in counted}


@cache
def _version(module: str) -> str:
    """Return the version of the distribution that a module comes from, found by name where that is possible: faster."""
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
