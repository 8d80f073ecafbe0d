"""Workflow files are laid out without changing what they mean, and no comment is lost."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pano_mvs.core.errors import WorkflowError
from pano_mvs.core.yaml_text import parse_yaml
from pano_mvs.engine.workflows.formatted import WIDTH, formatted
from pano_mvs.session.session import presets_folder
from tests.cli.conftest import Command, pano_mvs

__all__ = ["pano_mvs"]

MESSY = """
# What it is for.
name:   "lobby"
stages:
    # where they lie
    images:
        path: 'photos/lobby'   # of May
        use: source.folder

    depth: {cost: "census", on_error: stop, use: depth.sweep, planes: 0x40,
            near: 1e-1, note: "a, b"}
    # smooth: {use: filters.median}
    cloud:
        in: {ranges: depth}
        use: fusion.vote
        # kept as it is
        scale: fine
    ply: {use: "export.ply"}   # last
    # the end
pano_mvs: 1
# behind all
"""
NEAT = """\
pano_mvs: 1
# What it is for.
name: lobby
stages:
  # where they lie
  images:
      path: 'photos/lobby'   # of May
      use: source.folder

  depth:  {use: depth.sweep, cost: census, planes: 0x40, near: 1e-1, note: "a, b", on_error: stop}
  # smooth: {use: filters.median}
  cloud:
      in: {ranges: depth}
      use: fusion.vote
      # kept as it is
      scale: fine
  ply:    {use: export.ply}  # last
  # the end
# behind all
"""


def comments(text: str) -> list[str]:
    return sorted(re.findall(r"(?:^|\s)(#.*?)\s*$", text, re.MULTILINE))


def test_keys_quotes_and_lines_are_the_usual_ones_and_comments_stay() -> None:
    made = formatted(MESSY, "messy.yaml")
    assert made == NEAT
    assert formatted(made, "messy.yaml") == made
    assert comments(made) == comments(MESSY)
    assert parse_yaml(made, "").plain() == parse_yaml(MESSY, "").plain()


GROUPS = """\
pano_mvs: 1
stages:
    masks:
        # of people
        stages:
            people: {use: "masks.operator"}   # all
        group: 'masks'
    cameras: {stages: {house: {optional: true, use: house.links}}, group: cameras}
    sweep:
        stages: {depth: {planes: 64}}
        group: sweep
        description: "ranges, and more"
    exports:    # files
        description: "clouds, and files"
        stages:
            # of points
            cloud: {in: {ranges: depth}, use: fusion.vote}

            ply: {use: "export.ply"}
            # all of them
    layout: {group: layout}
"""
NEAT_GROUPS = """\
pano_mvs: 1
stages:
  masks:
    group: masks
    # of people
    stages:
      people: {use: masks.operator}  # all
  cameras: {group: cameras, stages: {house: {use: house.links, optional: true}}}
  sweep:   {group: sweep, description: "ranges, and more", stages: {depth: {planes: 64}}}
  exports:  # files
    description: clouds, and files
    stages:
      # of points
      cloud: {use: fusion.vote, in: {ranges: depth}}

      ply:   {use: export.ply}
      # all of them
  layout:  {group: layout}
