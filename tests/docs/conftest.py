"""What tests of the documentation share."""

from __future__ import annotations

from tests.cli.conftest import capture, of_all_processes, pano_mvs, quickstart, rendered, sample

__all__ = ["capture", "of_all_processes", "pano_mvs", "quickstart", "rendered", "sample"]
