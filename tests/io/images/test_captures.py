"""Which pictures a capture has, and which of them are panoramas."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.engine.cache.store import Store
from pano_mvs.io.images import captures
from pano_mvs.io.images.captures import PictureInfo, describe_picture, list_pictures, natural_key
from pano_mvs.io.ranges import write_range_tiff
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.scene.exr import write_exr
from pano_mvs.session.session import open_session
from tests.io.images.pictures import by_pillow, full_sphere, picture, sound_files, write_jpeg, write_png, xmp
from tests.permissions import permissions_hold


def test_pictures_come_in_the_order_in_which_people_count(tmp_path: Path) -> None:
    names = ["b/1.jpg", "B10.jpg", "a2.JPG", "a10.png", "A1.tif", "b2.webp", "a2b.jpeg", "a/3.tiff"]
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    for ignored in (".hidden.jpg", ".cache/x.jpg", "masks/a2.png", "b/Masks/1.png", "notes.txt", "masks.txt"):
        (tmp_path / ignored).parent.mkdir(exist_ok=True)
        (tmp_path / ignored).touch()
    (tmp_path / "folder.jpg").mkdir()
    found = [path.relative_to(tmp_path).as_posix() for path in list_pictures(tmp_path)]
    assert found == ["A1.tif", "a2.JPG", "a2b.jpeg", "a10.png", "a/3.tiff", "b2.webp", "B10.jpg", "b/1.jpg"]


def test_a_folder_under_a_hidden_one_is_not_hidden(tmp_path: Path) -> None:
    inside = tmp_path / ".photos" / "lobby"
    inside.mkdir(parents=True)
    (inside / "1.jpg").touch()
    assert list_pictures(inside) == [inside / "1.jpg"]


def test_names_that_differ_only_in_case_or_zeros_keep_one_order() -> None:
    names = ["img_1", "IMG_1", "img_01", "img_²"]
    assert len({tuple(map(str, natural_key(name))) for name in names}) == 4
    backwards = ["img_²", "img_01", "IMG_1", "img_1"]
    assert sorted(names, key=natural_key) == sorted(backwards, key=natural_key)


def test_caches_and_outputs_of_earlier_runs_are_no_part_of_the_capture(tmp_path: Path) -> None:
    """Their masks and previews were taken for images on the second run."""
    Store(tmp_path / "new")
    Store(tmp_path / "deep" / "old")
    caches = ("new/blobs/ab/3.png", "deep/old/blobs/ab/4.png")
    outputs = ("out/lobby/preview/1.jpg", "out/lobby/.pano-mvs-output", "b/run.json")
    for name in ("1.jpg", "deep/2.jpg", "b/2.jpg", *caches, *outputs):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found = [path.relative_to(tmp_path).as_posix() for path in list_pictures(tmp_path)]
    assert found == ["1.jpg", "b/2.jpg", "deep/2.jpg"]
    with pytest.raises(InputError, match=r"new: this is a cache of pano-mvs.* move them to a folder of their own"):
        list_pictures(tmp_path / "new")


@pytest.mark.parametrize("mode", [0o000, 0o400])
def test_a_subfolder_that_cannot_be_read_costs_what_it_holds(tmp_path: Path, mode: int) -> None:
    """A `lost+found` ended the run."""
    for name in ("1.jpg", "lost+found/2.jpg", "z/3.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "lost+found").chmod(mode)
    notes: list[str] = []
    with permissions_hold():
        found = [path.relative_to(tmp_path).as_posix() for path in list_pictures(tmp_path, notes)]
    (tmp_path / "lost+found").chmod(0o700)
    if mode:  # its names can be listed, and reading the file then says what is wrong
        assert (found, notes) == (["1.jpg", "lost+found/2.jpg", "z/3.jpg"], [])
    else:
        assert found == ["1.jpg", "z/3.jpg"]
        assert notes == [f"{tmp_path / 'lost+found'}: cannot be listed (Permission denied); its contents are skipped"]


def test_a_folder_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir(mode=0o000)
    with permissions_hold(), pytest.raises(InputError, match=r"photos: cannot be listed \(Permission denied\)"):
        list_pictures(tmp_path / "photos")
    (tmp_path / "photos").chmod(0o700)


@pytest.mark.parametrize(("folder", "what"), [("gone", "no such folder"), ("empty", "no images here")])
def test_a_folder_without_pictures_is_named(tmp_path: Path, folder: str, what: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=f"{folder}: {what}"):
        list_pictures(tmp_path / folder)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tiff", "webp"])
def test_twice_as_wide_as_high_is_a_panorama_with_a_warning(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), picture((32, 64)))
    info = describe_picture(path)
    assert info.size_hw == (32, 64)
    assert info.gpano is None
    assert info.warnings == ()
    assert "no GPano metadata" in info.traits[0]


def test_headers_are_read_without_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(captures, "decode_image", None)
    write_jpeg(tmp_path / "a.jpg", (32, 64))
    write_jpeg(tmp_path / "b.jpg", (32, 64), progressive=True)
    write_png(tmp_path / "c.png", (32, 64))
    for number, data in enumerate(
        [*sound_files((32, 64), b""), by_pillow((32, 64), "WEBP"), by_pillow((32, 64), "WEBP", lossless=True)]
    ):
        (tmp_path / f"{number}.webp").write_bytes(data)
    for path in tmp_path.iterdir():
        assert describe_picture(path).size_hw == (32, 64), path


def test_tables_before_the_frame_are_no_frame(tmp_path: Path) -> None:
    """Some encoders write their Huffman tables (marker C4, among the frames' markers) first."""
    data = write_jpeg(tmp_path / "a.jpg", (32, 64)).read_bytes()
    table = data[data.index(b"\xff\xc4") :]
    table = table[: 2 + int.from_bytes(table[2:4], "big")]
    (tmp_path / "a.jpg").write_bytes(data[:2] + table + data[2:])
    assert describe_picture(tmp_path / "a.jpg").size_hw == (32, 64)


def test_a_thumbnail_within_the_metadata_is_not_the_picture(tmp_path: Path) -> None:
    thumbnail = bytes(cv2.imencode(".jpg", picture((16, 20)))[1])
    data = write_jpeg(tmp_path / "a.jpg", (32, 64)).read_bytes()
    exif = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 8) + b"Exif\0\0" + thumbnail
    (tmp_path / "a.jpg").write_bytes(data[:2] + exif + b"\xff" + data[2:])
    assert describe_picture(tmp_path / "a.jpg").size_hw == (32, 64)


