"""Results of the built-in stages against those written down: none changes under a key that stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.golden.record import (
    Golden,
    by_other_libraries,
    case_names,
    complaint,
    differences,
    made_now,
    read_recorded,
    write_recorded,
)

BEFORE = Golden("c0de", {"numpy": "2.0"}, {"range": [100, 90, 2.0, 1.0, 1.5, 2.0, 2.5, 3.0], "metrics": [0.9]})
OTHER_RESULT = {"range": [100, 90, 2.5, 1.0, 1.5, 2.5, 2.5, 3.0], "metrics": [0.9]}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(case_names()))
def test_no_result_changes_under_a_key_that_stays(name: str) -> None:
    before, now = read_recorded().get(name), made_now(name)
    problem = complaint(name, before, now)
    if problem and (others := by_other_libraries(before, now)):
        pytest.skip(f"recorded with other libraries: {others}")
    assert not problem, problem


def test_every_stage_is_written_down() -> None:
    """That each one which is written down still exists is tested where the bundled plugins are."""
    assert {*case_names()} <= set(read_recorded())


def test_a_result_that_changes_under_its_key_is_a_complaint() -> None:
    assert complaint("a.b", BEFORE, BEFORE) == ""
    assert "its key has not" in complaint("a.b", BEFORE, replace(BEFORE, summary=OTHER_RESULT))


def test_a_result_that_changes_with_its_key_is_to_be_written_down() -> None:
    now = replace(BEFORE, code="other", summary=OTHER_RESULT)
    assert "range: [100, 90, 2.0" in complaint("a.b", BEFORE, now)
    assert "python -m tests.golden" in complaint("a.b", BEFORE, now)
    assert "its key has not" not in complaint("a.b", BEFORE, now)
    assert complaint("a.b", BEFORE, replace(BEFORE, code="other")) == "", "other code, same results: nothing to do"
    assert "not in stages.json" in complaint("a.b", None, now)


def test_other_libraries_are_named() -> None:
    assert by_other_libraries(BEFORE, BEFORE) == ""
    assert by_other_libraries(BEFORE, replace(BEFORE, libraries={"numpy": "2.1", "scipy": "1"})) == "numpy 2.0 → 2.1"


@pytest.mark.parametrize("factor", [0.995, 1.005])
def test_what_machines_do_differently_is_no_difference(factor: float) -> None:
    now = {name: [float(value) for value in np.multiply(values, factor)] for name, values in BEFORE.summary.items()}
    assert differences(BEFORE.summary, now) == []


@pytest.mark.parametrize("idx", range(8))
def test_each_figure_counts(idx: int) -> None:
    values = list(BEFORE.summary["range"])
    values[idx] *= 1.2
    assert differences(BEFORE.summary, BEFORE.summary | {"range": values}) != []


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    write_recorded({"a.b": BEFORE, "c": replace(BEFORE, summary={"refused": "InputError"})}, tmp_path / "some.json")
    assert read_recorded(tmp_path / "some.json")["a.b"] == BEFORE
    assert read_recorded(tmp_path / "some.json")["c"].summary == {"refused": "InputError"}
