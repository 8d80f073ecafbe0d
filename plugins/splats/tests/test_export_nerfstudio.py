"""transforms.json with its pictures, masks and depths, read as nerfstudio's data parser and cameras are documented."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import PIL.Image
import pytest
from pano_mvs_splats.nerfstudio import NerfstudioFramesParams, NerfstudioParams, nerfstudio, nerfstudio_frames
from scipy.spatial import cKDTree

from pano_mvs.api import FilePart, InputError, Panorama, Poses, RangeMap
from pano_mvs.io import transforms_json
from pano_mvs.io.ply import open_ply_points
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.transforms_json import NerfstudioFrame
from pano_mvs.scene.photographs import Photographs
from pano_mvs.testing.room import default_room, range_along
from pano_mvs.testing.tiny_capture import TinyCapture, Variant, tiny_capture
from tests.oracles.nerfstudio import documented_rays, world_points
from tests.stored import read_picture
from tests.synthetic.published_frames import published, scratch_in, true_ranges

HEIGHT, WIDTH = 192, 384
PLAIN = Variant((HEIGHT, WIDTH))
MASKED = Variant((64, 128), masked=True)


def exported(
    capture: TinyCapture,
    folder: Path,
    *,
    images: dict[str, Panorama] | None = None,
    frame: Literal["upright", "world"] = "upright",
) -> Path:
    """Write both variants with true ranges everywhere, as a run would, and return the folder nerfstudio/."""
    given, ranges = images or capture.images, true_ranges(capture)
    params, seeds = NerfstudioFramesParams(), NerfstudioParams(seed_points=100, frame=frame)
    poses, photographs = capture.whole(Poses), capture.whole(Photographs)
    out = published(
        folder,
        capture.names,
        lambda name, ctx: nerfstudio_frames(given[name], ranges[name], params, ctx),
        whole=lambda frames, ctx: nerfstudio(frames, poses, None, photographs, seeds, ctx),
    )
    return out / "nerfstudio"


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tiny_capture(PLAIN), tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def masked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some of the panoramas are masked, some are not."""
    capture, folder = tiny_capture(MASKED), tmp_path_factory.mktemp("masked")
    images = dict(capture.images)
    images["001.png"] = replace(images["001.png"], mask_file=None)
    return exported(capture, folder, images=images)


def test_photographs_are_listed_after_the_faces(plain: Path) -> None:
    folder, photographs = plain / "faces", tiny_capture(PLAIN).whole(Photographs)
    faces = json.loads((folder / "transforms.json").read_text())
    document = json.loads((folder / "transforms_photographs.json").read_text())
    *listed, last = document["frames"]
    assert [frame["transform_matrix"] for frame in listed] == [frame["transform_matrix"] for frame in faces["frames"]]
    assert document["camera_model"] == "OPENCV"
    assert (last["w"], last["h"], last["fl_x"], last["k1"]) == (40, 30, 35.0, -0.05)
    assert (folder / last["file_path"]).read_bytes() == photographs.pictures[0].path.read_bytes()
    pose = photographs.cam_from_world(0)
    turned = np.array(document["file_from_world"]) @ pose.rotation.T
    np.testing.assert_allclose(np.array(last["transform_matrix"])[:3, :3], turned @ np.diag([1, -1, -1]), atol=1e-12)
    assert "depth_file_path" not in last
    assert all((folder / frame["file_path"]).is_file() for frame in document["frames"])


@pytest.mark.parametrize("variant", ["equirectangular", "faces"])
def test_depths_are_on_the_walls(plain: Path, variant: str) -> None:
    """Each unprojected pixel lies on the room: as far along its ray as the room is, whatever the camera."""
    folder = plain / variant
    document = json.loads((folder / "transforms.json").read_text())
    capture = tiny_capture(PLAIN)
    assert len(document["frames"]) == len(capture.names) * (1 if variant == "equirectangular" else 6)
    errors = []
    for frame in document["frames"]:
        points, known = world_points(folder, document, frame)
        assert known.mean() > 0.98
        world_from_file = np.array(document["file_from_world"]).T
        points = points @ world_from_file.T
        origin = world_from_file @ np.array(frame["transform_matrix"])[:3, 3]
        length = np.linalg.norm(points - origin, axis=1)
        truth = range_along(default_room(), origin, (points - origin) / length[:, None])
        errors.append(np.abs(length - truth))
    found = np.concatenate(errors)
    if variant == "equirectangular":
        assert found.max() < 0.00051  # half a step
    else:
        assert np.median(found) < 0.001  # interpolated between range pixels 0.9° apart …
        assert np.quantile(found, 0.9) < 0.02  # … but at the edges of the furniture


