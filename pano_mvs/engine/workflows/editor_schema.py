"""The JSON Schema (2020-12) of workflow files, for completion and checks in editors."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any
from urllib.parse import quote

from pano_mvs.core.yaml_text import Located
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import StageSpec
from pano_mvs.engine.workflows.policy import RESERVED_KEYS, Policy
from pano_mvs.engine.workflows.workflow_file import FORMAT_VERSION

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_LIST = [{"type": "array", "items": {"type": "string"}}, {"type": "null"}]
_NAME = {"type": "string", "pattern": "^[^\\s/\\\\.:-][^\\s/\\\\:]*$"}

Schema = dict[str, Any]


def workflow_schema(
    registry: Registry, inherited: Mapping[str, Located] | None = None, groups: Collection[str] = ()
) -> Schema:
    """Return the schema of workflow files, which is also that of the files of groups.

    Args:
        inherited: the stages of the workflows that a file extends and of its groups. Their entries in the file may omit
            `use`, and get the settings of the stage that they use.
        groups: the groups of the workflows that a file extends.
    """
    specs = dict(sorted(registry.stages.items()))
    known = {name: _inherited(specs, str(node.value["use"].value)) for name, node in (inherited or {}).items()}
    own = Policy.model_json_schema(by_alias=True)
    keys = {
        f"key.{name}": {"description": value.pop("description", ""), "anyOf": [value, {"type": "null"}]}
        for name, value in _without_titles(own["properties"]).items()
        if name != "use"
    }
    return {
        "$schema": DIALECT,
        "title": "pano_mvs workflow",
        "type": "object",
        "required": ["pano_mvs"],
        "additionalProperties": False,
        "properties": _top(known | dict.fromkeys(groups, _ref("override"))),
        "if": {"anyOf": [{"required": ["extends"]}, _has_shared_group()]},
        "then": {"properties": {"stages": {"additionalProperties": _ref("override")}}},
        "else": {
            "required": ["stages"],
            "properties": {"stages": {"minProperties": 1, "additionalProperties": _ref("stage or group")}},
        },
        "$defs": {
            "stage": _entry(specs),
            "group": _group(known),
            "stage or group": {"if": _is_group(), "then": _ref("group"), "else": _ref("stage")},
            "override": {
                "anyOf": [
                    {"type": "null"},
                    {"if": _is_group(), "then": _ref("group"), "else": _override(specs)},
                ]
            },
            **{f"use.{name}": _settings(spec) for name, spec in specs.items()},
            **keys,
            **own.get("$defs", {}),
        },
    }


def _top(known: Schema) -> Schema:
    return {
        "pano_mvs": {"const": FORMAT_VERSION, "description": "version of the workflow format"},
        "name": _NAME | {"description": "name of the output folder; by default that of the file"},
        "description": {"type": "string"},
        "extends": {
            "description": "a preset or a file, or a list of them, whose stages this file inherits and overrides",
            "anyOf": [{"type": "string", "minLength": 1}, *_LIST],
        },
        "plugins": {
            "description": "Python files with plugins, relative to this file",
            "anyOf": _LIST,
        },
        "stages": {
            "type": "object",
            "description": "the stages by name, in order, and groups of stages",
            "properties": known,
            "propertyNames": _NAME,
        },
    }


def _is_group() -> Schema:
    """Return what an entry is that describes a group: an override of a stage may have a setting `group`, a number."""
    named = {"required": ["group"], "properties": {"group": {"type": ["string", "null"]}}}
    return {"type": "object", "not": {"required": ["use"]}, "anyOf": [named, {"required": ["stages"]}]}


def _has_shared_group() -> Schema:
    """Return the schema of a file with a group from another file, whose stages its other entries may override."""
    no_file = {"additionalProperties": {"not": {"type": "object", "required": ["group"]}}}
    return {"properties": {"stages": {"type": "object", "not": no_file}}, "required": ["stages"]}


def _group(known: Schema) -> Schema:
    """Return the schema of a group: its own stages, or changes of those of its file."""
    stages = {"type": ["object", "null"], "description": "the stages of the group", "propertyNames": _NAME}
    return {
        "type": "object",
        "description": "a group of stages",
        "additionalProperties": False,
        "properties": {
            "group": {
                "type": "string",
                "minLength": 1,
                "description": "a file with the stages of the group, or a shipped group",
            },
            "description": {"type": "string", "description": "what the group does, in a line"},
            "stages": stages | {"properties": known, "additionalProperties": _ref("override")},
        },
    }


def _entry(specs: Mapping[str, StageSpec]) -> Schema:
    """Return the schema of a complete stage entry."""
    return {
        "type": "object",
        "required": ["use"],
        **_use_of_entry(specs),
        "allOf": [_when(name, _ref(f"use.{name}") | {"required": _required(spec)}) for name, spec in specs.items()],
    }


def _override(specs: Mapping[str, StageSpec]) -> Schema:
    """Return the schema of an entry that may override an inherited one: no key is required, not even `use`."""
    return {
        "type": "object",
        **_use_of_entry(specs),
        "properties": _reserved(),
        "allOf": [_when(name, _ref(f"use.{name}")) for name in specs],
    }


def _inherited(specs: Mapping[str, StageSpec], use: str) -> Schema:
    """Return the schema of an entry that overrides a known stage: its settings, unless `use` is another one."""
    if use not in specs:
        return _ref("override")
    same = {"properties": {"use": {"const": use}}}
    return {
        "if": {"type": "object", **same},
        "then": _ref(f"use.{use}"),
        "else": _ref("override"),
    }


def _when(use: str, then: Schema) -> Schema:
    return {"if": {"required": ["use"], "properties": {"use": {"const": use}}}, "then": then}


def _use_of_entry(specs: Mapping[str, StageSpec]) -> Schema:
    """Return which stage an entry may use: one that is registered, or any, with any settings, if it is optional."""
    registered = _use(specs)
    return {
        "if": {"required": ["optional"], "properties": {"optional": {"const": True}}},
        "then": {"properties": {"use": {"description": "the stage", "anyOf": [registered, {"type": "string"}]}}},
        "else": {"properties": {"use": registered}},
    }


def _use(specs: Mapping[str, StageSpec]) -> Schema:
    return {
        "description": "the stage",
        "enum": list(specs),
        "markdownEnumDescriptions": [_first_line(spec) for spec in specs.values()],  # VS Code shows them
    }


def _settings(spec: StageSpec) -> Schema:
    """Return the schema of all keys of an entry that uses a stage."""
    own = spec.params_type.model_json_schema(
        by_alias=True, ref_template=f"{_pointer(f'use.{spec.name}')}/$defs/{{model}}"
    )
    ports = {port.name: {"type": "string", "description": str(port)} for port in spec.all_ports}
    schema: Schema = {
        "type": "object",
        "title": spec.name,
        "description": spec.doc,
        "additionalProperties": False,
        "properties": {
            "use": {"const": spec.name, "description": _first_line(spec)},
            **_without_titles(own.get("properties", {})),
            **_reserved(),
            "in": {
                "description": "port to the stage of this workflow that feeds it, if there are several candidates",
                "anyOf": [{"type": "object", "additionalProperties": False, "properties": ports}, {"type": "null"}],
            },
        },
    }
    return schema | ({"$defs": own["$defs"]} if "$defs" in own else {})


def _required(spec: StageSpec) -> list[str]:
    fields = spec.params_type.model_fields.items()
    return [info.alias or name for name, info in fields if info.is_required()]


def _reserved() -> Schema:
    """Return references to the schemas of the reserved keys."""
    return {name: _ref(f"key.{name}") for name in RESERVED_KEYS if name != "use"}


def _ref(name: str) -> Schema:
    return {"$ref": _pointer(name)}


def _pointer(name: str) -> str:
    """Return the URI fragment of a definition, escaped by RFC 6901."""
    return f"#/$defs/{quote(name.replace('~', '~0').replace('/', '~1'))}"


def _without_titles(properties: Schema) -> Schema:
    """Remove the titles that pydantic adds; editors would show them in place of the names."""
    return {name: {key: part for key, part in value.items() if key != "title"} for name, value in properties.items()}


def _first_line(spec: StageSpec) -> str:
    return spec.doc.partition("\n")[0]
