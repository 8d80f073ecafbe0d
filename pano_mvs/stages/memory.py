"""Memory needs of stages on range maps, as measured by `python -m tests.benchmarks.engine.stage_memory`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pano_mvs.api import Params


def bytes_per_pixel(own: int, *, each_source: int = 0) -> Callable[[Params, Mapping[str, Any]], int]:
    """Return a function that computes the memory of a unit with a port `range_map` and, optionally, `sources`.

    Args:
        own: bytes per pixel of the range map.
        each_source: additional bytes per pixel for each source.
    """

    def needed(_: Params, inputs: Mapping[str, Any]) -> int:
        pixels: int = inputs["range_map"].range.size
        return pixels * (own + each_source * len(inputs.get("sources", ())))

    return needed
