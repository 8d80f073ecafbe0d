"""What a person sees first: good runs are called good, bad ones bad, and why."""

import pytest

from pano_mvs.report.findings import findings
from pano_mvs.report.residuals import Histogram, Residuals
from pano_mvs.report.verdict import verdict

NAMES = [f"{number}.png" for number in range(10)]
GOOD = {
    "exit_code": 0,
    "stages": [{"name": "depth", "run": 10}],
    "poses": {"registered": NAMES, "rejected": {}, "links": [[a, b, 90] for a in NAMES for b in NAMES if a < b]},
    "views": [{"name": name, "completeness": 0.99, "consistent": 0.45} for name in NAMES],
    "cloud": {"points": 100_000},
    "scores": {"views": {name: {"psnr_db": 30.0, "constant_psnr_db": 18.0} for name in NAMES}},
}


def residuals(median_deg):
    return Residuals(Histogram((1,), 1.0, median_deg, 2 * median_deg, 1), {}, sampled=False)


def test_a_good_run_is_called_good_and_nothing_is_found():
    found = verdict(GOOD, residuals=residuals(0.04), image_width=1024)
    assert (found.mood, found.judgement, found.findings) == ("good", "The result looks reliable.", ())


def rejecting(count):
    reasons = {f"x{number}.png": f"{number} matches, 20 needed" for number in range(count)}
    return GOOD["poses"] | {"rejected": reasons}


def doubting(count):
    return GOOD["poses"] | {"doubts": dict.fromkeys(NAMES[:count], "confirmed 1 %")}


