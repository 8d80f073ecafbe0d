"""Presets are written in groups, and resolve as without them; some of their stages are of bundled plugins."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from pano_mvs.core.yaml_text import Problems
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.merged_stages import MergedStages
from pano_mvs.engine.workflows.workflow import load_workflow
from pano_mvs.engine.workflows.workflow_file import WorkflowFilesReader, read_text
from pano_mvs.session.session import open_session, presets_folder

NINE = ["source", "masks", "keypoints", "matching", "cameras", "sweep", "filters", "layout", "exports"]


def test_quality_reads_as_nine_groups() -> None:
    workflow = open_session("quality").workflow
    assert list(workflow.groups) == NINE
    assert all(entry.group for entry in workflow.stages.values())
    assert all(group.description for group in workflow.groups.values())
    assert [stage for group in workflow.groups.values() for stage in group.stages] == list(workflow.stages)
    for preset in presets_folder().glob("*.yaml"):
        assert set(open_session(preset).workflow.groups) <= {*NINE, "paper"}


def flattened(preset: Path) -> dict[str, Any]:
    """Return a preset that extends no other one as it would be without groups."""
    problems = Problems()
    reader = WorkflowFilesReader(problems, presets_folder())
    reader.read(read_text(preset), str(preset), preset.parent)
    merged = MergedStages(reader, problems)
    for file in reader.files:
        merged.add(file)
    return {"pano_mvs": 1, "stages": {name: node.plain() for name, node in merged.stages.items()}}


@pytest.mark.slow
def test_presets_in_a_list_are_merged_as_without_groups(tmp_path: Path) -> None:
    """What extends several presets must find the results that it computed before presets had groups."""
    registry = Registry.installed()
    (tmp_path / "samples").symlink_to(presets_folder() / "samples")
    whole = [path for path in sorted(presets_folder().glob("*.yaml")) if "\nextends:" not in path.read_text("utf-8")]
    for preset in whole:
        with (tmp_path / f"flat_{preset.stem}.yaml").open("w", encoding="utf-8") as stream:
            YAML().dump(flattened(preset), stream)
    for first, second in permutations([path.stem for path in whole], 2):
        found = []
        for name in ("", "flat_"):
            file = tmp_path / "both.yaml"
            ending = ".yaml" if name else ""
            file.write_text(f"pano_mvs: 1\nextends: [{name}{first}{ending}, {name}{second}{ending}]\n")
            workflow = load_workflow(file, registry, presets=presets_folder())
            text = {key: (one.params.model_dump_json(), one.policy) for key, one in workflow.stages.items()}
            found.append([(key, *value) for key, value in text.items()])
        names = [[(key, policy) for key, _, policy in one] for one in found]
        assert names[0] == names[1], (first, second)
        assert [one[1].replace(str(presets_folder()), "") for one in found[0]] == [
            one[1].replace(str(tmp_path), "") for one in found[1]
        ]
