"""The reserved keys of a stage entry, beside the stage's own settings."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler, field_validator, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from pano_mvs.core.file_names import folder_problem
from pano_mvs.core.memory import bytes_from_size


class Limits(BaseModel):
    """Between what a metric must lie for the run to go on.

    Attributes:
        min: the least value, or None.
        max: the largest value, or None.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    min: float | None = Field(default=None, description="least value with which the run goes on")
    max: float | None = Field(default=None, description="largest value with which the run goes on")

    @model_validator(mode="before")
    @classmethod
    def _number_is_least(cls, value: Any) -> Any:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return {"min": value}
        if not isinstance(value, dict | Limits):
            raise ValueError("must be a number (the least value) or {min: …, max: …}")
        return value

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the schema of both forms: a number, and a mapping."""
        mapping = handler.resolve_ref_schema(handler(core)) | {"minProperties": 1}
        return {"anyOf": [{"type": "number"}, mapping]}

    @model_validator(mode="after")
    def _limits_something(self) -> Limits:
        if self.min is None and self.max is None:
            raise ValueError("say {min: …}, {max: …} or both; a plain number is the least value")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is larger than max {self.max:g}: nothing would pass")
        return self

    def objection(self, value: float) -> str:
        """Return what the gate asks for, if a value does not pass, else an empty text."""
        if self.min is not None and not value >= self.min:
            return f"{self.min:.4g} or more"
        if self.max is not None and not value <= self.max:
            return f"{self.max:.4g} or less"
        return ""


class Policy(BaseModel):
    """The reserved keys of a stage entry: how it is wired and what happens when units fail.

    Attributes:
        use: name of the stage.
        inputs: `in:`, port to the name of the stage in this workflow that feeds it.
        on_error: `skip` lists a failed unit and goes on, `stop` ends the run.
        retries: further tries of a failed unit.
        min_success: share of units that must succeed, else the run stops (exit code 4).
        gate: metric to the limits within which the run goes on (exit code 4); a number is the least value.
        timeout_s: seconds after which a unit is ended and counts as failed; 0 for no limit.
        memory: what one unit needs, such as `2GB`; no more units run at a time than the host has free memory for.
        to: folder under the output folder into which the stage's files go.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    use: str = Field(description="name of the stage; `pano-mvs plugins` lists all")
    inputs: dict[str, str] = Field(
        default={}, alias="in", description="port to the stage of this workflow that feeds it, where there is a choice"
    )
    on_error: Literal["skip", "stop"] = Field(
        default="skip", description="skip: list a failed unit and go on; stop: end the run"
    )
    retries: int = Field(default=0, ge=0, le=100, description="further tries of a unit that failed")
    min_success: float = Field(
        default=0.0, ge=0, le=1, description="share of units that must succeed, else the run stops"
    )
    gate: dict[str, Limits] = Field(
        default={}, description="metric to its least value, or to {min: …, max: …}; else the run stops"
    )
    timeout_s: float = Field(
        default=0.0, ge=0, le=1e9, description="seconds after which a unit is ended and counts as failed; 0: no limit"
    )
    memory: str | int = Field(
        default=0, description="what one unit needs, such as 2GB; no more run at a time than there is room for"
    )
    to: str = Field(default="", description="folder under the output folder for the stage's files")

    @property
    def memory_bytes(self) -> int:
        """What one unit needs; 0 if the workflow does not say."""
        return bytes_from_size(self.memory)

    @model_validator(mode="before")
    @classmethod
    def _null_is_default(cls, values: Any) -> Any:
        """Take `retries: null` for what holds if nothing is said, so that what another file says can be undone."""
        return (
            {key: value for key, value in values.items() if value is not None} if isinstance(values, dict) else values
        )

    @field_validator("memory")
    @classmethod
    def _is_size(cls, memory: str | int) -> str | int:
        bytes_from_size(memory)
        return memory

    @field_validator("to")
    @classmethod
    def _inside(cls, to: str) -> str:
        if problem := folder_problem(to):
            raise ValueError(problem)
        return to


RESERVED_KEYS = tuple(info.alias or name for name, info in Policy.model_fields.items())
