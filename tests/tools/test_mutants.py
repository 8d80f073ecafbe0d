"""The faults of a module: each is one change, what is for people is left alone, and moving code changes no id."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tools.mutation.groups import GROUPS
from tools.mutation.mutants import mutants_of
from tools.mutation.trial import SECONDS, Baseline

ROOT = Path(__file__).resolve().parents[2]

TEXT = '''"""Text 1 of a module."""
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    import x
LIMIT: int = 3

@decorated(1)
def f(a: "int | None", b=2) -> int | None:
    """Text 2."""
    assert a > 0, "a text"
    if a <= b and not b:
        raise ValueError(f"{a + 1} is too {LIMIT}")
    a.size += 1.5
    g(f"{b - 1}", "two words", "word")
    return a if a in (b, True) else -a
'''


def test_faults_are_one_change_each() -> None:
    assert {(one.where, one.what) for one in mutants_of("m.py", TEXT)} == {
        ("", "3 → 4"),
        ("f", "2 → 3"),
        ("f", "a <= b and not b → not (a <= b and not b)"),
        ("f", "a <= b and not b → (a <= b) or (not b)"),
        ("f", "a <= b → (a < b)"),
        ("f", "not b → (b)"),
        ("f", 'raise ValueError(f"{a + 1} is too {LIMIT}") → pass'),
        ("f", "a.size += 1.5 → pass"),
        ("f", "1.5 → 3.0"),
        ("f", 'g(f"{b - 1}", "two words", "word") → pass'),
        ("f", "\"word\" → 'wordX'"),
        ("f", "return a if a in (b, True) else -a → return None"),
        ("f", "a in (b, True) → not (a in (b, True))"),
        ("f", "a in (b, True) → (a not in (b, True))"),
        ("f", "True → False"),
        ("f", "-a → (a)"),
    }


def test_ids_stay_where_code_moves() -> None:
    before = [one.id for one in mutants_of("folder/m.py", TEXT)]
    moved = TEXT.replace("LIMIT: int = 3", "# a comment\nLIMIT: int = 3\n")
    assert [one.id for one in mutants_of("elsewhere/m.py", moved)] == before
    assert len(set(before)) == len(before)


@pytest.mark.slow
def test_every_fault_of_every_group_is_python_and_has_an_id_of_its_own() -> None:
    for title, group in GROUPS.items():
        assert all((ROOT / path).exists() for path in group.tests), title
        paths = [path for source in group.sources for path in sorted(ROOT.glob(source))]
        assert paths, title
        del paths[3:]  # a few will do
        texts = [(path, path.read_text("utf-8")) for path in paths]
        mutants = [one for path, text in texts for one in mutants_of(path.name, text)]
        assert len(mutants) > 30, title
        assert len({one.id for one in mutants}) == len(mutants), title
        for one in mutants[::20]:
            ast.parse(one.text)


def test_the_quickest_tests_that_run_the_line_are_taken_for_some_seconds() -> None:
    seconds = {"slow": SECONDS, "quick": 1.0, "other": 0.1, "quicker": 0.5}
    lines = {5: ["slow", "other"], 15: ["slow", "quick", "quicker"], 0: list(seconds)}
    baseline = Baseline(seconds, {"m.py": lines})
    by_what = {one.what: one for one in mutants_of("m.py", TEXT)}
    assert baseline.of(by_what["-a → (a)"]) == ["quicker", "quick"]
    assert baseline.of(by_what["3 → 4"]) == ["other", "quicker", "quick"]
    assert baseline.of(by_what["1.5 → 3.0"]) == []
