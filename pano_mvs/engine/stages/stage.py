"""Declare stages: functions with typed ports, settings in a `params` model, and a kind as their result."""

from __future__ import annotations

import importlib.util
import inspect
import traceback
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, Protocol, TypeAlias, TypeVar, Union, get_args, get_origin

from pano_mvs.core.doors import own_packages
from pano_mvs.core.errors import PluginError
from pano_mvs.core.memory import bytes_from_size
from pano_mvs.core.settings import settings_of
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.params import Params, settings_model
from pano_mvs.scene import Axis, FilePart, Pairs, Record, SceneLink, Views


class Cardinality(StrEnum):
    """The number of items of a kind that one unit of work reads."""

    ONE = "One"
    EACH = "Each"
    NEAR = "Near"
    ALL = "All"
    NAMES = "Names"


K = TypeVar("K")

One: TypeAlias = Annotated[K, Cardinality.ONE]
Each: TypeAlias = Annotated[K, Cardinality.EACH]
Near: TypeAlias = Annotated[Sequence[K], Cardinality.NEAR]
All: TypeAlias = Annotated[Mapping[Any, K], Cardinality.ALL]
"""By image name; by (first, second) image names for kinds of the pair axis."""


class Names(tuple[str, ...], Generic[K]):
    """The names of all items of a kind, in the capture's order."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Port:
    """One typed input of a stage."""

    name: str
    kind: type[Record]
    cardinality: Cardinality
    optional: bool = False

    def __str__(self) -> str:
        """Return the port as it is annotated in code."""
        return f"{self.name}: {self.cardinality}[{self.kind.kind_name()}]{' | None' if self.optional else ''}"


def port_from_annotation(name: str, annotation: Any) -> Port | None:
    """Return the port that an annotation declares, or None if it does not declare one."""
    optional = False
    if get_origin(annotation) in (Union, types.UnionType):
        inner = [part for part in get_args(annotation) if part is not type(None)]
        if len(inner) != 1:
            return None
        annotation, optional = inner[0], True
    if get_origin(annotation) is Names:
        (kind,) = get_args(annotation)
        return Port(name, kind, Cardinality.NAMES, optional)
    if get_origin(annotation) is not Annotated:
        return None
    value_type, *marks = get_args(annotation)
    cardinality = next((mark for mark in marks if isinstance(mark, Cardinality)), None)
    if cardinality is None:
        return None
    if cardinality in (Cardinality.NEAR, Cardinality.ALL):
        value_type = get_args(value_type)[-1]
    if not (isinstance(value_type, type) and issubclass(value_type, Record)):
        return None
    return Port(name, value_type, cardinality, optional)


Function = TypeVar("Function", bound=Callable[..., Any])
_ATTRIBUTE = "__pano_mvs_stage__"


@dataclass(frozen=True, slots=True)
class SourceItem:
    """One item of a source.

    Attributes:
        name: path relative to the capture, with forward slashes.
        files: role to file; the cache key of the item is made of their content.
        problem: why the item cannot be used, if that is known when it is listed.
        notes: what a user should know in every run, even if the result is cached, such as notes on the location of
            files, which is not part of the key.
        links: to other items that are known to lie nearby, as those of a virtual tour; part of the key.
        digests: role to the digest of the file when it was listed; filled in by the engine.
    """

    name: str
    files: Mapping[str, Path]
    problem: str = ""
    notes: tuple[str, ...] = ()
    links: tuple[SceneLink, ...] = ()
    digests: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Convert links that are given by their names, or stored as lists."""
        object.__setattr__(self, "links", tuple(map(SceneLink.from_value, self.links)))

    def file(self, role: str) -> FilePart:
        """Return a file as part of a record; its `read_bytes` raises if the file has changed since it was listed."""
        return FilePart(self.files[role], external=True, digest=self.digests.get(role, ""))


is_only_planned: ContextVar[bool] = ContextVar("is_only_planned", default=False)
"""Whether items are listed for a plan, so that nobody should wait for what takes long and rarely changes the list."""

ListItems = Callable[[Any], Iterable[SourceItem]]
MemoryNeeded = Callable[[Any, Mapping[str, Any]], int]
"""Returns the bytes that a unit needs, given its params and its inputs by port ({"item": SourceItem} for a source)."""

