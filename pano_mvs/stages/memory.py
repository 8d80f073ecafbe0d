"""What stages on range maps take in memory, as measured: `python -m tests.benchmarks.engine.stage_memory`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pano_mvs.api import Params


def bytes_per_pixel(own: int, *, each_source: int = 0) -> Callable[[Params, Mapping[str, Any]], int]:
    """Return what finds the memory of a unit that works on a port `range_map` and, perhaps, on `sources`.

    Args:
        own: bytes for each pixel of the range map.
        each_source: as many more for each source.
    """

    def needed(_: Params, inputs: Mapping[str, Any]) -> int:
        pixels: int = inputs["range_map"].range.size
        return pixels * (own + each_source * len(inputs.get("sources", ())))

    return needed
