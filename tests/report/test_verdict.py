"""The verdict, the findings and the advice, also for several groups of cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.engine.cache.store import Store
from pano_mvs.report import write_report
from pano_mvs.report.cloud import cloud_pictures
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.records import Finding, NearestPair, PairLink, PoseGroup, PosesSummary, Verdict
from pano_mvs.results.residuals import Histogram, Residuals
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.results.verdict import findings, pictures_between, verdict
from pano_mvs.scene import PointCloud, Poses, Record
from pano_mvs.scene.pose_groups import join_groups, with_cameras
from pano_mvs.session.summarise import nearest_pair
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import stored, summary_of
from tests.report.html_page import Page

NAMES = [f"{number}.png" for number in range(10)]
POSES: dict[str, Any] = {
    "registered": NAMES,
    "rejected": {},
    "links": [[a, b, 90] for a in NAMES for b in NAMES if a < b],
}
GOOD = {
    "exit_code": 0,
    "stages": [{"name": "depth", "run": 10}],
    "poses": POSES,
    "views": [{"name": name, "completeness": 0.99, "consistent": 0.45} for name in NAMES],
    "cloud": {"points": 100_000},
    "scores": {"views": {name: {"psnr_db": 30.0, "constant_psnr_db": 18.0} for name in NAMES}},
}


def judged(summary: Mapping[str, Any], **known: Any) -> Verdict:
    return verdict(RunSummary.from_json(summary), **known)


def found_in(summary: Mapping[str, Any]) -> tuple[Finding, ...]:
    return findings(RunSummary.from_json(summary))


def residuals(median_deg: float) -> Residuals:
    return Residuals(Histogram((1,), 1.0, median_deg, 2 * median_deg, 1), {}, sampled=False)


def test_a_good_run_is_called_good_and_nothing_is_found() -> None:
    found = judged(GOOD, residuals=residuals(0.04), image_width=1024)
    assert (found.mood, found.judgement, found.findings) == ("good", "The result looks reliable.", ())


@pytest.mark.parametrize(("masked", "stopped", "mood"), [(0.4, "", None), (0.78, "", "fair"), (0.78, "no two", "bad")])
def test_masks_that_hide_most_are_found_before_all_else(masked: float, stopped: str, mood: str | None) -> None:
    """Masks whose white was meant to hide led to the advice to take panoramas closer together."""
    stages = [{"name": "images", "run": 10, "metrics": {"masked": masked}}]
    found = found_in(GOOD | {"stages": stages, "stopped": stopped, "poses": rejecting(30)})
    of_masks = [finding for finding in found if "hide 78 % of what the images show" in finding.text]
    assert [finding.mood for finding in of_masks] == ([mood] if mood else [])
    rejected = next(finding for finding in found if "30 of 40" in finding.text)
    assert ("more panoramas" in rejected.remedy) == (mood is None)
    assert all("invert them" in finding.remedy for finding in of_masks)
    assert mood != "bad" or found[0] in of_masks


def rejecting(count: int) -> dict[str, Any]:
    reasons = {f"x{number}.png": f"{number} matches, 20 needed" for number in range(count)}
    return POSES | {"rejected": reasons}


def doubting(count: int) -> dict[str, Any]:
    return POSES | {"doubts": dict.fromkeys(NAMES[:count], "confirmed 1 %")}


@pytest.mark.parametrize(
    ("change", "mood", "words"),
    [
        ({"poses": rejecting(2)}, "fair", "2 of 12 panoramas have no pose: 2 times such as “0 matches, 20 needed”"),
        ({"poses": rejecting(30)}, "bad", "30 of 40"),
        ({"views": [{"completeness": 0.6, "consistent": 0.5}]}, "fair", "less than 60 %"),
        ({"views": [{"completeness": 0.2, "consistent": 0.5}]}, "bad", "less than 20 %"),
        ({"views": [{"completeness": 1.0, "consistent": 0.05}]}, "bad", "confirm only 5"),
        (
            {"views": [{"completeness": 1.0, "consistent": 0.5, "confirmed_above": 0.1, "confirmed_below": 0.9}]},
            "fair",
            "confirm only 10 % of the ranges above the cameras",
        ),
        ({"cloud": {"points": 0}}, "bad", "The cloud has no points"),
        ({"scores": {"views": {"1": {"psnr_db": 17.0, "constant_psnr_db": 18.0}}}}, "bad", "18.0 dB, against 17.0 dB"),
        (
            {"all_scores": {"a": GOOD["scores"], "b": {"views": {"1": {"psnr_db": 9.0, "constant_psnr_db": 18.0}}}}},
            "bad",
            "(b)",
        ),
        ({"exit_code": 4, "stopped": "registered is 0.2, but `gate` requires 0.8"}, "bad", "but `gate` requires 0.8"),
        ({"exit_code": 130, "stopped": "interrupted"}, "fair", "was interrupted"),
        ({"exit_code": 3, "failures": [{"stage": "depth", "item": "1.png"}]}, "fair", "1 in depth"),
        ({"exit_code": 1, "stopped": "division by zero"}, "bad", "division by zero"),
        (
            {"poses": POSES | {"links": [[NAMES[0], name, 90] for name in NAMES[1:]]}},
            "fair",
            "9 cameras share a verified geometry with only one other camera",
        ),
        ({"exit_code": 3, "poses": doubting(1)}, "fair", "1 camera is doubtful: 0.png (confirmed 1 %)."),
        ({"poses": doubting(5)}, "fair", "5 cameras are doubtful: 0.png (confirmed 1 %); 1.png"),
        ({"poses": doubting(6)}, "bad", "4.png (confirmed 1 %); and 1 more."),
        ({"poses": doubting(len(NAMES))}, "bad", f"All {len(NAMES)} cameras are doubtful: confirmed 1 %."),
        (
            {"poses": POSES | {"groups": [{"images": NAMES[:7]}, {"images": NAMES[7:]}]}},
            "fair",
            "2 groups of panoramas share no reliable connection",
        ),
    ],
)
def test_what_is_wrong_is_found_and_named(change: dict[str, Any], mood: str, words: str) -> None:
    found = judged(GOOD | change)
    assert found.mood == mood
    assert any(words in finding.text for finding in found.findings), found.findings
    assert found.judgement != "The result looks reliable."


@pytest.mark.parametrize(("median_deg", "mood"), [(0.3, "good"), (0.5, "fair"), (1.0, "bad")])
def test_residuals_are_judged_by_the_pixels_of_the_pictures(median_deg: float, mood: str) -> None:
    """In pictures 1,024 wide a pixel is 0.35°; in larger ones the same angle is worse."""
    assert judged(GOOD, residuals=residuals(median_deg), image_width=1024).mood == mood
    assert judged(GOOD, residuals=residuals(median_deg), image_width=8192).mood == "bad"
    assert judged(GOOD, residuals=residuals(median_deg)).mood == "good", "not judged where that is not known"


def test_where_no_stage_compares_the_views_nothing_is_held_against_them() -> None:
    """The paper's workflow has no such stage: all its pixels are weak, however right they are."""
    views = [{"name": name, "completeness": 0.99, "consistent": 0.0} for name in NAMES]
    found = judged(GOOD | {"views": views})
    assert found.mood == "good"
    assert "it is unknown whether they agree" in found.findings[0].text
    assert not any("agree" in tile.label for tile in found.tiles)
    checked = [{"name": "checked", "use": "filters.consistency", "run": 10}]
    assert judged(GOOD | {"views": views, "stages": checked}).mood == "bad", "it compared, and nothing agrees"