def cropped(fields: dict[str, object], crop_ltwh: tuple[int, int, int, int]) -> dict[str, object]:
    """Return fields of GPano with those of a crop: left, top, width, height."""
    names = ("LeftPixels", "TopPixels", "ImageWidthPixels", "ImageHeightPixels")
    return fields | {f"CroppedArea{name}": value for name, value in zip(names, crop_ltwh, strict=True)}


def test_a_cropped_panorama_is_placed_on_its_sphere(tmp_path: Path) -> None:
    fields = cropped(full_sphere(40, 80), (10, 7, 60, 30))
    path = write_png(tmp_path / "a.png", (30, 60), xmp(fields))
    info = describe_picture(path)
    assert (info.size_hw, info.crop_ltwh, info.warnings) == ((40, 80), (10, 7, 60, 30), ())
    panorama = Panorama(FilePart(path), info.size_hw, info.size_hw, info.crop_ltwh)
    panorama.check()
    np.testing.assert_array_equal(panorama.load()[7:37, 10:70, ::-1], picture((30, 60)))
    assert panorama.load_mask().sum() == 30 * 60


def test_a_panorama_made_smaller_keeps_its_place(tmp_path: Path) -> None:
    fields = cropped(full_sphere(400, 800), (100, 70, 600, 300))
    info = describe_picture(write_png(tmp_path / "a.png", (30, 60), xmp(fields)))
    assert (info.size_hw, info.crop_ltwh, info.full_width_px) == ((400, 800), (100, 70, 600, 300), 80)
    assert "resized from 600×300 to 60×30 px" in info.warnings[0]


def described(folder: Path, size_hw: tuple[int, int], fields: dict[str, object]) -> PictureInfo:
    stated = {name: value for name, value in fields.items() if value is not None}
    return describe_picture(write_png(folder / "a.png", size_hw, xmp(stated)))


LEFT, TOP = "CroppedAreaLeftPixels", "CroppedAreaTopPixels"
WIDTH, HEIGHT = "CroppedAreaImageWidthPixels", "CroppedAreaImageHeightPixels"
FULL_WIDTH, FULL_HEIGHT = "FullPanoWidthPixels", "FullPanoHeightPixels"


