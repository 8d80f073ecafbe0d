"""Results as a few numbers that are the same on every machine but for small differences, and how they compare."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene import FilePart, Record
from tests.stored import read_picture

Summary = dict[str, Any]
"""Name to a list of numbers, the count first, or to a text."""

TOLERANCE = 0.03
"""By how much counts, and statistics in units of their spread, may differ between machines."""

_PICTURES = {".png", ".jpg", ".tiff", ".tif"}
_TEXTS = {".json", ".txt", ".csv", ".xml", ".cfg"}
_NUMBER = re.compile(r"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def summary_of(value: Record, metrics: Mapping[str, float]) -> Summary:
    """Return what a stage made, in a few numbers."""
    found: Summary = {"metrics": [float(f"{metrics[name]:.5g}") for name in sorted(metrics)]}
    for name, part in sorted(value.to_parts().items()):
        if isinstance(part, FilePart):
            found |= _of_file(name, part.path)
        elif isinstance(part, np.ndarray):
            found[name] = _of_array(part)
        else:
            leaves = list(_leaves(part))
            found[name] = _of_array(np.array([leaf for leaf in leaves if not isinstance(leaf, str)], np.float64))
            found[f"{name} texts"] = [sum(isinstance(leaf, str) for leaf in leaves)]
    return found


def _of_file(name: str, path: Path) -> Summary:
    if path.suffix in _PICTURES:
        picture = read_picture(path, cv2.IMREAD_UNCHANGED)
        assert picture is not None, path
        return {name: _of_array(picture)}
    data = path.read_bytes()
    if path.suffix in _TEXTS:
        numbers = [float(number) for number in _NUMBER.findall(data.decode())]
        return {name: _of_array(np.array(numbers, np.float64))}
    return {name: [len(data)]}


def _of_array(array: NDArray[Any]) -> list[float]:
    """Return how many values there are, how many of them are finite, and quantiles of those."""
    values = np.asarray(array, np.float64).ravel()
    finite = values[np.isfinite(values)]
    quantiles = np.quantile(finite, _QUANTILES) if len(finite) else np.full(len(_QUANTILES), 0.0)
    mean = finite.mean() if len(finite) else 0.0
    return [len(values), len(finite), *(float(f"{value:.5g}") for value in (mean, *quantiles))]


def _leaves(value: Any) -> Iterator[Any]:
    value = json.loads(json.dumps(value, default=str)) if not isinstance(value, list | dict) else value
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield str(name)
            yield from _leaves(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _leaves(inner)
    elif value is not None:
        yield float(value) if isinstance(value, int | float) else str(value)


def differences(before: Summary, now: Summary) -> list[str]:
    """Return what differs between two summaries by more than machines do, in words."""
    return [
        f"{name}: {before.get(name)} → {now.get(name)}"
        for name in sorted({*before, *now})
        if not _alike(before.get(name), now.get(name))
    ]


def _alike(before: Any, now: Any) -> bool:
    if not isinstance(before, list) or not isinstance(now, list) or len(before) != len(now):
        return bool(before == now)
    # The quantiles of an array are compared by how far they lie apart, counts and single figures by their size.
    spread = max(before[-1] - before[-len(_QUANTILES)], 0.0) if len(before) == len(_QUANTILES) + 3 else 0.0
    return all(
        abs(new - old) <= TOLERANCE * max(abs(old), spread) + (2 if idx < 2 and spread else 1e-6)
        for idx, (old, new) in enumerate(zip(before, now, strict=True))
    )
