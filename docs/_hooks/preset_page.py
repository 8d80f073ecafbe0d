"""The shipped workflows, as they are, and which stages they use."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.workflows.workflow import load_workflow

WORKFLOWS = Path(__file__).parents[2] / "workflows"

_INTRODUCTION = """# Shipped workflows

Run a preset by its name (`pano-mvs run quickstart --images photos`), or modify it in your own workflow with `extends:`
([Workflows](../workflows.md)). In all of them, the source is called `images`, the pose solver `poses` and the sweep
`depth`, so `--set depth.planes=192` works with each. Without `--images`, they run on an included sample capture. This
page shows the files unchanged, and below them the [groups of stages](../workflows.md#groups-of-stages) that they
share."""


def preset_page() -> str:
    """Return the page of all shipped workflows."""
    parts = [_INTRODUCTION]
    for path in sorted(WORKFLOWS.glob("*.yaml")):
        parts += [f"## {path.stem}", _text(path)]
    parts.append("## Groups of stages")
    for path in sorted((WORKFLOWS / "groups").glob("*.yaml")):
        parts += [f"### groups/{path.name}", _text(path)]
    return "\n\n".join(parts) + "\n"


def _text(path: Path) -> str:
    return f"```yaml\n{path.read_text(encoding='utf-8').rstrip()}\n```"


def presets_that_use(stage: str) -> str:
    """Return a sentence that names the presets in which a stage is, with links; empty if there is none."""
    names = [path.stem for path in sorted(WORKFLOWS.glob("*.yaml")) if stage in _uses(path)]
    links = ", ".join(f"[{name}](presets.md#{name})" for name in names)
    return f"Used in the presets {links}." if names else ""


@cache
def _uses(path: Path) -> set[str]:
    workflow = load_workflow(path, Registry.installed(), presets=WORKFLOWS)
    return {entry.spec.name for entry in workflow.stages.values()}
