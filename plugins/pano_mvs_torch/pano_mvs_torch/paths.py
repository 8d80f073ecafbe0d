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
from torch.nn import functional

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
    path = _no_costs((len(DIRECTIONS), depth, width), volume.device)
    downward = sum(rows > 0 for rows, _ in DIRECTIONS)
    lines = torch.arange(height, device=volume.device)
    rows = torch.stack([lines if step > 0 else lines.flip(0) for step, _ in DIRECTIONS], dim=1)
    ordered = penalties.flatten(0, 1), rows + height * torch.arange(len(DIRECTIONS), device=volume.device)
    columns = torch.arange(width, device=volume.device)
    aside = torch.stack([columns.roll(step) for _, step in DIRECTIONS])[:, None].expand(path.shape)
    for i in range(-warm_up((height, width))[0], height):
        row = i if i >= 0 else -1 - i
        costs, jumps = volume.index_select(0, rows[row]), ordered[0].index_select(0, ordered[1][row])
        if i < 0:
            costs, jumps = costs.roll(width // 2, -1), jumps.roll(width // 2, -1)
        path = path_step(costs, path.gather(2, aside), jumps, p1)
        if i >= 0:
            total[row] += path[:downward, 1:-1].sum(dim=0)
            total[height - 1 - row] += path[downward:, 1:-1].sum(dim=0)


def _along_rows(work: SweepInput, volume: Tensor) -> Tensor:
    """Return the sum of the two paths along the rows, (H, D, W) int32; all rows at the same time."""
    height, depth, width = volume.shape
    p1 = work.settings.penalties(height)[0]
    upright = volume.permute(2, 1, 0).contiguous()
    penalties = torch.cat([_penalties(work, (0, step), volume.device).T for step in (1, -1)])
    total = torch.zeros((width, depth, height), dtype=torch.int16, device=volume.device)
    path = _no_costs((2, depth, height), volume.device)
    columns = torch.arange(width, device=volume.device)
    columns = torch.stack([columns, columns.flip(0)], dim=1)
    places = columns + width * torch.arange(2, device=volume.device)
    for i in range(-warm_up((height, width))[1], width):
        column = i % width
        costs, jumps = upright.index_select(0, columns[column]), penalties.index_select(0, places[column])
        path = path_step(costs, path, jumps, p1)
        if i >= 0:
            total[column] += path[0, 1:-1]
            total[width - 1 - column] += path[1, 1:-1]
    return total.permute(2, 1, 0).to(torch.int32).contiguous()


def _no_costs(size: tuple[int, int, int], device: torch.device) -> Tensor:
    """Return the costs before the first pixels, (K, D + 2, N), with one plane more on either side than `size` has."""
    return functional.pad(torch.zeros(size, dtype=torch.int16, device=device), (0, 0, 1, 1), value=_OUTSIDE)


def path_step(costs: Tensor, before: Tensor, penalty: Tensor, p1: int) -> Tensor:
    """Return L(p, ·) from C(p, ·), uint8 (K, D, N), and L(q, ·), int16 (K, D + 2, N), for N lines of K paths at once.

    L has one more plane on either side, from which no path comes.

    Args:
        costs: of the pixels.
        before: of the pixels before them.
        penalty: (K, N) int16 P2.
        p1: P1.
    """
    same = before[:, 1:-1]
    floor = same.amin(dim=1, keepdim=True)
    best = torch.minimum(before[:, :-2], before[:, 2:]).add_(p1)
    torch.minimum(best, same, out=best)
    torch.minimum(best, floor + penalty[:, None], out=best)
    result = torch.full_like(before, _OUTSIDE)
    torch.add(best.sub_(floor), costs, out=result[:, 1:-1])
    return result


def _penalties(work: SweepInput, direction: tuple[int, int], device: torch.device) -> Tensor:
    penalties: NDArray[np.uint16] = step_penalties(work.contrast_picture, direction, work.settings)
    return torch.from_numpy(penalties.astype(np.int16)).to(device)
