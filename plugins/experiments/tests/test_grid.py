"""Combinations of settings: what options and files say, and the names of the combinations."""

from __future__ import annotations

import doctest
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pano_mvs_experiments import grid
from pano_mvs_experiments.grid import (
    Value,
    combinations_from_file,
    combinations_of_grid,
    grid_from_options,
    items_of,
    names_of,
    text_from_value,
)

from pano_mvs.core.errors import InputError, UsageError, WorkflowError
from pano_mvs.core.file_names import folder_problem
from pano_mvs.core.yaml_text import parse_yaml


def texts(options: list[str]) -> dict[str, list[str]]:
    return {target: [value.text for value in values] for target, values in grid_from_options(options).items()}


def from_file(folder: Path, text: str) -> list[dict[str, str]]:
    (folder / "v.yaml").write_text(text)
    return [
        {target: value.text for target, value in each.items()} for each in combinations_from_file(folder / "v.yaml")
    ]


def test_examples() -> None:
    assert doctest.testmod(grid).failed == 0


@pytest.mark.parametrize(
    ("written", "items"),
    [
        ("64", ["64"]),
        ("64,128", ["64", "128"]),
        (" 64 , 128 ", ["64", "128"]),
        ("[1, 2],[3]", ["[1, 2]", "[3]"]),
        ("{a: 1, b: [2, 3]}, null", ["{a: 1, b: [2, 3]}", ""]),
        ("'a,b',c", ["a,b", "c"]),
        ('"64",64', ['"64"', "64"]),
        ('["a]", b],c', ['["a]", b]', "c"]),
        ("'it''s',x", ["it's", "x"]),
        ('"a\\"b",x', ['a"b', "x"]),
        ("bob's,eve's", ["bob's", "eve's"]),
        ("", [""]),
        ("~,a #1", ["", "a #1"]),
    ],
)
def test_values_of_an_option(written: str, items: list[str]) -> None:
    assert texts([f"a.b={written}"]) == {"a.b": items}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["a.b=[1,2"], "--set a.b=.*] is missing"),
        (["a.b='x"], "--set a.b=.*closing ' is missing"),
        (["a.b=1,,2"], "there is no value beside a comma"),
        (["a.b=1,"], "there is no value beside a comma"),
        (["a.b"], "write STAGE.PARAM=V1,V2"),
        (["a.b=1", "a.b=2"], "a.b is set twice"),
        (["a.b='x' y,2"], "--set a.b"),
    ],
)
def test_options_that_cannot_be_read(options: list[str], message: str) -> None:
    with pytest.raises(WorkflowError, match=message):
        grid_from_options(options)


def test_null_removes_a_stage_and_unsets_a_setting() -> None:
    assert texts(["smooth=null", "images.masks=null"]) == {"smooth": ["null"], "images.masks": [""]}


@given(st.one_of(st.integers(), st.text(st.characters(codec="ascii", exclude_categories=["Cc"])), st.booleans()))
def test_the_text_of_a_value_is_read_as_the_value(value: object) -> None:
    assert parse_yaml(text_from_value(value), "x").value == value


@given(st.lists(st.one_of(st.integers(), st.text("ab,'\"[]{}: #"), st.lists(st.text("a,'\"[]"))), min_size=2))
def test_values_with_commas_survive_an_option(values: list[object]) -> None:
    written = [text_from_value([value])[1:-1] if isinstance(value, str) else text_from_value(value) for value in values]
    assert [parse_yaml(item, "x").value for item in items_of(",".join(written)) if item[0] == '"'] == [
        value for value in values if isinstance(value, str)
    ]
    assert len(items_of(",".join(written))) == len(values)


def test_a_grid_has_all_combinations_and_the_last_setting_varies_fastest(tmp_path: Path) -> None:
    expected = [{"a.x": x, "b.y": y} for x in ("1", "2") for y in ("p", "q", '"3"')]
    assert from_file(tmp_path, "grid: {a.x: [1, 2], b.y: [p, q, '3']}") == expected
    from_options = combinations_of_grid(grid_from_options(["a.x=1,2", "b.y=p,q,'3'"]))
    assert [{target: value.text for target, value in each.items()} for each in from_options] == expected


def test_a_grid_that_is_too_large_is_refused_before_it_is_made() -> None:
    values = {f"a.{name}": [Value(str(idx), "") for idx in range(1000)] for name in "xyz"}
    with pytest.raises(UsageError, match="1000 × 1000 × 1000 makes 1000000000 combinations"):
        combinations_of_grid(values)


def test_a_list_has_its_combinations(tmp_path: Path) -> None:
    found = from_file(tmp_path, "list:\n  - {}\n  - {a.x: [1, 2], b.y: null}\n  - {a.x: 'p,q'}\n")
    assert found == [{}, {"a.x": "[1, 2]", "b.y": ""}, {"a.x": "p,q"}]


RANDOM = "random: {{count: {count}, seed: {seed}, settings: {{a.x: [1, 2, 3], {more}}}}}"