ExpectedUnits = Callable[[Any, int], int]
"""Returns the number of units that an index is expected to hold, given its params and the number of images."""

ExpectedMemory = Callable[[Any, int, float], float]
"""Returns the bytes that the one unit of a stage is expected to need in memory, before any of its inputs exists, given
its params, the number of images and the bytes that it is expected to store."""


@dataclass(frozen=True, slots=True)
class StageCode:
    """What the results of a stage depend on beside its settings and inputs."""

    digest: str  # of the code
    libraries: Mapping[str, str]  # name to version of the libraries that this code imports


class RemoteStage(Protocol):
    """A stage whose code is not imported into this process, such as that of a plugin in another environment."""

    def code(self) -> StageCode:
        """Return its code and the libraries there."""

    def outcome(self, unit: Any, store: Any, *, threads: int, log: Path) -> Any:
        """Compute a unit there, and return its outcome, as `executors.execute.unit_outcome` does."""

    def close(self) -> None:
        """End the processes that compute its units for this process."""


@dataclass(frozen=True, slots=True)
class StageSpec:
    """The declaration of a stage."""

    name: str  # the `use:` name, such as `depth.sweep`
    version: int  # the author raises it if results change for a reason that is not in the code
    function: Callable[..., Record]  # called with the ports by name, `params` and `ctx`
    ports: tuple[Port, ...]
    params_type: type[Params]
    output: type[Record]
    list_items: ListItems | None = None  # the function that lists the items, for sources
    origin: str = ""  # where it is defined, `file:line`
    code_digest: str = ""  # digest of the code, for stages from user files; otherwise empty, see `stage_code`
    # name of each argument that is not a port, and its role
    extras: Mapping[str, Literal["params", "ctx", "item"]] = field(default_factory=dict)
    memory_bytes: int = 0  # memory that one unit needs; 0 if not declared
    # returns the memory that a unit needs, if it depends on settings and inputs
    memory_needed: MemoryNeeded | None = None
    every_image: bool = False  # whether the stage has a unit for images without neighbours as well; see `stage`
    # distributions that must be installed, by the module that each provides
    needs: Mapping[str, str] = field(default_factory=dict)
    # of a stage that returns an index, for plans; None if only earlier runs show it
    expected_units: ExpectedUnits | None = None
    # of a stage with one unit, whose memory grows with the capture; None if it does not
    expected_memory: ExpectedMemory | None = None
    remote: RemoteStage | None = None  # where its code is, if it is not imported into this process

    @property
    def doc(self) -> str:
        """The stage's docstring."""
        return inspect.getdoc(self.function) or ""

    @property
    def missing(self) -> tuple[str, ...]:
        """The distributions that the stage needs and that are not installed."""
        return tuple(name for module, name in self.needs.items() if importlib.util.find_spec(module) is None)

    @property
    def is_built_in(self) -> bool:
        """Whether the stage is one of the core or of a bundled plugin."""
        return self.remote is None and self.function.__module__.partition(".")[0] in own_packages()

    @property
    def index_kind(self) -> type[Record] | None:
        """The kind of index that the Near ports of the stage need; None if it has no such ports."""
        if all(port.cardinality is not Cardinality.NEAR for port in self.ports):
            return None
        return Pairs if self.output.axis is Axis.PAIR else Views

    @property
    def all_ports(self) -> tuple[Port, ...]:
        """The declared ports, and the port `index` if the stage needs an index."""
        if self.index_kind is None:
            return self.ports
        return (*self.ports, Port(INDEX_PORT, self.index_kind, Cardinality.ONE))

    def with_code(self, code_digest: str) -> StageSpec:
        """Return the stage with a digest of its code, which then counts towards the cache key."""
        return replace(self, code_digest=code_digest)


INDEX_PORT = "index"
_ENGINE = Path(__file__).parents[1]


@dataclass(frozen=True, slots=True)
class _Signature:
    ports: tuple[Port, ...]
    params_type: type[Params]
    output: type[Record]
    extras: Mapping[str, Literal["params", "ctx", "item"]]


