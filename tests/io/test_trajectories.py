"""Trajectories without names of images, and positions without rotations."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import quat_wxyz_from_rotation
from pano_mvs.io.poses.files import match_images, matched_positions, positions_in, read_poses
from pano_mvs.io.poses.positions import NO_POSES
from pano_mvs.stages.poses import known_groups
from pano_mvs.testing.room import capture_poses

TIMES = ("0.500000", "1.000000", "12.345000")
POSES = dict(zip(TIMES, capture_poses(3, seed=5), strict=True))
AXES = "pano_pos_x; pano_pos_y; pano_pos_z; pano_ori_w; pano_ori_x; pano_ori_y; pano_ori_z"
NAVVIS = f"""# pano poses v1.0: ID; filename; timestamp; {AXES}
0; 00000-pano.jpg; 1647329314.715836; -0.599143; -0.587440; 1.886546; 0.746558; -0.005474; -0.028297; 0.664696

1; 00001-pano.jpg; 1647329318.949630; 1.777497; 0.314116; 1.878300; 0.754395; -0.022532; -0.013212; 0.655901
"""
SURVEY = """label,Easting,Northing,Height
00000-pano,-0.599143,-0.587440,1.886546
00001-pano,1.777497,0.314116,1.8783
"""


def write_trajectory(path: Path) -> Path:
    lines = ["# timestamp tx ty tz qx qy qz qw", ""]
    for time, pose in POSES.items():
        world_from_cam = pose.inverse()
        w, x, y, z = quat_wxyz_from_rotation(world_from_cam.rotation)
        lines.append(" ".join([time, *map(str, world_from_cam.translation), *map(str, (x, y, z, w))]))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_trajectory_holds_the_poses_of_cameras_in_the_world(tmp_path: Path) -> None:
    found = read_poses(write_trajectory(tmp_path / "frame_trajectory.txt"))
    assert found.names == TIMES
    assert not found.metric
    for idx, pose in enumerate(POSES.values()):
        assert found.rotations[idx] == pytest.approx(pose.rotation, abs=1e-9)
        assert found.centers[idx] == pytest.approx(pose.center, abs=1e-9)


@pytest.mark.parametrize(
    ("images", "times", "how"),
    [
        (("12.345000.png", "0.500000.png"), ("12.345000", "0.500000"), "times in the names"),
        (("a/0.5.jpg", "12.345.jpg", "7.0.jpg"), ("0.500000", "12.345000", None), "times in the names"),
        (("walk_00001000ms.png", "walk_00012345ms.png"), ("1.000000", "12.345000"), "times in the names"),
        (("walk_00000500ms.png", "walk_00000533ms.png"), ("0.500000", None), "times in the names"),
        (("a.jpg", "b.jpg", "c.jpg"), TIMES, "their order"),
        (("000000.jpg", "000001.jpg", "000002.jpg"), TIMES, "their order"),
    ],
)
def test_images_are_matched_by_time_or_order(
    tmp_path: Path, images: tuple[str, ...], times: tuple[str | None, ...], how: str
) -> None:
    path = write_trajectory(tmp_path / "poses.tum")
    matched, note = match_images(images, TIMES, path)
    assert tuple(map(matched.get, images)) == times
    assert how in note
    notes: list[str] = []
    known = known_groups(path, images, notes)
    assert notes == [note]
    assert set(known.names) | set(known.rejected) == set(images)


@pytest.mark.parametrize("digits", [1, 6, 10])
def test_whole_numbers_are_times_with_and_without_leading_zeros(digits: int) -> None:
    """Image 000001 got the pose at time 2, because only unpadded numbers were compared with the times."""
    images = [f"{number:0{digits}d}.png" for number in range(5)]
    matched, note = match_images(images, ("1", "2", "3", "4", "5"), Path("poses.txt"))
    assert [matched.get(image) for image in images] == [None, "1", "2", "3", "4"]
    assert "times in the names" in note
    many = [f"{number:0{digits}d}.png" for number in (2, 10**6)]
    assert match_images(many, ("2.0", "1e6"), Path("poses.txt"))[0] == dict(zip(many, ("2.0", "1e6"), strict=True))


def test_several_images_of_one_time_have_no_position(tmp_path: Path) -> None:
    """Two videos of a folder have frames of the same times."""
    path = write_trajectory(tmp_path / "poses.txt")
    images = ("a/x_00000500ms.png", "b/x_00000500ms.png", "a/x_00001000ms.png", "a/x_00012345ms.png")
    positions, (how, ambiguous) = matched_positions(images, path)
    assert list(positions) == ["a/x_00001000ms.png", "a/x_00012345ms.png"]
    assert "times in the names" in how
    assert ambiguous.endswith("not used for any of them: a/x_00000500ms.png, b/x_00000500ms.png")
    rejected = known_groups(path, images, []).rejected
    assert set(rejected) == set(images[:2])
    assert all("matches several images" in reason for reason in rejected.values())


def test_a_trajectory_without_times_is_refused() -> None:
    with pytest.raises(InputError, match=r"poses\.txt: contains no poses"):
        match_images(("a.jpg",), (), Path("poses.txt"))


def test_images_that_fit_no_time_are_named(tmp_path: Path) -> None:
    path = write_trajectory(tmp_path / "poses.txt")
    with pytest.raises(
        InputError, match=r"poses\.txt: no image has one of its times \(0\.500000, …\) .* 3 poses do not"
    ):
        match_images(("a.jpg", "b.jpg"), TIMES, path)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "contains no poses"),
        ("1 2 3 4 5 6 7", ":1: expected 8 numbers"),
        ("# x\n1 2 3 4 0 0 0 one", ":2: expected 8 numbers"),
        ("1 2 3 4 0 0 0 0", ":1: the pose holds .* length 0"),
        ("1 2 3 nan 0 0 0 1", ":1: the pose holds NaN"),
        ("1 2 3 4 0 0 0 1\n1 2 3 4 0 0 0 1", "'1' is listed twice"),
    ],
)
def test_what_is_wrong_in_a_trajectory_is_named(tmp_path: Path, text: str, what: str) -> None:
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(InputError, match=rf"poses\.txt.*{what}"):
        read_poses(tmp_path / "poses.txt")


TABLES = {
    "survey.csv": SURVEY,
    "pano-poses.csv": NAVVIS,
    "quoted.csv": """\"\",\"name\",\"x\",\"y\",\"z\"
