from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def check_kernel_marker(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test whose marker `kernel` names a module that nothing has imported."""
    yield
    named = [name for marker in request.node.iter_markers("kernel") for name in marker.args]
    missing = [name for name in named if f"pano_mvs.algorithms.{name}" not in sys.modules]
    assert missing == []
