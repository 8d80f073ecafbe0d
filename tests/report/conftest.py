from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.engine.cache.store import Store
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.preview import write_preview
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import Panorama, PointCloud, Poses, RangeMap, TwoView
from pano_mvs.scene.two_view import pair_name
from pano_mvs.testing.room import default_room, render
from pano_mvs.testing.tiny_capture import TinyCapture, tiny_capture


@pytest.fixture(scope="session")
def preview_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("preview") / "1.jpg"
    write_preview(path, *render(default_room(), Rigid3.identity(), (32, 64)))
    return path


@pytest.fixture
def out_dir(tmp_path: Path, preview_file: Path) -> Path:
    """An output folder with the preview of one picture."""
    out = tmp_path / "out"
    (out / "preview" / "a").mkdir(parents=True)
    shutil.copy(preview_file, out / "preview" / "a" / "1.jpg")
    return out


@pytest.fixture(scope="session")
def tiny() -> TinyCapture:
    return tiny_capture()


@pytest.fixture
def results(tmp_path: Path, tiny: TinyCapture) -> StoredValues:
    """What a run over the tiny capture might have left in a store; the last two pictures have nothing in common."""
    return stored(Store(tmp_path / "cache"), tiny)


def stored(store: Store, tiny: TinyCapture) -> StoredValues:
    names = tiny.names
    pairs = {pair_name(*pair): record for pair, record in tiny.each(TwoView).items()}
    pairs[pair_name(names[2], names[3])] = TwoView.failed("only 7 of 31 matches agree", candidates=31)
    refs = {
        "images": {name: store.put_value(tiny.each(Panorama)[name]) for name in names},
        "pairs": {name: store.put_value(record) for name, record in pairs.items()},
        "poses": {"": store.put_value(tiny.whole(Poses))},
        "ranges": {name: store.put_value(tiny.each(RangeMap)[name]) for name in names},
        "cloud": {"": store.put_value(outward(tiny))},
    }
    return StoredValues(store, refs)


def outward(tiny: TinyCapture) -> PointCloud:
    """Return the true surfaces as a cloud, seen from the first camera."""
    cloud = tiny.whole(PointCloud)
    rng = np.random.default_rng(4)
    return replace(cloud, colors_rgb=rng.integers(0, 255, (len(cloud), 3), np.uint8))


def summary_of(tiny: TinyCapture) -> dict[str, Any]:
    """Return what run.json would say of it."""
    poses = tiny.whole(Poses)
    names = list(tiny.names)
    links = [[a, b, 100, 120, 0.02] for i, a in enumerate(names) for b in names[i + 1 :]]
    links[-1] = [names[2], names[3], 0, 31, None]
    return {
        "workflow": {"name": "tiny"},
        "exit_code": 0,
        "stages": [{"name": "depth", "use": "depth.sweep", "units": 4, "run": 4, "params": {"planes": 32}}],
        "poses": {
            "registered": names,
            "rejected": {},
            "centers": poses.centers.tolist(),
            "frame": poses.frame,
            "scale": poses.scale,
            "metric": False,
            "links": links,
        },
        "views": [{"name": name, "completeness": 1.0, "consistent": 0.5} for name in names],
        "cloud": {"points": 240},
    }
