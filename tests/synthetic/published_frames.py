"""Frames for trainers as a run writes them: through the store, published into a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from pano_mvs.api import Context, Files, RangeMap
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.running.publish import Publisher
from pano_mvs.testing.tiny_capture import TinyCapture

Frames = TypeVar("Frames", bound=Files)


def scratch_in(folder: Path) -> Context:
    """Return a context whose scratch folder is made."""
    folder.mkdir(parents=True, exist_ok=True)
    return Context(np.random.default_rng(0), folder)


def published(
    folder: Path,
    names: Sequence[str],
    frames_of: Callable[[str, Context], Frames],
    *,
    whole: Callable[[dict[str, Frames], Context], Files],
) -> Path:
    """Write the frames of each panorama, and what lists them all; return the output folder."""
    store = Store(folder / "cache")
    publisher = Publisher(folder / "out", store)
    frames: dict[str, Frames] = {}
    publisher.name_items(tuple(names))
    for number, name in enumerate(names):
        made = frames_of(name, scratch_in(folder / f"scratch_{number}"))
        ref = store.put_value(made)
        publisher.publish("frames", name, ref)
        read = store.load(ref, type(made))
        assert isinstance(read, type(made))
        frames[name] = read
    publisher.publish("whole", "", store.put_value(whole(frames, scratch_in(folder / "scratch"))))
    return folder / "out"


def true_ranges(capture: TinyCapture) -> dict[str, RangeMap]:
    """Return the true ranges everywhere, masked pixels included."""
    ranges = zip(capture.names, capture.ranges, strict=True)
    return {name: RangeMap(true, np.full(true.shape, 200, np.uint8)) for name, true in ranges}
