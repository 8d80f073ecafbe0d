"""Describe a run as a research object: RO-Crate metadata with software, settings, and digests of inputs and outputs.

It follows the profile Process Run Crate (https://w3id.org/ro/wfrun/process/0.5): the run is a `CreateAction` of the
software, with images and settings as its objects, and files of the output folder as its results.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from pano_mvs.core.digest import DIGEST_BYTES, digest_from_file
from pano_mvs.core.errors import UsageError
from pano_mvs.core.extras import import_extra
from pano_mvs.core.files import replacing
from pano_mvs.results.summary import RUN_JSON, RunSummary

CRATE_FILE = "ro-crate-metadata.json"
_PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
_COMPLETED, _FAILED = "http://schema.org/CompletedActionStatus", "http://schema.org/FailedActionStatus"


def write_crate(out: Path) -> Path:
    """Write the metadata of the latest run into its output folder, from its run.json, and return the file.

    Raises:
        UsageError: if rocrate is not installed, or the folder holds merged runs.
        InputError: if there is no run.json.
        StoreError: if the file cannot be written.
    """
    library = import_extra("rocrate.rocrate", "pano-mvs crate", "crate")
    entities = import_extra("rocrate.model.contextentity", "pano-mvs crate", "crate")
    summary = RunSummary.read(out)
    if summary.merged is not None:
        raise UsageError(f"{out} holds merged runs: describe the run of each block, {', '.join(summary.merged.blocks)}")
    crate = library.ROCrate()

    def described(key: str, kind: str, **properties: object) -> Any:
        return crate.add(entities.ContextEntity(crate, key, properties={"@type": kind, **properties}))

    inputs = [
        crate.add_file(Path(path).absolute().as_uri(), properties=_digest(digest), validate_url=False)
        for path, digest in summary.inputs.items()
    ]
    files = {**summary.files, RUN_JSON: digest_from_file(out / RUN_JSON)}
    outputs = [crate.add_file(dest_path=name, properties=_digest(digest)) for name, digest in files.items()]
    settings = [
        described(f"#{stage.name}.{name}", "PropertyValue", name=f"{stage.name}.{name}", value=_plain(value))
        for stage in summary.stages
        for name, value in {"use": stage.use, "version": stage.version, **stage.params}.items()
    ]
    libraries = [
        described(f"#{name}", "SoftwareApplication", name=name, softwareVersion=version)
        for name, version in summary.versions.items()
    ]
    software = described(
        "#pano_mvs",
        "SoftwareApplication",
        name="pano_mvs",
        softwareVersion=summary.version,
        softwareRequirements=[{"@id": entity.id} for entity in libraries],
    )
    began = datetime.fromisoformat(summary.started)
    action = described(
        "#run",
        "CreateAction",
        name=f"pano-mvs run {summary.workflow.name}",
        instrument={"@id": software.id},
        object=[{"@id": entity.id} for entity in (*inputs, *settings)],
        result=[{"@id": entity.id} for entity in outputs],
        startTime=began.isoformat(),
        endTime=(began + timedelta(seconds=summary.seconds or 0)).isoformat(),
        actionStatus={"@id": _COMPLETED if summary.exit_code in (0, 3) else _FAILED},
        **({"error": summary.stopped} if summary.stopped else {}),
    )
    profile = described(_PROFILE, "CreativeWork", name="Process Run Crate", version="0.5")
    crate.name = f"{summary.workflow.name}: panoramas to 3D by pano_mvs"
    crate.description = summary.verdict.sentence if summary.verdict is not None else summary.stopped
    crate.datePublished = began
    crate.root_dataset["conformsTo"] = {"@id": profile.id}
    crate.root_dataset["mentions"] = {"@id": action.id}
    with replacing(out / CRATE_FILE) as temporary:
        temporary.write_text(json.dumps(crate.metadata.generate(), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return out / CRATE_FILE


def _digest(digest: str) -> Mapping[str, str]:
    """Return the property that states a digest; `b2sum -l 128` computes it."""
    return {"identifier": f"blake2b-{8 * DIGEST_BYTES}:{digest}"}


def _plain(value: object) -> str | int | float | bool:
    return value if isinstance(value, str | int | float | bool) else json.dumps(value, ensure_ascii=False)
