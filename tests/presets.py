"""The presets that can be run with the plugins that are there."""

from __future__ import annotations

from pathlib import Path

from pano_mvs.core.yaml_text import Located, Problems
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.merged_stages import MergedStages
from pano_mvs.engine.workflows.workflow_file import WorkflowFilesReader, read_text
from pano_mvs.session.session import presets_folder


def usable_presets() -> list[Path]:
    """Return the presets each of whose stages is registered or optional: with all bundled plugins, all presets."""
    registered = Registry.installed().stages
    return [
        path
        for path in sorted(presets_folder().glob("*.yaml"))
        if all(entry.plain()["use"] in registered or "optional" in entry.value for entry in _stages(path).values())
    ]


def _stages(path: Path) -> dict[str, Located]:
    """Return the entries of a preset, with those of its groups and of the presets that it extends."""
    problems = Problems()
    reader = WorkflowFilesReader(problems, presets_folder())
    reader.read(read_text(path), str(path), path.parent)
    merged = MergedStages(reader, problems)
    for file in reader.files:
        merged.add(file)
    problems.raise_if_any()
    return merged.stages
