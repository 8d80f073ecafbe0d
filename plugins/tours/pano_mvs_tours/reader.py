"""How a folder is known to hold a virtual tour."""

from __future__ import annotations

from pathlib import Path

from pano_mvs.core.paths import is_folder
from pano_mvs.io.readers import CaptureReader
from pano_mvs_tours.tour_folders import is_tour


def _holds_tour(path: Path) -> bool:
    return is_folder(path) and is_tour(path)


tour = CaptureReader("a virtual tour", "source.tour", _holds_tour)
