"""What docs/frames_and_scale.md shows works as it stands; tests/cli/workflows/test_frame.py runs its workflow."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app

PAGE = Path(__file__).parents[2] / "docs" / "frames_and_scale.md"


def block(mark: str) -> str:
    """Return the fenced block that follows a mark."""
    found = re.search(rf"<!-- {mark} -->\n```\w+\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert found, mark
    return found.group(1)


@pytest.mark.parametrize("line", block("variants").splitlines())
def test_every_way_to_metres_is_accepted(tmp_path: Path, line: str) -> None:
    (tmp_path / "photos").mkdir()
    text, count = re.subn(r"  metres: .*", lambda _: f"  {line}", block("workflow"))
    assert count == 1
    (tmp_path / "mine.yaml").write_text(text)
    result = CliRunner().invoke(app, ["check", str(tmp_path / "mine.yaml")])
    assert result.exit_code == 0, result.output


def test_every_choice_of_evidence_is_explained() -> None:
    from pano_mvs.stages.frame import LevelParams, ScaleParams

    text = PAGE.read_text(encoding="utf-8")
    choices = LevelParams.model_json_schema()["properties"]["evidence"]["enum"]
    assert all(f"| `{choice}` |" in text for choice in choices if choice != "auto")
    assert all(f"`{name}" in text for name in ScaleParams.model_fields)