def test_draws_are_repeatable_and_lie_in_their_range(tmp_path: Path) -> None:
    more = "b.y: {min: 0.001, max: 10, log: true}, c.z: {min: 3, max: 5, integer: true}"
    found = from_file(tmp_path, RANDOM.format(count=200, seed=4, more=more))
    assert found == from_file(tmp_path, RANDOM.format(count=200, seed=4, more=more))
    assert len(found) == 200
    assert {each["a.x"] for each in found} == {"1", "2", "3"}
    assert {each["c.z"] for each in found} == {"3", "4", "5"}
    values = [float(each["b.y"]) for each in found]
    assert min(values) >= 0.001
    assert max(values) <= 10
    assert 60 < sum(value < 0.1 for value in values) < 140  # half of them, on a logarithmic scale
    assert found != from_file(tmp_path, RANDOM.format(count=200, seed=5, more=more))


def test_more_draws_begin_with_the_same_ones_and_no_setting_changes_those_of_another(tmp_path: Path) -> None:
    few = from_file(tmp_path, RANDOM.format(count=5, seed=1, more="b.y: [1, 2]"))
    many = from_file(tmp_path, RANDOM.format(count=9, seed=1, more="c.z: [1, 2]"))
    assert [each["a.x"] for each in few] == [each["a.x"] for each in many[:5]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("grid: {a.x: 1}", r"v.yaml:1:13: must be a list of values"),
        ("grid: [1]", r"v.yaml:1:7: must be a mapping"),
        ("grid: {}", r"v.yaml:1:7: grid holds no combination"),
        ("list: 3", r"v.yaml:1:7: must be a list of combinations"),
        ("list: [3]", r"v.yaml:1:8: must be a mapping"),
        ("grdi: {a.x: [1]}", r"v.yaml:1:1: unknown key 'grdi'. Did you mean 'grid'"),
        ("{}", r"give one of the keys grid, list, random, not nothing"),
        ("{grid: {a.x: [1]}, list: [{}]}", r"not grid and list"),
        ("random: {count: 3}", r"v.yaml:1:9: settings are missing"),
        ("random: {count: x, settings: {a.x: [1]}}", r"v.yaml:1:17: count must be a whole number"),
        ("random: {settings: {a.x: [1]}}", r"v.yaml:1:9: count must be a whole number"),
        ("random: {count: 3, settings: {a.x: {min: 1}}}", r"max must be a number"),
        ("random: {count: 3, settings: {a.x: {min: 3, max: 1}}}", r"needs min not above max"),
        ("random: {count: 3, settings: {a.x: {min: 0, max: 1, log: true}}}", r"needs min above 0"),
        ("random: {count: 3, settings: {a.x: {min: 1.2, max: 1.8, integer: true}}}", r"with a whole number between"),
        ("random: {count: 3, settings: {a.x: {min: 1, max: 2, log: 3}}}", r"log must be true or false"),
        ("random: {count: 3, settings: {a.x: {min: 1, max: 2, lgo: true}}}", r"unknown key 'lgo'"),
        ("random: {count: 3, settings: {a.x: 4}}", r"v.yaml:1:36: must be a list of values"),
        ("random: {count: 3, sed: 4, settings: {a.x: [4]}}", r"v.yaml:1:20: unknown key 'sed'"),
        ("grid: {a.x: [1", r"v.yaml:1"),
        ("", r"the file is empty"),
    ],
)
def test_mistakes_in_a_file_are_reported_with_their_place(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(WorkflowError, match=message):
        from_file(tmp_path, text)


def test_a_file_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none.yaml: cannot be read"):
        combinations_from_file(tmp_path / "none.yaml")


def named(*combinations: dict[str, str]) -> list[str]:
    return names_of([{target: Value(text, "") for target, text in each.items()} for each in combinations])


def test_names_are_short_and_readable() -> None:
    assert named({"depth.planes": "64", "depth.cost": "census"}) == ["planes=64,cost=census"]
    assert named({"a.x": "1", "b.x": "0.5"}, {}) == ["a.x=1,b.x=0.5", "default"]
    assert named({"a.x": ""}) == ["x=null"]
    assert named({"a.use": "depth.sweep", "a.seed": "3"}) == ["a.use=depth.sweep,a.seed=3"]


def test_names_that_are_not_safe_or_long_end_with_a_digest() -> None:
    for text in ("photos/x", "Census", "a,b", "[1, 2]", "..", "x" * 100, "ä", "1.", "con", "a=b", "\u202e"):
        (name,) = named({"a.x": text})
        assert not folder_problem(name)
        assert len(name) <= 60
        if text != "con":
            assert name.rpartition("-")[2] not in (name, text)
    assert named({"a.x": "Census"}) != named({"a.x": "census"})
    assert len({*map(str.casefold, named({"a.x": "Ab"}, {"a.x": "aB"}, {"a.x": "ab"}))}) == 3


def test_different_combinations_have_different_names() -> None:
    assert len({*named({"a.x": ""}, {"a.x": '"null"'}, {"a.x": "null"})}) == 3
    assert len({*named({"a.x": "1"}, {"a.x": "1"})}) == 1
    assert len({*named({"a.x": "1,y=2"}, {"a.x": "1", "a.y": "2"})}) == 2