def test_poses_are_read_back_by_our_own_reader(plain: Path) -> None:
    capture = tiny_capture(PLAIN)
    poses = read_poses(plain / "equirectangular")
    assert list(poses.names) == list(capture.names)
    for idx, pose in enumerate(capture.poses):
        np.testing.assert_allclose(poses.rotations[idx], pose.rotation, atol=1e-12)
        np.testing.assert_allclose(poses.translations[idx], pose.translation, atol=1e-12)


def test_cameras_and_points_have_z_up_together(plain: Path) -> None:
    """A floor below the cameras is below along z, in the file of the points, too."""
    document = json.loads((plain / "equirectangular" / "transforms.json").read_text())
    assert document["file_from_world"] == [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    for frame, pose in zip(document["frames"], tiny_capture(PLAIN).poses, strict=True):
        x, y, z = pose.center
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], [x, z, -y], atol=1e-12)
    x, y, z = tiny_capture(PLAIN).points_in_world.T
    for variant in ("equirectangular", "faces"):
        seed = open_ply_points(plain / variant / document["ply_file_path"])
        assert 85 <= seed.count <= 100
        in_file = np.stack([seed.vertices[name] for name in "xyz"], axis=-1)
        assert np.max(cKDTree(np.stack([x, z, -y], axis=-1)).query(in_file)[0]) < 1e-5
        assert np.max(cKDTree(np.stack([x, y, z], axis=-1)).query(next(seed.chunks()))[0]) < 1e-5


def test_the_world_frame_can_be_kept(tmp_path: Path) -> None:
    folder = exported(tiny_capture(PLAIN), tmp_path, frame="world")
    document = json.loads((folder / "equirectangular" / "transforms.json").read_text())
    assert "file_from_world" not in document
    center = tiny_capture(PLAIN).poses[1].center
    np.testing.assert_allclose(np.array(document["frames"][1]["transform_matrix"])[:3, 3], center, atol=1e-12)
    assert b"comment" not in (folder / "equirectangular" / "seed.ply").read_bytes()[:300]


def test_faces_look_where_their_cameras_say(plain: Path) -> None:
    """A colour of a face is that of the panorama along the ray that the file describes."""
    capture = tiny_capture(PLAIN)
    document = json.loads((plain / "faces" / "transforms.json").read_text())
    differences = []
    for frame in document["frames"]:
        name = Path(frame["file_path"]).name.split(".png.")[0] + ".png"
        picture = read_picture(plain / "faces" / frame["file_path"])[..., ::-1].astype(int)
        assert picture.shape[1::-1] == (document["w"], document["h"])
        rays = documented_rays(document, frame, picture.shape[1::-1])
        pose = capture.poses[capture.names.index(name)]
        in_cam = rays @ np.array(document["file_from_world"]) @ pose.rotation.T
        column = ((np.arctan2(in_cam[..., 0], in_cam[..., 2]) / (2 * np.pi) + 0.5) * WIDTH).astype(int) % WIDTH
        row = (0.5 + np.arctan2(in_cam[..., 1], np.hypot(in_cam[..., 0], in_cam[..., 2])) / np.pi) * HEIGHT
        seen = capture.pictures[capture.names.index(name)][np.minimum(row.astype(int), HEIGHT - 1), column]
        differences.append(np.abs(picture - seen).mean(axis=-1))
    assert np.median(differences) < 8  # a wrong sign or half a turn gives 40 and more


def test_the_file_says_what_nerfstudio_looks_for(plain: Path) -> None:
    for variant, model in (("equirectangular", "EQUIRECTANGULAR"), ("faces", "PINHOLE")):
        document = json.loads((plain / variant / "transforms.json").read_text())
        assert document["camera_model"] == model
        assert document["applied_transform"] == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
        assert document["depth_unit_scale_factor"] == 0.001
        assert (document["cx"], document["cy"]) == (document["w"] / 2, document["h"] / 2)
        assert not any("mask_path" in frame for frame in document["frames"])
        assert not (plain / variant / "masks").exists()
        for frame in document["frames"]:
            assert (plain / variant / frame["file_path"]).is_file()
    document = json.loads((plain / "equirectangular" / "transforms.json").read_text())
    assert (document["w"], document["h"], document["fl_x"], document["fl_y"]) == (WIDTH, HEIGHT, WIDTH / 2, HEIGHT)


