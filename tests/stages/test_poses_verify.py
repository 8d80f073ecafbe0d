"""poses.verify: what it tells the user of cameras that the images contradict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.verification.belief.coefficients import FITTED
from pano_mvs.api import Features, Panorama, Poses, RunStoppedError, SceneLink, TwoView
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene.pose_groups import join_groups
from pano_mvs.stages.poses import (
    RefineParams,
    ScaledTranslationParams,
    changed_places,
    refine,
    scaled_translation,
    verify,
)
from pano_mvs.stages.poses_frame import level
from pano_mvs.stages.views import nearest
from pano_mvs.testing.tiny_capture import TinyCapture, Variant, tiny_capture

LevelParams = Registry.installed().stages["poses.level"].params_type
VerifyParams = Registry.installed().stages["poses.verify"].params_type
NearestParams = Registry.installed().stages["views.nearest"].params_type

WRONG = "002.png"


@pytest.fixture(scope="module")
def tiny() -> TinyCapture:
    return tiny_capture(Variant(size_hw=(128, 256)))


@pytest.fixture
def ctx(tmp_path: Path) -> Context:
    return Context(np.random.default_rng(0), tmp_path)


def poses_of(tiny: TinyCapture, *, wrong: bool) -> Poses:
    """Return the true poses, or with one of them turned and moved."""
    cameras = dict(zip(tiny.names, tiny.poses, strict=True))
    if wrong:
        pose = cameras[WRONG]
        turn = rotation_from_rotvec([0.0, 0.4, 0.1])
        cameras[WRONG] = Rigid3.from_center(turn @ pose.rotation, pose.center + np.array([0.3, 0.0, 0.3]))
    return Poses.without_points(cameras, frame="site", scale="metres", metric=True)


def verified(
    tiny: TinyCapture, ctx: Context, *, wrong: bool = True, matched: bool = True, correct: bool = True
) -> Poses:
    return verify(
        poses=poses_of(tiny, wrong=wrong),
        images=tiny.each(Panorama),
        features=tiny.each(Features) if matched else None,
        matches=tiny.each(TwoView) if matched else None,
        params=VerifyParams.model_validate({"correct": correct}),
        ctx=ctx,
    )


@pytest.mark.slow
def test_a_moved_camera_is_noted(tiny: TinyCapture, ctx: Context) -> None:
    poses = verified(tiny, ctx)
    assert ctx.notes == [f"{WRONG} was moved to another place, where the images confirm more of all cameras"]
    assert poses.doubts == {}
    assert poses.points_in_world.shape[0] > 50
    truth = dict(zip(tiny.names, tiny.poses, strict=True))
    found = poses.cam_from_world(poses.names.index(WRONG))
    assert np.linalg.norm(found.center - truth[WRONG].center) < 0.02
    assert ctx.rejected == {}
    assert ctx.metrics["registered"] == 1
    assert ctx.metrics["confirmed_share_median"] > 0.4


def test_cameras_of_a_new_group_were_not_moved() -> None:
    """Their world is another one; the first of them stands at its origin, as it may have done before."""
    cameras = {
        f"{name}.png": Rigid3.from_center(np.eye(3), np.array([place, 0.0, 0.0]))
        for name, place in zip("abcdefg", (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0), strict=True)
    }
    before = Poses.without_points(cameras, frame="site", scale="metres", metric=True)

    def group(names: str, shift: float, moved: str = "") -> Poses:
        centers = {f"{name}.png": cameras[f"{name}.png"].center[0] + shift + (name == moved) for name in names}
        return Poses.without_points(
            {name: Rigid3.from_center(np.eye(3), np.array([x, 0.0, 0.0])) for name, x in centers.items()},
            frame="x",
            scale="x",
            metric=False,
        )

    first, second = "ab", "cdefg"
    together = join_groups([group(second, 0.0, moved="d"), group(first, 0.0, moved="b")], order=before.names)
    assert changed_places(before, together) == (["d.png"], [["a.png", "b.png"]])
    apart = join_groups([group("abcd", 0.0), group("efg", -4.0)], order=before.names)
    assert changed_places(before, apart) == ([], [["e.png", "f.png", "g.png"]])
    assert changed_places(before, group("abcdefg", 0.0, moved="c")) == (["c.png"], [])
    assert changed_places(before, before) == ([], [])


@pytest.mark.parametrize(("matched", "correct"), [pytest.param(False, True, marks=pytest.mark.slow), (True, False)])
def test_without_matches_or_permission_it_only_reports(
    tiny: TinyCapture, ctx: Context, matched: bool, correct: bool
) -> None:
    poses = verified(tiny, ctx, matched=matched, correct=correct)
    assert set(poses.doubts) == {WRONG}
    assert poses.right_probabilities is not None
    for row, probability in zip(poses.evidence.values(), poses.right_probabilities, strict=True):
        assert matched or row["contradicted"] is None
        known = {name: np.nan if value is None else value for name, value in row.items()}
        assert FITTED.probability(known) == pytest.approx(probability)
    assert ctx.metrics["p_right_lowest"] == poses.right_probabilities.min()
    assert ctx.metrics["registered_rightly"] == pytest.approx(poses.right_probabilities.mean())
    assert ctx.notes == []
    assert poses.translations.tobytes() == poses_of(tiny, wrong=True).translations.tobytes()


@pytest.mark.slow
def test_nothing_is_said_of_true_poses(tiny: TinyCapture, ctx: Context) -> None:
    poses = verified(tiny, ctx, wrong=False)
    assert poses.doubts == {}
    assert ctx.notes == []
    assert ctx.rejected == {}


def test_one_pose_is_no_model(tiny: TinyCapture, ctx: Context) -> None:
    alone = Poses.without_points(
        {"000.png": tiny.poses[0]}, rejected={"001.png": "no pair"}, frame="x", scale="x", metric=False
    )
    with pytest.raises(RunStoppedError, match=r"001\.png: no pair"):
        verify(poses=alone, images=tiny.each(Panorama), features=None, matches=None, params=VerifyParams(), ctx=ctx)
    assert ctx.rejected == {"001.png": "no pair"}


def test_a_tour_that_matches_do_not_join_goes_on_to_its_links(tiny: TinyCapture, ctx: Context) -> None:
    alone = Poses.without_points({}, rejected={"001.png": "no pair"}, frame="x", scale="x", metric=False)
    linked = (SceneLink("000.png", (10.0, 0.0)),)
    images = {name: replace(image, links=linked) for name, image in tiny.each(Panorama).items()}
    checked = verify(poses=alone, images=images, features=None, matches=None, params=VerifyParams(), ctx=ctx)
    refined = refine(poses=checked, images=images, params=RefineParams(), ctx=ctx)
    assert level(poses=refined, images=images, params=LevelParams(), ctx=ctx).names == ()
    assert ctx.rejected == {"001.png": "no pair"}
    assert ctx.metrics["registered"] == 0.0


def test_a_solver_that_places_nothing_leaves_it_to_the_next_stages_to_stop(tiny: TinyCapture, ctx: Context) -> None:
    """The run ended although learned matches, which come after the poses of SIFT, may place all images."""
    poses = scaled_translation(
        features=tiny.each(Features),
        matches={},
        images=tiny.each(Panorama),
        params=ScaledTranslationParams(),
        ctx=ctx,
    )
    assert poses.names == ()
    assert set(ctx.rejected) == set(poses.rejected) == set(tiny.names)
    with pytest.raises(RunStoppedError, match="no two panoramas could be registered"):
        nearest(poses=poses, params=NearestParams(), ctx=ctx)


@pytest.mark.parametrize("ask_images", [False, True])
def test_the_solver_opens_pictures_only_where_it_may(
    tiny: TinyCapture, ctx: Context, monkeypatch: pytest.MonkeyPatch, ask_images: bool
) -> None:
    """Nothing is ambiguous in the room, so the poses are the same either way."""
    opened: list[Panorama] = []
    load = Panorama.load

    def noted(image: Panorama) -> NDArray[np.uint8]:
        opened.append(image)
        return load(image)

    monkeypatch.setattr(Panorama, "load", noted)
    poses = scaled_translation(
        features=tiny.each(Features),
        matches=tiny.each(TwoView),
        images=tiny.each(Panorama),
        params=ScaledTranslationParams(ask_images=ask_images),
        ctx=ctx,
    )
    assert poses.names == tiny.names
    assert len(opened) <= (len(tiny.names) if ask_images else 0)
