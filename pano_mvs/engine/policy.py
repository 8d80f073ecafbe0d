"""The reserved keys of a stage entry, beside the stage's own settings."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from pano_mvs.engine.memory import bytes_from_size


class Policy(BaseModel):
    """The reserved keys of a stage entry: how it is wired and what happens when units fail.

    Attributes:
        use: name of the stage.
        inputs: `in:`, port to the name of the stage in this workflow that feeds it.
        on_error: `skip` lists a failed unit and goes on, `stop` ends the run.
        retries: further tries of a failed unit.
        min_success: share of units that must succeed, else the run stops (exit code 4).
        gate: metric to the least value with which the run goes on (exit code 4).
        timeout_s: seconds after which a unit is ended and counts as failed; 0 for no limit.
        memory: what one unit needs, such as `2GB`; no more units run at a time than the host has free memory for.
        to: folder under the output folder into which the stage's files go.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    use: str
    inputs: dict[str, str] = Field(default={}, alias="in")
    on_error: Literal["skip", "stop"] = "skip"
    retries: int = Field(default=0, ge=0, le=100)
    min_success: float = Field(default=0.0, ge=0, le=1)
    gate: dict[str, float] = {}
    timeout_s: float = Field(default=0.0, ge=0)
    memory: str | int = 0
    to: str = ""

    @property
    def memory_bytes(self) -> int:
        """What one unit needs; 0 if the workflow does not say."""
        return bytes_from_size(self.memory)

    @field_validator("memory")
    @classmethod
    def _is_size(cls, memory: str | int) -> str | int:
        bytes_from_size(memory)
        return memory

    @field_validator("to")
    @classmethod
    def _inside(cls, to: str) -> str:
        path = PurePosixPath(to)
        if path.is_absolute() or ".." in path.parts or "\\" in to or ":" in to:
            raise ValueError("must be a folder inside the output folder")
        return to


RESERVED_KEYS = tuple(info.alias or name for name, info in Policy.model_fields.items())
