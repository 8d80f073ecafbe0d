"""Compute the units of a stage in workers of its environment, whatever executor has received them.

A worker of the environment gets the same request as any worker, reads its inputs from the cache and stores the result
there. Who asks it is a worker of the run, or the main process of a serial one; it ends with that process.
"""

from __future__ import annotations

import threading
import uuid
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from pano_mvs.api import Params, SourceItem, is_only_planned
from pano_mvs.core import errors
from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import PanoMvsError, PluginError
from pano_mvs.core.files import make_folder, temporary_prefix, write_text
from pano_mvs.core.paths import exists, reason_of
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.processes import WorkerProcess
from pano_mvs.engine.executors.protocol import Job, JobOutcome
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.executors.unit_requests import request_to_json
from pano_mvs.engine.stages.params import json_settings
from pano_mvs.engine.stages.stage import RemoteStage, StageCode
from pano_mvs.engine.stages.stage_code import PackageCode, code_of_package, module_version
from pano_mvs_environments.index import Environment
from pano_mvs_environments.interpreter import OPTIONS, ask, variables

_CHECKED = "checked"  # folder in an environment with an empty file for each settings that its process has accepted


class EnvironmentStage(RemoteStage):
    """A stage of a plugin with an environment of its own."""

    def __init__(self, environment: Environment, described: Mapping[str, Any]) -> None:
        """Prepare.

        Args:
            described: what `inside` says of the stage.
        """
        self._environment = environment
        self._described = described

    def code(self) -> StageCode:
        """Return the code of the plugin when it was installed, with the present one of pano_mvs."""
        return self._code

    @cached_property
    def _code(self) -> StageCode:
        found = self._described["code"]
        return code_of_package(PackageCode(found["files"], tuple(found["outer"])), self._version_of)

    def _version_of(self, module: str) -> str:
        found = self._environment.libraries.get(module)
        if found is None:
            return module_version(module) if self._environment.mode == "overlay" else "not installed"
        return found

    def outcome(self, unit: Any, store: Store, *, threads: int, log: Path) -> JobOutcome:
        """Compute a unit in a worker of the environment."""
        job = Job(0, unit, threads, 0.0, log)
        try:
            request = request_to_json(job, store)
        except errors.StoreError as error:
            return JobOutcome("stopped", cause=str(error), error="StoreError", exit_code=error.exit_code)
        return _workers(self._environment.folder).run(request, store, self._environment)

    def close(self) -> None:
        """End the workers of the environment."""
        _workers(self._environment.folder).close()

    def check(self, params: Params) -> None:
        """Ask the process of the plugin whether settings can be used; it is asked once only.

        Raises:
            ValidationError: if they cannot.
            PluginError: if it gives no answer.
        """
        settings = json_settings(params, Path.absolute)
        name = digest_from_value([self._described["name"], self._environment.digest, settings])
        accepted = Path(self._environment.folder, _CHECKED, name)
        if exists(accepted):
            return
        if problems := self._ask("check", settings=settings)["problems"]:
            details = [
                InitErrorDetails(
                    type=PydanticCustomError(problem["type"], "{text}", {"text": problem["msg"]}),
                    loc=tuple(problem["loc"]),
                    input=_at(settings, problem["loc"]),
                )
                for problem in problems
            ]
            raise ValidationError.from_exception_data(type(params).__name__, details)
        try:
            write_text(accepted, "")
        except errors.StoreError:
            return  # it is asked again next time

    def list_items(self, params: Params) -> list[SourceItem]:
        """Return the items that the source lists."""
        answer = self._ask("list", settings=json_settings(params, Path.absolute), is_only_planned=is_only_planned.get())
        if "problem" in answer:
            if answer["class"]:
                raise getattr(errors, answer["class"], PanoMvsError)(answer["problem"])
            raise PluginError(f"source {self._described['name']} cannot list its items: {answer['problem']}")
        return [
            SourceItem(
                item["name"],
                {role: Path(path) for role, path in item["files"].items()},
                item["problem"],
                tuple(item["notes"]),
                tuple(item["links"]),
            )
            for item in answer["items"]
        ]

    def _ask(self, action: str, **more: Any) -> dict[str, Any]:
        there = self._environment
        question = {"do": action, "stage": self._described["name"], **more}
        try:
            answer = ask(there.python, question, folder=Path(there.folder), libraries=there.libraries)
        except PluginError as error:
            raise PluginError(_unusable(there, str(error))) from error
        if "broken" in answer:
            raise PluginError(_unusable(there, answer["broken"]))
        return answer


def _at(settings: Any, place: list[str | int]) -> Any:
    """Return the value at a place in settings; None if there is none."""
    for step in place:
        try:
            settings = settings[step]
        except (KeyError, IndexError, TypeError):
            return None
    return settings


class _Workers:
    """The workers of an environment that compute units for this process: as many as it asks at a time."""

    def __init__(self) -> None:
        self._idle: list[WorkerProcess] = []
        self._lock = threading.Lock()

    def run(self, request: Mapping[str, Any], store: Store, environment: Environment) -> JobOutcome:
        with self._lock:
            worker = self._idle.pop() if self._idle else _new_worker(store, environment)
        try:
            make_folder(worker.errors.parent)
            outcome = worker.run(request)
        except OSError as error:
            return JobOutcome("failed", cause=_unusable(environment, reason_of(error)), exit_code=2)
        except BaseException:  # such as an interrupt of a serial run
            worker.kill()
            worker.stop()
            raise
        if worker.refused:
            worker.stop()
            return JobOutcome("failed", cause=_unusable(environment, outcome.cause), exit_code=2)
        with self._lock:
            self._idle.append(worker)
        if outcome.status == "stopped" and outcome.error == "UsageError":  # the stage there is not the one in the index
            return JobOutcome("failed", cause=_unusable(environment, outcome.cause), exit_code=2)
        return outcome

    def close(self) -> None:
        with self._lock:
            idle, self._idle = self._idle, []
        for worker in idle:
            worker.stop()


_by_folder: dict[str, _Workers] = {}


def _workers(folder: str) -> _Workers:
    """Return the workers of the environment in a folder."""
    return _by_folder.setdefault(folder, _Workers())


def _new_worker(store: Store, environment: Environment) -> WorkerProcess:
    return WorkerProcess(
        available_threads(),
        store.blobs.temporary / f"{temporary_prefix()}worker-{uuid.uuid4().hex}.txt",
        python=(environment.python, *OPTIONS),
        variables=variables(Path(environment.folder), environment.libraries),
    )


def _unusable(environment: Environment, why: str) -> str:
    return f"the environment of the plugin {environment.origin} cannot be used: {why}. To go on, {environment.remedy}"
