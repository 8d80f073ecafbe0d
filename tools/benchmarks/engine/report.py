"""How long the report of a large run takes to write, and how large it is.

Poses with 400 observations a view, eight pairs a view, small range maps, and one full-sized preview that all views
share. The second time is that of a run that computed nothing: its page takes the pictures from the first.
"""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pano_mvs.engine.cache.store import Store
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.preview import write_preview
from pano_mvs.report import write_report
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import Poses, RangeMap
from pano_mvs.testing.room import default_room, render

_SIZE_HW = (64, 128)
_OBSERVATIONS, _PAIRS, _POINTS = 400, 8, 100_000


def made(folder: Path, count: int) -> tuple[dict[str, Any], StoredValues]:
    """Return what a run over so many views would leave."""
    rng = np.random.default_rng(0)
    names = [f"{idx:05d}.jpg" for idx in range(count)]
    store = Store(folder / "cache")
    poses = _poses(names, rng)
    image, true_range = render(default_room(), Rigid3.identity(), (256, 512))
    (folder / "out" / "preview").mkdir(parents=True)
    write_preview(folder / "out" / "preview" / "shared.jpg", image, true_range)
    ranges = {}
    for name in names:
        confidence = rng.integers(1, 255, _SIZE_HW, np.uint8)
        ranges[name] = store.put_value(RangeMap(rng.uniform(1, 9, _SIZE_HW).astype(np.float32), confidence))
    links = [
        [names[idx], names[(idx + step) % count], int(rng.integers(0, 400)), 500, 0.03]
        for idx in range(count)
        for step in range(1, 1 + _PAIRS)
    ]
    views = [
        {"name": name, "preview": "preview/shared.jpg", "completeness": rng.random(), "consistent": rng.random()}
        for name in names
    ]
    summary = {
        "workflow": {"name": "large"},
        "exit_code": 0,
        "views": views,
        "poses": {"registered": names, "rejected": {}, "centers": poses.centers.tolist(), "links": links},
    }
    return summary, StoredValues(store, {"poses": {"": store.put_value(poses)}, "ranges": ranges})


def _poses(names: list[str], rng: np.random.Generator) -> Poses:
    count = len(names)
    centers = rng.uniform(-100, 100, (count, 3)) * (1, 0.01, 1)
    points = rng.uniform(-120, 120, (_POINTS, 3))
    point_idx = rng.integers(0, _POINTS, count * _OBSERVATIONS, np.int32)
    image_idx = np.repeat(np.arange(count, dtype=np.int32), _OBSERVATIONS)
    bearings = points[point_idx] - centers[image_idx]
    bearings += rng.normal(0, 1e-3, bearings.shape) * np.linalg.norm(bearings, axis=1, keepdims=True)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    return Poses(
        names=tuple(names),
        rotations=np.tile(np.eye(3), (count, 1, 1)),
        translations=-centers,
        points_in_world=points,
        point_colors_rgb=np.zeros((_POINTS, 3), np.uint8),
        point_errors_rad=np.zeros(_POINTS, np.float32),
        track_point_idx=point_idx,
        track_image_idx=image_idx,
        track_bearings=bearings,
        rejected={},
    )


def main(count: int = 5000) -> None:
    """Print the times, of the processor and passed, and the size."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        summary, results = made(folder, count)
        for what in ("first", "again"):
            passed, worked = time.perf_counter(), time.process_time()
            write_report(
                folder / "out", RunSummary.from_json(summary), StoredValues(Store(folder / "cache"), results.refs)
            )
            size = (folder / "out" / "report.html").stat().st_size
            print(
                f"{count} views, {what}: {time.process_time() - worked:.2f} s of work, "
                f"{time.perf_counter() - passed:.2f} s passed, {size / 1e6:.1f} MB"
            )
