"""The report of a run: whatever the summary lacks, one page that says what is known, and nothing leaves it."""

import base64
import re
import shutil
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from pano_mvs.geometry import Rigid3
from pano_mvs.io.preview import write_preview
from pano_mvs.report import write_report
from pano_mvs.testing.room import default_room, render

NAMES = ["a/1.png", "a/2.png", "a/3.png"]
SUMMARY = {
    "workflow": {"name": "lobby", "path": "flows/lobby.yaml"},
    "version": "1.2.3",
    "started": "2026-11-21 04:17",
    "seconds": 187.2,
    "exit_code": 3,
    "stages": [
        {"name": "depth", "use": "depth.sweep", "units": 4, "run": 2, "cached": 1, "failed": 1, "blocked": 9,
         "seconds": 90.0, "metrics": {"planes": 128, "median_error_deg": 0.01234567}},
        {"name": "ply", "use": "export.ply", "units": 1, "run": 1, "cached": 0, "failed": 0, "seconds": 0.2},
    ],
    "failures": [{"stage": "depth", "item": "a/4.png", "cause": "it is truncated", "consequence": "no range map"}],
    "notes": ["one picture has no GPano metadata"],
    "poses": {
        "registered": NAMES,
        "rejected": {"a/4.png": "too few matches"},
        "centers": [[0, 0, 0], [1, 0.1, 0.2], [0.4, 0, 2]],
        "frame": "the first camera",
        "scale": "the first baseline is 1",
        "links": [["a/1.png", "a/2.png", 300], ["a/2.png", "a/3.png", 30], ["a/1.png", "a/4.png", 3]],
    },
    "scores": {
        "poses": {"median_pair_error_deg": 0.0123, "registered": 3},
        "views": {
            "a/1.png": {"median_relative_error": 0.02},
            "a/2.png": {"median_relative_error": 0.04, "psnr_db": 30.0},
        },
        "notes": ["the scale was fitted"],
    },
    "views": [
        {"name": "a/1.png", "preview": "preview/a/1.jpg", "completeness": 0.98, "consistent": 0.7},
        {"name": "a/2.png", "preview": "preview/gone.jpg", "completeness": 0.9},
    ],
    "cloud": {"points": 1234567},
    "workflow_text": "pano_mvs: 1\nstages: {}\n",
    "versions": {"numpy": "2.1"},
}  # fmt: skip
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Collects the text and the attributes of a page, and whether its elements nest."""

    def __init__(self, source):
        super().__init__()
        self.open, self.text, self.attributes, self.tags = [], [], [], []
        self.feed(source)
        assert not self.open, f"not closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *attr) for attr in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *attr) for attr in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.text.append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())


def reported(out_dir, summary):
    write_report(out_dir, summary)
    return Page((out_dir / "report.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def preview_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("preview") / "1.jpg"
    write_preview(path, *render(default_room(), Rigid3.identity(), (32, 64)))
    return path


@pytest.fixture
def out_dir(tmp_path, preview_file):
    (tmp_path / "preview" / "a").mkdir(parents=True)
    shutil.copy(preview_file, tmp_path / "preview" / "a" / "1.jpg")
    return tmp_path


def test_everything_that_is_known_is_said(out_dir):
    words = reported(out_dir, SUMMARY).words
    for text in (
        "lobby", "Finished, with failed items", "3 of 4 panoramas registered", "94 % of pixels have a range",
        "1.23 M points in the cloud", "0.012° median pose error", "3 % median range error", "Took 3 min 07 s",
        "5 units of work: 3 computed, 1 taken from the cache, 1 failed.", "it is truncated", "no range map",
        "too few matches", "one picture has no GPano metadata", "the first baseline is 1", "median error, °: 0.01235",
        "the scale was fitted", "PSNR dB", "pano_mvs: 1 stages: {}", "numpy 2.1", "no preview", "1 min 30 s",
        "9 blocked",
    ):  # fmt: skip
        assert text in words, text


@pytest.mark.parametrize("key", [None, *SUMMARY])
def test_any_key_may_be_missing_or_empty(out_dir, key):
    without = {name: value for name, value in SUMMARY.items() if name != key}
    assert "pano-mvs" in reported(out_dir, without if key else {}).words
    if isinstance(SUMMARY.get(key), dict | list):
        reported(out_dir, without | {key: type(SUMMARY[key])()})
        reported(out_dir, without | {key: None})


@pytest.mark.parametrize("key", SUMMARY["poses"])
def test_any_key_of_the_poses_may_be_missing(out_dir, key):
    poses = {name: value for name, value in SUMMARY["poses"].items() if name != key}
    reported(out_dir, SUMMARY | {"poses": poses})


def test_nothing_is_fetched_and_nothing_runs(out_dir):
    page = reported(out_dir, SUMMARY)
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    sources = [value for _, name, value in page.attributes if name in ("src", "href", "srcset", "data")]
    assert sources
    assert all(value.startswith("data:image/jpeg;base64,") for value in sources)
    assert "url(" not in (out_dir / "report.html").read_text(encoding="utf-8")
    assert ("meta", "content", "default-src 'none'; img-src data:; style-src 'unsafe-inline'") in page.attributes


def test_names_and_causes_are_text_and_never_markup(out_dir):
    evil = '<script>alert("1")</script>&\'">'
    summary = {
        "workflow": {"name": evil}, "notes": [evil], "workflow_text": evil, "versions": {evil: evil},
        "failures": [{"stage": evil, "item": evil, "cause": evil}],
        "poses": {"registered": [evil], "centers": [[0, 0, 0]], "rejected": {evil + "2": evil}},
        "views": [{"name": evil, "preview": evil}], "stages": [{"name": evil, "metrics": {evil: evil}}],
        "scores": {"poses": {evil: 1}, "views": {evil: {evil: evil}}},
    }  # fmt: skip
    page = reported(out_dir, summary)
    assert "script" not in page.tags
    assert page.words.count(evil) >= 12


def test_previews_travel_within_the_page_no_wider_than_1024(out_dir):
    page = reported(out_dir, SUMMARY)
    (data,) = [value for tag, name, value in page.attributes if (tag, name) == ("img", "src")]
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data.split(",")[1]), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] == 1024
    assert ("img", "width", "1024") in page.attributes


@pytest.mark.parametrize("preview", ["../secret.jpg", "empty.jpg", "text.jpg", "", "preview"])
def test_what_is_no_preview_within_the_folder_is_not_shown(out_dir, preview):
    inside = out_dir / "out"
    (inside / "preview").mkdir(parents=True)
    cv2.imwrite(str(out_dir / "secret.jpg"), np.zeros((8, 16, 3), np.uint8))
    (inside / "empty.jpg").touch()
    (inside / "text.jpg").write_text("hello")
    page = reported(inside, {"views": [{"name": "1", "preview": preview}]})
    assert "img" not in page.tags
    assert "no preview" in page.words


def test_of_many_views_the_worst_and_some_others_are_shown(out_dir):
    views = [{"name": f"view {idx}", "completeness": 0.2 if idx in (400, 411) else 0.9} for idx in range(1000)]
    words = reported(out_dir, {"views": views}).words
    assert "24 of 1000 are shown" in words
    assert words.count("no preview") == 24
    assert {"view 400", "view 411", "view 999"} <= set(re.findall(r"view \d+", words))


def circles(page):
    x, y = (
        [float(value) for tag, name, value in page.attributes if (tag, name) == ("circle", f"c{axis}")] for axis in "xy"
    )
    return np.stack([x, y], axis=-1)


def test_the_map_shows_the_cameras_true_to_scale_from_above_and_from_the_side(out_dir):
    page = reported(out_dir, SUMMARY)
    above, side = circles(page).reshape(2, 3, 2)
    centers = np.array(SUMMARY["poses"]["centers"])
    for drawn, flat in ((above, centers[:, [0, 2]] * (1, -1)), (side, centers[:, [0, 1]])):
        scale = np.linalg.norm(drawn[1] - drawn[0]) / np.linalg.norm(flat[1] - flat[0])
        assert drawn - drawn[0] == pytest.approx((flat - flat[0]) * scale, abs=1)
    assert page.tags.count("line") == 4  # two links between registered cameras, on two maps


def test_the_map_is_drawn_along_the_direction_up(out_dir):
    """Cameras on a wall of the world stand side by side from above if that wall is the ground."""
    poses = {"registered": NAMES, "centers": [[0, 0, 0], [1, 0, 0], [0, 3, 0]], "up": [0, 0, 1]}
    above, side = circles(reported(out_dir, {"poses": poses})).reshape(2, 3, 2)
    assert np.ptp(above[:, 1]) == pytest.approx(3 * np.ptp(above[:, 0]), rel=0.02)
    assert np.ptp(side[:, 1]) == pytest.approx(0, abs=0.11)


@pytest.mark.parametrize(
    "centers", [[[0, 0, 0]] * 3, [[0, 0, 0], [0, 1e-12, 0], [0, 0, 0]], [[0, 0, 0], [1e6, 0, 0], [2e6, 0, 0]]]
)
def test_cameras_in_one_place_or_in_a_row_are_drawn_within_the_map(out_dir, centers):
    poses = {"registered": ["a rather long name of a picture", "b", "c"], "centers": centers}
    drawn = circles(reported(out_dir, {"poses": poses}))
    assert drawn.shape == (6, 2)
    assert np.all((drawn > 0) & (drawn < 480))


@pytest.mark.parametrize("centers", [[[0, 0, 0]], [[0, 0, float("nan")]] * 3])
def test_centres_that_do_not_fit_give_no_map(out_dir, centers):
    assert "svg" not in reported(out_dir, {"poses": {"registered": NAMES, "centers": centers}}).tags


@pytest.mark.parametrize(
    ("code", "text", "mood"),
    [(0, "Finished", "good"), (1, "internal error", "bad"), (4, "Stopped by a quality gate", "bad"),
     (130, "Interrupted", "fair"), (77, "Ended with code 77", "bad")],
)  # fmt: skip
def test_the_outcome_is_that_of_the_exit_code(out_dir, code, text, mood):
    page = reported(out_dir, {"exit_code": code})
    assert text in page.words
    assert ("span", "class", f"chip {mood}") in page.attributes


def test_a_run_that_registered_little_is_not_called_good(out_dir):
    page = reported(out_dir, {"exit_code": 0, "poses": {"registered": ["1"], "rejected": {"2": "dark", "3": "dark"}}})
    assert ("span", "class", "chip fair") in page.attributes
    assert ("li", "class", "bad") in page.attributes


def test_a_run_that_computed_nothing_says_so(out_dir):
    stages = [{"name": "depth", "cached": 7}, {"name": "ply", "cached": 1}]
    assert "Nothing had changed: all 8 units" in reported(out_dir, {"stages": stages}).words
