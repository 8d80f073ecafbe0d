"""Building blocks for backends of the sweep: the readable backend and its parts.

A backend takes a `SweepInput` and returns `Winners`. `find_winners` is the readable backend in numpy; the other names
are its parts: weights of the sources, the average of costs among pixels of similar colour, penalties between depth
hypotheses, windows and constants of the costs.
"""

from pano_mvs.algorithms.sweep.backends.numpy_backend import find_winners
from pano_mvs.algorithms.sweep.backends.registry import register_sweep_backend
from pano_mvs.algorithms.sweep.costs import census_weight, register_sweep_cost
from pano_mvs.algorithms.sweep.edge_support import average_volume
from pano_mvs.algorithms.sweep.kernels_constants import (
    GREY_WEIGHT,
    MAX_COLOR_COST,
    MAX_GRADIENT_COST,
    ZNCC_NOISE_VARIANCE,
)
from pano_mvs.algorithms.sweep.penalties import DIRECTIONS, step_penalties, warm_up
from pano_mvs.algorithms.sweep.preparation import SweepInput, source_weights
from pano_mvs.algorithms.sweep.windows import CostWindow, WindowBands, column_offsets
from pano_mvs.algorithms.sweep.winner import Winners

__all__ = [
    "DIRECTIONS",
    "GREY_WEIGHT",
    "MAX_COLOR_COST",
    "MAX_GRADIENT_COST",
    "ZNCC_NOISE_VARIANCE",
    "CostWindow",
    "SweepInput",
    "WindowBands",
    "Winners",
    "average_volume",
    "census_weight",
    "column_offsets",
    "find_winners",
    "register_sweep_backend",
    "register_sweep_cost",
    "source_weights",
    "step_penalties",
    "warm_up",
]
