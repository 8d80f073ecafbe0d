"""The reference of all stages, from the registry: what each reads and gives, its settings, and who uses it."""

from __future__ import annotations

import json
from collections import defaultdict
from importlib.metadata import entry_points

from guide_pages import pages_about
from markdown_text import cell, docstring, table
from preset_page import presets_that_use
from pydantic.fields import FieldInfo
from setting_schema import limits_of, type_of

from pano_mvs import api
from pano_mvs.core.doors import is_bundled
from pano_mvs.engine.stages.params import NOT_IN_KEY
from pano_mvs.engine.stages.registry import ENTRY_POINT_GROUP, Registry
from pano_mvs.engine.stages.stage import Port, StageSpec
from pano_mvs.engine.workflows.editor_schema import workflow_schema
from pano_mvs.engine.workflows.policy import Policy

KINDS = {
    "source": "list the images of a capture and read them",
    "mask": "mask areas of an image",
    "masks": "find what moves with the camera, from all images, and mask it",
    "features": "compute key points of a panorama, as bearings on the sphere",
    "global": "describe an image by one vector",
    "pairs": "select the pairs of images to match",
    "matches": "match key points and estimate the geometry of two views",
    "poses": "estimate, verify, refine and transform poses",
    "house": "put all panoramas of a tour into one house",
    "views": "select the sources of each reference",
    "depth": "compute the range of every pixel of a reference",
    "filters": "improve range maps",
    "fusion": "merge range maps into one cloud",
    "points": "select seed points for other programs",
    "export": "write files to the output folder",
    "evaluate": "compare with ground truth",
}
"""What the stages of a kind do, in the order of a workflow."""


def stage_page() -> str:
    """Return the page of all stages, by kind in the order of a workflow."""
    kinds: dict[str, list[StageSpec]] = defaultdict(list)
    for name, spec in sorted(shipped().stages.items()):
        kinds[name.partition(".")[0]].append(spec)
    order = [kind for kind in KINDS if kind in kinds] + sorted(kinds.keys() - KINDS.keys())
    rows = [
        (kind, ", ".join(f"[`{spec.name}`](#{_anchor(spec.name)})" for spec in kinds[kind]), KINDS.get(kind, ""))
        for kind in order
    ]
    parts = [_INTRODUCTION, table(("kind", "stages", ""), rows), _COMMON, _policy()]
    for kind in order:
        about = f"{KINDS[kind][0].upper()}{KINDS[kind][1:]}." if kind in KINDS else ""
        parts += [f"## {kind}", about, *map(_stage, kinds[kind])]
    return "\n\n".join(parts) + "\n"


def schema_text() -> str:
    """Return the JSON Schema of workflow files, as `pano-mvs schema` writes it."""
    return json.dumps(workflow_schema(shipped()), indent=1, ensure_ascii=False)


def shipped() -> Registry:
    """Return our own stages and those of bundled plugins, whatever others are installed where the site is built."""
    registry = Registry()
    for entry in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda entry: entry.value):
        if is_bundled(entry):
            registry.add_module(entry.load(), entry.name)
    return registry


def _anchor(name: str) -> str:
    return name.replace(".", "-")


_INTRODUCTION = """# Stages

This page is generated from the stages; `pano-mvs stage show NAME` prints the same text for one stage.
[Workflows](../workflows.md) describes how stages are combined, and [Plugins](../plugins.md) how to write one. The same
information is available as a [JSON Schema](pano-mvs.schema.json) for editors."""

_COMMON = """## What every stage takes

Every stage accepts these keys in addition to its own settings. They are not part of the cache key."""


def _policy() -> str:
    properties = Policy.model_json_schema(by_alias=True)["properties"]
    fields = Policy.model_fields.items()
    rows = [
        (f"`{info.alias or name}`", _default(info), cell(info.description or ""))
        for name, info in fields
        if (info.alias or name) in properties
    ]
    return table(("key", "default", ""), rows)


def _stage(spec: StageSpec) -> str:
    reads = [f"- `{port.name}` {_port(port)}" for port in spec.all_ports] or ["- files named in its settings"]
    parts = [
        f"### {spec.name} {{ #{_anchor(spec.name)} }}",
        docstring(spec.doc),
        '<div class="ports" markdown>\n',
        "Reads\n",
        "\n".join(reads),
        f"\nReturns {_kind(spec.output.kind_name())}, version {spec.version}{_memory(spec)}.\n\n</div>",
        _settings(spec),
        " ".join(sentence for sentence in (presets_that_use(spec.name), pages_about(spec.name)) if sentence),
    ]
    return "\n\n".join(part for part in parts if part)


def _port(port: Port) -> str:
    return f"`{port.cardinality}` {_kind(port.kind.kind_name())}{', optional' if port.optional else ''}"


def _kind(name: str) -> str:
    return f"[{name}](api.md#{name.lower()})" if name in api.__all__ else f"`{name}`"


def _memory(spec: StageSpec) -> str:
    if spec.memory_needed is not None:
        return "; estimates the memory of each unit"
    return f"; a unit needs up to {spec.memory_bytes / 1e9:.1f} GB" if spec.memory_bytes else ""


def _settings(spec: StageSpec) -> str:
    """Return the table of a stage's settings."""
    if not spec.params_type.model_fields:
        return "No settings of its own."
    schema = spec.params_type.model_json_schema(by_alias=True)
    rows = []
    for name, info in spec.params_type.model_fields.items():
        field = schema["properties"][info.alias or name]
        kind = type_of(field, schema)
        about = cell(info.description or "") + _part_in_key(info, kind)
        rows.append((f"`{info.alias or name}`", kind, _default(info), limits_of(field), about))
    return f'<div class="settings" markdown>\n\n{table(("setting", "type", "default", "limits", ""), rows)}\n\n</div>'


def _part_in_key(info: FieldInfo, kind: str) -> str:
    """Return what is special about how a setting counts towards the cache."""
    if kind.startswith("path"):
        return " (counts by content, whatever its name)"
    return " (does not count towards the cache)" if NOT_IN_KEY in info.metadata else ""


def _default(info: FieldInfo) -> str:
    if info.is_required():
        return "required"
    value = info.get_default(call_default_factory=True)
    if value is None or value == "":
        return "–"
    return f"`{json.dumps(value, default=str, ensure_ascii=False)}`".replace('"', "")
