"""The sweep backend `torch` of pano_mvs: `backend: torch`, and `device: auto | cpu | cuda | cuda:1`."""

from __future__ import annotations

from pano_mvs.api import SweepInput, Winners, register_sweep_backend

COSTS = ("census", "census_gradient", "zncc", "sad", "sad_gradient")


@register_sweep_backend("torch", costs=COSTS, bytes_per_voxel=8)
def find_winners(work: SweepInput) -> Winners:
    """Return the winning plane of every pixel and the costs around it; equals the other backends' but for rounding.

    Raises:
        UsageError: if `work.device` is not there.
    """
    from pano_mvs_torch import sweep  # on use: torch is slow to import

    winners: Winners = sweep.find_winners(work)
    return winners
