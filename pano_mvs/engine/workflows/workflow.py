"""Load workflow files with what is set for a run, and validate their settings, reporting all errors at once."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import PluginError, UsageError, WorkflowError
from pano_mvs.core.file_names import is_plain_name
from pano_mvs.core.paths import children, exists, is_denied, is_file, resolved
from pano_mvs.core.yaml_text import Located, Problems, did_you_mean, parse_yaml, report_invalid
from pano_mvs.engine.stages.params import Params, files_of, takes_path
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import StageSpec
from pano_mvs.engine.stages.stage_code import code_digest
from pano_mvs.engine.workflows.merged_stages import MergedStages, Removed, StageGroup
from pano_mvs.engine.workflows.policy import RESERVED_KEYS, Policy
from pano_mvs.engine.workflows.workflow_file import WorkflowFile, WorkflowFilesReader, read_text

_MOST_VALUES = 8  # of a setting that are tried before a hint at `pano-mvs vary`


@dataclass(frozen=True, slots=True)
class StageEntry:
    """One stage of a workflow, validated."""

    name: str
    spec: StageSpec
    params: Params
    policy: Policy
    place: str  # `file:line:column` of its name
    places: dict[str, str] = field(default_factory=dict)  # port or setting to `file:line:column`
    group: str = ""  # the group of stages that it belongs to; empty if it is in none


@dataclass(frozen=True, slots=True)
class RemovedStage:
    """A stage that a workflow has no more, or a group of stages."""

    how: str  # such as "was removed with the group 'masks' (--set masks)"
    spec: StageSpec | None = None  # None for a group, or if no plugin offers the stage


@dataclass(frozen=True, slots=True)
class Workflow:
    """A validated workflow."""

    name: str  # for the output folder and the report
    path: Path | None
    text: str  # the YAML, followed by that of the files that it extends and of the groups
    stages: dict[str, StageEntry]  # in the order of the file
    overrides: tuple[str, ...] = ()  # the `--set` and `--images` options that were applied
    # its plugin files, with the digests of their code
    plugins: Mapping[Path, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # such as why optional stages are missing
    files: tuple[Path, ...] = ()  # its file, those that it extends, and those of groups
    groups: Mapping[str, StageGroup] = field(default_factory=dict)  # by name, in order; a stage may be in none
    removed: Mapping[str, RemovedStage] = field(default_factory=dict)  # stages and groups, by name

    @property
    def id(self) -> str:
        """Digest under which the cache keys of its latest run are remembered: of its name and its stages' names."""
        return digest_from_value([self.name, list(self.stages)])


def load_workflow(
    path: Path,
    registry: Registry,
    *,
    overrides: Sequence[str] = (),
    images: Path | None = None,
    presets: Path | None = None,
    on_file: Callable[[Path], None] = lambda _: None,
) -> Workflow:
    """Read and validate a workflow file.

    Args:
        path: the YAML file; relative paths in it start from its folder.
        registry: the known stages; the plugin files of the workflow are added to it.
        on_file: called with each file of the workflow before it is read, and with those that are missing.

    Raises:
        InputError: if the file cannot be read.
        WorkflowError: with every error and its location.
    """
    on_file(path)
    reader = WorkflowReader(str(path), path.parent, registry, presets=presets, on_file=on_file)
    return reader.read(read_text(path), overrides=overrides, images=images, path=path)


class InvalidWorkflowError(WorkflowError):
    """A workflow with errors."""

    def __init__(self, problems: list[str], stages: dict[str, StageEntry], unknown: frozenset[str]) -> None:
        self.stages = stages  # its entries whose stage exists, so that their connections can be checked
        self.unknown = unknown  # names of the other entries
        super().__init__(problems)