def stage(
    name: str,
    *,
    settings: Callable[..., Any] | Sequence[Callable[..., Any]] = (),
    version: int = 1,
    memory: str | int | MemoryNeeded = 0,
    every_image: bool = False,
    needs: Mapping[str, str] | None = None,
    expected_units: ExpectedUnits | None = None,
    expected_memory: ExpectedMemory | None = None,
) -> Callable[[Function], Function]:
    """Declare a function as a stage.

    The function takes ports annotated `One/Each/Near/All[Kind]`, `params` annotated with a `Params` model (optional),
    and `ctx: Context` (optional), and is annotated to return a kind. It is called with keywords. `memory`, such as
    "2GB", is the most that one unit needs; only as many units run at a time as fit into memory. If it depends on the
    unit, pass a function `(params, inputs) -> bytes`, which receives the same values as the stage. It is called in the
    main process, so it must be fast.

    `settings` names the algorithms whose settings are all that `params` holds (see `params_from`); it is then annotated
    `params: Params`. A stage with further parameters declares a model of its own.

    A stage with Near ports has a unit for each view of the index. With `every_image`, it has one for each item of its
    Each ports instead, so that a stage that returns images loses none. Near ports then begin with the image's own
    items, if it has them at all Near ports, and are empty for images that are not in the index.

    `needs` names what must be installed, as module to distribution, such as `{"cv2": "opencv-python-headless"}`. A
    workflow with the stage is refused before anything runs if one is missing.

    `expected_units` is for a stage that returns an index, such as the pairs to match: a function `(params, images) ->
    units` by which `plan` states the work of the stages that follow it, before the index exists.

    `expected_memory` is for a stage with one unit whose memory grows with the number of images: a function `(params,
    images, stored_bytes) -> bytes`, by which `run` divides captures into blocks before any input of the unit exists.
    `stored_bytes` is the expected size of its result; 0 if no earlier run shows it.

    Raises:
        PluginError: if the function does not have the signature of a stage, or `settings` cannot be its parameters.
    """

    def decorate(function: Function) -> Function:
        signature = _read_signature(function, name)
        if settings != ():
            _check_settings(settings, signature, _label(name, function))
            sources = settings if isinstance(settings, Sequence) else (settings,)
            signature = replace(signature, params_type=settings_model(name, *sources))
        spec = _spec(name, function, signature, version=version, memory=memory)
        if every_image and not {Cardinality.EACH, Cardinality.NEAR} <= {port.cardinality for port in spec.ports}:
            raise PluginError(f"stage {name!r} ({spec.origin}): every_image needs ports annotated Each and Near")
        spec = replace(
            spec,
            every_image=every_image,
            needs=dict(needs or {}),
            expected_units=expected_units,
            expected_memory=expected_memory,
        )
        setattr(function, _ATTRIBUTE, spec)
        return function

    return decorate


def source(
    name: str, *, list_items: ListItems, version: int = 1, memory: str | int | MemoryNeeded = 0
) -> Callable[[Function], Function]:
    """Declare a function as a source: `list_items(params)` lists the items, and the function reads one of them.

    The function takes `item: SourceItem`, `params` and `ctx`, and returns a kind of the image axis. Items are listed in
    each run; reading an item is cached by the content of its files. `memory` is as in `stage`; a function receives
    `{"item": item}` as inputs.
    """

    def decorate(function: Function) -> Function:
        signature = _read_signature(function, name, leading="item")
        setattr(
            function,
            _ATTRIBUTE,
            _spec(name, function, signature, version=version, memory=memory, list_items=list_items),
        )
        return function

    return decorate


def spec_of(value: object) -> StageSpec | None:
    """Return the stage that an object was declared as, or None."""
    spec = getattr(value, _ATTRIBUTE, None)
    return spec if isinstance(spec, StageSpec) else None


def place_of(error: BaseException, spec: StageSpec) -> str:
    """Return the `file:line` to name for an error of a stage's code.

    For a plugin, this is the line in its file, or otherwise the line that raised the error. If that is in the engine,
    which then could not use what the plugin returned, it is the line that declares the stage.
    """
    frames = traceback.extract_tb(error.__traceback__)
    if spec.is_built_in:
        return f"{frames[-1].filename}:{frames[-1].lineno}"
    own, _, _ = spec.origin.rpartition(":")
    frame = next((frame for frame in reversed(frames) if frame.filename == own), frames[-1])
    return spec.origin if Path(frame.filename).is_relative_to(_ENGINE) else f"{frame.filename}:{frame.lineno}"