@pytest.mark.parametrize(
    ("size_hw", "crop_ltwh", "missing", "placed", "said"),
    [
        # a missing upper edge counted as 0: directions were wrong by half of what was cut off
        ((30, 80), (0, 7, 80, 30), {TOP: None}, (0, 5, 80, 30), "no CroppedAreaTopPixels in their GPano metadata"),
        ((30, 80), (0, 7, 80, 30), {TOP: "n/a"}, (0, 5, 80, 30), "no CroppedAreaTopPixels in their GPano metadata"),
        ((30, 80), (0, 7, 80, 30), {TOP: -7}, (0, 5, 80, 30), "no CroppedAreaTopPixels in their GPano metadata"),
        ((30, 60), (10, 7, 60, 30), {LEFT: None}, (10, 7, 60, 30), "no CroppedAreaLeftPixels in their GPano metadata"),
        # what the other fields imply is known
        ((30, 80), (0, 7, 80, 30), {LEFT: None}, (0, 7, 80, 30), ""),
        ((40, 60), (9, 0, 60, 40), {TOP: None}, (9, 0, 60, 40), ""),
        ((30, 60), (9, 7, 60, 30), {FULL_WIDTH: None}, (9, 7, 60, 30), ""),
        ((30, 60), (9, 7, 60, 30), {FULL_HEIGHT: None}, (9, 7, 60, 30), ""),
        ((15, 30), (9, 7, 60, 30), {HEIGHT: None}, (9, 7, 60, 30), "resized from 60×30"),
        ((15, 30), (9, 7, 60, 30), {WIDTH: None}, (9, 7, 60, 30), "resized from 60×30"),
        ((30, 60), (9, 7, 60, 30), {WIDTH: None, HEIGHT: None}, (9, 7, 60, 30), "do not state the size of the part"),
        ((40, 80), (0, 0, 80, 40), {TOP: None, LEFT: None}, None, ""),
        ((20, 40), (0, 0, 80, 40), {TOP: None, LEFT: None, WIDTH: None, HEIGHT: None}, None, ""),
        ((40, 80), (3, 0, 80, 40), {}, None, "show all of the sphere"),
        ((40, 80), (0, 0, 80, 40), {FULL_WIDTH: None, FULL_HEIGHT: None}, None, ""),
    ],
)
def test_a_field_that_a_crop_does_not_state_is_not_zero(
    tmp_path: Path,
    size_hw: tuple[int, int],
    crop_ltwh: tuple[int, int, int, int],
    missing: dict[str, object],
    placed: tuple[int, int, int, int] | None,
    said: str,
) -> None:
    info = described(tmp_path, size_hw, cropped(full_sphere(40, 80), crop_ltwh) | missing)
    assert (info.size_hw, info.crop_ltwh) == (size_hw if placed is None else (40, 80), placed)
    notes = (*info.warnings, *info.traits)
    assert any(said in note for note in notes) if said else not notes


@pytest.mark.parametrize(
    ("crop_ltwh", "missing", "what"),
    [
        ((10, 7, 60, 30), {TOP: None}, "60×30 px of a sphere of 80×40, but not its upper edge, CroppedAreaTopPixels"),
        ((10, 7, 60, 30), {FULL_WIDTH: None, FULL_HEIGHT: None}, "but not the size of the full sphere"),
        ((30, 7, 60, 30), {}, r"60×30 px at \(30, 7\) does not lie within the sphere of 80×40"),
        ((10, 17, 60, 30), {}, r"60×30 px at \(10, 17\) does not lie within the sphere of 80×40"),
    ],
)
def test_a_crop_whose_place_is_unknown_is_refused(
    tmp_path: Path, crop_ltwh: tuple[int, int, int, int], missing: dict[str, object], what: str
) -> None:
    """Those that are twice as wide as high were taken for full spheres."""
    with pytest.raises(InputError, match=rf"a\.png: .*{what}.*\. (Write|Correct) the "):
        described(tmp_path, (30, 60), cropped(full_sphere(40, 80), crop_ltwh) | missing)


def test_a_crop_that_may_begin_anywhere_has_neither_a_heading_nor_a_slope(tmp_path: Path) -> None:
    fields = cropped(full_sphere(40, 80), (10, 7, 60, 30)) | {LEFT: None, "PoseHeadingDegrees": 90}
    for pitch_deg, expected in ((0, (0, -1, 0)), (5, None)):
        angles = {"PosePitchDegrees": pitch_deg, "PoseRollDegrees": 0}
        gpano = described(tmp_path, (30, 60), fields | angles).gpano
        assert gpano is not None
        assert gpano.heading_deg is None
        assert gpano.up_in_cam == (None if expected is None else pytest.approx(expected))


@pytest.mark.parametrize("height", [20_000, 10**9, 10**300])
def test_a_sphere_of_any_size_costs_no_memory(tmp_path: Path, height: int) -> None:
    """A GPano field of two thousand million columns ended the whole run without a report."""
    fields = cropped(full_sphere(height, 2 * height), (0, 0, 64, 32))
    with pytest.raises(InputError, match=r"the full sphere is \d+×\d+ px, more than the limit of 512 megapixels"):
        describe_picture(write_png(tmp_path / "a.png", (32, 64), xmp(fields)))