class WorkflowReader:
    """Turns YAML into a workflow and collects errors."""

    def __init__(
        self,
        shown_as: str,
        base: Path,
        registry: Registry,
        *,
        presets: Path | None = None,
        on_file: Callable[[Path], None] = lambda _: None,
    ) -> None:
        self.shown_as = shown_as
        self.base = base
        self.registry = registry
        self.presets = presets
        self.on_file = on_file
        self.problems = Problems()
        self.plugins: dict[Path, str] = {}
        self._lacks_plugins = False
        self.folders: dict[str, Path] = {}

    def read(
        self, text: str, *, overrides: Sequence[str] = (), images: Path | None = None, path: Path | None = None
    ) -> Workflow:
        """Return the workflow, or raise WorkflowError with every error."""
        files, merged = self._read_files(text, path)
        rest = self._apply_to_groups(merged, overrides, files[-1])
        entries = merged.stages
        for file in (*merged.group_files, *files):
            self._load_plugins(file.root.value.get("plugins"))
        groups = merged.groups(list(entries))
        applying = _Overrides(entries, groups, merged.removed, self.problems, self._load_plugin, self._params_of)
        applying.apply(rest, images=images)
        if not entries and not self.problems.lines:
            self.problems.add(files[-1].root.place, "no stage is left")
        left_out = self._leave_out(entries)
        groups = merged.groups(list(entries))
        stages = {
            name: entry for name, node in entries.items() if (entry := self._stage(name, node, groups)) is not None
        }
        if self.problems.lines:
            self._hint_at_vary(text, overrides, path)
            unknown = frozenset({*merged.written, *entries} - set(stages))
            raise InvalidWorkflowError(self.problems.lines, stages, unknown)
        root = files[-1].root
        name = root.value["name"].plain() if "name" in root.value else _name_of(self.shown_as)
        shown = ([f"images.path={images}"] if images else []) + list(overrides)
        others = {file.shown_as: ("extended", file) for file in files[:-1]}
        others |= {file.shown_as: ("group", file) for file in merged.group_files if file.shown_as not in others}
        below = (f"\n---\n# {what}: {shown_as}\n{file.text}" for shown_as, (what, file) in others.items())
        text = "".join([files[-1].text, *below])
        paths = () if path is None else (*map(Path, others), path)
        warnings = (*merged.notes, *left_out)
        removed = {
            name: RemovedStage(one.how, self.registry.stages.get(one.use) if isinstance(one.use, str) else None)
            for name, one in merged.removed.items()
        }
        return Workflow(name, path, text, stages, tuple(shown), self.plugins, warnings, paths, groups, removed)

    def inherited(self, text: str, path: Path) -> tuple[dict[str, Located], frozenset[str]]:
        """Return the stages and the groups that a file has from other files, and load the plugins of all its files.

        Errors are ignored, as this serves editors while the file is being written.

        Raises:
            WorkflowError: if the text is not YAML.
        """
        parse_yaml(text, self.shown_as)  # without a list of problems, it raises the first one
        files, merged = self._read_files(text, path)
        for file in (*merged.group_files, *files):
            self._load_plugins(file.root.value.get("plugins"))
        below = MergedStages(merged.reader, self.problems)
        for file in files[:-1]:
            below.add(file)
        own = files[-1].shown_as
        from_groups = {name: node for name, node in merged.stages.items() if node.value["use"].file != own}
        return from_groups | below.stages, frozenset(below.groups(list(below.stages)))

    def _read_files(self, text: str, path: Path | None) -> tuple[list[WorkflowFile], MergedStages]:
        """Return a workflow after the files that it extends, and their stages."""
        reader = WorkflowFilesReader(self.problems, self.presets, self.on_file)
        reader.read(text, self.shown_as, self.base, chain=(resolved(path),) if path is not None else ())
        merged = MergedStages(reader, self.problems)
        for file in reader.files:
            merged.add(file)
        self.folders = {file.shown_as: file.base for file in (*reader.files, *merged.group_files)}
        return reader.files, merged

    def _apply_to_groups(self, merged: MergedStages, overrides: Sequence[str], file: WorkflowFile) -> list[str]:
        """Remove and replace groups by `GROUP=null` and `GROUP.group=FILE`, and return the other overrides."""
        rest: list[str] = []
        for text in overrides:
            target, equals, written = text.partition("=")
            name, _, key = target.strip().rpartition(".")
            groups = merged.groups(list(merged.stages))
            origin = f"--set {target.strip()}"
            if equals and target.strip() in groups and written.strip() in {"null", "~"}:
                entry = Located(None, 0, 0, origin=origin)
                merged.apply(file, {target.strip(): entry})
            elif equals and key == "group" and name in groups and written.strip() in {"", "null", "~"}:
                self.problems.add(
                    origin, f"give the file of a group, or the name of a shipped one; {name}=null removes it"
                )
            elif equals and key == "group" and name in groups and name not in merged.stages:
                value = Located(written.strip(), 0, 0, origin=origin)
                entry = Located({"group": value}, 0, 0, origin=origin)
                merged.apply(replace(file, inherits=file.inherits | {file.shown_as}), {name: entry})
            else:
                rest.append(text)
        self.folders |= {one.shown_as: one.base for one in merged.group_files}
        return rest

    def _hint_at_vary(self, text: str, overrides: Sequence[str], path: Path | None) -> None:
        """Add to the errors about several values of a setting which command takes these, if each is a valid one."""
        for override in overrides:
            target, _, written = (part.strip() for part in override.partition("="))
            refused, values = f"--set {target}:", [value.strip() for value in written.split(",")]
            lines = self.problems.lines
            if len(values) < 2 or not any(line.startswith(refused) for line in lines):
                continue
            others = [one for one in overrides if one.partition("=")[0].strip() != target and "," not in one]
            single = ([*others, f"{target}={value}"] for value in values[:_MOST_VALUES])
            if any(line.startswith(refused) for given in single for line in self._problems_with(text, given, path)):
                continue
            hint = f". `pano-mvs vary --set {shlex.quote(f'{target}={written}')}` runs with each of these values"
            lines[:] = [f"{line}{hint}" if line.startswith(refused) else line for line in lines]

    def _problems_with(self, text: str, overrides: Sequence[str], path: Path | None) -> list[str]:
        """Return the errors of the workflow with other settings."""
        reader = WorkflowReader(self.shown_as, self.base, self.registry, presets=self.presets)
        try:
            reader.read(text, overrides=overrides, path=path)
        except WorkflowError as error:
            return error.problems
        return []

    def _load_plugins(self, node: Located | None) -> None:
        if node is None or node.value is None:
            return
        if not isinstance(node.value, list):
            self.problems.add(node.place, "plugins must be a list of Python files")
            return
        for item in node.value:
            self._load_plugin(item)

    def _load_plugin(self, item: Located) -> None:
        if not isinstance(item.value, str):
            self.problems.add(item.place, "a plugin must be the path of a Python file")
            return
        path = self._folder(item) / item.value
        if path in self.plugins:
            return
        self.on_file(path)
        try:
            self.registry.add_file(path)
            self.plugins[path] = code_digest(path)
        except PluginError as error:
            self.problems.add(item.place, str(error))
            self._lacks_plugins = True

    def _params_of(self, node: Located) -> type[Params] | None:
        """Return the settings of a stage as a model; None if there is no such stage."""
        use = node.value["use"].value if "use" in node.value else None
        spec = self.registry.stages.get(use) if isinstance(use, str) else None
        return None if spec is None else spec.params_type

    def _folder(self, item: Located) -> Path:
        """Return the folder that a relative path starts from: that of its file, or the current one for overrides."""
        return resolved(Path()) if item.origin else self.folders.get(item.file, self.base)

    def _leave_out(self, entries: dict[str, Located]) -> tuple[str, ...]:
        """Remove optional stages that no plugin offers, and return why each is missing."""
        missing = {
            name: use
            for name, node in entries.items()
            if "optional" in node.value
            and node.value["optional"].value is True
            and isinstance(use := node.value["use"].value, str)
            and use not in self.registry.stages
        }
        for name in missing:
            del entries[name]
        return tuple(
            f"stage {name!r} is left out, because it is optional and no plugin offers {use}; `pano-mvs plugins` lists "
            "all plugins"
            for name, use in missing.items()
        )

    def _stage(self, name: str, node: Located, groups: Mapping[str, StageGroup]) -> StageEntry | None:
        use = node.value["use"]
        spec = self.registry.stages.get(use.value) if isinstance(use.value, str) else None
        if spec is None and self._lacks_plugins:
            return None  # it may be one of theirs
        if spec is None:
            shown = repr(use.plain())[:80]
            hint = self.registry.suggest(str(use.value)[:80])
            self.problems.add(use.place, f"stage {name!r}: there is no stage {shown}; {hint}")
            return None
        if missing := spec.missing:
            packages = " ".join(missing)
            message = f"{use.value} needs packages that are not installed: pip install {packages}"
            self.problems.add(use.place, f"stage {name!r}: {message}")
        values = node.plain()
        for key in {"group", "stages"} & values.keys() - spec.params_type.model_fields.keys():
            del values[key]
            shown = f"; groups of this workflow: {', '.join(groups)}" if groups else ""
            self.problems.add(node.value[key].key_place, f"{name!r} is a stage, and {key!r} is for groups{shown}")
        policy = self._validate(Policy, {key: values[key] for key in values if key in RESERVED_KEYS}, node, name=name)
        own = {key: value for key, value in values.items() if key not in RESERVED_KEYS}
        params = self._validate(spec.params_type, own, node, name=name)
        self._check_files(params or self._valid_part(spec.params_type, own, node), node, name)
        places = {key: item.place for key, item in node.value.items()}
        wiring = node.value.get("in")
        if wiring is not None and isinstance(wiring.value, dict):
            places.update({f"in.{port}": item.place for port, item in wiring.value.items()})
        group = next((one for one, found in groups.items() if name in found.stages), "")
        # Continue after errors in settings, so that the connections are checked too.
        policy = policy or Policy(use=spec.name)
        return StageEntry(name, spec, params or Params(), policy, node.key_place, places, group)

    def _valid_part(self, model: type[Params], values: dict[str, Any], node: Located) -> Params:
        """Return settings without those that are wrong, so that the files of the others are checked too."""
        context = {"base": self.base, "bases": self._bases(node)}
        try:
            return model.model_validate(values, context=context)
        except ValidationError as error:
            wrong = {problem["loc"][0] for problem in error.errors() if problem["loc"]}
        kept = {key: value for key, value in values.items() if key not in wrong}
        try:
            return model.model_validate(kept, context=context)
        except ValidationError:
            return Params()

    def _check_files(self, params: Params, node: Located, name: str) -> None:
        for key, paths in files_of(params).items():
            for path in paths:
                if not exists(path):
                    why = "cannot be examined (permission denied)" if is_denied(path) else "does not exist"
                    self.problems.add(node.at((key,)).place, f"stage {name!r}: {key}: {path} {why}")

    def _validate(self, model: type[Any], values: dict[str, Any], node: Located, *, name: str) -> Any:
        try:
            return model.model_validate(values, context={"base": self.base, "bases": self._bases(node)})
        except ValidationError as error:
            report_invalid(
                error, node, self.problems, model=model, also=tuple(RESERVED_KEYS), subject=f"stage {name!r}: "
            )
            return None

    def _bases(self, node: Located) -> dict[str, Path]:
        """Return the folder that the paths in each setting start from."""
        return {key: self._folder(item) for key, item in node.value.items()}


