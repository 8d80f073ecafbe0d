"""The presets that can be run with the plugins that are there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from pano_mvs.engine.stages.registry import Registry
from pano_mvs.session.session import presets_folder


def usable_presets() -> list[Path]:
    """Return the presets each of whose stages is registered or optional: with all bundled plugins, all presets."""
    registered = Registry.installed().stages
    return [
        path
        for path in sorted(presets_folder().glob("*.yaml"))
        if all(entry["use"] in registered or entry.get("optional") is True for entry in _stages(path).values())
    ]


def _stages(path: Path) -> dict[str, dict[str, Any]]:
    """Return the entries of a preset, with those of the presets that it extends."""
    value = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    extended = value.get("extends") or []
    stages: dict[str, dict[str, Any]] = {}
    for name in [extended] if isinstance(extended, str) else extended:
        stages |= _stages(path.with_name(f"{name}.yaml"))
    for name, entry in (value.get("stages") or {}).items():
        if entry is None:
            stages.pop(name, None)
        else:
            stages[name] = stages.get(name, {}) | entry
    return stages
