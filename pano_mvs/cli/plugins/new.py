"""Write a new plugin: a working file of some kind, and its test; or a package with an environment of its own."""

from __future__ import annotations

import keyword
import re
import sys
from collections.abc import Collection
from dataclasses import dataclass
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path
from shlex import quote
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.console import Console
from pano_mvs.core.errors import UsageError
from pano_mvs.core.files import write_given
from pano_mvs.core.paths import exists
from pano_mvs.core.plugin_folders import PLUGINS_VARIABLE

_NAME = re.compile(r"[a-z][a-z0-9_]*")


@dataclass(frozen=True, slots=True)
class PluginKind:
    """A kind of plugin."""

    prefix: str  # of the stage's name; empty for what is not a stage
    what: str
    use: str  # how a workflow, or the command line, uses it, with `{name}` for its name
    # the function of `pano_mvs.testing.conformance` that returns its contract tests
    contract_tests: str = "stage_contract_tests"
    in_workflow: bool = True  # whether a workflow uses it; otherwise `use` is a command


KINDS = {
    "source": PluginKind("source", "where panoramas come from", "images: {{use: source.{name}, path: photos}}"),
    "mask": PluginKind("mask", "which pixels every later stage ignores", "masked: {{use: mask.{name}}}"),
    "features": PluginKind("features", "key points as bearings", "features: {{use: features.{name}}}"),
    "pairs": PluginKind("pairs", "which images are matched", "pairs: {{use: pairs.{name}}}"),
    "matches": PluginKind("matches", "matches between key points", "matches: {{use: matches.{name}}}"),
    "poses": PluginKind("poses", "poses of the cameras", "poses: {{use: poses.{name}}}"),
    "views": PluginKind("views", "the sources of each reference", "views: {{use: views.{name}}}"),
    "depth": PluginKind("depth", "the range of every pixel", "depth: {{use: depth.{name}}}"),
    "sweep_cost": PluginKind(
        "",
        "matching cost of depth.sweep",
        "depth: {{use: depth.sweep, backend: numpy, cost: {name}}}",
        "cost_contract_tests",
    ),
    "sweep_backend": PluginKind(
        "",
        "implementation of depth.sweep",
        "depth: {{use: depth.sweep, backend: {name}, cost: sad}}",
        "backend_contract_tests",
    ),
    "filter": PluginKind("filters", "turns a range map into another", "filtered: {{use: filters.{name}}}"),
    "fusion": PluginKind("fusion", "merges range maps into a cloud", "cloud: {{use: fusion.{name}}}"),
    "export": PluginKind("export", "files for other programs", "written: {{use: export.{name}}}"),
    "command": PluginKind(
        "", "a command", "pano-mvs {name} out/quickstart", "command_contract_tests", in_workflow=False
    ),
    "executor": PluginKind(
        "",
        "when and where units are computed",
        "pano-mvs run quickstart --executor {name}",
        "executor_contract_tests",
        in_workflow=False,
    ),
    "observer": PluginKind(
        "",
        "receives the events of a run",
        "pano-mvs run quickstart --{name} runs.txt",
        "observer_contract_tests",
        in_workflow=False,
    ),
    "capture_reader": PluginKind(
        "",
        "another kind of capture",
        "pano-mvs run quickstart --images photos.txt",
        "reader_contract_tests",
        in_workflow=False,
    ),
    "pose_reader": PluginKind(
        "",
        "poses of another program",
        "pano-mvs run known_poses --images photos --set poses.path=poses.txt",
        "reader_contract_tests",
        in_workflow=False,
    ),
}
EXAMPLES = {
    "pose_reader": "# {name}: image, x east, y north, z up, heading clockwise from north\n"
    "a.jpg, 1.5, 2.0, 1.7, 90\nb.jpg, 2.5, 2.0, 1.7, 135.5\n"
}
"""A file that the plugin of a kind reads, with `{name}` for its name."""


ENVIRONMENTS = ("overlay", "isolated")
"""The kinds of environments of its own that a plugin may ask for."""


def rendered(kind: str, name: str) -> tuple[str, str]:
    """Return the text of a new plugin and that of its test."""
    plugin, test = _rendered(kind, name, f"{kind}.py", "test.py")
    return plugin, test


def rendered_package(kind: str, name: str, environment: str) -> dict[str, str]:
    """Return the files of a new plugin with an environment of its own: paths in its folder to their texts."""
    if environment not in ENVIRONMENTS:
        raise UsageError(f"--environment {environment}: must be {' or '.join(ENVIRONMENTS)}")
    if kind in KINDS and not KINDS[kind].prefix:
        stages = ", ".join(name for name, one in KINDS.items() if one.prefix)
        raise UsageError(f"a plugin with an environment of its own brings stages: {stages}, but no {kind}")
    plugin, test, project = _rendered(kind, name, f"{kind}.py", "test.py", "pyproject.toml", environment=environment)
    return {f"{name}/__init__.py": plugin, f"test_{name}.py": test, "pyproject.toml": project}


