"""What a run on a dask cluster delivers and stores."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.workflows.test_equivariance import check_same_bytes


@pytest.mark.slow
def test_dask_gives_the_same_bytes(of_all_processes: Path, tmp_path: Path) -> None:
    check_same_bytes(("--executor", "dask", "--workers", "2"), of_all_processes, tmp_path)
