"""Texts of others: cut, and with their control characters spelled out."""

from __future__ import annotations

import json

import pytest

from pano_mvs.core.text import json_without_controls, one_line, shortened, without_controls


def test_long_texts_keep_their_beginning_and_end() -> None:
    cut = shortened("<" + "x" * 1_000_000 + ">")
    assert len(cut) < 2100
    assert cut.startswith("<xx")
    assert cut.endswith("xx>")
    assert "998002 characters left out" in cut


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a\x1b[2Jb", "a\\x1b[2Jb"),
        ("a\x9b31mb", "a\\x9b31mb"),
        ("a\rb\x07\x7f", "a\\x0db\\x07\\x7f"),
        ("gpj.\u202eb", "gpj.\\u202eb"),
        ("a\udc80b", "a\\udc80b"),
    ],
)
def test_what_would_steer_a_terminal_is_spelled_out(text: str, shown: str) -> None:
    assert without_controls(text) == shown
    line = json_without_controls(json.dumps(text, ensure_ascii=False))
    assert without_controls(line) == line
    assert json.loads(line) == text


def test_a_name_stays_on_its_line() -> None:
    """A file name with a newline could print a line of its own, such as "results in …"."""
    assert one_line("x\nresults in\there\x1b.jpg") == r"x\x0aresults in\x09here\x1b.jpg"
    assert one_line("räume/1.jpg") == "räume/1.jpg"
