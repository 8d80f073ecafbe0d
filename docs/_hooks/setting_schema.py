"""Describe the type and the limits of a setting, from its JSON Schema."""

from __future__ import annotations

from typing import Any

Schema = dict[str, Any]
_LIMITS = {"minimum": "≥ {}", "exclusiveMinimum": "> {}", "maximum": "≤ {}", "exclusiveMaximum": "< {}"}
_NAMES = {"number": "number", "integer": "integer", "boolean": "true or false", "string": "text"}


def type_of(field: Schema, root: Schema) -> str:
    """Return the type of a setting, or its choices.

    Args:
        field: the schema of the setting.
        root: the schema of all settings, with the definitions that a field may refer to.
    """
    if "enum" in field:
        return " · ".join(f"`{choice}`" for choice in field["enum"])
    if "anyOf" in field:
        options = [option for option in field["anyOf"] if option.get("type") != "null"]
        return " or ".join(dict.fromkeys(type_of(option, root) for option in options))
    if "$ref" in field:
        return type_of(root["$defs"][field["$ref"].rpartition("/")[2]], root)
    if "const" in field:
        return f"`{field['const']}`"
    if field.get("type") == "array":
        return _list_of(field, root)
    if field.get("type") == "object":
        return _mapping(field, root)
    return "path" if field.get("format") in ("path", "file-path") else _NAMES.get(field.get("type", ""), "any")


def limits_of(field: Schema) -> str:
    """Return within what a number must be, or what a text must look like."""
    found = [text.format(f"{field[key]:g}") for key, text in _LIMITS.items() if key in field]
    if "pattern" in field:
        found.append(f"`{field['pattern']}`".replace("|", "\\|"))
    for option in field.get("anyOf", ()):
        if (inner := limits_of(option)) and inner not in found:
            found.append(inner)
    return ", ".join(found)


def _list_of(field: Schema, root: Schema) -> str:
    if "prefixItems" in field:
        return f"{len(field['prefixItems'])} × {type_of(field['prefixItems'][0], root)}"
    return f"list of {type_of(field.get('items', {}), root)}"


def _mapping(field: Schema, root: Schema) -> str:
    if "properties" in field:
        return "`{" + ", ".join(field["properties"]) + "}`"
    return f"mapping to {type_of(field.get('additionalProperties') or {}, root)}"
