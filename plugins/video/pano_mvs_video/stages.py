"""The stages of videos."""

from pano_mvs_video.source import video

__all__ = ["video"]