def test_a_picture_is_delivered_as_it_is_and_not_kept_twice(plain: Path) -> None:
    for name in tiny_capture(PLAIN).names:
        given = tiny_capture(PLAIN).folder / "images" / name
        assert (plain / "equirectangular" / "images" / name).read_bytes() == given.read_bytes()
        cached = [
            path
            for path in (plain.parents[1] / "cache" / "blobs").rglob("*.png")
            if path.read_bytes() == given.read_bytes()
        ]
        assert not cached


@pytest.mark.parametrize("variant", ["equirectangular", "faces"])
def test_no_depth_comes_from_a_masked_pixel(masked: Path, variant: str) -> None:
    """Every frame has a mask, though one panorama has none of its own; pictures show nothing that is masked."""
    capture = tiny_capture(MASKED)
    document = json.loads((masked / variant / "transforms.json").read_text())
    hidden = 0
    for frame in document["frames"]:
        mask = read_picture(masked / variant / frame["mask_path"], cv2.IMREAD_UNCHANGED)
        steps = read_picture(masked / variant / frame["depth_file_path"], cv2.IMREAD_UNCHANGED)
        picture = read_picture(masked / variant / frame["file_path"])
        assert mask.shape == steps.shape == picture.shape[:2]
        assert set(np.unique(mask)) <= {0, 255}
        assert not steps[mask == 0].any()
        hidden += int((mask == 0).sum())
        if "001" in frame["file_path"]:
            assert variant == "faces" or frame["file_path"] == "images/001.png"  # nothing to paint over
            assert (mask == 255).all()
            assert frame["mask_path"].startswith("masks/none_")
        elif variant == "equirectangular":
            name = Path(frame["file_path"]).stem
            np.testing.assert_array_equal(mask > 0, capture.images[name].load_mask())
            shown = picture[..., ::-1].astype(int) - capture.images[name].load()
            assert np.abs(shown).mean() < 4  # JPEG of what is painted over
    assert hidden > 1000


def test_nothing_unprojects_to_where_only_masked_pixels_look(masked: Path) -> None:
    """Faces too: no depth pixel's ray falls into a masked pixel of its panorama."""
    capture = tiny_capture(MASKED)
    document = json.loads((masked / "faces" / "transforms.json").read_text())
    for frame in document["frames"]:
        name = Path(frame["file_path"]).name.split(".png.")[0] + ".png"
        if name == "001.png":
            continue
        points, _ = world_points(masked / "faces", document, frame)
        points = points @ np.array(document["file_from_world"])
        in_cam = capture.poses[capture.names.index(name)].apply(points)
        column = ((np.arctan2(in_cam[:, 0], in_cam[:, 2]) / (2 * np.pi) + 0.5) * 128).astype(int) % 128
        row = ((0.5 + np.arctan2(in_cam[:, 1], np.hypot(in_cam[:, 0], in_cam[:, 2])) / np.pi) * 64).astype(int)
        assert capture.images[name].load_mask()[np.minimum(row, 63), column].all()


def test_cropped_and_scaled_panoramas_are_written_whole(tmp_path: Path) -> None:
    capture = tiny_capture(Variant((64, 128), cropped=True))
    images = dict(capture.images)
    images["001.png"] = replace(tiny_capture(PLAIN).images["001.png"], size_hw=(32, 64))
    for image, size_hw in ((images["000.png"], (64, 128)), (images["001.png"], (32, 64))):
        params = NerfstudioFramesParams(variants=("equirectangular",), image_format="png")
        made = nerfstudio_frames(image, None, params, scratch_in(tmp_path))
        assert not made.pictures
        path = made.files["nerfstudio/equirectangular/images/{name}.png"]
        picture = read_picture(path)[..., ::-1]
        assert picture.shape[:2] == size_hw
        np.testing.assert_array_equal(picture, image.load())
        assert made.frames[0].size_wh == size_hw[::-1]
        assert not made.frames[0].depth
        assert bool(made.frames[0].mask) == (image is images["000.png"])


