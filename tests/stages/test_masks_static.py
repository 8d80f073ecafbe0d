"""The stages masks.static and masks.apply: one mask for each camera of a capture, applied to its images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.core.errors import ContractError
from pano_mvs.engine.stages.context import Context
from pano_mvs.geometry import Rigid3, roll_panorama
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.panorama import StaticMasks, camera_of
from pano_mvs.stages.masks import StaticParams, apply, static
from pano_mvs.testing.room import default_room, render
from tests.synthetic.rig import helmet, with_rig

SIZE_HW = (128, 256)


def panorama(path: Path, picture: NDArray[np.uint8]) -> Panorama:
    write_png(path, picture)
    size_hw = (picture.shape[0], picture.shape[1])
    return Panorama(FilePart(path), size_hw=size_hw, source_size_hw=size_hw)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Panorama]:
    """Three images of a camera with a helmet, two larger ones without."""
    folder, room = tmp_path_factory.mktemp("capture"), default_room()
    images = {}
    for number, center in enumerate([(0.0, 0.0, 0.0), (0.5, 0.1, 0.2), (-0.3, 0.0, 0.6)]):
        picture = render(room, Rigid3.from_center(np.eye(3), np.array(center)), SIZE_HW, supersample=1)[0]
        images[f"{number}.png"] = panorama(folder / f"{number}.png", with_rig(picture, helmet(SIZE_HW)))
        if number < 2:
            larger = np.repeat(np.repeat(picture, 2, axis=0), 2, axis=1)
            images[f"large{number}.png"] = panorama(folder / f"large{number}.png", larger)
    return images


def test_each_camera_has_its_mask(capture: dict[str, Panorama], tmp_path: Path) -> None:
    context = Context(np.random.default_rng(0), tmp_path, 1)
    masks = static(capture, StaticParams(), context)
    masks.check()
    assert masks.cameras == (camera_of(capture["0.png"]),)
    assert context.metrics["images_masked"] == pytest.approx(0.6)
    assert any("3 images of 256×128 px" in note and "moves with the camera" in note for note in context.notes)
    assert any("2 images of 512×256 px" in note and "3 panoramas" in note for note in context.notes)
    masked = apply(capture["0.png"], masks, context)
    _, truth = helmet(SIZE_HW)
    found = ~masked.load_mask()
    assert found[truth].mean() > 0.9
    assert found[:80].sum() == 0
    assert apply(capture["large0.png"], masks, context) is capture["large0.png"]


def test_it_can_be_switched_off(capture: dict[str, Panorama], tmp_path: Path) -> None:
    context = Context(np.random.default_rng(0), tmp_path, 1)
    masks = static(capture, StaticParams(enabled=False), context)
    assert masks.cameras == ()
    assert not context.notes
    assert apply(capture["0.png"], masks, context) is capture["0.png"]
    assert apply(capture["0.png"], None, context) is capture["0.png"]


def test_a_mask_is_scaled_across_the_seam(capture: dict[str, Panorama]) -> None:
    pixels = np.zeros((8, 16), np.uint8)
    pixels[6:, 3:7] = 1
    image = capture["0.png"]
    straight, rolled = (
        StaticMasks(roll_panorama(pixels, columns)[0][None], (camera_of(image),)).of(image) for columns in (0, 12)
    )
    assert straight is not None
    assert rolled is not None
    assert straight[104:, 56:104].all()
    assert straight.mean() == pytest.approx(1 / 16, rel=0.05)
    assert np.array_equal(np.roll(straight, 12 * 16, axis=1), rolled)


def test_masks_are_of_full_spheres() -> None:
    with pytest.raises(ContractError, match="full spheres"):
        StaticMasks(np.zeros((1, 8, 8), np.uint8), ((8, 8),)).check()
    with pytest.raises(ContractError, match="shape"):
        StaticMasks(np.zeros((2, 8, 16), np.uint8), ((8, 16),)).check()
