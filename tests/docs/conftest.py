"""What tests of the documentation share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.cli.conftest import capture, pano_mvs, quickstart, rendered

__all__ = ["capture", "pano_mvs", "quickstart", "rendered"]


@pytest.fixture(scope="session")
def sample_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache for all that runs the quickstart on the sample, in all processes of the test run: it is computed once."""
    folder = tmp_path_factory.getbasetemp()
    return (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "sample-cache"