@pytest.mark.parametrize(
    ("change", "mood", "words"),
    [
        ({"poses": rejecting(2)}, "fair", "2 of 12 panoramas have no pose: 2 times such as “0 matches, 20 needed”"),
        ({"poses": rejecting(30)}, "bad", "30 of 40"),
        ({"views": [{"completeness": 0.6, "consistent": 0.5}]}, "fair", "less than 60 %"),
        ({"views": [{"completeness": 0.2, "consistent": 0.5}]}, "bad", "less than 20 %"),
        ({"views": [{"completeness": 1.0, "consistent": 0.05}]}, "bad", "confirm only 5"),
        ({"cloud": {"points": 0}}, "bad", "The cloud has no points"),
        ({"scores": {"views": {"1": {"psnr_db": 17.0, "constant_psnr_db": 18.0}}}}, "bad", "17.0 dB to 18.0 dB"),
        ({"all_scores": {"a": GOOD["scores"], "b": {"views": {"1": {"psnr_db": 9.0, "constant_psnr_db": 18.0}}}}},
         "bad", "(b)"),
        ({"exit_code": 4, "stopped": "registered is 0.2, the gate asks for 0.8"}, "bad", "the gate asks for 0.8"),
        ({"exit_code": 130, "stopped": "interrupted"}, "fair", "was interrupted"),
        ({"exit_code": 3, "failures": [{"stage": "depth", "item": "1.png"}]}, "fair", "1 in depth"),
        ({"exit_code": 1, "stopped": "division by zero"}, "bad", "division by zero"),
        ({"poses": GOOD["poses"] | {"links": [[NAMES[0], name, 90] for name in NAMES[1:]]}}, "fair",
         "9 cameras share a verified geometry with one other alone"),
        ({"exit_code": 3, "poses": doubting(1)}, "fair", "1 camera is doubtful: 0.png (confirmed 1 %)."),
        ({"poses": doubting(5)}, "fair", "5 cameras are doubtful: 0.png (confirmed 1 %); 1.png"),
        ({"poses": doubting(6)}, "bad", "4.png (confirmed 1 %); and 1 more."),
        ({"poses": GOOD["poses"] | {"groups": [{"images": NAMES[:7]}, {"images": NAMES[7:]}]}}, "fair",
         "2 groups of panoramas share no reliable connection"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_found_and_named(change, mood, words):
    found = verdict(GOOD | change)
    assert found.mood == mood
    assert any(words in finding.text for finding in found.findings), found.findings
    assert found.judgement != "The result looks reliable."


@pytest.mark.parametrize(("median_deg", "mood"), [(0.3, "good"), (0.5, "fair"), (1.0, "bad")])
def test_residuals_are_judged_by_the_pixels_of_the_pictures(median_deg, mood):
    """In pictures 1,024 wide a pixel is 0.35°; in larger ones the same angle is worse."""
    assert verdict(GOOD, residuals=residuals(median_deg), image_width=1024).mood == mood
    assert verdict(GOOD, residuals=residuals(median_deg), image_width=8192).mood == "bad"
    assert verdict(GOOD, residuals=residuals(median_deg)).mood == "good", "not judged where that is not known"


def test_where_no_stage_compares_the_views_nothing_is_held_against_them():
    """The paper's workflow has no such stage: all its pixels are weak, however right they are."""
    views = [{"name": name, "completeness": 0.99, "consistent": 0.0} for name in NAMES]
    found = verdict(GOOD | {"views": views})
    assert found.mood == "good"
    assert "nothing is known of their agreement" in found.findings[0].text
    assert not any("agree" in tile.label for tile in found.tiles)
    checked = [{"name": "checked", "use": "filters.consistency", "run": 10}]
    assert verdict(GOOD | {"views": views, "stages": checked}).mood == "bad", "it compared, and nothing agrees"


def test_the_worst_comes_first():
    found = verdict(GOOD | {"exit_code": 3, "failures": [{"stage": "depth"}], "cloud": {"points": 0}})
    assert [finding.mood for finding in found.findings] == ["bad", "fair"]


@pytest.mark.parametrize(
    ("code", "text", "mood"),
    [(0, "Finished", "good"), (1, "internal error", "bad"), (4, "Stopped by a quality gate", "bad"),
     (130, "Interrupted", "fair"), (77, "Ended with code 77", "bad")],
)  # fmt: skip
def test_the_outcome_is_that_of_the_exit_code(code, text, mood):
    found = verdict({"exit_code": code})
    assert text in found.outcome
    assert found.mood == mood


def test_a_run_with_doubtful_cameras_alone_has_no_failed_items():
    doubts = {"0.png": {"stage": "checked", "reason": "confirmed 1 %"}}
    doubtful = GOOD | {"exit_code": 3, "poses": doubting(1), "doubts": doubts}
    found = verdict(doubtful)
    assert found.outcome == "Finished, with doubtful cameras"
    assert (found.tiles[0].label, found.tiles[0].mood) == ("panoramas registered, 1 doubtful", "fair")
    failed = doubtful | {"failures": [{"stage": "depth", "item": "1.png"}]}
    assert verdict(failed).outcome == "Finished, with failed items"


def test_a_run_with_unregistered_panoramas_alone_has_no_failed_items():
    rejected = {"x0.png": {"stage": "poses", "reason": "0 matches, 20 needed"}}
    summary = GOOD | {"exit_code": 3, "poses": rejecting(1), "rejected": rejected}
    assert verdict(summary).outcome == "Finished, with panoramas left out"
    doubts = {"0.png": {"stage": "checked", "reason": "confirmed 1 %"}}
    assert verdict(summary | {"doubts": doubts}).outcome == "Finished, with panoramas left out and doubtful cameras"
    assert verdict({"exit_code": 3}).outcome == "Finished, with failed items"


def test_one_of_anything_is_not_named_as_several():
    (finding,) = [one for one in findings({"poses": rejecting(1)}) if "no pose" in one.text]
    assert finding.text == "1 of 11 panoramas has no pose: 0 matches, 20 needed."
    failed = {"failures": [{"stage": "depth"}], "blocked": [{}]}
    assert findings(failed)[0].text == "1 unit of work failed (1 in depth); 1 further unit could not run because of it."
    assert verdict({"stages": [{"run": 1}]}).sentence.startswith("1 unit of work: 1 computed")
    assert "the one unit of work was taken" in verdict({"stages": [{"cached": 1}]}).sentence
    assert verdict({"cloud": {"points": 1}}).tiles[0].label == "point in the cloud"


def test_reasons_that_differ_in_figures_and_endings_alone_are_counted_together():
    reasons = {"a": "1 match, 20 needed", "b": "7 matches, 20 needed", "c": "1 of its points is known",
               "d": "2 of its points are known", "e": "3 of its points are known"}  # fmt: skip
    (finding,) = findings({"poses": {"registered": NAMES, "rejected": reasons}})
    assert "3 times such as “1 of its points is known”" in finding.text


def test_where_nothing_is_known_nothing_is_judged():
    assert verdict({}).judgement == ""


def test_a_run_that_computed_nothing_says_so():
    stages = [{"name": "depth", "cached": 7}, {"name": "ply", "cached": 1}]
    assert "Nothing had changed: all 8 units" in verdict({"stages": stages}).sentence


def test_doubts_of_a_run_without_poses_are_findings_too() -> None:
    """The run ended with exit code 3 and said nothing."""
    doubts = {"0.png": {"stage": "judge", "reason": "the lens is dirty"}}
    summary = {"exit_code": 3, "poses": {}, "doubts": doubts}
    (finding,) = [finding for finding in findings(summary) if "doubtful" in finding.text]
    assert finding.mood == "fair"
    assert "1 image is doubtful: 0.png (the lens is dirty)" in finding.text
    both = GOOD | {"poses": doubting(1), "doubts": doubts | {"9.png": {"stage": "judge", "reason": "dark"}}}
    assert "9.png (dark)" in next(finding.text for finding in findings(both) if "doubtful" in finding.text)
