"""Cropped panoramas, one of them resized since, and masks over crop and sphere, from files to cloud."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from pano_mvs.io.ply import read_ply
from pano_mvs.io.ranges import read_range_tiff
from tests.cli.conftest import SIZE_HW, SMALL, Command
from tests.io.images.pictures import png_chunk, xmp
from tests.stored import read_picture

LEFT, TOP, WIDTH, HEIGHT = 20, 18, 290, 121


def cut(path: Path, *, half: bool = False) -> None:
    """Leave a part of a panorama in its file, with the metadata that say so."""
    part = read_picture(path)[TOP : TOP + HEIGHT, LEFT : LEFT + WIDTH]
    if half:
        part = cv2.resize(part, (WIDTH // 2, round(HEIGHT / 2)), interpolation=cv2.INTER_AREA)
    packet = xmp(
        {
            "FullPanoWidthPixels": SIZE_HW[1],
            "FullPanoHeightPixels": SIZE_HW[0],
            "CroppedAreaImageWidthPixels": WIDTH,
            "CroppedAreaImageHeightPixels": HEIGHT,
            "CroppedAreaLeftPixels": LEFT,
            "CroppedAreaTopPixels": TOP,
        }
    )
    data = bytes(cv2.imencode(".png", part)[1])
    path.write_bytes(data[:33] + png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + packet) + data[33:])


@pytest.mark.slow
def test_cropped_and_masked_panoramas_from_files_to_cloud(pano_mvs: Command, capture: Path) -> None:
    pictures = sorted((capture / "images").iterdir())
    for idx, path in enumerate(pictures):
        cut(path, half=idx == 3)
    poses = json.loads((capture / "truth" / "poses.json").read_text())
    for view in poses["views"]:
        view.pop("sha256", None)  # of the whole pictures
    (capture / "truth" / "poses.json").write_text(json.dumps(poses))
    (capture / "drawn").mkdir()
    of_picture = np.full((HEIGHT, WIDTH), 255, np.uint8)
    of_picture[30:60, 100:140] = 0
    of_sphere = np.full(SIZE_HW, 255, np.uint8)
    of_sphere[TOP + 30 : TOP + 60, LEFT + 100 : LEFT + 140] = 0
    cv2.imwrite(str(capture / "drawn" / "000.png.png"), of_picture)
    cv2.imwrite(str(capture / "drawn" / "001.png"), of_sphere)
    result = pano_mvs(
        *f"run known_poses --images {capture / 'images'} --out out".split(),
        *SMALL,
        *f"--set depth.planes=64 --set poses.path={capture / 'truth' / 'poses.json'}".split(),
        *f"--set scores.truth={capture / 'truth'} --set images.masks={capture / 'drawn'}".split(),
    )
    assert result.code == 0, result.text
    assert "fields count the original's pixels" in result.flat
    cameras = pycolmap.Reconstruction("out/colmap/sparse/0").cameras.values()
    assert {(camera.model.name, camera.width, camera.height) for camera in cameras} == {("EQUIRECTANGULAR", 320, 160)}
    inside = np.zeros(SIZE_HW, np.bool_)
    inside[TOP : TOP + HEIGHT, LEFT : LEFT + WIDTH] = True
    with np.load(capture / "truth" / "depth.npz") as file:
        truth = {path.stem: file[path.stem] for path in pictures}
    for idx, path in enumerate(pictures[:3]):
        ranges = read_range_tiff(Path(f"out/range/{path.stem}.tiff"))
        seen = inside & ((of_sphere > 0) if idx < 2 else True)
        assert ranges.shape == SIZE_HW
        assert np.isnan(ranges[~seen]).all()
        with np.errstate(invalid="ignore"):
            right = np.abs(ranges / truth[path.stem] - 1) < 0.05
        assert right[seen].mean() > 0.75, right[seen].mean()
    assert read_range_tiff(Path("out/range/003.tiff")).shape == (SIZE_HW[0] // 2, SIZE_HW[1] // 2)
    assert len(read_ply(Path("out/cloud.ply"))) > 1000
