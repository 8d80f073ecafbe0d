"""Load workflow files with what is set for a run, and validate their settings, reporting all errors at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import PluginError, UsageError, WorkflowError
from pano_mvs.core.file_names import is_plain_name
from pano_mvs.core.paths import children, exists, is_denied, is_file, resolved
from pano_mvs.core.yaml_text import Located, Problems, did_you_mean, parse_yaml, report_invalid
from pano_mvs.engine.stages.params import Params, files_of
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
        added = apply_overrides(entries, overrides, self.problems, images=images)
        for file in files:
            self._load_plugins(file.root.value.get("plugins"))
        for item in added:
            self._load_plugin(item)
        if not entries and not self.problems.lines:
            self.problems.add(files[-1].root.place, "no stage is left")
        stages = {name: entry for name, node in entries.items() if (entry := self._stage(name, node)) is not None}
        if self.problems.lines:
            written = {name for file in files for name, node in file.stages.items() if node.value is not None}
            raise InvalidWorkflowError(self.problems.lines, stages, frozenset({*written, *entries} - set(stages)))
        root = files[-1].root
        name = root.value["name"].plain() if "name" in root.value else _name_of(self.shown_as)
        shown = ([f"images.path={images}"] if images else []) + list(overrides)
        below = (f"\n---\n# extended: {file.shown_as}\n{file.text}" for file in files[:-1])
        return Workflow(name, path, "".join([files[-1].text, *below]), stages, tuple(shown), self.plugins)

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

    def _folder(self, item: Located) -> Path:
        """Return the folder that a relative path starts from: that of its file, or the current one for overrides."""
        return resolved(Path()) if item.origin else self.folders.get(item.file, self.base)

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
            value = override.value
            items = value.value if isinstance(value.value, list) else [value]
            plugins.extend(Located(item.value, 0, 0, origin=value.origin) for item in items)
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
