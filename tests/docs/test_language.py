"""Documentation and package use plain words; see tests/language.py."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests import language


@pytest.mark.parametrize("path", language.documents(), ids=lambda path: path.relative_to(language.ROOT).as_posix())
def test_documents_use_plain_words(path: Path) -> None:
    assert [str(place) for place in language.places_in_document(path)] == []


def test_unplain_words_in_the_package_become_fewer() -> None:
    counts = language.count(place for path in language.modules() for place in language.places_in_module(path))
    assert language.grown(counts, language.allowed_counts()) == [], "python -m tests.language lists the places"


def test_the_baseline_knows_all_words() -> None:
    assert language.allowed_counts().keys() == language.WORDS.keys()


def test_a_word_in_a_document_is_found_on_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(language, "ROOT", tmp_path)
    page = tmp_path / "page.md"
    page.write_text("`told`\n```text\ntold\n```\n<!-- laws -->\n[x](told.md)\n\nas you are\ntold, but\nfor all\n")
    assert [(place.word, place.line) for place in language.places_in_document(page)] == [("tell", 9), ("but for", 9)]


def test_of_a_workflow_comments_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(language, "ROOT", tmp_path)
    page = tmp_path / "a.yaml"
    page.write_text("told: gate  # so\n# many laws\n")
    assert [(place.word, place.line) for place in language.places_in_document(page)] == [("law", 2)]


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ('"""Says so\nmany things."""\n', ["so many"]),
        ("told = 1  # what is told\n", ["tell"]),
        ("# as\n# so many\nlaw = 2\n# laws\n", ["so many", "law"]),
        ("x = f'{told} is a sound name'\n", ["sound"]),
        ("x = {'gate': 1}\ny = '`gate` is a key'\n", []),
        ("# the law of sines tells them apart\n", []),
        ('"""Gates.\n\n    Args:\n        gate: of laws.\n"""\n', ["law", "gate"]),
        ('"""Return None if it is None or is none."""\n', ["is none"]),
        ('"""It is no mask if there is no pixel, and is no longer one."""\n', ["is no"]),
    ],
)
def test_comments_and_strings_of_a_module_count(
    source: str, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(language, "ROOT", tmp_path)
    path = tmp_path / "module.py"
    path.write_text(source)
    assert [place.word for place in language.places_in_module(path)] == words


def test_a_count_above_the_baseline_is_reported() -> None:
    assert language.grown(Counter({"tell": 3, "law": 2}), {"tell": 3, "law": 1}) == ["law"]
    assert language.grown(Counter({"tell": 3}), {}) == ["tell"]