def _rendered(kind: str, name: str, *templates: str, environment: str = "") -> list[str]:
    """Return the texts of some templates for a new plugin."""
    if kind not in KINDS:
        raise UsageError(f"unknown kind of plugin {kind!r}; known kinds: {', '.join(KINDS)}")
    if not _NAME.fullmatch(name) or keyword.iskeyword(name):
        raise UsageError(
            f"a plugin cannot be called {name!r}: use lower-case letters, digits and '_', starting with a letter"
        )
    if name in sys.stdlib_module_names or name in _installed():
        raise UsageError(f"a plugin cannot be called {name!r}: its file would hide the Python package with that name")
    texts = Environment(
        loader=PackageLoader("pano_mvs.cli.plugins", "templates"),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        autoescape=False,  # noqa: S701  # it writes Python, and the name is checked
    )
    title = "".join(word.capitalize() for word in name.split("_"))
    values = {
        "name": name,
        "title": title,
        "kind": kind,
        "contract_tests": KINDS[kind].contract_tests,
        "prefix": KINDS[kind].prefix,
        "example": EXAMPLES.get(kind, "").format(name=name),
        "environment": environment,
        "what": KINDS[kind].what.capitalize(),
    }
    return [texts.get_template(f"{template}.jinja").render(values) for template in templates]


@cache  # takes a third of a second
def _installed() -> frozenset[str]:
    return frozenset(packages_distributions())


def write_plugin(kind: str, name: str, folder: Path, *, commands: Any, console: Console, environment: str = "") -> None:
    """Write a new plugin and its test into a folder, and print how to use it.

    Args:
        commands: the group of all built-in commands, as typer runs it.
        environment: that the plugin asks for, which is then a package in a folder of its own; empty for a file.
    """
    if environment:
        files = {f"{name}/{path}": text for path, text in rendered_package(kind, name, environment).items()}
    else:
        files = dict(zip((f"{name}.py", f"test_{name}.py"), rendered(kind, name), strict=True))
    if (full := f"{KINDS[kind].prefix}.{name}".removeprefix(".")) in _taken(kind, commands):
        what = "observer or option" if kind == "observer" else kind.replace("_", " ")
        raise UsageError(f"{full} exists already as another {what}; nothing was written. Choose another name")
    for path in [folder / name, *(folder / path for path in files)] if environment else map(folder.joinpath, files):
        if exists(path):
            raise UsageError(f"{path} already exists; nothing was written. Choose another name or another --dir")
    for written, text in files.items():
        write_given(folder / written, text, f"--dir {folder}")
    paths = [folder / path for path in files]
    use = KINDS[kind].use.format(name=name)
    if environment:
        console.say(f"wrote the package {escape(str(folder / name))} and its test")
        console.say("state what it needs in its pyproject.toml, install it, and use it in a workflow:")
        console.say(f"  pano-mvs plugin install {escape(quote(str(folder / name)))}")
        console.print(f"  stages:\n    {use}", highlight=False, markup=False)
    elif KINDS[kind].in_workflow:
        console.say(f"wrote {escape(str(paths[0]))} and its test")
        console.print("use it in a workflow:", highlight=False)
        console.print(f"  plugins: [{name}.py]\n  stages:\n    {use}", highlight=False, markup=False)
    else:
        console.say(f"wrote {escape(str(paths[0]))} and its test")
        console.say(f"use it: put {name}.py into a folder that ${PLUGINS_VARIABLE} names, and run")
        console.print(f"  {use}", highlight=False, markup=False, soft_wrap=True)
    console.say(f"test it: pytest {escape(str(paths[1]))}")


def _taken(kind: str, built_in: Any) -> Collection[str]:
    """Return the names that a new plugin of a kind cannot have, because what has them is built in or installed."""
    from pano_mvs.cli.commands import COMMANDS, options_of_runs
    from pano_mvs.engine.executors.choose import EXECUTORS
    from pano_mvs.engine.stages.registry import Registry
    from pano_mvs.io.readers import CAPTURE_READERS, POSE_READERS

    registry = Registry.installed()  # with the plugins in the user's folders
    match kind:
        case "command":
            return {*built_in.commands, *COMMANDS.names()}
        case "executor":
            return EXECUTORS.names()
        case "observer":
            options = {text.lstrip("-") for option in built_in.commands["run"].params for text in option.opts}
            return {*options, *options_of_runs()}
        case "capture_reader":
            return CAPTURE_READERS.names()
        case "pose_reader":
            return POSE_READERS.names()
        case _:
            return {*registry.stages}


def show_kinds(console: Console) -> None:
    """List the kinds of plugins."""
    table = Table("kind", "purpose", "use, in a workflow or as a command")
    for name, kind in KINDS.items():
        table.add_row(name, kind.what, escape(kind.use.format(name="mine")))
    console.print(table)