"""


def test_groups_are_laid_out_with_their_stages() -> None:
    made = formatted(GROUPS, "groups.yaml")
    assert made == NEAT_GROUPS
    assert formatted(made, "groups.yaml") == made


PRESETS = sorted([*presets_folder().glob("*.yaml"), *(presets_folder() / "groups").glob("*.yaml")])


@pytest.mark.parametrize("preset", PRESETS, ids=lambda path: path.stem)
def test_presets_are_laid_out(preset: Path) -> None:
    text = preset.read_text(encoding="utf-8")
    assert formatted(text, preset.name) == text


def test_long_entries_take_several_lines() -> None:
    settings = {f"setting_{number}": "x" * 12 for number in range(8)}
    made = formatted(f"stages:\n  depth: {json.dumps({'use': 'depth.sweep'} | settings)}\n", "long.yaml")
    assert made.splitlines()[:3] == ["stages:", "  depth:", "    use: depth.sweep"]
    assert all(len(line) <= WIDTH for line in made.splitlines())
    assert len(made.splitlines()) == 11


@pytest.mark.parametrize(
    "text",
    [
        "stages:\n  a: &shared {use: x.y, p: 1}\n  b: {<<: *shared}\n",
        "stages:\n  a:\n    use: x.y\n    text: |\n      two\n      lines\n",
        "{stages: {a: {use: x.y}}}\n",
        "stages: {a: {use: x.y}}\n",
        "stages:\n  a: null\n",
    ],
)
def test_what_cannot_be_written_anew_stays(text: str) -> None:
    assert formatted(text, "a.yaml") == text


@pytest.mark.parametrize(
    ("value", "comment"),
    [
        (r'"C:\\x\\"', "# behind a backslash"),
        ("a 'b}", "# behind an apostrophe in a plain text"),
        ("'it''s # 1'", "# behind a doubled quote"),
        ("'two\n        lines # 2'", "# behind two lines"),
        ("a#b", "# behind a sign in a plain text"),
    ],
)
def test_no_comment_is_lost_behind_odd_values(value: str, comment: str) -> None:
    text = f"stages:\n    a:\n        use: x.y\n        text: {value}  {comment}\n    b: {{use: x.z}}\n"
    try:
        made = formatted(text, "a.yaml")
    except WorkflowError as error:
        assert "without losing something; it was left as it is" in str(error)  # noqa: PT017
        return
    assert comment in made
    assert parse_yaml(made, "").plain() == parse_yaml(text, "").plain()


@pytest.mark.parametrize("text", ["---\nstages:\n    a: {use: x.y}\n", "  stages:\n      a: {use: x.y}\n"])
def test_documents_with_marks_and_indented_ones_stay(text: str) -> None:
    assert formatted(text, "a.yaml") == text


def test_what_is_no_workflow_is_refused_with_its_place() -> None:
    with pytest.raises(WorkflowError, match=r"a\.yaml: a workflow is a mapping"):
        formatted("- 1\n", "a.yaml")
    with pytest.raises(WorkflowError, match=r"a\.yaml:\d"):
        formatted("stages:\n  a: {use: [\n", "a.yaml")


SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
VALUES = st.recursive(
    SCALARS | st.text(max_size=12),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.slow
@example({"a": {".Inf": None}})  # a text that YAML would read as a number which is refused
@given(st.dictionaries(st.from_regex(r"[a-z]{1,12}", fullmatch=True), VALUES, min_size=1, max_size=4))
def test_any_values_mean_the_same(settings: dict[str, object]) -> None:
    text = f"pano_mvs: 1\nstages:\n    a: {json.dumps({'use': 'x.y'} | settings)}\n"
    try:
        before = parse_yaml(text, "a.yaml").plain()
    except WorkflowError:
        return  # such as a key that is not printable
    made = formatted(text, "a.yaml")
    assert parse_yaml(made, "a.yaml").plain() == before
    assert formatted(made, "a.yaml") == made


def test_the_command_writes_checks_and_shows(pano_mvs: Command, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(MESSY)
    assert pano_mvs("fmt", path, "--check").code == 4
    shown = pano_mvs("fmt", path, "--diff")
    assert shown.code == 4
    assert "+  ply:    {use: export.ply}  # last" in shown.text
    assert path.read_text() == MESSY
    assert "was laid out" in pano_mvs("fmt", path).flat
    assert path.read_text() == NEAT
    assert pano_mvs("fmt", path, "--check").code == 0
    assert pano_mvs("fmt", tmp_path / "nowhere.yaml").code == 2
    path.write_text("stages:\n  a: {use: [}\n")
    assert pano_mvs("fmt", path).code == 2


def test_line_ends_permissions_and_links_stay(pano_mvs: Command, tmp_path: Path) -> None:
    path, link = tmp_path / "mine.yaml", tmp_path / "link.yaml"
    path.write_bytes(MESSY.replace("\n", "\r\n").encode())
    path.chmod(0o640)
    link.symlink_to(path)
    assert pano_mvs("fmt", link).code == 0
    assert link.is_symlink()
    assert path.read_bytes() == NEAT.replace("\n", "\r\n").encode()
    assert path.stat().st_mode & 0o777 == 0o640
    assert pano_mvs("fmt", path, "--check").code == 0


def test_one_file_that_cannot_be_read_leaves_all_as_they_are(pano_mvs: Command, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(MESSY)
    (tmp_path / "b.yaml").write_text("stages:\n  a: {use: [}\n")
    assert pano_mvs("fmt", tmp_path / "a.yaml", tmp_path / "b.yaml").code == 2
    assert (tmp_path / "a.yaml").read_text() == MESSY
