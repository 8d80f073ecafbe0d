"""Call a stage on a tiny capture, like the engine does, and compute a digest of the result."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.digest import digest_from_bytes, digest_from_file, digest_from_value
from pano_mvs.core.errors import ContractError, PanoMvsError, UsageError
from pano_mvs.core.paths import is_file, is_inside
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.params import Params
from pano_mvs.engine.stages.stage import Cardinality, Names, Port, StageSpec
from pano_mvs.scene import Axis, FilePart, Files, Panorama, Record
from pano_mvs.testing.tiny_capture import TinyCapture, Variant, tiny_capture


@dataclass(frozen=True, slots=True)
class Call:
    """The result of a call."""

    value: Record | None  # the value that the stage returned; None if it rejected its inputs
    digest: str  # digest of the value and of the metrics
    refusal: PanoMvsError | None = None  # the error by which the stage rejected its inputs
    # (H, W) valid pixels of a returned panorama, whose files no longer exist after the call
    mask: NDArray[np.bool_] | None = None
    notes: tuple[str, ...] = ()
    files: Mapping[str, bytes] = field(default_factory=dict)  # target to the content of a returned file


@dataclass(frozen=True, eq=False)
class StageCase:
    """A stage with its test inputs."""

    spec: StageSpec
    # replace the defaults; `{capture}` in a string stands for the folder of the capture
    settings: Mapping[str, Any] = field(default_factory=dict)
    # port to a value, for ports of kinds that the tiny capture does not have
    inputs: Mapping[str, Any] = field(default_factory=dict)
    size_hw: tuple[int, int] = (32, 64)  # size of the ordinary images

    @property
    def capture(self) -> TinyCapture:
        """The ordinary capture."""
        return tiny_capture(Variant(self.size_hw))

    def params(self, capture: TinyCapture) -> Params:
        """Return the settings; a required path that is not given is that of the images, or else of the ground truth."""
        given = {key: _placed(value, capture) for key, value in self.settings.items()}
        own = capture.folder / ("images" if self.spec.list_items is not None else "truth")
        for name, info in self.spec.params_type.model_fields.items():
            if info.is_required() and info.annotation is Path:
                given.setdefault(name, str(own))
        return self.spec.params_type.model_validate(given)

    def arguments(self, capture: TinyCapture) -> dict[str, Any]:
        """Return a value for each port: those of the first image, or of the first pair."""
        return {
            port.name: self.inputs[port.name] if port.name in self.inputs else self._argument(port, capture)
            for port in self.spec.ports
        }

    def call(self, capture: TinyCapture, *, threads: int = 1, arguments: Mapping[str, Any] | None = None) -> Call:
        """Call the stage on the first image, the first pair, or all, with fixed random numbers.

        Our own errors, except those that blame the stage, count as rejected inputs; all other exceptions are raised.
        """
        with TemporaryDirectory(prefix="pano-mvs-call-") as scratch:
            context = Context(np.random.default_rng(0), Path(scratch), threads)
            try:
                params = self.params(capture)
                extras = {"params": params, "ctx": context}
                if self.spec.list_items is not None:
                    extras["item"] = next(iter(self.spec.list_items(params)))
                given = self.arguments(capture) if arguments is None else arguments
                own = {name: extras[role] for name, role in self.spec.extras.items()}
                value = self.spec.function(**given, **own)
            except ContractError:
                raise
            except PanoMvsError as error:
                return Call(None, f"{type(error).__name__}: {error}", error)
            require_valid(value, self.spec, Path(scratch))
            figures = {name: float(metric).hex() for name, metric in context.metrics.items()}
            told = [figures, context.notes, context.rejected]
            digest = digest_from_value([digest_of(value), json.dumps(told)])
            mask = value.load_mask() if isinstance(value, Panorama) else None
            written = value.files if isinstance(value, Files) else {}
            files = {target: path.read_bytes() for target, path in written.items()}
            return Call(value, digest, mask=mask, notes=(*context.notes,), files=files)

    def _argument(self, port: Port, capture: TinyCapture) -> Any:
        items = capture.items.get(port.kind)
        if port.cardinality is Cardinality.ONE:
            return capture.wholes[port.kind]
        if items is None:
            raise UsageError(
                f"the tiny capture has no {port.kind.kind_name()}: give one as inputs={{{port.name!r}: …}}"
            )
        names = list(items)
        match port.cardinality:
            case Cardinality.ALL:
                return dict(items)
            case Cardinality.NAMES:
                return Names(names)
            case Cardinality.NEAR:
                first = 0 if self.spec.every_image or self.spec.output.axis is Axis.PAIR else 1
                return [items[name] for name in names[first : 2 if self.spec.output.axis is Axis.PAIR else None]]
        return items[names[0]]


def require_valid(value: object, spec: StageSpec, scratch: Path) -> None:
    """Raise AssertionError, or the record's ContractError, unless a value is what the stage declares."""
    declared = spec.output.kind_name()
    assert isinstance(value, spec.output), f"{spec.name} declares {declared}, but returned {type(value).__name__}"
    value.check()
    for item in value.explode().values():
        item.check()
    for path in value.files.values() if isinstance(value, Files) else ():
        inside = is_inside(path, scratch)
        assert is_file(path), f"{spec.name} returns {path} as written, but the file does not exist"
        assert inside, f"{spec.name} wrote {path}, outside ctx.scratch"


def digest_of(value: object) -> str:
    """Return the digest of a record, or of a tuple, list or mapping of records, by their bytes."""
    if isinstance(value, Record):
        parts = value.to_parts()
        return digest_from_value({name: _part_digest(parts[name]) for name in sorted(parts)})
    if isinstance(value, Mapping):
        return digest_from_value([[str(key), digest_of(item)] for key, item in value.items()])
    if isinstance(value, list):
        return digest_from_value([digest_of(item) for item in value])
    return digest_from_value(repr(value))


def _part_digest(part: object) -> str:
    if isinstance(part, np.ndarray):
        return f"{part.dtype} {part.shape} {digest_from_bytes(np.ascontiguousarray(part).tobytes())}"
    if isinstance(part, FilePart):
        return digest_from_file(part.path)
    return json.dumps(part, sort_keys=True, default=_plain)


def _plain(value: object) -> object:
    """Return a value in a form that JSON supports, as the store does."""
    return (
        dict(value) if isinstance(value, Mapping) else value.tolist() if isinstance(value, np.generic) else str(value)
    )


def _placed(value: Any, capture: TinyCapture) -> Any:
    return value.replace("{capture}", str(capture.folder)) if isinstance(value, str) else value