"1","00000-pano",-0.599143,-0.587440,1.886546
"2","00001-pano",1.777497,0.314116,1.8783
""",
    "metashape.csv": """# CoordinateSystem: WGS 84 / UTM zone 32N (EPSG::32632)
#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll,Error_(m),X_error,Y_error,Z_error
00000-pano,-0.599143,-0.587440,1.886546,,,,,,,
00001-pano,1.777497,0.314116,1.8783,,,,,,,
# Total Error,0.1,0.1,0.1
""",
    "plain.csv": NAVVIS.removeprefix("# pano poses v1.0: "),
    "positions.json": json.dumps(
        {
            "views": [
                {"image": "00000-pano.jpg", "center": [-0.599143, -0.587440, 1.886546]},
                {"image": "00001-pano.jpg", "center": [1.777497, 0.314116, 1.8783]},
            ]
        }
    ),
}


@pytest.mark.parametrize("name", TABLES)
def test_positions_are_read_where_rotations_are_not_needed(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(TABLES[name])
    found = positions_in(path)
    np.testing.assert_allclose(list(found.values()), [[-0.599143, -0.58744, 1.886546], [1.777497, 0.314116, 1.8783]])
    assert match_images(("00001-pano.jpg",), tuple(found), path)[0].keys() == {"00001-pano.jpg"}
    with pytest.raises(InputError, match=f"{name}: {NO_POSES[:40]}.* pairs.position .* poses.scale"):
        read_poses(path)


def test_positions_of_poses_are_their_centres(tmp_path: Path) -> None:
    poses = write_trajectory(tmp_path / "poses.txt")
    np.testing.assert_allclose(list(positions_in(poses).values()), [pose.center for pose in POSES.values()], atol=1e-9)


def test_what_is_wrong_in_positions_is_named(tmp_path: Path) -> None:
    path = tmp_path / "positions.csv"
    for line, what in (("a,1,2", ":2: expected a name"), ("a,1,2,nan", "position of a holds NaN"), ("", "no poses")):
        path.write_text(f"name,x,y,z\n{line}\n")
        with pytest.raises(InputError, match=what):
            positions_in(path)
    for text in (f"name,x,y,z\na,{'1' * 200_000},2,3", f"name,tx,ty,tz,qw,qx,qy,qz\na,{'1' * 200_000},2,3"):
        path.write_text(text)
        with pytest.raises(InputError, match=r"positions\.csv:2: not a line of a CSV file \(field larger than"):
            positions_in(path)
    path.write_text("1" * 200_000)
    with pytest.raises(InputError, match=r"positions\.csv:1: not a line of a CSV file"):
        positions_in(path)
    (tmp_path / "poses.json").write_text(json.dumps({"views": [{"image": "a.jpg", "t": [1, 2, 3]}]}))
    with pytest.raises(InputError, match=r"views\[0\] \(a\.jpg\): key 'R' is missing.*'center'"):
        read_poses(tmp_path / "poses.json")


@pytest.mark.parametrize(
    "heading", ["name,latitude,longitude,altitude", "name;Lat;Lon;z", "#Label,X/Longitude,Y/Latitude,Z/Altitude"]
)
def test_degrees_are_no_positions(tmp_path: Path, heading: str) -> None:
    path = tmp_path / "positions.csv"
    path.write_text(f"{heading}\na,47,8,400\n")
    with pytest.raises(InputError, match=r":1: latitudes and .*name,tx,ty,.*positions alone.*name, x, y, z.*metres"):
        positions_in(path)
    path.write_text("name,latitude,x,y,longitude,z\na,47,1,2,8,3\n")
    assert positions_in(path)["a"].tolist() == [1, 2, 3]
    path.write_text("name,somewhere\na,47\n")
    with pytest.raises(InputError, match=r"csv:1: the first line must be name,tx,.*positions alone.*name, x, y, z"):
        positions_in(path)
