"""Types of settings that several stages have."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import AfterValidator

from pano_mvs.core.settings import odd

Odd: TypeAlias = Annotated[int, AfterValidator(odd)]
"""Side length of a window."""