def test_captures_of_two_sizes_say_the_intrinsics_of_each(tmp_path: Path) -> None:
    folder = exported(tiny_capture(Variant((64, 128), mixed=True)), tmp_path)
    for variant in ("equirectangular", "faces"):
        document = json.loads((folder / variant / "transforms.json").read_text())
        assert "fl_x" not in document
        widths = {frame["w"] for frame in document["frames"]}
        assert len(widths) == 2
        for frame in document["frames"][:3]:
            points, known = world_points(folder / variant, document, frame)
            assert len(points) == known.sum() > 100


def test_ranges_beyond_16_bits_are_unknown_and_told(tmp_path: Path) -> None:
    image = tiny_capture(PLAIN).images["000.png"]
    far = np.full((HEIGHT, WIDTH), 70.0, np.float32)
    far[:96] = 2
    doubtful = np.full((HEIGHT, WIDTH), 200, np.uint8)
    doubtful[:48] = 40
    ctx = scratch_in(tmp_path)
    params = NerfstudioFramesParams(variants=("equirectangular",))
    made = nerfstudio_frames(image, RangeMap(far, doubtful), params, ctx)
    steps = read_picture(made.files["nerfstudio/equirectangular/depths/{name}.png"], cv2.IMREAD_UNCHANGED)
    assert np.unique(steps[:48]).tolist() == np.unique(steps[96:]).tolist() == [0]
    assert np.unique(steps[48:96]).tolist() == [2000]
    assert ctx.metrics["beyond_depth"] == pytest.approx(2 / 3)
    assert "exceed the 65.535 scene units" in ctx.notes[0]
    assert "a larger depth_unit" in ctx.notes[0]


def test_panoramas_without_frames_are_told_and_none_at_all_is_refused(tmp_path: Path) -> None:
    capture = tiny_capture(PLAIN)
    poses = capture.whole(Poses)
    params = NerfstudioFramesParams.model_validate({"variants": ("faces",), "size_px": 32})
    made = nerfstudio_frames(capture.images["002.png"], None, params, scratch_in(tmp_path / "a"))
    ctx = scratch_in(tmp_path)
    files = nerfstudio({"002.png": made}, poses, None, None, NerfstudioParams(seed_points=0), ctx).files
    assert set(files) == {"nerfstudio/faces/transforms.json"}
    document = json.loads(files["nerfstudio/faces/transforms.json"].read_text())
    assert "ply_file_path" not in document
    assert not any("depth_file_path" in frame for frame in document["frames"])
    assert ctx.notes == ["3 of 4 registered panoramas have no ranges and are not in transforms.json"]
    with pytest.raises(InputError, match="no panorama has both a pose and frames"):
        nerfstudio({}, poses, None, None, NerfstudioParams(), ctx)


def test_grey_16_bit_and_cmyk_pictures_are_written_anew(tmp_path: Path) -> None:
    """Trainers read 8 bits a channel; what is no such file is decoded once, here.

    CMYK JPEGs were delivered as they are, and trainers took the four channels for colours with transparency.
    """
    image = tiny_capture(PLAIN).images["000.png"]
    deep = read_picture(image.image.path).astype(np.uint16) * 257
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    cv2.imwrite(str(tmp_path / "grey.png"), (deep[..., 0] >> 8).astype(np.uint8))
    PIL.Image.open(image.image.path).convert("CMYK").save(tmp_path / "cmyk.jpg")
    PIL.Image.open(image.image.path).convert("L").save(tmp_path / "grey.jpg")
    for idx, name in enumerate(("deep.png", "grey.png", "cmyk.jpg", "grey.jpg")):
        given = replace(image, image=FilePart(tmp_path / name, external=True))
        params = NerfstudioFramesParams(variants=("equirectangular",))
        made = nerfstudio_frames(given, None, params, scratch_in(tmp_path / str(idx)))
        assert list(made.files) == ["nerfstudio/equirectangular/images/{name}.jpg"]


def test_frames_are_read_with_one_schema(monkeypatch: pytest.MonkeyPatch) -> None:
    """Building a schema takes longer than reading hundreds of frames with it."""
    turned = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0))
    frame = NerfstudioFrame("faces", "a.png", "", "a_depth.png", (64, 64), (32.0, 32.0), turned, radial=0.1)
    document = json.loads(json.dumps(frame.to_json()))
    monkeypatch.delattr(transforms_json, "TypeAdapter")
    assert NerfstudioFrame.from_json(document) == frame
