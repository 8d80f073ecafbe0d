"""What a run on a dask cluster delivers and stores."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.workflows.test_equivariance import WAYS, check_same_bytes


@pytest.mark.slow
def test_dask_gives_the_same_bytes(rendered: Path, tmp_path: Path) -> None:
    ways = {"serial": WAYS["serial"], "dask": ("--executor", "dask", "--workers", "2")}
    check_same_bytes(ways, rendered, tmp_path)
