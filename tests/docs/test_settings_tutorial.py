"""The tutorial on settings, from three captures to a decision: its commands run, and print what it shows."""

from __future__ import annotations

import re
from itertools import islice
from math import isclose
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.testing.room import capture_poses, default_room
from tests.docs.pages import text_of
from tests.docs.test_examples import FENCED, commands
from tests.synthetic.capture_files import write_capture

PAGE = text_of("tutorials/settings.md")
LESS = ["--executor", "serial"]  # and what makes the runs short
for each in ("features.max_keypoints=1500", "weak.learned=never", "verified=null", "views.sources=2"):
    LESS += ["--set", each]
CAPTURES = {"lobby": 0.4, "flat": 0.5, "house": 0.6}  # the spread of the cameras


def make_captures(folder: Path) -> None:
    """Write the captures whose results the page shows into the folder `photos`."""
    (folder / "photos").mkdir()
    for seed, (name, spread) in enumerate(CAPTURES.items()):
        poses = capture_poses(3, spread=spread, seed=seed)
        write_capture(folder / "made" / name, default_room(seed), poses, size_hw=(112, 224))
        (folder / "made" / name / "images").rename(folder / "photos" / name)


def words_of(text: str) -> list[str]:
    """Return the words of a text, without the frames of tables; less than the smallest number is that number."""
    return re.sub(r"[\u2500-\u257f]|< (?=0\.0001)", " ", text).split()


def is_same(shown: str, printed: str) -> bool:
    """Return whether a word is the printed one; numbers with digits behind the point may differ by 2 %.

    Deviations over seeds, some ten-thousandths, depend on the processor, and may differ by as much.
    """
    numbers = [re.fullmatch(r"\(?(\d+\.\d+)\)?[,;]?", word) for word in (shown, printed)]
    if all(numbers):
        first, second = (float(found[1]) for found in numbers if found is not None)
        return isclose(first, second, rel_tol=0.02, abs_tol=0.0005)
    return shown == printed


def is_in(shown: str, printed: str) -> bool:
    """Return whether a text was printed, with any spaces, line breaks and frames."""
    words, found = words_of(shown), words_of(printed)
    places = range(len(found) - len(words) + 1)
    return any(all(map(is_same, words, islice(found, place, None))) for place in places)


@pytest.mark.slow
def test_the_commands_print_what_the_page_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_captures(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PANO_MVS_CACHE", raising=False)
    monkeypatch.setenv("COLUMNS", "200")
    (workflow,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "mine.yaml").write_text(workflow)
    printed, compared = "", 0
    for _, language, text in (found.groups() for found in FENCED.finditer(PAGE)):
        if language == "bash":
            for arguments in commands(text):
                own = LESS if arguments[0] in ("run", "vary") else []
                result = CliRunner().invoke(app, [*arguments, *own])
                assert result.exit_code in (0, 3), result.output
                printed = result.output
        elif language == "text":
            assert is_in(text, printed), printed
            compared += 1
    assert compared == PAGE.count("<!-- printed -->") == 5
    assert (tmp_path / "costs.html").is_file()


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("a  b", "│ a │ b │", True),
        ("0.8832 ± < 0.0001", "x 0.8835 ± < 0.0001 y", True),
        ("0.8832", "0.9205", False),
        ("0.74 ± 0.00018", "0.741 ± < 0.0001", True),
        ("0.74 ± 0.00018", "0.74 ± 0.0012", False),
        ("(0.8832)", "(0.8833)", True),
        ("a b", "a c b", False),
    ],
)
def test_texts_are_compared_by_their_words(shown: str, printed: str, same: bool) -> None:
    assert is_in(shown, printed) is same
