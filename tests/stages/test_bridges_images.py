"""matches.bridges reads the images of groups that it compares, and no others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.algorithms.poses.joining import bridges as joining
from pano_mvs.algorithms.poses.joining.bridges import Bridges
from pano_mvs.engine.stages.context import Context
from pano_mvs.scene import Features, Panorama, TwoView
from pano_mvs.stages.matches import BridgesParams, bridges
from pano_mvs.testing.tiny_capture import tiny_capture

NAMES = "000.png", "001.png"


class _Unread(Mapping[str, Panorama]):
    """Images of which none may be read."""

    def __getitem__(self, name: str) -> Panorama:
        return pytest.fail(f"{name} was read")

    def __iter__(self) -> Iterator[str]:
        return iter(NAMES)

    def __len__(self) -> int:
        return len(NAMES)


@pytest.fixture
def ctx(tmp_path: Path) -> Context:
    return Context(np.random.default_rng(0), tmp_path)


def _inputs() -> tuple[dict[str, Features], dict[tuple[str, str], TwoView], dict[str, Panorama]]:
    tiny = tiny_capture()
    features, images = tiny.each(Features), tiny.each(Panorama)
    apart = {NAMES: TwoView.failed("apart", candidates=20)}
    return {name: features[name] for name in NAMES}, apart, {name: images[name] for name in NAMES}


@pytest.mark.parametrize("squeezed", [True, False])
def test_the_setting_decides_whether_images_are_read(
    ctx: Context, monkeypatch: pytest.MonkeyPatch, squeezed: bool
) -> None:
    seen = []

    def find(*_: object, load: object, **_settings: object) -> Bridges:
        seen.append(load)
        return Bridges()

    monkeypatch.setattr("pano_mvs.stages.matches.find_bridges", find)
    features, apart, images = _inputs()
    bridges(features=features, matches=apart, images=images, params=BridgesParams(squeezed_tiles=squeezed), ctx=ctx)
    if not squeezed:
        assert seen == [None]
        return
    assert callable(seen[0])
    picture, mask = seen[0](NAMES[1])
    np.testing.assert_array_equal(picture, images[NAMES[1]].load())
    np.testing.assert_array_equal(mask, images[NAMES[1]].load_mask())


def test_two_lone_images_are_not_read(ctx: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    """Groups of one image are not aligned with one another, so their images need no further descriptors."""
    monkeypatch.setattr(joining, "further_pairs", lambda *_, **__: {})
    features, apart, _ = _inputs()
    found = bridges(features=features, matches=apart, images=_Unread(), params=BridgesParams(), ctx=ctx)
    assert not any(found.views.values())


@pytest.mark.parametrize(("images", "more_mb"), [(2, 120), (256, 3200), (5000, 3200)])
def test_the_memory_for_squeezed_tiles_is_bounded(images: int, more_mb: int) -> None:
    one = next(iter(_inputs()[2].values()))
    inputs = {
        "features": dict.fromkeys(map(str, range(images))),
        "matches": {},
        "images": dict.fromkeys(map(str, range(images)), one),
    }
    needed = bridges.__pano_mvs_stage__.memory_needed  # type: ignore[attr-defined]
    off, on = (needed(BridgesParams(squeezed_tiles=squeezed), inputs) for squeezed in (False, True))
    assert 0.8 * more_mb < (on - off) / 1e6 < 1.2 * more_mb
