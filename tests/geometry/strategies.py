"""What the laws of the geometry are drawn from: hard cases first (near identity, seam, poles, antipodes)."""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec

FEW = settings(max_examples=40)
"""Fewer draws than usual, for laws that hold everywhere; hard cases come first."""
SIZES = st.sampled_from([(1, 2), (8, 16), (97, 194), (512, 1024), (300, 700)])
TINY = st.sampled_from([0.0, 1e-300, -1e-12, 1e-9, -1e-6, 1e-3])
COMPONENT = st.one_of(TINY, st.floats(-1, 1), st.sampled_from([1.0, -1.0]))


def _unit(vector: tuple[float, float, float]) -> NDArray[np.float64]:
    result: NDArray[np.float64] = np.array(vector) / np.linalg.norm(vector)
    return result


UNITS = st.tuples(COMPONENT, COMPONENT, COMPONENT).filter(lambda v: np.linalg.norm(v) > 1e-3).map(_unit)
ANGLES = st.one_of(st.floats(-np.pi, np.pi), st.sampled_from([0.0, 1e-9, 1e-5, np.pi / 2, np.pi - 1e-9, np.pi, -np.pi]))
ROTATIONS = st.builds(lambda axis, angle: rotation_from_rotvec(axis * angle), UNITS, ANGLES)
POINTS = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)
RIGIDS = st.builds(Rigid3, ROTATIONS, POINTS)
SIMILARITIES = st.builds(Similarity3, st.floats(0.01, 100), ROTATIONS, POINTS)
