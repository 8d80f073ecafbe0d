"""Load workflow files with what is set for a run, and validate their settings, reporting all errors at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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
from pano_mvs.engine.workflows.policy import RESERVED_KEYS, Policy
from pano_mvs.engine.workflows.workflow_file import ExtendsReader, WorkflowFile, merge_stages, read_text


@dataclass(frozen=True, slots=True)
class StageEntry:
    """One stage of a workflow, validated."""

    name: str
    spec: StageSpec
    params: Params
    policy: Policy
    place: str  # `file:line:column` of its name
    places: dict[str, str] = field(default_factory=dict)  # port or setting to `file:line:column`


@dataclass(frozen=True, slots=True)
class Workflow:
    """A validated workflow."""

    name: str  # for the output folder and the report
    path: Path | None
    text: str  # the YAML, followed by that of the files that it extends
    stages: dict[str, StageEntry]  # in the order of the file
    overrides: tuple[str, ...] = ()  # the `--set` and `--images` options that were applied
    # its plugin files, with the digests of their code
    plugins: Mapping[Path, str] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()  # why optional stages are missing
    files: tuple[Path, ...] = ()  # its file, and those that it extends

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
) -> Workflow:
    """Read and validate a workflow file.

    Args:
        path: the YAML file; relative paths in it start from its folder.
        registry: the known stages; the plugin files of the workflow are added to it.

    Raises:
        InputError: if the file cannot be read.
        WorkflowError: with every error and its location.
    """
    reader = WorkflowReader(str(path), path.parent, registry, presets=presets)
    return reader.read(read_text(path), overrides=overrides, images=images, path=path)


class InvalidWorkflowError(WorkflowError):
    """A workflow with errors."""

    def __init__(self, problems: list[str], stages: dict[str, StageEntry], unknown: frozenset[str]) -> None:
        self.stages = stages  # its entries whose stage exists, so that their connections can be checked
        self.unknown = unknown  # names of the other entries
        super().__init__(problems)


class WorkflowReader:
    """Turns YAML into a workflow and collects errors."""

    def __init__(self, shown_as: str, base: Path, registry: Registry, *, presets: Path | None = None) -> None:
        self.shown_as = shown_as
        self.base = base
        self.registry = registry
        self.presets = presets
        self.problems = Problems()
        self.plugins: dict[Path, str] = {}
        self._lacks_plugins = False
        self.folders: dict[str, Path] = {}

    def read(
        self, text: str, *, overrides: Sequence[str] = (), images: Path | None = None, path: Path | None = None
    ) -> Workflow:
        """Return the workflow, or raise WorkflowError with every error."""
        files = self._read_files(text, path)
        entries = merge_stages(files, self.problems)
        for file in files:
            self._load_plugins(file.root.value.get("plugins"))
        applying = _Overrides(entries, self.problems, self._load_plugin, self._params_of)
        applying.apply(overrides, images=images)
        if not entries and not self.problems.lines:
            self.problems.add(files[-1].root.place, "no stage is left")
        left_out = self._leave_out(entries)
        stages = {name: entry for name, node in entries.items() if (entry := self._stage(name, node)) is not None}
        if self.problems.lines:
            written = {name for file in files for name, node in file.stages.items() if node.value is not None}
            raise InvalidWorkflowError(self.problems.lines, stages, frozenset({*written, *entries} - set(stages)))
        root = files[-1].root
        name = root.value["name"].plain() if "name" in root.value else _name_of(self.shown_as)
        shown = ([f"images.path={images}"] if images else []) + list(overrides)
        below = (f"\n---\n# extended: {file.shown_as}\n{file.text}" for file in files[:-1])
        text = "".join([files[-1].text, *below])
        paths = () if path is None else (*(Path(file.shown_as) for file in files[:-1]), path)
        return Workflow(name, path, text, stages, tuple(shown), self.plugins, left_out, paths)

    def inherited(self, text: str, path: Path) -> dict[str, Located]:
        """Return the stages that a file inherits, and load the plugins of all its files.

        Errors are ignored, as this serves editors while the file is being written.

        Raises:
            WorkflowError: if the text is not YAML.
        """
        parse_yaml(text, self.shown_as)  # without a list of problems, it raises the first one
        files = self._read_files(text, path)
        for file in files:
            self._load_plugins(file.root.value.get("plugins"))
        return merge_stages(files[:-1], self.problems)

    def _read_files(self, text: str, path: Path | None) -> list[WorkflowFile]:
        reader = ExtendsReader(self.problems, self.presets)
        reader.read(text, self.shown_as, self.base, chain=(resolved(path),) if path is not None else ())
        self.folders = {file.shown_as: file.base for file in reader.files}
        return reader.files

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

    def _stage(self, name: str, node: Located) -> StageEntry | None:
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
        policy = self._validate(Policy, {key: values[key] for key in values if key in RESERVED_KEYS}, node, name=name)
        own = {key: value for key, value in values.items() if key not in RESERVED_KEYS}
        params = self._validate(spec.params_type, own, node, name=name)
        self._check_files(params or self._valid_part(spec.params_type, own, node), node, name)
        places = {key: item.place for key, item in node.value.items()}
        wiring = node.value.get("in")
        if wiring is not None and isinstance(wiring.value, dict):
            places.update({f"in.{port}": item.place for port, item in wiring.value.items()})
        # Continue after errors in settings, so that the connections are checked too.
        return StageEntry(name, spec, params or Params(), policy or Policy(use=spec.name), node.key_place, places)

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
            del stages[stage]
        else:
            problems.add(f"--set {override.text[:80]}", f"{_SYNTAX}; {stage}=null removes the stage")
        return True

    def _set(self, override: _Override) -> None:
        place, stage = f"--set {override.text[:80]}", _stage_of(override.target, self.stages)
        if not stage:
            wanted = override.target.partition(".")[0]
            self.problems.add(place, f"no stage {wanted[:80]!r}.{did_you_mean(wanted, self.stages)}")
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
