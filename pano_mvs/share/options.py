"""What a shared page contains."""

from __future__ import annotations

from dataclasses import dataclass

from pano_mvs.core.errors import UsageError


@dataclass(frozen=True)
class ShareOptions:
    """What a shared page contains.

    Attributes:
        title: heading of the page; empty for the name of the output folder.
        max_points: largest number of points of the cloud; 0 for none. Those kept are drawn at random.
        max_triangles: about the largest number of triangles of a mesh without texture; 0 for no mesh.
        max_width: largest width of a panorama in pixels, at least 1024.
        jpeg_quality: of the panoramas, 1 to 100.
        max_single_file_bytes: size up to which everything is also written as one HTML file.
    """

    title: str = ""
    max_points: int = 5_000_000
    max_triangles: int = 300_000
    max_width: int = 4096
    jpeg_quality: int = 85
    max_single_file_bytes: int = 40_000_000

    def __post_init__(self) -> None:
        """Raise UsageError if an option is out of its range."""
        if self.max_points < 0:
            raise UsageError(f"--points {self.max_points}: give a number of points, or 0 for none")
        if self.max_triangles < 0:
            raise UsageError(f"--triangles {self.max_triangles}: give a number of triangles, or 0 for no mesh")
        if self.max_width < 1024:
            raise UsageError(f"--width {self.max_width}: panoramas need at least 1024 pixels")
        if not 1 <= self.jpeg_quality <= 100:
            raise UsageError(f"--quality {self.jpeg_quality}: give 1 to 100")
