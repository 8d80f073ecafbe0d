"""The sweep on PyTorch: bands of rows, many virtual ranges at a time; the same code on a processor and on a card.

Memory beyond the pictures and the result is that of one band (see `Batch`), whatever the rows; for "sgm" on top of it
about 8 bytes for each pixel and plane. Nothing races: the same input gives the same bytes on the same device.
"""

from __future__ import annotations

from math import ceil

import numpy as np
import torch
from pano_mvs.api import SweepInput, Winners
from pano_mvs.api.sweep import average_volume, source_weights
from torch import Tensor

from pano_mvs_torch.batch import Batch, batch_for
from pano_mvs_torch.costs import BandCost
from pano_mvs_torch.lookup import Lookup
from pano_mvs_torch.paths import sum_of_paths


@torch.inference_mode()
def find_winners(work: SweepInput) -> Winners:
    """Return the winning plane of every pixel and the costs around it."""
    batch = batch_for(work.device)
    height, width = work.reference.shape[:2]
    planes = len(work.ranges)
    lookups = [Lookup(work, idx, batch.device) for idx in range(len(work.sources))]
    weights = torch.from_numpy(source_weights((height, width), work.source_from_reference, work.settings))
    rows = batch.rows(planes, width)
    bands = [(first, min(first + rows, height)) for first in range(0, height, rows)]
    if work.settings.aggregation == "box":
        return _joined([winners_of(_band(work, lookups, weights, band, batch)) for band in bands])
    volume = torch.empty((height, planes, width), dtype=torch.uint8, device=batch.device)
    scale = float(np.float32(work.settings.cost_scale))
    for first, last in bands:
        costs = _band(work, lookups, weights, (first, last), batch)
        volume[first:last] = costs.mul_(scale).add_(0.5).clamp_(max=255).to(torch.uint8).transpose(0, 1)
    averaged = volume.cpu().numpy()  # shares the memory of a processor's tensor
    average_volume(averaged, work)
    total = sum_of_paths(work, torch.from_numpy(averaged).to(batch.device))
    return _joined([winners_of(total[first:last].transpose(0, 1).float()) for first, last in bands])


def winners_of(volume: Tensor) -> Winners:
    """Return the winners of a volume of costs, (D, rows, W) float32."""
    plane = volume.argmin(dim=0, keepdim=True)  # the first of equals
    cost, before, after = (
        volume.gather(0, (plane + step).clamp_(0, len(volume) - 1))[0].cpu().numpy() for step in (0, -1, 1)
    )
    near_winner = (torch.arange(len(volume), device=volume.device)[:, None, None] - plane).abs_() <= 1
    rival = torch.where(near_winner, torch.inf, volume).amin(dim=0)
    return Winners(plane[0].to(torch.int32).cpu().numpy(), cost, before, after, rival.cpu().numpy())


def _band(work: SweepInput, lookups: list[Lookup], weights: Tensor, band: tuple[int, int], batch: Batch) -> Tensor:
    """Return the costs of a band of rows at all planes, combined over the sources, (D, rows, W) float32."""
    first, last = band
    width = work.reference.shape[1]
    cost = BandCost(work, first, last, batch.device)
    directions = [lookup.directions(first - cost.halo, last + cost.halo) for lookup in lookups]
    weights = weights[:, first:last].to(batch.device)
    at_once = batch.planes(last - first + 2 * cost.halo, width)
    result = torch.empty((len(work.ranges), last - first, width), device=batch.device)
    for start in range(0, len(work.ranges), at_once):
        ranges = work.ranges[start : start + at_once]
        costs = torch.empty((len(lookups), len(ranges), last - first, width), device=batch.device)
        for idx, lookup in enumerate(lookups):
            warped, votes = lookup.at(directions[idx], ranges)
            costs[idx] = cost.of(warped)
            if votes is not None:
                costs[idx].masked_fill_(~votes[:, cost.halo : cost.halo + last - first], torch.inf)
        result[start : start + at_once] = _combined(costs, weights, work)
    return result


def _combined(costs: Tensor, weights: Tensor, work: SweepInput) -> Tensor:
    """Return the mean cost of the sources that count, (S, P, rows, W) to (P, rows, W); see `combine_costs`."""
    settings = work.settings
    most = settings.max_sources(len(costs))
    if work.source_valid is None and not len(weights):
        return _mean_of_least(costs, min(ceil(settings.weight_share * len(costs)), most))
    ordered, order = costs.sort(dim=0, stable=True)
    votes = ordered.isfinite()
    shares = weights[:, None].expand_as(costs).gather(0, order) if len(weights) else torch.ones_like(costs)
    shares = shares * votes
    wanted = settings.weight_share * (1 - 1e-5) * shares.sum(dim=0)
    taken = shares * (shares.cumsum(dim=0) - shares < wanted)
    taken[most:] = 0
    total = (taken * torch.where(votes, ordered, 0)).sum(dim=0)
    held = taken.sum(dim=0)
    return torch.where(held > 0, total / held, settings.neutral_cost)


def _mean_of_least(costs: Tensor, used: int) -> Tensor:
    """Return the mean of the least `used` of the sources' costs; they are sorted in place."""
    for first in range(used if used < len(costs) else 0):
        for other in range(first + 1, len(costs)):
            less, more = torch.minimum(costs[first], costs[other]), torch.maximum(costs[first], costs[other])
            costs[first], costs[other] = less, more
    total = costs[0].clone()
    for cost in costs[1:used]:
        total += cost
    return total / used


def _joined(bands: list[Winners]) -> Winners:
    names = ("plane", "cost", "before", "after", "rival")
    return Winners(*(np.concatenate([getattr(band, name) for band in bands]) for name in names))