def _name_of(shown_as: str) -> str:
    """Return the name of a workflow that states none, from its file."""
    word = "".join(sign if sign.isalnum() or sign in "-_." else "_" for sign in Path(shown_as).stem)
    return word if is_plain_name(word) else "workflow"


def find_workflow(name: str, presets: Path) -> tuple[Path, bool]:
    """Return the file of a workflow given as a path or as the name of a preset, and whether it is a preset.

    Raises:
        UsageError: if there is no such file or preset.
    """
    path = Path(name)
    if is_file(path):
        return path, False
    preset = presets / f"{name}.yaml"
    if is_plain_name(name) and is_file(preset):
        return preset, True
    if exists(path) or is_denied(path):
        return path, False  # reading it reports the error
    names = [file.stem for file in children(presets, "*.yaml")]
    raise UsageError(f"there is no workflow file {name[:80]!r} and no preset of that name.{did_you_mean(name, names)}")


_SYNTAX = "write STAGE.PARAM=VALUE, such as depth.planes=192"


@dataclass(frozen=True, slots=True)
class _Override:
    text: str
    target: str
    written: str  # the value as it was given

    def as_text(self) -> Located:
        """Return the value as it was given."""
        return Located(self.written, 0, 0, origin=f"--set {self.target}")

    def parsed(self, problems: Problems) -> Located | None:
        """Return the value as YAML; None with problems if it is not YAML."""
        origin = f"--set {self.target}"
        if not self.written.strip():
            return Located(None, 0, 0, origin=origin)
        try:
            return Located(parse_yaml(self.written, origin).value, 0, 0, origin=origin)
        except WorkflowError as error:
            problems.lines.extend(error.problems)
            return None


