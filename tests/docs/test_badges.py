"""The badges of the README show what pyproject.toml says, and the README shows all of them."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "docs" / "_pictures"))

from badges import FOLDER, badges  # type: ignore[import-not-found]  # noqa: E402

README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("name", "text"), badges().items())
def test_the_files_are_what_the_script_makes(name: str, text: str) -> None:
    assert (FOLDER / name).read_text(encoding="utf-8") == text
    ElementTree.fromstring(text)
    assert f"(docs/images/badges/{name})" in README
    assert {path.name for path in FOLDER.iterdir()} == set(badges())


def test_the_texts_beside_the_badges_are_true() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    found = re.search(r"!\[Python (3\.\d+) to (3\.\d+)\].*!\[Licence: (\w+)\].*at least (\d+) %", README, re.DOTALL)
    assert found
    first, last, licence, coverage = found.groups()
    assert settings["project"]["requires-python"] == f">={first}"
    assert f"Programming Language :: Python :: {last}" in settings["project"]["classifiers"]
    assert settings["project"]["license"] == licence
    assert settings["tool"]["coverage"]["report"]["fail_under"] == int(coverage)
