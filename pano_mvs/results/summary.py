"""The summary of a run, which is the content of run.json."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from pano_mvs.core.errors import InputError
from pano_mvs.core.file_names import file_inside
from pano_mvs.core.files import replacing
from pano_mvs.results.records import (
    BlockedUnit,
    CloudSummary,
    Entry,
    FailedUnit,
    ImageReason,
    MergedSummary,
    Number,
    PosesSummary,
    ScoresSummary,
    StageOutcome,
    UnitCounts,
    Verdict,
    ViewSummary,
    WorkflowSummary,
)

RUN_JSON = "run.json"
BLOCKS = "blocks"  # folder in the output folder in which `pano-mvs run --block-size` computes the blocks
CACHE_VARIABLE = "PANO_MVS_CACHE"
SCHEMA = 1

FAILED_ITEMS, INTERRUPTED = 3, 130
"""Exit codes of a run with failed or doubtful items, and of one that was interrupted."""


class RunSummary(Entry):
    """What a run did and what it found; immutable. `to_json` and `from_json` convert to and from run.json.

    >>> summary = RunSummary.from_json({"workflow": {"name": "fast"}, "exit_code": 3, "failures": [{"stage": "depth"}]})
    >>> summary.workflow.name, summary.ok, summary.failures[0].stage
    ('fast', False, 'depth')
    >>> RunSummary.from_json(summary.to_json()) == summary
    True
    """

    # of run.json, where it is called `schema`; fields may be added to a version, none changes
    schema_version: int = Field(default=SCHEMA, alias="schema")
    workflow: WorkflowSummary = WorkflowSummary()  # what ran
    cache: str = ""  # folder of the cache; empty if it is not known
    version: str = ""  # of pano_mvs
    started: str = ""  # date and time, ISO 8601 in UTC
    machine: Mapping[str, Number | str] = {}  # processor, number of cores and memory
    executor: Mapping[str, Number | str] = {}  # its name, number of workers, and threads of each
    seconds: float | None = None  # that the run took; None if it is not known
    # 0 finished; 1 internal error; 2 unusable workflow or input; 3 finished with failed or doubtful items; 4 stopped by
    # a quality threshold or a safety check; 130 interrupted
    exit_code: int = 0
    stopped: str = ""  # why the run ended early; empty if it did not
    units: UnitCounts = UnitCounts()  # number of units, by outcome
    stages: tuple[StageOutcome, ...] = ()  # those that began, in the order of the workflow
    failures: tuple[FailedUnit, ...] = ()  # units that failed
    blocked: tuple[BlockedUnit, ...] = ()  # units that could not run because others failed
    rejected: Mapping[str, ImageReason] = {}  # image that a stage left out to the reason
    doubts: Mapping[str, ImageReason] = {}  # image that a stage finds doubtful to the reason
    warnings: tuple[str, ...] = ()  # such as damaged files in the cache that were computed again
    notes: tuple[str, ...] = ()  # of the stages
    # role (`images`, `pairs`, `poses`, `ranges`, `cloud`, `static`) to the stage that made the final values
    results: Mapping[str, str] = {}
    poses: PosesSummary = PosesSummary()  # the cameras
    scores: ScoresSummary = ScoresSummary()  # of the first stage that compares with the ground truth
    all_scores: Mapping[str, ScoresSummary] = {}  # scores by stage, if several branches were compared
    views: tuple[ViewSummary, ...] = ()  # the final range maps
    cloud: CloudSummary = CloudSummary()  # the fused cloud
    workflow_text: str = ""  # the workflow as it was read
    versions: Mapping[str, str] = {}  # library to version
    files: Mapping[str, str] = {}  # file in the output folder to its digest
    left_over: Mapping[str, str] = {}  # existing files of earlier runs that this run did not write, with their digests
    verdict: Verdict | None = None  # whether the result is reliable; None if the run ended before it could be judged
    merged: MergedSummary | None = None  # the blocks, if the folder holds merged runs and not a run
    inputs: Mapping[str, str] = {}  # file that a source read to its digest

    @staticmethod
    def from_json(value: object) -> RunSummary:
        """Return the summary from the value of `to_json`; missing or null fields have their defaults.

        Raises:
            InputError: if it is not the content of a run.json.
        """
        try:
            return RunSummary.model_validate(value)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            place = ".".join(map(str, first["loc"])) or "the whole file"
            raise InputError(f"{place}: {first['msg']}") from error

    @staticmethod
    def read(out: Path) -> RunSummary:
        """Return the summary of the latest run into an output folder.

        Raises:
            InputError: if the folder has no run.json that can be read.
        """
        path = out / RUN_JSON
        try:
            value = json.loads(path.read_bytes())
        except OSError as error:
            raise InputError(f"{path} cannot be read ({error.strerror}). Give the output folder of a run") from error
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path} is not a valid run.json ({error}). Run the workflow again") from error
        if not isinstance(value, Mapping) or not isinstance(value.get("stages"), list):
            raise InputError(f"{path} is not a run.json. Run the workflow again")
        if isinstance(schema := value.get("schema"), int) and schema > SCHEMA:
            raise InputError(
                f"{path} was written by a newer version of pano_mvs (schema {schema}; this one reads up to {SCHEMA}). "
                "Update pano_mvs, or run the workflow again"
            )
        try:
            return RunSummary.from_json(value)
        except InputError as error:
            raise InputError(f"{path} is not a valid run.json ({error}). Run the workflow again") from error

    def to_json(self) -> dict[str, Any]:
        """Return the content of run.json, as values that `json.dumps` takes."""
        return self.model_dump(by_alias=True)

    def write(self, out: Path) -> None:
        """Write run.json into an output folder.

        Raises:
            StoreError: if it cannot be written.
        """
        encoder = json.JSONEncoder(indent=1, allow_nan=False)
        with replacing(out / RUN_JSON) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as stream:
            stream.writelines(encoder.iterencode(self.to_json()))
            stream.write("\n")

    @property
    def ok(self) -> bool:
        """Whether the run finished without failed or doubtful items."""
        return self.exit_code == 0

    @property
    def scores_by_stage(self) -> Mapping[str, ScoresSummary]:
        """The scores of each branch, by the stage that computed them."""
        return self.all_scores or ({"scores": self.scores} if self.scores else {})

    @property
    def doubtful_images(self) -> Mapping[str, str]:
        """Doubtful image to the reason: those of the final poses first, then what other stages found."""
        others = {name: doubt.reason for name, doubt in self.doubts.items()}
        return {**self.poses.doubts, **{name: why for name, why in others.items() if name not in self.poses.doubts}}

    @property
    def source_folder(self) -> Path | None:
        """Folder from which the run, or the blocks that were merged, read the images, if it is one folder."""
        if self.merged is not None:
            return Path(self.merged.images) if self.merged.images else None
        paths = [stage.params.get("path") for stage in self.stages if stage.use.startswith("source.")]
        return next((Path(str(path)) for path in paths if path), None)

    def source_file(self, name: str, images: Path | None = None) -> Path | None:
        """Return the file of an image in a folder, by default the `source_folder`; None if it is not there."""
        folder = images or self.source_folder
        return file_inside(folder, name, through_links=True) if folder is not None else None


def cache_of(summary: RunSummary, given: Path | None = None) -> Path:
    """Return the cache that is given, else $PANO_MVS_CACHE, else the one that the run used."""
    return given or Path(os.environ.get(CACHE_VARIABLE) or summary.cache or ".pano-mvs")
