"""A calibration file gives the rig that it states, or an error with file, line, key and remedy.

The pictures of both lenses are found side by side, in two folders, or by the ends of their names.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import LensRig
from pano_mvs.io.images.captures import Layout, list_rig_pictures
from pano_mvs.io.rig_calibration import calibration_text, read_rig
from pano_mvs.scene import FilePart
from tests.synthetic.fisheye_rig import example_rig

TEXT = """\
model: opencv_fisheye
first_pixel_px: 0
lenses:
  front:
    image_size_px: [640, 480]
    focal_px: [150.0, 151.0]
    principal_point_px: [319.5, 239.5]
    distortion: [0.01, 0, 0, 0]
    field_of_view_deg: 190
    lens_from_rig: {rotation_wxyz: [1, 0, 0, 0], translation_m: [0, 0, 0]}
  back:
    image_size_px: [640, 480]
    focal_px: [150.0, 151.0]
    principal_point_px: [320, 240]
    distortion: [0.01, 0, 0, 0]
    field_of_view_deg: 190
    lens_from_rig:
      rotation: [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]
      translation_m: [0, 0, -0.03]
"""


def file_of(folder: Path, text: str) -> FilePart:
    (folder / "rig.yaml").write_text(text, encoding="utf-8")
    return FilePart(folder / "rig.yaml")


def test_a_rig_survives_its_own_calibration_file(tmp_path: Path) -> None:
    rig = example_rig()
    again = read_rig(file_of(tmp_path, calibration_text(rig)))
    assert again.names == rig.names
    for lens, expected in zip(again.lenses, rig.lenses, strict=True):
        assert lens.size_hw == expected.size_hw
        assert (*lens.focal_xy, *lens.principal_xy, *lens.distortion) == pytest.approx(
            (*expected.focal_xy, *expected.principal_xy, *expected.distortion)
        )
        assert lens.max_angle_rad == pytest.approx(expected.max_angle_rad)
    for pose, true in zip(again.lens_from_rig, rig.lens_from_rig, strict=True):
        assert pose.rotation == pytest.approx(true.rotation, abs=1e-12)
        assert pose.translation == pytest.approx(true.translation, abs=1e-12)


def test_a_merge_key_takes_what_is_not_stated_from_another_lens(tmp_path: Path) -> None:
    start, end = TEXT.index("  back:"), TEXT.index("    lens_from_rig:\n")
    merged = TEXT[:start].replace("front:", "front: &front") + "  back:\n    <<: [*front]\n    focal_px: [9, 9]\n"
    rig = read_rig(file_of(tmp_path, merged + TEXT[end:]))
    assert rig.lenses[1].focal_xy == pytest.approx((9, 9))
    assert rig.lenses[1].distortion == rig.lenses[0].distortion
    with pytest.raises(InputError, match=r"rig\.yaml:11:14: a merge key \(<<\) takes a mapping or a list of mappings"):
        read_rig(file_of(tmp_path, TEXT.replace("  back:", "  back: {<<: 3}\n  next:")))


def test_an_assumed_distance_stays_one(tmp_path: Path) -> None:
    rig = replace(example_rig(), metric=False)
    again = read_rig(file_of(tmp_path, calibration_text(rig, comments=["from 8 captures"])))
    assert not again.metric
    assert not LensRig.from_values(again.to_values()).metric
    assert (tmp_path / "rig.yaml").read_text(encoding="utf-8").startswith("# from 8 captures\n")
    assert read_rig(file_of(tmp_path, TEXT)).metric
    with pytest.raises(InputError, match=r"rig\.yaml:1:9: metric: Input should be a valid boolean"):
        read_rig(file_of(tmp_path, f"metric: 1\n{TEXT}"))


def test_opencv_counts_pixels_from_the_centre_of_the_first(tmp_path: Path) -> None:
    rig = read_rig(file_of(tmp_path, TEXT), stitch_distance_m=2.0)
    assert rig.lenses[0].principal_xy == (320.0, 240.0)
    assert rig.lenses[1].principal_xy == (320.5, 240.5)
    assert rig.stitch_distance_m == 2.0
    # Its centre is -Rᵀ t = (0, 0, -0.03) in the frame of the front lens.
    assert rig.centers[0] - rig.centers[1] == pytest.approx((0, 0, 0.03))
    assert rig.lens_of_bearings([(0, 0, 1), (0, 0, -1)]).tolist() == [0, 1]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("opencv_fisheye", "pinhole", "1:8: model: Input should be 'kannala_brandt' or"),
        ("first_pixel_px: 0", "first_pixel_px: 1", "2:17: first_pixel_px: must be 0.5 (COLMAP) or 0"),
        ("first_pixel_px: 0\n", "", "1:1: setting 'first_pixel_px' is missing"),
        ("[640, 480]", "[640]", "5:5: setting 'lenses.front.image_size_px.1' is missing"),
        ("[640, 480]", "[640, 4.5]", "5:26: lenses.front.image_size_px.1: Input should be a multiple of 1"),
        ("[640, 480]", "['640', 480]", "5:21: lenses.front.image_size_px.0: Input should be a valid number"),
        ("[640, 480]", "[true, 480]", "5:21: lenses.front.image_size_px.0: Input should be a valid number"),
        ("[150.0, 151.0]", "[150.0, -1]", "6:23: lenses.front.focal_px.1: Input should be greater than 0"),
        (
            "[319.5, 239.5]",
            "[319.5, 500]",
            "7:25: lenses.front.principal_point_px: is outside of the picture of 640×480",
        ),
        ("[0.01, 0, 0, 0]", "[-0.2, 0, 0, 0]", "5:5: lenses.front: distortion: the distortion is not invertible"),
        ("[0.01, 0, 0, 0]", "['1', 0, 0, 0]", "8:18: lenses.front.distortion.0: Input should be a valid number"),
        ("field_of_view_deg: 190", "field_of_view_deg: 0", "9:24: lenses.front.field_of_view_deg: Input should be"),
        ("focal_px", "focal_xp", "6:5: unknown setting 'lenses.front.focal_xp'. Did you mean 'focal_px'?"),
        ("[1, 0, 0, 0]", "[1, 1, 0, 0]", "10:20: lenses.front.lens_from_rig: the length of the quaternion is not 1"),
        ("[0, 0, 0]}", "[0, 0, 30]}", "10:20: lenses.front.lens_from_rig: translation_m is more than 10 metres"),
        ("[[-1, 0, 0]", "[[1, 0, 0]", "18:7: lenses.back.lens_from_rig: rotation is not a rotation matrix"),
        ("rotation_wxyz: [1, 0, 0, 0], ", "", "10:20: lenses.front.lens_from_rig: must have the keys rotation_wxyz"),
        ("  back:", "  front:", "11:3: key 'front' occurs twice"),
        ("  back:", "  ba ck:", "12:5: lenses.ba ck.[key]: String should match"),
        ("[640, 480]", "[640, 480", "6:"),
    ],
)
def test_errors_state_file_line_key_and_remedy(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(InputError, match=rf"rig\.yaml:{re.escape(message)}") as error:
        read_rig(file_of(tmp_path, TEXT.replace(old, new, 1)))
    assert "docs/rigs.md" in str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "- 1\n",
        "3\n",
        "\x00",
        "model: kannala_brandt\nfirst_pixel_px: 0\nlenses: {a: 1}\n",
        f"extra: [{'1, ' * 400_000}1]\n",
    ],
    ids=["empty", "a list", "a number", "a control character", "a lens that is a number", "too large"],
)
def test_files_that_are_no_calibration_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=r"(?s)rig\.yaml.*docs/rigs\.md") as error:
        read_rig(file_of(tmp_path, text))
    assert "instance of" not in str(error.value)


def test_a_stitching_distance_inside_of_the_rig_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"rig\.yaml: the stitching distance of 0\.01 m .* Give a larger stitch_distance_m"
    ):
        read_rig(file_of(tmp_path, TEXT), stitch_distance_m=0.01)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing\.yaml: cannot be read"):
        read_rig(FilePart(tmp_path / "nothing.yaml"))


def test_names_of_lenses_are_those_of_the_file(tmp_path: Path) -> None:
    rig = read_rig(file_of(tmp_path, TEXT.replace("front", "left").replace("back", "right")))
    assert rig.names == ("left", "right")
    assert np.isinf(rig.stitch_distance_m)


LENSES = ("front", "back")


def listed(folder: Path, names: list[str], layout: Layout = "auto") -> list[tuple[str, list[str], str]]:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    return [
        (one.name, [path.relative_to(folder).as_posix() for path in one.files], one.problem)
        for one in list_rig_pictures(folder, LENSES, layout)
    ]


def test_folders_of_the_lenses_may_be_anywhere_in_the_path(tmp_path: Path) -> None:
    names = ["hall/back/2.jpg", "hall/front/2.jpg", "hall/front/10.jpg", "hall/back/10.jpg"]
    assert listed(tmp_path, names) == [
        ("hall/2.png", ["hall/front/2.jpg", "hall/back/2.jpg"], ""),
        ("hall/10.png", ["hall/front/10.jpg", "hall/back/10.jpg"], ""),
    ]


def test_suffixes_of_names(tmp_path: Path) -> None:
    assert listed(tmp_path, ["a/1_front.jpg", "a/1_back.jpg", "a/2-back.jpg", "a/2-front.jpg"]) == [
        ("a/1.png", ["a/1_front.jpg", "a/1_back.jpg"], ""),
        ("a/2.png", ["a/2-front.jpg", "a/2-back.jpg"], ""),
    ]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (
            ["front/a.jpg", "front/a.png", "back/a.jpg", "back/a.png"],
            [
                ("a.jpg.png", ["front/a.jpg", "back/a.jpg"], ""),
                ("a.png.png", ["front/a.png", "back/a.png"], ""),
            ],
        ),
        (
            ["front/a.jpg", "front/a.png", "back/a.jpg"],
            [
                ("a.jpg.png", ["front/a.jpg", "back/a.jpg"], ""),
                ("a.png.png", ["front/a.png"], "the picture of the lens back is missing"),
            ],
        ),
        (
            ["a-front.jpg", "a_front.jpg", "a_back.jpg"],
            [
                ("a.png", ["a-front.jpg", "a_back.jpg"], ""),
                (
                    "a_front.jpg",
                    [],
                    "shows the same capture and lens as a-front.jpg; rename or remove one of them",
                ),
            ],
        ),
        (
            ["a.jpg", "a.png", "b.png"],
            [("a.jpg.png", ["a.jpg"], ""), ("a.png.png", ["a.png"], ""), ("b.png", ["b.png"], "")],
        ),
    ],
)
def test_no_file_is_dropped_in_silence(
    tmp_path: Path, names: list[str], expected: list[tuple[str, list[str], str]]
) -> None:
    """Of two files of the same capture and lens, only the first was used, and the second was not named anywhere."""
    assert listed(tmp_path, names) == expected


def test_other_files_show_both_lenses(tmp_path: Path) -> None:
    assert listed(tmp_path, ["1.jpg", "2.jpg", "setback.jpg"]) == [
        (f"{name}.png", [f"{name}.jpg"], "") for name in ("1", "2", "setback")
    ]


def test_incomplete_captures_are_reported(tmp_path: Path) -> None:
    assert listed(
        tmp_path, ["front/1.jpg", "back/1.jpg", "back/2.jpg", "notes/3.jpg", "back/4.png", "front/4.jpg"]
    ) == [
        ("1.png", ["front/1.jpg", "back/1.jpg"], ""),
        ("2.png", ["back/2.jpg"], "the picture of the lens front is missing"),
        (
            "4.png",
            ["front/4.jpg", "back/4.png"],
            "the pictures of its lenses have different formats; save both in the same",
        ),
        ("notes/3.jpg", [], "does not belong to a lens: no folders front or back"),
    ]


def test_a_layout_that_fits_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no image belongs to a lens.*front/000\.jpg, or set layout: side_by_side"):
        listed(tmp_path, ["1.jpg"], "folders")
