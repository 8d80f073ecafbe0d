"""A workflow file: parsed, its settings validated, every mistake found at once."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pano_mvs.core.errors import InputError, PluginError, UsageError, WorkflowError
from pano_mvs.engine.code_digest import code_digest
from pano_mvs.engine.params import Params, files_of
from pano_mvs.engine.policy import RESERVED_KEYS, Policy
from pano_mvs.engine.registry import Registry
from pano_mvs.engine.stage import StageSpec
from pano_mvs.engine.yaml_text import Located, parse_yaml

FORMAT_VERSION = 1
_TOP_KEYS = ("pano_mvs", "name", "description", "plugins", "stages")


@dataclass(frozen=True, slots=True)
class StageEntry:
    """One stage of a workflow, validated.

    Attributes:
        name: its name in this workflow.
        spec: the stage it uses.
        params: its settings.
        policy: wiring and error handling.
        place: `file:line:column` of its name.
        places: port or setting to `file:line:column`.
    """

    name: str
    spec: StageSpec
    params: Params
    policy: Policy
    place: str
    places: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Workflow:
    """A validated workflow.

    Attributes:
        name: for the output folder and the report.
        path: the file, or None.
        text: the YAML as written.
        stages: in the order of the file.
        overrides: the `--set` and `--images` that were applied.
        plugins: the plugin files that it names, with the digests of their code.
    """

    name: str
    path: Path | None
    text: str
    stages: dict[str, StageEntry]
    overrides: tuple[str, ...] = ()
    plugins: Mapping[Path, str] = field(default_factory=dict)


def load_workflow(
    path: Path, registry: Registry, *, overrides: Sequence[str] = (), images: Path | None = None
) -> Workflow:
    """Read and validate a workflow file.

    Args:
        path: the YAML file; relative paths in it are relative to its folder.
        registry: the stages there are; the plugin files that the workflow names are added to it.
        overrides: `STAGE.PARAM=VALUE`, the value in YAML.
        images: a folder for the stage called `images` to read instead of its own.

    Raises:
        InputError: if the file cannot be read.
        WorkflowError: with every mistake found, each with its place.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"workflow {path} cannot be read: {error}") from error
    return WorkflowReader(str(path), path.parent, registry).read(text, overrides=overrides, images=images, path=path)


class PartialWorkflowError(WorkflowError):
    """A workflow with mistakes; `stages` are its entries where all could be named, for the wiring to be checked too."""

    def __init__(self, problems: list[str], stages: dict[str, StageEntry]) -> None:
        self.stages = stages
        super().__init__(problems)


