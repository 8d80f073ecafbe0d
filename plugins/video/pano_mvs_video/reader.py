"""How a file is known to be a video."""

from __future__ import annotations

from pathlib import Path

from pano_mvs.core.paths import is_folder
from pano_mvs.io.images.captures import VIDEO_SUFFIXES
from pano_mvs.io.readers import CaptureReader


def _is_video(path: Path) -> bool:
    return not is_folder(path) and path.suffix.lower() in VIDEO_SUFFIXES


video = CaptureReader(
    "a video",
    "source.video",
    _is_video,
    "Use the preset walk, or --set images.use=source.video --set pairs.use=pairs.sequential",
)
