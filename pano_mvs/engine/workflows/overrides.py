"""Apply changes from the command line to a workflow: `--set STAGE.PARAM=VALUE` and `--images DIR`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pano_mvs.core.errors import WorkflowError
from pano_mvs.core.paths import resolved
from pano_mvs.engine.workflows.extends import did_you_mean
from pano_mvs.engine.workflows.yaml_text import Located, Problems, parse_yaml

_SYNTAX = "write STAGE.PARAM=VALUE, such as depth.planes=192"


@dataclass(frozen=True, slots=True)
class _Override:
    text: str
    target: str
    value: Located


def apply_overrides(
    stages: dict[str, Located], overrides: Sequence[str], problems: Problems, *, images: Path | None = None
) -> list[Located]:
    """Change stages in place, and return the plugin files to add.

    Overrides that add plugins, remove a stage or change its `use` are applied first, then the folder of images, then
    the others in the given order. So the settings of a new stage may precede its `use`.

    Args:
        stages: the merged entries.
        overrides: `STAGE.PARAM=VALUE`, `STAGE.PARAM.KEY=VALUE`, `STAGE=null` or `plugins=FILE`, with values in YAML.
        images: folder that replaces the path of the stage `images`; None to keep it.
    """
    plugins: list[Located] = []
    rest: list[_Override] = []
    for override in filter(None, (_read(text, problems) for text in overrides)):
        if override.target == "plugins":
            plugins.extend(_items(override.value))
        elif _stage_of(override.target, stages) == override.target:
            if override.value.value is None:
                del stages[override.target]
            else:
                problems.add(f"--set {override.text[:80]}", f"{_SYNTAX}; {override.target}=null removes the stage")
        elif override.target.removeprefix(f"{_stage_of(override.target, stages)}.") == "use":
            _replace(stages, override)
        else:
            rest.append(override)
    if images is not None:
        if "images" in stages:
            _set(stages["images"], ("path",), Located(str(resolved(images)), 0, 0, origin=f"--images {images}"))
        else:
            problems.add("--images", "this workflow has no stage called 'images'; use --set STAGE.path=DIR")
    for override in rest:
        _apply(stages, override, problems)
    return plugins


def _read(text: str, problems: Problems) -> _Override | None:
    target, equals, written = text.partition("=")
    target = target.strip()
    if not (equals and target) or (target != "plugins" and "." not in target and written.strip() not in {"null", "~"}):
        problems.add(f"--set {text[:80]}", _SYNTAX)
        return None
    origin = f"--set {target}"
    try:
        value = parse_yaml(written, origin) if written.strip() else Located(None, 0, 0)
    except WorkflowError as error:
        problems.lines.extend(error.problems)
        return None
    return _Override(text, target, Located(value.value, 0, 0, origin=origin))


def _stage_of(target: str, stages: dict[str, Located]) -> str:
    """Return the stage that a target begins with, the longest match as names may contain dots; empty if none."""
    found = [name for name in stages if target == name or target.startswith(f"{name}.")]
    return max(found, key=len, default="")


def _items(value: Located) -> list[Located]:
    items = value.value if isinstance(value.value, list) else [value]
    return [Located(item.value, 0, 0, origin=value.origin) for item in items]


def _replace(stages: dict[str, Located], override: _Override) -> None:
    """Change the `use` of a stage; this drops the settings of the old stage."""
    name = _stage_of(override.target, stages)
    node = stages[name]
    kept = node.value if node.value["use"].value == override.value.value else {}
    stages[name] = Located(
        {**kept, "use": override.value}, node.line, node.column, node.key_line, node.key_column, node.origin, node.file
    )


def _apply(stages: dict[str, Located], override: _Override, problems: Problems) -> None:
    name = _stage_of(override.target, stages)
    if not name:
        wanted = override.target.partition(".")[0]
        problems.add(f"--set {override.text[:80]}", f"no stage {wanted[:80]!r}.{did_you_mean(wanted, stages)}")
        return
    steps = tuple(override.target[len(name) + 1 :].split("."))
    if not all(steps):
        problems.add(f"--set {override.text[:80]}", _SYNTAX)
    elif problem := _set(stages[name], steps, override.value):
        problems.add(f"--set {override.text[:80]}", problem)


def _set(node: Located, steps: tuple[str, ...], value: Located) -> str:
    """Set a value at a path of keys and list positions; return why this is impossible, or ""."""
    here = node.value
    for number, step in enumerate(steps):
        last = number == len(steps) - 1
        shown = ".".join(steps[:number])
        if isinstance(here, list):
            if not step.isdecimal() or int(step[:9]) > len(here) - (not last):
                return f"{shown} is a list of {len(here)}: give a position from 0, or the whole list in [ ]"
            key: str | int = int(step[:9])
            if key == len(here):
                here.append(value)
                return ""
        elif isinstance(here, dict):
            key = step
            if not last and (key not in here or here[key].value is None):
                here[key] = Located({}, 0, 0, origin=value.origin)
        else:
            return f"{shown} is {here!r:.80}, which has no {step!r}"
        if last:
            here[key] = value
        else:
            here = here[key].value
    return ""