def test_the_worst_comes_first() -> None:
    found = judged(GOOD | {"exit_code": 3, "failures": [{"stage": "depth"}], "cloud": {"points": 0}})
    assert [finding.mood for finding in found.findings] == ["bad", "fair"]


@pytest.mark.parametrize(
    ("code", "text", "mood"),
    [
        (0, "Finished", "good"),
        (1, "internal error", "bad"),
        (4, "Stopped by a quality threshold", "bad"),
        (130, "Interrupted", "fair"),
        (77, "Ended with code 77", "bad"),
    ],
)
def test_the_outcome_is_that_of_the_exit_code(code: int, text: str, mood: str) -> None:
    found = judged({"exit_code": code})
    assert text in found.outcome
    assert found.mood == mood


def test_a_run_with_doubtful_cameras_alone_has_no_failed_items() -> None:
    doubts = {"0.png": {"stage": "checked", "reason": "confirmed 1 %"}}
    doubtful = GOOD | {"exit_code": 3, "poses": doubting(1), "doubts": doubts}
    found = judged(doubtful)
    assert found.outcome == "Finished, with doubtful cameras"
    assert (found.tiles[0].label, found.tiles[0].mood) == ("panoramas registered, 1 doubtful", "fair")
    failed = doubtful | {"failures": [{"stage": "depth", "item": "1.png"}]}
    assert judged(failed).outcome == "Finished, with failed items"


def test_a_run_with_unregistered_panoramas_alone_has_no_failed_items() -> None:
    rejected = {"x0.png": {"stage": "poses", "reason": "0 matches, 20 needed"}}
    summary = GOOD | {"exit_code": 3, "poses": rejecting(1), "rejected": rejected}
    assert judged(summary).outcome == "Finished, with panoramas left out"
    doubts = {"0.png": {"stage": "checked", "reason": "confirmed 1 %"}}
    assert judged(summary | {"doubts": doubts}).outcome == "Finished, with panoramas left out and doubtful cameras"
    assert judged({"exit_code": 3}).outcome == "Finished, with failed items"


