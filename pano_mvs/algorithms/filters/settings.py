"""Settings that several filters have."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pano_mvs.core.settings import Setting

Window: TypeAlias = Annotated[int, Setting("side length in pixels, odd", ge=3, le=15, odd=True)]
Domain: TypeAlias = Annotated[Literal["range", "inverse"], Setting("quantity to smooth: range or 1/range")]
MaxHoleDeg: TypeAlias = Annotated[
    float, Setting("larger holes, such as a sky, are not filled (diameter of a disc); 0: fill all", ge=0)
]