class WorkflowReader:
    """Turns YAML into a workflow, collecting problems."""

    def __init__(self, shown_as: str, base: Path, registry: Registry) -> None:
        self.shown_as = shown_as
        self.base = base
        self.registry = registry
        self.problems: list[str] = []
        self.plugins: dict[Path, str] = {}

    def read(
        self, text: str, *, overrides: Sequence[str] = (), images: Path | None = None, path: Path | None = None
    ) -> Workflow:
        """Return the workflow, or raise WorkflowError with every mistake."""
        root = parse_yaml(text, self.shown_as)
        if not isinstance(root.value, dict):
            raise WorkflowError([f"{self._place(root)}: a workflow is a mapping with the keys {', '.join(_TOP_KEYS)}"])
        self._check_top(root)
        self._load_plugins(root.value.get("plugins"))
        entries = self._stage_nodes(root)
        self._apply(entries, overrides, images)
        stages = {name: entry for name, node in entries.items() if (entry := self._stage(name, node)) is not None}
        if self.problems:
            raise PartialWorkflowError(self.problems, stages if len(stages) == len(entries) else {})
        name = root.value["name"].plain() if "name" in root.value else Path(self.shown_as).stem
        shown = ([f"images.path={images}"] if images else []) + list(overrides)
        return Workflow(str(name), path, text, stages, tuple(shown), self.plugins)

    def _check_top(self, root: Located) -> None:
        for key, node in root.value.items():
            if key not in _TOP_KEYS:
                self._problem(node, f"unknown key {key!r}.{_did_you_mean(key, _TOP_KEYS)}", at_key=True)
        version = root.value.get("pano_mvs")
        if version is None:
            self._problem(root, f"the key `pano_mvs: {FORMAT_VERSION}` is missing (the version of the workflow format)")
        elif version.value != FORMAT_VERSION:
            self._problem(
                version, f"workflow format {version.plain()!r} is not known; this version reads {FORMAT_VERSION}"
            )
        if "name" in root.value and not _is_plain_name(root.value["name"].plain()):
            self._problem(root.value["name"], "name must be a word of letters, digits, '-', '_' and '.'")

    def _load_plugins(self, node: Located | None) -> None:
        if node is None or node.value is None:
            return
        if not isinstance(node.value, list):
            self._problem(node, "plugins must be a list of Python files")
            return
        for item in node.value:
            if not isinstance(item.value, str):
                self._problem(item, "a plugin is the path of a Python file")
                continue
            try:
                self.registry.add_file(self.base / item.value)
                self.plugins[self.base / item.value] = code_digest(self.base / item.value)
            except PluginError as error:
                self._problem(item, str(error))

    def _stage_nodes(self, root: Located) -> dict[str, Located]:
        node = root.value.get("stages")
        if node is None or not isinstance(node.value, dict) or not node.value:
            self._problem(node or root, "`stages:` must be a mapping of stage names to {use: …}")
            return {}
        entries: dict[str, Located] = {}
        for name, entry in node.value.items():
            if not _is_plain_name(name):
                self._problem(entry, f"stage name {name!r} must be a word of letters, digits, '-' and '_'", at_key=True)
            elif not isinstance(entry.value, dict) or "use" not in entry.value:
                self._problem(entry, f"stage {name!r} needs `use: NAME`", at_key=True)
            else:
                entries[name] = entry
        return entries

    def _apply(self, entries: dict[str, Located], overrides: Sequence[str], images: Path | None) -> None:
        if images is not None:
            if "images" not in entries:
                self.problems.append("--images: this workflow has no stage called 'images'; use --set STAGE.path=DIR")
            else:
                node = entries["images"]
                node.value["path"] = Located(
                    str(images.resolve()), node.line, node.column, node.key_line, node.key_column
                )
        for override in overrides:
            self._apply_override(entries, override)

    def _apply_override(self, entries: dict[str, Located], override: str) -> None:
        target, equals, text = override.partition("=")
        stage_name, dot, param = target.strip().partition(".")
        if not (equals and dot and param):
            self.problems.append(f"--set {override}: write STAGE.PARAM=VALUE")
        elif stage_name not in entries:
            self.problems.append(f"--set {override}: no stage {stage_name!r}.{_did_you_mean(stage_name, entries)}")
        else:
            try:
                value = parse_yaml(text, f"--set {target}") if text.strip() else Located(None, 1, 1)
            except WorkflowError as error:
                self.problems.extend(error.problems)
                return
            entries[stage_name].value[param] = Located(value.value, 0, 0, origin=f"--set {target.strip()}")

    def _stage(self, name: str, node: Located) -> StageEntry | None:
        use = node.value["use"]
        spec = self.registry.stages.get(use.value) if isinstance(use.value, str) else None
        if spec is None:
            self._problem(
                use, f"stage {name!r}: there is no stage {use.plain()!r}; {self.registry.suggest(str(use.value))}"
            )
            return None
        values = node.plain()
        policy = self._validate(Policy, {key: values[key] for key in values if key in RESERVED_KEYS}, node, name)
        own = {key: value for key, value in values.items() if key not in RESERVED_KEYS}
        params = self._validate(spec.params_type, own, node, name)
        if params is not None:
            self._check_files(params, node, name)
        places = {key: self._place(item) for key, item in node.value.items()}
        wiring = node.value.get("in")
        if wiring is not None and isinstance(wiring.value, dict):
            places.update({f"in.{port}": self._place(item) for port, item in wiring.value.items()})
        # Mistakes in settings do not keep the wiring from being checked, so that all are found in one go.
        return StageEntry(
            name, spec, params or Params(), policy or Policy(use=spec.name), self._key_place(node), places
        )

    def _check_files(self, params: Params, node: Located, name: str) -> None:
        for key, paths in files_of(params).items():
            for path in paths:
                if not path.exists():
                    self._problem(node.at((key,)), f"stage {name!r}: {key}: {path} does not exist")

    def _validate(self, model: type[Any], values: dict[str, Any], node: Located, name: str) -> Any:
        try:
            return model.model_validate(values, context={"base": self.base, "bases": self._bases(node)})
        except ValidationError as error:
            known = [info.alias or field_name for field_name, info in model.model_fields.items()]
            for problem in error.errors(include_url=False):
                self._report(problem, node, name, known)
            return None

    @staticmethod
    def _bases(node: Located) -> dict[str, Path]:
        """Return the settings from the command line: their paths are relative to where it was typed."""
        return {key: Path.cwd() for key, item in node.value.items() if item.origin}

    def _report(self, problem: Any, node: Located, name: str, known: list[str]) -> None:
        path = tuple(problem["loc"])
        found = node.at(path)
        key = ".".join(map(str, path))
        if problem["type"] == "extra_forbidden":
            options = [*known, *(key for key in RESERVED_KEYS if key not in known)]
            self._problem(found, f"stage {name!r}: unknown setting {key!r}.{_did_you_mean(key, options)}", at_key=True)
        elif problem["type"] == "missing":
            self._problem(node, f"stage {name!r}: setting {key!r} is missing", at_key=True)
        else:
            message = problem["msg"].removeprefix("Value error, ")
            shown = json.dumps(problem["input"], default=str, ensure_ascii=False)[:80]
            setting = f"{key}: " if key else ""
            self._problem(found, f"stage {name!r}: {setting}{message} (got {shown})")

    def _place(self, node: Located) -> str:
        if node.origin:
            return node.origin
        return f"{self.shown_as}:{node.line}:{node.column}"

    def _key_place(self, node: Located) -> str:
        return f"{self.shown_as}:{node.key_line}:{node.key_column}" if node.key_line else self._place(node)

    def _problem(self, node: Located, message: str, *, at_key: bool = False) -> None:
        self.problems.append(f"{self._key_place(node) if at_key else self._place(node)}: {message}")


def _is_plain_name(name: object) -> bool:
    return isinstance(name, str) and bool(name) and name[0] not in ".-" and all(c.isalnum() or c in "-_." for c in name)


def _did_you_mean(word: str, options: Sequence[str] | dict[str, Any]) -> str:
    close = get_close_matches(word, list(options), n=2, cutoff=0.5)
    if close:
        return f" Did you mean {' or '.join(map(repr, close))}?"
    return f" Known: {', '.join(options)}" if options else ""


def find_workflow(name: str, presets: Path) -> tuple[Path, bool]:
    """Return the file of a workflow given as a path or as a preset's name, and whether it is a preset.

    Raises:
        UsageError: if there is neither.
    """
    path = Path(name)
    if path.is_file():
        return path, False
    preset = presets / f"{name}.yaml"
    if _is_plain_name(name) and preset.is_file():
        return preset, True
    names = sorted(file.stem for file in presets.glob("*.yaml"))
    raise UsageError(f"there is no workflow file {name!r} and no preset of that name.{_did_you_mean(name, names)}")
