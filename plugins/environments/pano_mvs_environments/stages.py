"""The stages of plugins with environments of their own, as the index describes them; nothing of them is imported."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from pano_mvs.core.errors import PluginError
from pano_mvs.core.paths import exists
from pano_mvs.engine.stages.registry import Plugin, PluginProblem, ProvidedPlugin
from pano_mvs.engine.stages.stage import Cardinality, Port, StageSpec
from pano_mvs.scene import Record
from pano_mvs_environments.index import MARK, Environment, environments
from pano_mvs_environments.interpreter import ask


def provided() -> Iterator[ProvidedPlugin]:
    """Yield the plugins of this installation with environments of their own; none in such an environment itself."""
    if exists(Path(sys.prefix, MARK)):
        return
    for environment in environments():
        problem = environment.problem()
        names = tuple(("stage", described["name"]) for described in environment.stages)
        plugin = Plugin(
            environment.origin,
            names,
            str(problem) if problem else "",
            environment=environment.folder,
            check=partial(examined, environment),
        )
        stages = () if problem is not None else tuple(_spec(environment, described) for described in environment.stages)
        yield ProvidedPlugin(plugin, stages)


def examined(environment: Environment) -> PluginProblem | None:
    """Return why the stages of an environment cannot be computed, after trying to load them; None if they can."""
    if (problem := environment.problem()) is not None:
        return problem
    question = {"do": "describe", "distribution": environment.name, "mode": environment.mode}
    try:
        found = ask(environment.python, question, folder=Path(environment.folder), libraries=environment.libraries)
    except PluginError as error:
        return PluginProblem(f"its environment does not start: {error}", environment.remedy)
    if "problem" in found:
        return PluginProblem(found["problem"], environment.remedy)
    if found["stages"] != list(environment.stages):
        return PluginProblem("its code is not the one that was installed", environment.remedy)
    return None


def _spec(environment: Environment, described: Mapping[str, Any]) -> StageSpec:
    from pano_mvs_environments.remote import EnvironmentStage
    from pano_mvs_environments.settings import model_from

    remote = EnvironmentStage(environment, described)
    settings = described["settings"]
    return StageSpec(
        name=described["name"],
        version=described["version"],
        function=_function(environment, described),
        ports=tuple(
            Port(name, _kind(kind), Cardinality(cardinality), optional)
            for name, kind, cardinality, optional in described["ports"]
        ),
        params_type=model_from(settings, remote.check if settings["asks"] else None),
        output=_kind(described["output"]),
        list_items=remote.list_items if described["is_source"] else None,
        origin=described["origin"],
        extras=described["extras"],
        memory_bytes=described["memory_bytes"],
        every_image=described["every_image"],
        remote=remote,
    )


def _function(environment: Environment, described: Mapping[str, Any]) -> Callable[..., Record]:
    """Return what stands for the function of a stage, with its name and its text."""

    def not_here(**_inputs: Any) -> Record:
        raise PluginError(f"{described['name']} can be called in {environment.folder} only")

    not_here.__name__ = described["name"].rpartition(".")[2]
    not_here.__doc__ = described["doc"]
    not_here.__module__ = described["module"]
    return not_here


def _kind(place: str) -> type[Record]:
    module, _, name = place.partition(":")
    found: type[Record] = getattr(import_module(module), name)
    return found


@dataclass(frozen=True, slots=True)
class PluginEnvironment:
    """The environment of a plugin.

    Attributes:
        name: of the plugin.
        version: of the plugin.
        mode: "overlay" or "isolated".
        folder: of the environment.
        source: path or requirement that it was installed from.
        python_version: of its interpreter.
        stages: names of the stages of the plugin.
        problem: why it cannot be used, and what to do; empty if it can.
    """

    name: str
    version: str
    mode: str
    folder: Path
    source: str
    python_version: str
    stages: tuple[str, ...]
    problem: str


def plugin_environments(*, check: bool = False) -> list[PluginEnvironment]:
    """Return the environments of plugins of this installation.

    Args:
        check: whether to import each plugin in its environment, which takes seconds; otherwise only missing files and
            other versions are noticed.

    Raises:
        PluginError: if their index cannot be read.
    """
    return [
        PluginEnvironment(
            one.name,
            one.version,
            one.mode,
            Path(one.folder),
            one.source,
            one.python_version,
            tuple(described["name"] for described in one.stages),
            str(problem) if (problem := examined(one) if check else one.problem()) else "",
        )
        for one in environments()
    ]
