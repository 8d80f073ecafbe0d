"""Semi-global matching on the sphere: eight paths through a volume of costs, a whole row or column at a time.

H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", TPAMI 2008, equation 13:
L(p, d) = C(p, d) + min(L(q, d), L(q, d ± 1) + P1, min L(q) + P2) − min L(q), q the pixel before p on the path.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from pano_mvs.api import SweepInput
from pano_mvs.api.sweep import DIRECTIONS, step_penalties, warm_up
from torch import Tensor

# The cost of the planes before the first and after the last. A path costs at most 255 + P2; with P1 on top of this
# 16 bits do not overflow.
_OUTSIDE = 20_000


def sum_of_paths(work: SweepInput, volume: Tensor) -> Tensor:
    """Return the sum of the eight paths' costs, (H, D, W) uint8 to (H, D, W) int32."""
    total = _along_rows(work, volume)
    _from_pole_to_pole(work, volume, total)
    return total


def _from_pole_to_pole(work: SweepInput, volume: Tensor, total: Tensor) -> None:
    """Add the six paths that run over the rows, all at the same time, the upward ones from the last row."""
    height, depth, width = volume.shape
    p1 = work.settings.penalties(height)[0]
    penalties = torch.stack([_penalties(work, direction, volume.device) for direction in DIRECTIONS])
    path = torch.zeros((len(DIRECTIONS), depth, width), dtype=torch.int16, device=volume.device)
    downward = sum(rows > 0 for rows, _ in DIRECTIONS)
    for i in range(-warm_up((height, width))[0], height):
        row = i if i >= 0 else -1 - i
        beyond = 0 if i >= 0 else width // 2
        rows = [row if step > 0 else height - 1 - row for step, _ in DIRECTIONS]
        before = torch.stack([line.roll(columns, -1) for line, (_, columns) in zip(path, DIRECTIONS, strict=True)])
        costs = torch.stack([volume[line] for line in rows]).roll(beyond, -1)
        jumps = torch.stack([penalties[k, line] for k, line in enumerate(rows)]).roll(beyond, -1)
        path = path_step(costs, before, jumps, p1)
        if i >= 0:
            total[row] += path[:downward].sum(dim=0)
            total[height - 1 - row] += path[downward:].sum(dim=0)


def _along_rows(work: SweepInput, volume: Tensor) -> Tensor:
    """Return the sum of the two paths along the rows, (H, D, W) int32; all rows at the same time."""
    height, depth, width = volume.shape
    p1 = work.settings.penalties(height)[0]
    upright = volume.permute(2, 1, 0).contiguous()
    penalties = torch.stack([_penalties(work, (0, step), volume.device).T for step in (1, -1)])
    total = torch.zeros((width, depth, height), dtype=torch.int16, device=volume.device)
    path = torch.zeros((2, depth, height), dtype=torch.int16, device=volume.device)
    for i in range(-warm_up((height, width))[1], width):
        columns = i % width, width - 1 - i % width
        costs = torch.stack([upright[column] for column in columns])
        jumps = torch.stack([penalties[k, column] for k, column in enumerate(columns)])
        path = path_step(costs, path, jumps, p1)
        if i >= 0:
            total[columns[0]] += path[0]
            total[columns[1]] += path[1]
    return total.permute(2, 1, 0).to(torch.int32).contiguous()


def path_step(costs: Tensor, before: Tensor, penalty: Tensor, p1: int) -> Tensor:
    """Return L(p, ·) from C(p, ·), uint8, and L(q, ·), int16, (K, D, N) each, for N lines of K paths at once.

    Args:
        costs: of the pixels.
        before: of the pixels before them.
        penalty: (K, N) int16 P2.
        p1: P1.
    """
    floor = before.amin(dim=1, keepdim=True)
    best = torch.minimum(before, floor + penalty[:, None])
    outside = torch.full_like(before[:, :1], _OUTSIDE)
    best = torch.minimum(best, torch.cat([outside, before[:, :-1]], dim=1) + p1)
    best = torch.minimum(best, torch.cat([before[:, 1:], outside], dim=1) + p1)
    return best.sub_(floor).add_(costs)


def _penalties(work: SweepInput, direction: tuple[int, int], device: torch.device) -> Tensor:
    penalties: NDArray[np.uint16] = step_penalties(work.contrast_picture, direction, work.settings)
    return torch.from_numpy(penalties.astype(np.int16)).to(device)
