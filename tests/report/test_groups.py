"""Groups of panoramas that nothing connects: told first of all, drawn apart, with the pictures to take."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.engine.cache.store import Store
from pano_mvs.report import write_report
from pano_mvs.report.cloud_pictures import cloud_pictures
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.records import NearestPair, PairLink, PoseGroup, PosesSummary
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.results.verdict import findings, pictures_between, verdict
from pano_mvs.scene import PointCloud, Poses, Record
from pano_mvs.scene.pose_groups import join_groups, with_cameras
from pano_mvs.session.summarise import nearest_pair
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import stored, summary_of
from tests.report.html_page import Page

LINKS = [
    PairLink("a", "b", 90, 120, 0.01),
    PairLink("b", "x", 0, 31),
    PairLink("x", "a", 0, 12),
    PairLink("x", "y", 80),
]


@pytest.fixture
def rooms(tmp_path: Path, tiny: TinyCapture) -> tuple[dict[str, Any], StoredValues]:
    """What a run over the tiny capture might say had it found two pictures to be of another room."""
    summary, results = summary_of(tiny), stored(_store(tmp_path), tiny)
    large, small = _halves(tiny)
    poses = join_groups([large, replace(small, frame="the annexe's", scale="metres, by GPS", metric=True)])
    cloud = tiny.whole(PointCloud)
    far_away = replace(cloud, points_in_world=cloud.points_in_world + 1000)
    results = with_values(results, poses=poses, cloud=PointCloud.of_groups([cloud, far_away]))
    names = list(tiny.names)
    links = [
        [names[0], names[1], 100, 120, 0.02],
        [names[2], names[3], 100, 120, 0.02],
        [names[1], names[2], 0, 31, None],
        [names[0], names[3], 0, 8, None],
    ]
    groups = [
        {
            "images": list(group.names),
            "frame": world.frame,
            "scale": world.scale,
            "metric": world.metric,
            "points": 240,
            "up": None,
            "nearest_pair": [names[1], names[2], 0, 31] if number else None,
        }
        for number, (group, world) in enumerate(zip((large, small), poses.worlds, strict=True))
    ]
    return {**summary, "poses": {**summary["poses"], "links": links, "groups": groups}}, results


def with_values(results: StoredValues, **values: Record) -> StoredValues:
    """Put other values in place of those that there is one of."""
    store = results.store
    assert store is not None
    return replace(
        results, refs={**results.refs, **{role: {"": store.put_value(value)} for role, value in values.items()}}
    )


def _store(folder: Path) -> Store:
    from pano_mvs.engine.cache.store import Store

    return Store(folder / "cache")


def _halves(tiny: TinyCapture) -> tuple[Poses, Poses]:
    poses = tiny.whole(Poses)
    first = np.arange(4) < 2
    return with_cameras(poses, first), with_cameras(poses, ~first)


def test_the_pair_that_comes_closest_to_joining_two_groups_has_most_matches_or_else_candidates() -> None:
    assert nearest_pair(("a", "b"), ("x", "y"), LINKS) == ("b", "x", 0, 31)
    assert nearest_pair(("a", "b"), ("x", "y"), [*LINKS, PairLink("a", "y", 5)]) == ("a", "y", 5, 0)
    assert nearest_pair(("a", "b"), ("x", "y"), LINKS[:1]) is None


def test_groups_are_a_doubt_and_the_pictures_to_take_are_named(rooms: tuple[dict[str, Any], StoredValues]) -> None:
    summary, _ = rooms
    found = verdict(RunSummary.from_json(summary))
    assert found.mood == "fair"
    assert found.tiles[0].label == "panoramas registered, in 2 groups"
    told = next(finding for finding in found.findings if "groups of panoramas" in finding.text)
    assert (told.mood, told.remedy) == (
        "fair",
        "To connect them, take panoramas between 001.png and 002.png (31 candidates).",
    )
    assert "group 1 has 2 (002.png, 003.png)" in told.text


def test_one_group_is_no_finding(rooms: tuple[dict[str, Any], StoredValues]) -> None:
    summary, _ = rooms
    one = {**summary, "poses": {**summary["poses"], "groups": summary["poses"]["groups"][:1]}}
    assert not any("groups" in finding.text for finding in findings(RunSummary.from_json(one)))
    poses = RunSummary.from_json(one).poses
    assert poses.by_group() == (poses,)


def test_of_groups_that_were_never_compared_nothing_is_guessed() -> None:
    text = pictures_between([PoseGroup(images=("a",)), PoseGroup(images=("x",))])
    assert text.startswith("Take panoramas between the groups")


def test_of_many_groups_a_few_are_named() -> None:
    groups = [
        PoseGroup(images=("a",)),
        *(PoseGroup(images=(f"x{n}", f"y{n}"), nearest_pair=NearestPair("a", f"x{n}", n, 9)) for n in range(9)),
    ]
    text = pictures_between(groups)
    assert text.count("between") == 5
    assert text.endswith(" ….")
    (told,) = (
        finding
        for finding in findings(RunSummary(poses=PosesSummary(groups=tuple(groups))))
        if "groups" in finding.text
    )
    assert "and 4 more" in told.text


def test_the_page_draws_each_group_apart_and_says_its_frame(
    rooms: tuple[dict[str, Any], StoredValues], out_dir: Path
) -> None:
    summary, results = rooms
    write_report(out_dir, RunSummary.from_json(summary), results)
    page = Page((out_dir / "report.html").read_text(encoding="utf-8"))
    text = " ".join(" ".join(page.text).split())
    assert "Group 0: 2 panoramas" in text
    assert "Group 1: 2 panoramas" in text
    assert "the annexe's" in text
    assert [text.count(f"{name} group {number}") for name, number in (("001.png", 0), ("002.png", 1))] == [1, 1]
    assert "metres, by GPS" in text
    assert "Each group has its own frame and unit of length" in text
    assert sum(tag == "svg" and "cameras from" in str(values.get("aria-label")) for tag, values in page.elements) == 4
    labels = [
        str(values["aria-label"])
        for _, values in page.elements
        if "scale of the range" in str(values.get("aria-label"))
    ]
    ends = {name: [label for label in labels if label.endswith(name)] for name in ("metres", "scene units")}
    assert len(ends["metres"]) >= 2
    assert len(ends["scene units"]) >= 2
    assert [text.count(f"range in {unit}") for unit in ("m ", "scene units")] == [len(found) for found in ends.values()]


def test_the_cloud_of_the_largest_group_is_shown_alone(rooms: tuple[dict[str, Any], StoredValues]) -> None:
    """The other one is a thousand units away here: with it nothing would be seen of either."""
    _, results = rooms
    shown = cloud_pictures(results, EarlierPage(), up=np.array([0.0, -1.0, 0.0]))
    assert "this is group 0" in shown.note
    assert results.cloud is not None
    alone = with_values(results, cloud=results.cloud.groups()[0])
    for (_, picture), (_, expected) in zip(
        shown.shown, cloud_pictures(alone, EarlierPage(), up=np.array([0.0, -1.0, 0.0])).shown, strict=True
    ):
        assert picture.uri == expected.uri
