"""The device of a sweep, and how much it works on at a time."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from pano_mvs.api import UsageError


@dataclass(frozen=True)
class Batch:
    """How much is worked on at a time; no limit changes a result.

    Attributes:
        device: where.
        costs: how many costs of a band of rows, over all planes, are held (4 bytes each).
        samples: how many samples of one source are looked up at a time (some 30 bytes each while they are).
    """

    device: torch.device
    costs: int
    samples: int

    def rows(self, planes: int, width: int) -> int:
        """Return the rows of a band."""
        return max(1, self.costs // (planes * width))

    def planes(self, rows: int, width: int) -> int:
        """Return how many planes of a band, of so many rows with its margins, are looked up at a time."""
        return max(1, self.samples // (rows * width))


def batch_for(name: str) -> Batch:
    """Return the device of that name, "auto" for a graphics card if there is one, and what suits its memory.

    Raises:
        UsageError: if it is not there.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cpu":
        return Batch(torch.device("cpu"), costs=1 << 24, samples=1 << 21)
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    device = torch.device(name)
    if (device.index or 0) >= count:
        found = f"{count} CUDA devices" if count else "no CUDA device"
        raise UsageError(f"the sweep backend 'torch' found {found}, so not {name!r}: use `device: auto` or `cpu`")
    return Batch(device, costs=1 << 28, samples=1 << 23)