def test_what_is_not_a_picture_file_is_named(tmp_path: Path) -> None:
    """Broken links, pipes, links to devices, GIFs, raw pictures, and recordings that are not stitched vanished."""
    write_png(tmp_path / "a.png", (32, 64))
    (tmp_path / "b.jpg").symlink_to("nowhere.jpg")
    (tmp_path / "c.jpg").symlink_to("/dev/zero")
    for name in ("e.gif", "f.DNG", "g.insv", "h.mp4", "notes.txt"):
        (tmp_path / name).touch()
    write_range_tiff(tmp_path / "i.tiff", np.ones((32, 64), np.float32))
    write_exr(tmp_path / "j.exr", {"Z": np.ones((32, 64), np.float32)})
    notes: list[str] = []
    os.mkfifo(tmp_path / "d.jpg")
    assert [path.name for path in list_pictures(tmp_path, notes)] == ["a.png"]
    assert [note.removeprefix(str(tmp_path)) for note in notes] == [
        "/b.jpg: this is a link that leads nowhere; it is skipped",
        "/c.jpg: this is not a regular file; it is skipped",
        "/d.jpg: this is not a regular file; it is skipped",
        ": images of unsupported formats (dng, gif; convert them to JPEG or TIFF to use them) are skipped: "
        "e.gif, f.DNG",
        ": maps of a single quantity, such as ranges (floating-point TIFF or EXR files without colours), are skipped: "
        "i.tiff, j.exr",
        ": recordings that are not stitched yet are skipped: g.insv",
        ": videos, which source.video reads, are skipped: h.mp4",
    ]


@pytest.mark.parametrize("suffix", ["jfif", "jpe", "JPE", "hdr", "exr"])
def test_pictures_are_read_whatever_their_suffix(tmp_path: Path, suffix: str) -> None:
    """Files called .jfif, .jpe, .hdr and .exr beside others were left out without a word."""
    path = tmp_path / f"b.{suffix}"
    if suffix == "exr":
        write_exr(path, dict.fromkeys("RGB", np.ones((32, 64), np.float32)))
    else:
        kind = ".hdr" if suffix == "hdr" else ".jpg"
        path.write_bytes(bytes(cv2.imencode(kind, picture((32, 64)).astype(np.float32))[1]))
    write_png(tmp_path / "a.png", (32, 64))
    notes: list[str] = []
    assert list_pictures(tmp_path, notes) == [tmp_path / "a.png", path]
    assert notes == []
    info = describe_picture(path)
    assert info.size_hw == (32, 64)
    assert any("tone-mapped" in trait for trait in info.traits) == (suffix in ("hdr", "exr"))


@pytest.mark.parametrize(("name", "rig"), [("VID_1.insv", True), ("GS010001.360", False)])
def test_recordings_that_are_not_stitched_say_so_wherever_they_are_given(tmp_path: Path, name: str, rig: bool) -> None:
    """A folder of them had "no images here"."""
    (tmp_path / name).touch()

    def read_as_images() -> None:
        open_session("quickstart", images=tmp_path / name, out=tmp_path / "out")

    reads: list[Callable[[], object]] = [lambda: list_pictures(tmp_path), read_as_images]
    for read in reads:
        with pytest.raises(InputError, match=rf"{name}, which a camera .* recorded .*Export it as") as caught:
            read()
        assert ("source.dual_fisheye" in str(caught.value)) == rig


@pytest.mark.parametrize(
    ("size", "fields", "what"),
    [
        ((30, 64), None, "64×30 px is not a full sphere"),
        ((30, 64), {"PoseHeadingDegrees": 3}, "64×30 px is not a full sphere"),
        ((32, 64), {"ProjectionType": "cylindrical"}, "it is cylindrical, not equirectangular"),
        ((20, 64), full_sphere(32, 64), "cut after it was taken"),
        ((32, 64), full_sphere(32, 64, FullPanoHeightPixels=40), "the full sphere is 64×40 px"),
    ],
)
def test_what_is_no_panorama_is_named_with_the_remedy(
    tmp_path: Path, size: tuple[int, int], fields: dict[str, object] | None, what: str
) -> None:
    path = write_jpeg(tmp_path / "odd one.jpg", size, None if fields is None else xmp(fields))
    with pytest.raises(InputError, match=rf"odd one\.jpg: .*{what}.*[.:] "):
        describe_picture(path)


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xd8\xff", b"\xff\xd8\xff\xe1\x00\x00\xff\xd9", b"\x89PNG\r\n\x1a\n", b"hello"]
)
def test_what_is_no_picture_is_named(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.jpg").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.jpg: "):
        describe_picture(tmp_path / "a.jpg")
