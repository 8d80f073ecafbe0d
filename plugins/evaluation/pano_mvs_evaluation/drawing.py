"""Figures of errors, which matplotlib draws."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 1024
_DPI = 100


@contextmanager
def drawn_figure(path: Path, size_px: tuple[float, float]) -> Iterator[Figure]:
    """Give an empty figure, (width, height), and write it as JPEG or PNG by the file's extension; make its folder."""
    from matplotlib import rc_context, rcParamsDefault  # 0.2 s
    from matplotlib.figure import Figure

    with rc_context(rcParamsDefault), warnings.catch_warnings():  # without the user's own style
        figure = Figure((size_px[0] / _DPI, size_px[1] / _DPI), dpi=_DPI, layout="constrained")
        yield figure
        path.parent.mkdir(parents=True, exist_ok=True)
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # boxes in their place say enough
        if path.suffix.lower() == ".jpg":
            # Colours at full resolution: at half of it they bleed over the sharp edges of errors.
            figure.savefig(path, pil_kwargs={"quality": 92, "subsampling": 0})
        else:
            figure.savefig(path, metadata={"Software": None})  # whose version would change the bytes