def test_one_of_anything_is_not_named_as_several() -> None:
    (finding,) = [one for one in found_in({"poses": rejecting(1)}) if "no pose" in one.text]
    assert finding.text == "1 of 11 panoramas has no pose: 0 matches, 20 needed."
    failed = {"failures": [{"stage": "depth"}], "blocked": [{}]}
    assert found_in(failed)[0].text == "1 unit of work failed (1 in depth); 1 further unit could not run because of it."
    assert judged({"stages": [{"run": 1}]}).sentence.startswith("1 unit of work: 1 computed")
    assert "the one unit of work was taken" in judged({"stages": [{"cached": 1}]}).sentence
    assert judged({"cloud": {"points": 1}}).tiles[0].label == "point in the cloud"


def test_reasons_that_differ_in_figures_and_endings_alone_are_counted_together() -> None:
    reasons = {
        "a": "1 match, 20 needed",
        "b": "7 matches, 20 needed",
        "c": "1 of its points is known",
        "d": "2 of its points are known",
        "e": "3 of its points are known",
    }
    (finding,) = found_in({"poses": {"registered": NAMES, "rejected": reasons}})
    assert "3 times such as “1 of its points is known”" in finding.text


def test_where_nothing_is_known_nothing_is_judged() -> None:
    assert judged({}).judgement == ""


def test_a_run_that_computed_nothing_says_so() -> None:
    stages = [{"name": "depth", "cached": 7}, {"name": "ply", "cached": 1}]
    assert "Nothing has changed: all 8 units" in judged({"stages": stages}).sentence


def test_doubts_of_a_run_without_poses_are_findings_too() -> None:
    """The run ended with exit code 3 and said nothing."""
    doubts = {"0.png": {"stage": "judge", "reason": "the lens is dirty"}}
    summary = {"exit_code": 3, "poses": {}, "doubts": doubts}
    (finding,) = [finding for finding in found_in(summary) if "doubtful" in finding.text]
    assert finding.mood == "fair"
    assert "1 image is doubtful: 0.png (the lens is dirty)" in finding.text
    both = GOOD | {"poses": doubting(1), "doubts": doubts | {"9.png": {"stage": "judge", "reason": "dark"}}}
    assert "9.png (dark)" in next(finding.text for finding in found_in(both) if "doubtful" in finding.text)


ROW = {
    "registered": ["a", "b", "c", "d", "e"],
    "centers": [[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 0, 0], [6, 0, 0]],
    "metric": True,
}


def reported(out_dir: Path, summary: dict[str, object], values: StoredValues | None = None) -> Page:
    write_report(out_dir, RunSummary.from_json(summary), values)
    return Page((out_dir / "report.html").read_text(encoding="utf-8"))


def test_a_gap_is_listed_and_marked_on_the_map(out_dir: Path) -> None:
    page = reported(out_dir, {"poses": ROW})
    assert "Take 2 panoramas between c and d. They are 3 m apart" in page.words
    assert page.source.count('class="stand"') == 1
    assert "numbers are places to stand" in page.words
    assert page.all("a", href="#next-time")


def test_a_capture_without_gaps_is_said_to_have_none(out_dir: Path) -> None:
    even = {**ROW, "centers": [[idx, 0, 0] for idx in range(5)]}
    page = reported(out_dir, {"poses": even})
    assert "No gap was found" in page.words
    assert 'class="stand"' not in page.source
    assert "Next time" not in reported(out_dir, {}).words


def test_of_many_suggestions_the_first_are_shown_and_the_others_counted(out_dir: Path) -> None:
    names = [f"{idx:02}" for idx in range(40)]
    centers = [[idx + 4 * (idx // 2), 0, 0] for idx in range(40)]
    near = [[idx, 0, 0] for idx in range(40, 100)]
    poses = {
        "registered": names + [f"n{idx}" for idx in range(60)],
        "centers": centers + [[2000 + x, 0, 0] for x, *_ in near],
    }
    page = reported(out_dir, {"poses": poses})
    assert page.words.count("panoramas between") == 12
    assert "8 more are less urgent" in page.words


def test_the_next_page_does_not_read_the_ranges_again(
    results: StoredValues, tiny: TinyCapture, out_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported(out_dir, summary_of(tiny), results)
    monkeypatch.setattr("pano_mvs.report.content.coverage", lambda *_: pytest.fail("read again"))
    reported(out_dir, summary_of(tiny), results)


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
