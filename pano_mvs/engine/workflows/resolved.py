"""A workflow as one YAML file with every setting, as `pano-mvs show --resolved` prints it."""

from __future__ import annotations

from io import StringIO
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.representer import RoundTripRepresenter

from pano_mvs.core.paths import resolved
from pano_mvs.engine.stages.params import json_settings
from pano_mvs.engine.workflows.wiring import Graph
from pano_mvs.engine.workflows.workflow import StageEntry, Workflow
from pano_mvs.engine.workflows.workflow_file import FORMAT_VERSION

_FIRST_KEYS = ("use", "in")


def resolved_yaml(workflow: Workflow, graph: Graph) -> str:
    """Return a workflow as YAML that depends on no other file, and whose units have the same cache keys.

    All settings of each stage have values, paths are absolute, and `in:` names what feeds each port. Other reserved
    keys, such as `gate`, are included where they differ from their defaults.
    """
    root: dict[str, Any] = {"pano_mvs": FORMAT_VERSION, "name": workflow.name}
    if workflow.plugins:
        root["plugins"] = [str(resolved(path)) for path in workflow.plugins]
    root["stages"] = {name: _entry(entry, graph) for name, entry in workflow.stages.items()}
    stream = StringIO()
    yaml = YAML()
    yaml.width = 1000  # no line breaks inside values
    yaml.indent(mapping=2, sequence=4, offset=2)
    yaml.Representer = _Representer
    yaml.dump(_commented(root), stream)
    return stream.getvalue()


def _entry(entry: StageEntry, graph: Graph) -> dict[str, Any]:
    """Return one stage: its keys and settings in the order in which they are usually written."""
    ports = {port: edge.producer for port, edge in graph.edges[entry.name].items()}
    policy = entry.policy.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    found: dict[str, Any] = {"use": entry.spec.name} | ({"in": ports} if ports else {})
    found |= json_settings(entry.params, resolved)
    found |= {key: value for key, value in policy.items() if key not in _FIRST_KEYS}
    return found


def _commented(value: Any) -> Any:
    """Return a value whose mappings keep their order when they are written."""
    if isinstance(value, dict):
        return CommentedMap({key: _commented(inner) for key, inner in value.items()})
    return [_commented(inner) for inner in value] if isinstance(value, list | tuple) else value


class _Representer(RoundTripRepresenter):
    """Writes None as `null` rather than as nothing."""

    def represent_none(self, _data: None) -> Any:
        return self.represent_scalar("tag:yaml.org,2002:null", "null")


_Representer.add_representer(type(None), _Representer.represent_none)
