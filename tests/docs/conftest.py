"""What tests of the documentation share."""

from __future__ import annotations

from tests.cli.conftest import capture, pano_mvs, quickstart, rendered, sample_cache

__all__ = ["capture", "pano_mvs", "quickstart", "rendered", "sample_cache"]
