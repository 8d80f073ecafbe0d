"""What rounds to zero is shown without a sign, which would depend on the last bit of a machine's arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.cli import inspect_command as inspect_text
from pano_mvs.cli.run import printing
from pano_mvs.evaluation.ranges import tables as depth_tables
from pano_mvs.results.figures import figure


@pytest.mark.parametrize(
    "shown",
    [
        figure(-0.0),
        figure([-0.0, 1.0]),
        printing._shown(-0.0),
        depth_tables._shown("psnr_db", {"psnr_db": -0.0}),
        inspect_text._vector(np.array([-1e-9, 0.0, 1.0])),
    ],
)
def test_zero_has_no_sign(shown: str) -> None:
    assert "-" not in shown
    assert "0" in shown
