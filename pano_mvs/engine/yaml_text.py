"""Read YAML 1.2 into plain values that remember the line and column they were written at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from pano_mvs.core.errors import WorkflowError

MAX_DEPTH = 40
MAX_VALUES = 100_000
_MAX_DIGITS = 400


@dataclass(frozen=True, slots=True)
class Located:
    """A YAML value and where it stands.

    Attributes:
        value: a scalar, a dict of str to Located, or a list of Located.
        line: 1-based line of the value.
        column: 1-based column of the value.
        key_line: 1-based line of its key, if it is an entry of a mapping.
        key_column: likewise.
        origin: what to show instead of the file and the place, for values from the command line.
    """

    value: Any
    line: int
    column: int
    key_line: int = 0
    key_column: int = 0
    origin: str = ""

    def plain(self) -> Any:
        """Return the value without its places."""
        if isinstance(self.value, dict):
            return {key: item.plain() for key, item in self.value.items()}
        if isinstance(self.value, list):
            return [item.plain() for item in self.value]
        return self.value

    def at(self, path: tuple[Any, ...]) -> Located:
        """Return what stands at a path of keys and positions, or the nearest thing above it."""
        here = self
        for step in path:
            try:
                inner = here.value[step]
            except (KeyError, IndexError, TypeError):
                break
            here = inner if isinstance(inner, Located) else here
        return here


def parse_yaml(text: str, name: str) -> Located:
    """Return the one document of a YAML 1.2 text.

    Args:
        text: the YAML.
        name: what to call the text in messages, such as its path.

    Raises:
        WorkflowError: for every mistake that can be seen, as `name:line:column: message`.
    """
    try:
        root = YAML(typ="safe", pure=True).compose(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}:{mark.column + 1}" if mark else name
        raise WorkflowError([f"{place}: {error.problem or error.context or 'not valid YAML'}"]) from None
    except YAMLError as error:
        raise WorkflowError([f"{name}: not valid YAML: {str(error).splitlines()[0]}"]) from None
    except RecursionError:
        raise WorkflowError([f"{name}: nested too deeply; {MAX_DEPTH} levels are allowed"]) from None
    if root is None:
        raise WorkflowError([f"{name}:1:1: the file is empty"])
    builder = _Builder(name)
    located = builder.build(root, 0)
    if builder.problems:
        raise WorkflowError(builder.problems)
    return located


class _Builder:
    """Turn ruamel's nodes into located values, collecting every problem on the way."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.problems: list[str] = []
        self.count = 0

    def build(self, node: Node, depth: int) -> Located:
        line, column = node.start_mark.line + 1, node.start_mark.column + 1
        self.count += 1
        if depth > MAX_DEPTH or self.count > MAX_VALUES:
            limit = f"{MAX_DEPTH} levels" if depth > MAX_DEPTH else f"{MAX_VALUES} values"
            raise WorkflowError([*self.problems, f"{self.name}:{line}:{column}: too large; {limit} are allowed"])
        if isinstance(node, MappingNode):
            return Located(self._mapping(node, depth), line, column)
        if isinstance(node, SequenceNode):
            return Located([self.build(item, depth + 1) for item in node.value], line, column)
        assert isinstance(node, ScalarNode)
        return Located(self._scalar(node, line, column), line, column)

    def _mapping(self, node: MappingNode, depth: int) -> dict[str, Located]:
        entries: dict[str, Located] = {}
        for key_node, value_node in node.value:
            line, column = key_node.start_mark.line + 1, key_node.start_mark.column + 1
            if not isinstance(key_node, ScalarNode):
                self._problem(line, column, "a key must be a plain word")
                continue
            key = str(key_node.value)
            if key in entries:
                self._problem(line, column, f"key {key!r} is given twice (first in line {entries[key].key_line})")
                continue
            value = self.build(value_node, depth + 1)
            entries[key] = Located(value.value, value.line, value.column, line, column)
        return entries

    def _scalar(self, node: ScalarNode, line: int, column: int) -> Any:
        text = str(node.value)
        tag = str(node.tag).removeprefix("tag:yaml.org,2002:")
        try:
            match tag:
                case "str":
                    return text
                case "null":
                    return None
                case "bool":
                    return text.lower() == "true"
                case "int" if len(text) <= _MAX_DIGITS:
                    return int(text.replace("_", ""), 0) if text[:2] in ("0x", "0o") else int(text.replace("_", ""))
                case "float" if len(text) <= _MAX_DIGITS:
                    return float(text.replace("_", "").replace(".inf", "inf").replace(".nan", "nan"))
        except ValueError:
            pass
        if tag in ("int", "float"):
            self._problem(line, column, f"{text[:40]!r} is not a number that can be used")
        else:
            self._problem(line, column, f"tag {str(node.tag)!r} is not allowed; write a plain value")
        return None

    def _problem(self, line: int, column: int, message: str) -> None:
        self.problems.append(f"{self.name}:{line}:{column}: {message}")
