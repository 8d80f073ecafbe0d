"""The reserved keys of a stage entry, beside the stage's own settings."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler, field_validator, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from pano_mvs.core.file_names import folder_problem
from pano_mvs.core.memory import bytes_from_size


class Thresholds(BaseModel):
    """The thresholds of a metric; outside them the run stops."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    min: float | None = Field(default=None, description="minimum; the run stops below it")
    max: float | None = Field(default=None, description="maximum; the run stops above it")

    @model_validator(mode="before")
    @classmethod
    def _number_is_minimum(cls, value: Any) -> Any:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return {"min": value}
        if not isinstance(value, dict | Thresholds):
            raise ValueError("must be a number (the minimum) or {min: …, max: …}")
        return value

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the schema of both forms: a number, and a mapping."""
        mapping = handler.resolve_ref_schema(handler(core)) | {"minProperties": 1}
        return {"anyOf": [{"type": "number"}, mapping]}

    @model_validator(mode="after")
    def _limits_something(self) -> Thresholds:
        if self.min is None and self.max is None:
            raise ValueError("give {min: …}, {max: …} or both; a plain number is the minimum")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is larger than max {self.max:g}: nothing would pass")
        return self

    def objection(self, value: float) -> str:
        """Return the threshold that a value does not meet, or "" if it meets both."""
        if self.min is not None and not value >= self.min:
            return f"{self.min:.4g} or more"
        if self.max is not None and not value <= self.max:
            return f"{self.max:.4g} or less"
        return ""


class Policy(BaseModel):
    """The reserved keys of a stage entry: its inputs, and how its units run."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    use: str = Field(description="name of the stage; `pano-mvs plugins` lists all")
    inputs: dict[str, str] = Field(
        default={},
        alias="in",
        description="port to the stage of this workflow that feeds it, if there are several candidates",
    )
    on_error: Literal["skip", "stop"] = Field(
        default="skip", description="skip: report a failed unit and go on; stop: end the run"
    )
    retries: int = Field(default=0, ge=0, le=100, description="further attempts for a unit that failed")
    min_success: float = Field(
        default=0.0, ge=0, le=1, description="share of units that must succeed; otherwise the run stops"
    )
    gate: dict[str, Thresholds] = Field(
        default={}, description="metric to its minimum, or to {min: …, max: …}; outside the run stops"
    )
    timeout_s: float = Field(
        default=0.0, ge=0, le=1e9, description="seconds after which a unit is ended and counts as failed; 0: no limit"
    )
    memory: str | int = Field(
        default=0, description="memory that one unit needs, such as 2GB; only as many units run at a time as fit"
    )
    rng_seed: int = Field(
        default=0,
        ge=0,
        le=2**63 - 1,
        description="another number lets the stage draw other random numbers, to see how much they change the result; "
        "part of the cache key unless it is 0",
    )
    optional: bool = Field(
        default=False, description="whether the stage is left out, with a warning, if no plugin offers it"
    )
    temporary: bool = Field(
        default=False,
        description="whether a run drops the results from the cache once all stages that read them are done; they are "
        "computed again when something reads them. The last results of a kind, and files, are always kept",
    )
    to: str = Field(default="", description="folder for the stage's files, inside the output folder")

    @property
    def memory_bytes(self) -> int:
        """The memory that one unit needs; 0 if the workflow does not state it."""
        return bytes_from_size(self.memory)

    @model_validator(mode="before")
    @classmethod
    def _null_is_default(cls, values: Any) -> Any:
        """Treat `retries: null` as the default, so that a file can undo what the files it extends set."""
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
    def _is_inside(cls, to: str) -> str:
        if problem := folder_problem(to):
            raise ValueError(problem)
        return to


RESERVED_KEYS = tuple(info.alias or name for name, info in Policy.model_fields.items())
