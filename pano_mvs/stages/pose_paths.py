"""The type of settings that name a file or folder of known poses or positions."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pano_mvs.api import InputPath, ReadBy
from pano_mvs.io.poses.files import file_of_reader

PosesPath: TypeAlias = Annotated[InputPath, ReadBy(file_of_reader)]
"""A file or folder that `read_poses` reads; if a plugin reads it, the plugin's code is in the cache key."""