def _spec(
    name: str,
    function: Callable[..., Any],
    signature: _Signature,
    *,
    version: int,
    memory: str | int | MemoryNeeded,
    list_items: ListItems | None = None,
) -> StageSpec:
    return StageSpec(
        name=name,
        version=version,
        function=function,
        ports=signature.ports,
        params_type=signature.params_type,
        output=signature.output,
        list_items=list_items,
        origin=_origin(function),
        extras=signature.extras,
        memory_bytes=0 if callable(memory) else bytes_from_size(memory),
        memory_needed=memory if callable(memory) else None,
    )


def _origin(function: Callable[..., Any]) -> str:
    code = function.__code__
    return f"{code.co_filename}:{code.co_firstlineno}"


def _label(name: str, function: Callable[..., Any]) -> str:
    return f"stage {name!r} ({_origin(function)})"


def _read_signature(function: Callable[..., Any], name: str, *, leading: str = "") -> _Signature:
    """Read ports, params and output from the annotations."""
    where = _label(name, function)
    try:
        hints = typing.get_type_hints(function, include_extras=True)
    except NameError as error:
        raise PluginError(f"{where}: an annotation cannot be resolved: {error}") from error
    ports: list[Port] = []
    params_type: type[Params] = Params
    extras: dict[str, Literal["params", "ctx", "item"]] = {}
    for argument in inspect.signature(function).parameters.values():
        annotation = hints.get(argument.name)
        if argument.name == leading:
            extras[argument.name] = "item"
            continue
        if annotation is Context:
            extras[argument.name] = "ctx"
            continue
        if isinstance(annotation, type) and issubclass(annotation, Params):
            params_type = annotation
            extras[argument.name] = "params"
            continue
        port = port_from_annotation(argument.name, annotation)
        if port is None or port.name == INDEX_PORT:
            raise PluginError(
                f"{where}: argument {argument.name!r} must be annotated One/Each/Near/All[Kind], a Params model or "
                f"Context, got {annotation!r}"
            )
        ports.append(port)
    output = hints.get("return")
    if not (isinstance(output, type) and issubclass(output, Record)):
        raise PluginError(f"{where}: the result must be annotated with a kind (a Record), got {output!r}")
    return _Signature(tuple(ports), params_type, output, extras)


def _check_settings(settings: object, signature: _Signature, where: str) -> None:
    """Raise PluginError unless `settings` can be all parameters of a stage with the signature."""
    arguments = [name for name, role in signature.extras.items() if role == "params"]
    if len(arguments) != 1 or signature.params_type is not Params:
        one = f"{arguments[0]}: {signature.params_type.__name__}" if len(arguments) == 1 else ""
        got = one or ", ".join(arguments) or "none"
        raise PluginError(
            f"{where}: settings= needs exactly one argument annotated Params itself (`params: Params`), got {got}; for "
            "a model with further fields, leave out settings= and decorate the model with params_from"
        )
    sources = settings if isinstance(settings, Sequence) and not isinstance(settings, str) else (settings,)
    if not sources:
        raise PluginError(f"{where}: settings= names no function; name one, or leave it out")
    found: dict[str, str] = {}
    for source in sources:
        if not callable(source):
            raise PluginError(
                f"{where}: settings= must be a function or a dataclass with settings, or a tuple or list of them, got "
                f"{source!r}"
            )
        called = getattr(source, "__qualname__", repr(source))
        try:
            names = settings_of(source)
        except (TypeError, NameError) as error:
            raise PluginError(f"{where}: the settings of {called} in settings= cannot be read: {error}") from error
        if not names:
            raise PluginError(
                f"{where}: {called} in settings= has no settings; annotate its keyword-only parameters with Setting, "
                "or declare the fields of a dataclass by setting()"
            )
        for setting in names:
            if setting in found:
                raise PluginError(
                    f"{where}: both {found[setting]} and {called} in settings= have a setting {setting!r}; rename one "
                    "of the two"
                )
            found[setting] = called