@dataclass(frozen=True, slots=True)
class _Overrides:
    """Applies what is set for a run to the merged entries of the stages, in place."""

    stages: dict[str, Located]
    groups: Mapping[str, StageGroup]
    removed: dict[str, Removed]
    problems: Problems
    load_plugin: Callable[[Located], None]
    params_of: Callable[[Located], type[Params] | None]  # an entry to the model of its settings

    def apply(self, overrides: Sequence[str], *, images: Path | None = None) -> None:
        """Change the stages, and load further plugins.

        Overrides that add plugins, remove a stage or change its `use` are applied first, then the folder of images,
        then the others in the given order. So the settings of a new stage may precede its `use`.

        Args:
            overrides: `STAGE.PARAM=VALUE`, `STAGE.PARAM.KEY=VALUE`, `STAGE=null` or `plugins=FILE`, with values in
                YAML. A setting that is a path takes the text as it stands; without text, it is unset.
            images: folder that replaces the path of the stage `images`; None to keep it.
        """
        stages, problems = self.stages, self.problems
        rest = [override for text in overrides if (override := _read(text, problems)) and not self._restages(override)]
        if images is not None:
            if "images" in stages:
                _set(stages["images"], ("path",), Located(str(resolved(images)), 0, 0, origin=f"--images {images}"))
            else:
                problems.add("--images", "this workflow has no stage called 'images'; use --set STAGE.path=DIR")
        for override in rest:
            self._set(override)

    def _restages(self, override: _Override) -> bool:
        """Add plugins, remove a stage or change its `use`, and return whether the override does one of these."""
        stages, problems = self.stages, self.problems
        stage = _stage_of(override.target, stages)
        is_plugin, is_stage = override.target == "plugins", override.target == stage
        if not (is_plugin or is_stage or (stage and override.target.removeprefix(f"{stage}.") == "use")):
            return False
        is_file = is_plugin and not override.written.strip().startswith("[")
        value = override.as_text() if is_file else override.parsed(problems)
        if value is None:
            return True
        if is_plugin:
            for item in value.value if isinstance(value.value, list) else [value]:
                self.load_plugin(Located(item.value, 0, 0, origin=value.origin))
        elif not is_stage:
            _replace(stages, stage, value)
        elif value.value is None:
            self.removed[stage] = Removed(f"was removed (--set {stage})", stages[stage].value["use"].value)
            del stages[stage]
        else:
            problems.add(f"--set {override.text[:80]}", f"{_SYNTAX}; {stage}=null removes the stage")
        return True

    def _set(self, override: _Override) -> None:
        place, stage = f"--set {override.text[:80]}", _stage_of(override.target, self.stages)
        if not stage:
            wanted = override.target.partition(".")[0]
            if group := self.groups.get(wanted):
                stages = ", ".join(group.stages)
                self.problems.add(place, f"{wanted!r} is a group of stages; set a setting of one of them: {stages}")
                return
            names = [*self.stages, *self.groups]
            self.problems.add(place, f"no stage {wanted[:80]!r}.{did_you_mean(wanted, names)}")
            return
        steps = tuple(override.target[len(stage) + 1 :].split("."))
        if not all(steps):
            self.problems.add(place, _SYNTAX)
            return
        model = self.params_of(self.stages[stage])
        value: Located | None
        if override.written and model is not None and takes_path(model, steps[0], override.written):
            value = override.as_text()
        else:
            value = override.parsed(self.problems)
        if value is not None and (problem := _set(self.stages[stage], steps, value)):
            self.problems.add(place, problem)


def _read(text: str, problems: Problems) -> _Override | None:
    target, equals, written = text.partition("=")
    if target.endswith(" "):  # as in `images.path = photos`
        written = written.lstrip()
    target = target.strip()
    if not (equals and target) or (target != "plugins" and "." not in target and written.strip() not in {"null", "~"}):
        problems.add(f"--set {text[:80]}", _SYNTAX)
        return None
    return _Override(text, target, written)


def _stage_of(target: str, stages: dict[str, Located]) -> str:
    """Return the stage that a target begins with, the longest match as names may contain dots; empty if none."""
    found = [name for name in stages if target == name or target.startswith(f"{name}.")]
    return max(found, key=len, default="")


def _replace(stages: dict[str, Located], name: str, use: Located) -> None:
    """Change the `use` of a stage; this drops the settings of the old stage."""
    node = stages[name]
    kept = node.value if node.value["use"].value == use.value else {}
    stages[name] = Located(
        {**kept, "use": use}, node.line, node.column, node.key_line, node.key_column, node.origin, node.file
    )


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
