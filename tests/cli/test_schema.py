"""`pano-mvs schema` as a person uses it."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema

from tests.cli.conftest import Command
from tests.engine.toy import HELPER, PLUGIN


def test_to_the_standard_output_and_to_a_file(pano_mvs: Command) -> None:
    printed = pano_mvs("schema")
    assert printed.code == 0
    written = pano_mvs("schema", "--out", "pano-mvs.schema.json")
    assert written.code == 0
    assert "# yaml-language-server: $schema=pano-mvs.schema.json" in written.flat
    schema = json.loads(Path("pano-mvs.schema.json").read_text(encoding="utf-8"))
    assert json.loads(printed.text) == schema
    jsonschema.Draft202012Validator.check_schema(schema)


def test_of_a_workflow_that_is_being_written(pano_mvs: Command) -> None:
    """Its plugins and what it extends count, though it has mistakes of its own."""
    Path("plug.py").write_text(PLUGIN)
    Path("helper.py").write_text(HELPER)
    Path("mine.yaml").write_text("pano_mvs: 1\nextends: quickstart\nplugins: [plug.py]\nstages: {depth: {plan: 1}}\n")
    result = pano_mvs("schema", "mine.yaml")
    assert result.code == 0, result.text
    schema = json.loads(result.text)
    assert "toy.scale" in schema["$defs"]["stage"]["properties"]["use"]["enum"]
    assert "depth" in schema["properties"]["stages"]["properties"]


def test_where_it_cannot_be_written_or_read(pano_mvs: Command) -> None:
    Path("file").touch()
    assert pano_mvs("schema", "--out", "file/schema.json").code == 2
    assert pano_mvs("schema", "nothing").code == 2
    Path("bad.yaml").write_text("[")
    assert pano_mvs("schema", "bad.yaml").code == 2
