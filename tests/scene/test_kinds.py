"""Every kind of record refuses arrays that do not agree, and comes back from its parts as it was."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.core.errors import ChangedFileError, ContractError, InputError
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import Features, Files, GlobalDescriptor, Pairs, PointCloud, Pose, Poses, RangeMap, TwoView, Views
from pano_mvs.scene.files import FaceFiles, group_file, item_stems
from pano_mvs.scene.poses import World
from pano_mvs.scene.record import Axis, FilePart, Record, require_array
from pano_mvs.scene.surfaces import Structure, SurfaceSamples, TrackedPoints
from pano_mvs.scene.two_view import pair_from_name, pair_name
from tests.scene.pose_groups import drawn_group

RNG = np.random.default_rng(5)
UNITS = RNG.normal(size=(4, 3))
UNITS /= np.linalg.norm(UNITS, axis=1, keepdims=True)
FLOATS = RNG.uniform(1, 2, 4).astype(np.float32)
BYTES = RNG.integers(0, 256, 4).astype(np.uint8)
COLORS = RNG.integers(0, 256, (4, 3)).astype(np.uint8)
TRACKS = np.array([0, 3, 1], np.int32)

GENERAL = TwoView(
    np.arange(8, dtype=np.int32).reshape(4, 2), np.eye(3), UNITS[0], FLOATS, "general", "", 9, 1.5, 0.2, 0.3
)
KINDS: dict[str, Record] = {
    "cloud": PointCloud(UNITS.astype(np.float32), UNITS.astype(np.float32), COLORS, BYTES, BYTES, (3, 1)),
    "features": Features(UNITS, np.ones((4, 8), np.float32), FLOATS, FLOATS, COLORS, "l2", (10, 20)),
    "binary features": Features(UNITS, np.ones((4, 8), np.uint8), FLOATS, FLOATS, COLORS, "hamming", (10, 20)),
    "descriptor": GlobalDescriptor(FLOATS, np.ones((4, 8), np.int16)),
    "poses": replace(
        drawn_group(("a", "b", "c"), seed=1),
        confirmed_shares=np.ones(3),
        expected_shares=np.full(3, 0.5),
        right_probabilities=np.full(3, 0.9),
        evidence={"a": {"share": 1.0, "repeats": None}},
    ),
    "range map": RangeMap(np.ones((2, 4), np.float32), np.full((2, 4), 200, np.uint8)),
    "samples": SurfaceSamples(UNITS, FLOATS, COLORS, BYTES),
    "structure": Structure(
        UNITS, np.ones(4), np.full(4, 0.01), np.zeros(4, np.int32), np.ones((2, 4, 3)), np.zeros(2, np.int32)
    ),
    "tracked points": TrackedPoints(("a", "b"), UNITS, COLORS, FLOATS, TRACKS, TRACKS % 2, UNITS[:3]),
    "two views": GENERAL.with_alternatives([replace(GENERAL, direction=UNITS[idx]) for idx in (1, 2)]),
}


def fields_of(value: object) -> list[str]:
    assert is_dataclass(value)
    return [field.name for field in fields(value)]


def changed(value: Record, **changes: object) -> Record:
    return type(value)(**{name: changes.get(name, getattr(value, name)) for name in fields_of(value)})


ARRAYS = [
    (title, field)
    for title, value in KINDS.items()
    for field in fields_of(value)
    if isinstance(getattr(value, field), np.ndarray)
]
KNOWN_NAN = {
    "range",
    "center_stds",
    "rotation_stds_rad",
    "confirmed_shares",
    "expected_shares",
    "right_probabilities",
    "normals_in_cam",
}


def assert_same(first: object, second: object) -> None:
    assert type(first) is type(second)
    for field in fields_of(first):
        one, other = getattr(first, field), getattr(second, field)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
        elif is_dataclass(one):
            assert_same(one, other)
        else:
            assert one == other


@pytest.mark.parametrize("title", KINDS)
def test_what_is_right_passes_and_comes_back_from_its_parts(title: str) -> None:
    KINDS[title].check()
    assert_same(type(KINDS[title]).from_parts(KINDS[title].to_parts()), KINDS[title])


@pytest.mark.parametrize(("title", "field"), ARRAYS)
def test_an_array_of_another_type_is_named(title: str, field: str) -> None:
    array = getattr(KINDS[title], field)
    other = np.int64 if array.dtype != np.int64 else np.int32
    with pytest.raises(ContractError, match=f"{field} must be {array.dtype}, got {np.dtype(other)}"):
        changed(KINDS[title], **{field: array.astype(other)}).check()


@pytest.mark.parametrize(("title", "field"), ARRAYS)
def test_an_array_of_another_shape_is_refused(title: str, field: str) -> None:
    array = getattr(KINDS[title], field)
    others = [array[None]]
    if array.ndim > 1 and field not in ("descriptors", "sample"):
        others.append(array[..., :-1])
    if field not in ("vector", "sample"):
        others.append(array[:-1])
    for other in others:
        with pytest.raises(ContractError, match=r"must have shape|do not make up"):
            changed(KINDS[title], **{field: other}).check()


@pytest.mark.parametrize(("title", "field"), ARRAYS)
def test_nan_is_refused_where_it_is_not_the_value_for_unknown(title: str, field: str) -> None:
    array = getattr(KINDS[title], field).copy()
    if array.dtype.kind != "f" or field in KNOWN_NAN:
        return
    array.ravel()[0] = np.nan
    with pytest.raises(ContractError, match=f"{field} holds NaN or infinite values"):
        changed(KINDS[title], **{field: array}).check()


def test_an_array_may_be_of_any_length_where_none_is_asked_for() -> None:
    assert require_array(GENERAL, "matches_idx", dtype=np.int32, shape=(None, 2)) is GENERAL.matches_idx
    with pytest.raises(ContractError, match="must be an array, got list"):
        changed(GENERAL, matches_idx=[1, 2]).check()


@pytest.mark.parametrize(
    ("title", "changes", "said"),
    [
        ("cloud", {"group_sizes": (3, 2)}, "do not make up 4"),
        ("cloud", {"group_sizes": (5, -1)}, "do not make up 4"),
        ("features", {"bearings": UNITS * 1.00001}, "unit vectors"),
        ("features", {"metric": "hamming"}, "descriptors must be uint8"),
        ("binary features", {"metric": "l2"}, "descriptors must be float32"),
        ("samples", {"ranges": FLOATS * np.array([1, 1, 0, 1], np.float32)}, "zero or negative"),
        ("tracked points", {"track_point_idx": np.array([0, 4, 1], np.int32)}, "no point"),
        ("tracked points", {"track_point_idx": np.array([0, -1, 1], np.int32)}, "no point"),
        ("tracked points", {"track_image_idx": np.array([0, 2, 1], np.int32)}, "no image"),
        ("tracked points", {"track_image_idx": np.array([0, -1, 1], np.int32)}, "no image"),
        ("poses", {"names": ("a", "b", "a")}, "listed twice"),
        ("poses", {"doubts": {"z": "far"}}, "not registered"),
        ("poses", {"track_sigmas_rad": np.zeros(90, np.float32)}, "not positive"),
        ("poses", {"track_point_idx": np.full(90, 30, np.int32)}, "no point"),
        ("poses", {"track_point_idx": np.full(90, -1, np.int32)}, "no point"),
        ("poses", {"track_image_idx": np.full(90, 3, np.int32)}, "no image"),
        ("poses", {"track_image_idx": np.full(90, -1, np.int32)}, "no image"),
        ("range map", {"range": np.full((2, 4), np.inf, np.float32)}, "infinite|0 exactly"),
        ("range map", {"range": np.zeros((2, 4), np.float32)}, "zero or negative"),
        ("range map", {"confidence": np.zeros((2, 4), np.uint8)}, "0 exactly where"),
    ],
)
def test_values_that_do_not_fit_each_other_are_refused(title: str, changes: dict[str, object], said: str) -> None:
    with pytest.raises(ContractError, match=said):
        changed(KINDS[title], **changes).check()


def test_groups_without_points_may_be() -> None:
    changed(KINDS["cloud"], group_sizes=(4, 0)).check()
    TrackedPoints((), UNITS, COLORS, FLOATS, TRACKS[:0], TRACKS[:0], UNITS[:0]).check()


def test_a_cloud_of_groups_is_put_together_and_taken_apart() -> None:
    cloud = KINDS["cloud"]
    assert isinstance(cloud, PointCloud)
    first, second = cloud.groups()
    assert (len(cloud), len(first), len(second)) == (4, 3, 1)
    np.testing.assert_array_equal(second.points_in_world, cloud.points_in_world[3:])
    np.testing.assert_array_equal(second.normals_in_world, cloud.normals_in_world[3:])
    np.testing.assert_array_equal(second.colors_rgb, cloud.colors_rgb[3:])
    np.testing.assert_array_equal(first.view_counts, cloud.view_counts[:3])
    assert second.confidence is not None
    np.testing.assert_array_equal(second.confidence, BYTES[3:])
    assert second.groups() == [second]
    assert_same(PointCloud.of_groups([first, second]), cloud)
    assert PointCloud.of_groups([first]) is first
    unsure = PointCloud.of_groups([first, replace(second, confidence=None)])
    assert unsure.confidence is None
    assert unsure.groups()[1].confidence is None


def test_points_join_poses_behind_their_own_or_in_their_place() -> None:
    poses = drawn_group(("b", "c", "a"), seed=3)
    points = KINDS["tracked points"]
    assert isinstance(points, TrackedPoints)
    points = replace(points, names=("a", "z"))  # the second image has no pose
    both, alone = (points.joined_to(poses, keep_points=keep) for keep in (True, False))
    for joined, own in ((both, 30), (alone, 0)):
        joined.check()
        assert len(points) == len(joined.points_in_world) - own == 4
        np.testing.assert_array_equal(joined.points_in_world[own:], UNITS)
        np.testing.assert_array_equal(joined.point_colors_rgb[own:], COLORS)
        np.testing.assert_array_equal(joined.point_errors_rad[own:], FLOATS)
        seen = points.track_image_idx == 0
        np.testing.assert_array_equal(joined.track_point_idx[3 * own :], points.track_point_idx[seen] + own)
        assert set(joined.track_image_idx[3 * own :].tolist()) == {2}
        np.testing.assert_array_equal(joined.track_bearings[3 * own :], points.track_bearings[seen])
    np.testing.assert_array_equal(both.track_point_idx[:90], poses.track_point_idx)


def test_an_unseen_point_is_left_out_only_if_there_are_several_worlds() -> None:
    poses = drawn_group(("a", "b", "c", "d"), seed=3, points=0)
    points = KINDS["tracked points"]
    assert isinstance(points, TrackedPoints)
    assert len(points.joined_to(poses, keep_points=True).points_in_world) == 4
    groups = replace(poses, group_idx=np.array([0, 0, 0, 1], np.int32), other_worlds=poses.worlds)
    joined = points.joined_to(groups, keep_points=True)
    np.testing.assert_array_equal(joined.points_in_world, UNITS[[0, 1, 3]])
    np.testing.assert_array_equal(joined.points_in_world[joined.track_point_idx], UNITS[TRACKS])


def test_a_pair_without_geometry_is_falsy_and_says_why() -> None:
    failed = TwoView.failed("too few matches", candidates=7)
    failed.check()
    assert not failed
    assert (failed.reason, failed.candidates, failed.geometry, len(failed)) == ("too few matches", 7, "none", 0)
    assert failed.residual_deg == 0
    assert failed.alternatives == ()


def test_a_pair_with_geometry_is_truthy_and_has_runners_up() -> None:
    assert GENERAL
    assert not replace(GENERAL, geometry="rotation")
    assert GENERAL.residual_deg == pytest.approx(np.rad2deg(np.median(FLOATS)))
    one = replace(GENERAL, matches_idx=GENERAL.matches_idx[:1], residuals_rad=FLOATS[:1], rotation=-np.eye(3))
    other = replace(GENERAL, direction=UNITS[2])
    first, second = GENERAL.with_alternatives([one, other]).alternatives
    for found, expected in ((first, one), (second, other)):
        assert found
        assert found.candidates == 9
        for field in ("matches_idx", "rotation", "direction", "residuals_rad"):
            np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))
    assert GENERAL.with_alternatives([one]).with_alternatives([]).alternatives == ()


def test_pairs_and_views_name_their_units() -> None:
    pairs, views = Pairs((("a", "b"), ("b", "c"))), Views({"a": ("b", "c"), "b": ()})
    for value in (pairs, views):
        value.check()
        assert_same(type(value).from_parts(value.to_parts()), value)
    assert pairs.units() == {pair_name("a", "b"): ("a", "b"), pair_name("b", "c"): ("b", "c")}
    assert pair_from_name(pair_name("x.jpg", "y.jpg")) == ("x.jpg", "y.jpg")
    assert views.units() == {"a": ("b", "c"), "b": ()}
    for wrong, said in (
        (Pairs((("a", "b"), ("b", "a"))), "twice"),
        (Pairs((("a", "a"),)), "with itself"),
        (Views({"a": ("b", "a")}), "a is its own neighbour"),
    ):
        with pytest.raises(ContractError, match=said):
            wrong.check()


@pytest.mark.parametrize("group", [0, 2])
def test_a_pose_keeps_all_its_digits(group: int) -> None:
    pose = Pose(Rigid3(rotation_from_rotvec((0.1, 0.2, 0.3)), np.array([1 / 3, -2, 1e-17])), group)
    pose.check()
    back = Pose.from_parts(pose.to_parts())
    assert back.group == group
    assert_same(back.cam_from_world, pose.cam_from_world)


@pytest.mark.parametrize(
    ("rotation", "translation", "group", "said"),
    [
        (np.eye(3), np.zeros(3), -1, "negative"),
        (np.eye(3) * 1.0001, np.zeros(3), 0, "orthonormal"),
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), 0, "reflection"),
        (np.eye(3), np.array([0, np.nan, 0]), 0, "not finite"),
    ],
)
def test_what_is_no_pose_is_refused(rotation: np.ndarray, translation: np.ndarray, group: int, said: str) -> None:
    with pytest.raises(ContractError, match=said):
        Pose(Rigid3(rotation, translation), group).check()


def test_poses_explode_into_the_poses_of_their_images() -> None:
    poses = drawn_group(("a", "b"), seed=2)
    exploded = poses.explode()
    assert list(exploded) == ["a", "b"]
    for idx, pose in enumerate(exploded.values()):
        assert isinstance(pose, Pose)
        assert pose.group == 0
        assert_same(pose.cam_from_world, poses.cam_from_world(idx))
        assert pose.cam_from_world.center == pytest.approx(poses.centers[idx])
    assert poses.doubted() == {"b": "doubt 2"}
    empty = Poses.without_points({}, frame="f", scale="s", metric=True, rejected={"a": "blurred"})
    empty.check()
    assert empty.rejected == {"a": "blurred"}
    assert empty.worlds == (World("f", "s", metric=True),)


@dataclass(frozen=True, eq=False)
class Plain(Record):
    """A kind with everything that a plugin may use."""

    array: np.ndarray
    file: FilePart
    nested: tuple[tuple[int, ...], ...] = ()


def test_a_plain_kind_stores_arrays_files_and_the_rest_as_json(tmp_path: Path) -> None:
    value = Plain(UNITS, FilePart(tmp_path / "a"), ((1, 2), ()))
    parts = value.to_parts()
    assert parts.keys() == {"array", "file", "meta"}
    assert parts["meta"] == {"nested": ((1, 2), ())}
    read = {**parts, "meta": {"nested": [[1, 2], []], "of a later version": 1}}
    back = Plain.from_parts(read)
    assert back.nested == value.nested
    assert back.array is UNITS
    assert back.file == value.file
    assert (Plain.kind_name(), Plain.axis, value.explode(), value.doubted()) == ("Plain", Axis.ONE, {}, {})
    assert value.loading_bytes() == 0


def test_a_users_file_is_read_only_as_it_was_listed(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"new")
    assert FilePart(path, digest="old").read_bytes() == b"new"  # the store checks its own files
    assert FilePart(path, external=True).read_bytes() == b"new"  # not listed by digest
    with pytest.raises(ChangedFileError, match="changed during the run"):
        FilePart(path, external=True, digest="old").read_bytes()
    with pytest.raises(InputError, match=r"none: cannot be read \(.*\)\. Check"):
        FilePart(tmp_path / "none").read_bytes()
    with pytest.raises(InputError, match="cannot be read"):
        FilePart(Path("a\0b")).read_bytes()


@pytest.mark.parametrize("target", ["/a", "../a", "a/../../b", "a\\b", "c:a", "a\0", "", "."])
def test_a_target_outside_the_output_folder_is_refused(target: str) -> None:
    with pytest.raises(ContractError, match="not inside the output folder"):
        Files({"fine/a.txt": Path("a"), target: Path("b")}).check()


def test_files_come_back_under_their_targets() -> None:
    files = Files({"b.txt": Path("1"), "a/{item}.txt": Path("2")})
    files.check()
    assert Files.from_parts(files.to_parts()).files == files.files
    faces = FaceFiles(files.files, "octagon", 80.0, 512, ".png")
    faces.check()
    assert_same(FaceFiles.from_parts(faces.to_parts()), faces)
    with pytest.raises(ContractError, match="size_px must be positive, got 0"):
        replace(faces, size_px=0).check()
    with pytest.raises(ContractError, match="not inside"):
        replace(faces, files={"/a": Path("1")}).check()


def test_the_first_group_s_file_has_the_plain_name() -> None:
    assert group_file("a/cloud.ply", 0) == "a/cloud.ply"
    assert group_file("a/cloud.ply", 1) == "a/cloud_1.ply"


@pytest.mark.parametrize(
    ("names", "stems"),
    [
        (["a.jpg", "d/b.jpg"], ["a", "d/b"]),
        (["a.jpg", "a.png", "b.png"], ["a.jpg", "a.png", "b"]),
        (["a.jpg", "A.png"], ["a.jpg", "A.png"]),  # one file on some systems
        (["a.jpg", "a.jpg.png"], ["a", "a.jpg"]),
        (["a.x.jpg", "a.x", "a.x.png"], ["a.x.jpg", "a", "a.x.png"]),
        (["000.png", "000.tiff/1.png"], ["000.png", "000.tiff/1"]),
        (["000.png", "001.tiff/1.png"], ["000", "001.tiff/1"]),
        (["d/000.png", "d/000.a.b/x/1.png"], ["d/000.png", "d/000.a.b/x/1"]),
        (["d.x/000.png", "000.png"], ["d.x/000", "000"]),
        (["a", "a.jpg", "a.jpg.png"], ["a", "a.jpg", "a.jpg.png"]),
    ],
)
def test_images_have_names_without_extension_where_these_are_unique(names: list[str], stems: list[str]) -> None:
    assert list(item_stems(names).values()) == stems
