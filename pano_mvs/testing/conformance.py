"""The contract that every stage keeps, ours and a stranger's, as a list of laws to be run by any test runner.

    @pytest.mark.parametrize("law", stage_laws(Path("my_filter.py")), ids=str)
    def test_keeps_the_contract(law: Law) -> None:
        law.check()

A stage is called on a tiny synthetic capture (`pano_mvs.testing.tiny_capture`) with what the stages before it might
have made. It may refuse inputs with one of our errors, such as InputError, wherever a law speaks of tiny pictures or of
nothing to see; any other exception breaks the law.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pano_mvs.core.errors import UsageError
from pano_mvs.engine.stages.ports import Cardinality
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import StageSpec, spec_of
from pano_mvs.geometry import pixel_from_ray, roll_panorama
from pano_mvs.scene import Features, Panorama, RangeMap
from pano_mvs.testing.law import Law
from pano_mvs.testing.part_laws import backend_laws, cost_laws
from pano_mvs.testing.stage_calls import StageCase, digest_of
from pano_mvs.testing.tiny_capture import Variant, tiny_capture

__all__ = ["Law", "backend_laws", "check_stage", "cost_laws", "stage_laws"]

Stage = StageSpec | Callable[..., Any] | ModuleType | Path | str

_SIZES = {
    "8×16": Variant((8, 16)),
    "9×18": Variant((9, 18)),
    "25×50": Variant((25, 50)),
    "cropped": Variant(cropped=True),
    "of two sizes": Variant(mixed=True),
}
_ROLL = 16
_LARGEST_ROLL_ERROR = 0.01
_LEAST_ROLL_AGREEMENT = {RangeMap: 0.95, Features: 0.5, Panorama: 0.99}


def stage_laws(
    stage: Stage,
    *,
    settings: Mapping[str, Any] | None = None,
    inputs: Mapping[str, Any] | None = None,
    size_hw: tuple[int, int] = (32, 64),
) -> list[Law]:
    """Return the laws that a stage must keep; of a file or module, those of all its stages.

    Args:
        stage: the decorated function, the file or module that holds it, its spec, or the name of an installed one.
        settings: in place of its defaults; `{capture}` in a text stands for the folder of the tiny capture, which
            holds images/, truth/poses.json and truth/depth.npz.
        inputs: port to a value, for ports of kinds of your own.
        size_hw: of the pictures, for stages that can do nothing with ordinary ones as small as these.

    Raises:
        UsageError: if there is no stage.
        PluginError: if a file cannot be loaded.
    """
    return [
        Law(f"{spec.name} {what}", partial(check, StageCase(spec, settings or {}, inputs or {}, size_hw)))
        for spec in _specs(stage)
        for what, check in _LAWS.items()
        if _applies(what, spec)
    ]


def check_stage(
    stage: Stage,
    *,
    settings: Mapping[str, Any] | None = None,
    inputs: Mapping[str, Any] | None = None,
    size_hw: tuple[int, int] = (32, 64),
) -> None:
    """Check all laws of a stage, see `stage_laws`.

    Raises:
        AssertionError: at the first that it breaks.
        Exception: whatever else the stage raises.
    """
    for law in stage_laws(stage, settings=settings, inputs=inputs, size_hw=size_hw):
        law.check()


def _declares_itself(case: StageCase) -> None:
    """It has a name of the form kind.name, a docstring, and a description of every setting."""
    spec = case.spec
    assert re.fullmatch(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)+", spec.name), f"{spec.name!r} is not kind.name"
    assert spec.doc, f"{spec.name} has no docstring"
    bare = [name for name, info in spec.params_type.model_fields.items() if not info.description]
    assert not bare, f"settings of {spec.name} without a description: {', '.join(bare)}"
    assert inspect.isfunction(spec.function), f"{spec.name} is not a plain function, which workers find by its name"


def _settings_are_values(case: StageCase) -> None:
    """Its settings have sound defaults, survive JSON, cannot be changed, and refuse what is not one of them."""
    params = case.params(case.capture)
    again = type(params).model_validate(json.loads(params.model_dump_json(by_alias=True)))
    assert again == params, f"settings of {case.spec.name} do not survive JSON: {params} became {again}"
    assert params.model_config.get("frozen"), f"settings of {case.spec.name} are not frozen: derive them from Params"
    unknown = params.model_dump(by_alias=True) | {"no_such_setting": 1}
    try:
        type(params).model_validate(unknown)
    except ValidationError:
        return
    raise AssertionError(f"settings of {case.spec.name} take a setting that they do not have")


def _result(case: StageCase) -> None:
    """It returns what it declares, from inputs that cannot be written to, and leaves them and its settings alone."""
    capture = case.capture
    arguments = case.arguments(capture)
    before = {name: digest_of(value) for name, value in arguments.items()}
    params = case.params(capture).model_dump_json()
    call = case.call(capture, arguments=arguments)
    assert call.refusal is None, f"{case.spec.name} refuses ordinary inputs: {call.refusal}"
    changed = [name for name, value in arguments.items() if digest_of(value) != before[name]]
    assert not changed, f"{case.spec.name} changes its inputs {', '.join(changed)}"
    assert case.params(capture).model_dump_json() == params, f"{case.spec.name} changes its settings"


def _same_bytes(case: StageCase) -> None:
    """Twice the same, with any number of threads: random numbers come from ctx.rng alone, sums have an order."""
    digests = [case.call(case.capture, threads=threads).digest for threads in (1, 1, 3)]
    assert digests[0] == digests[1], f"{case.spec.name} returns something else again: is a draw not ctx.rng's?"
    assert digests[0] == digests[2], f"{case.spec.name} returns something else with three threads"


def _any_size(case: StageCase, variant: Variant) -> None:
    """A sound result or a refusal."""
    case.call(tiny_capture(variant))


def _nothing_to_see(case: StageCase) -> None:
    """A sound result or a refusal where all is masked and no stage before found anything."""
    case.call(tiny_capture(Variant(blank=True)))


def _optional_inputs(case: StageCase) -> None:
    """A sound result or a refusal without the inputs that may be left out."""
    capture = case.capture
    left_out = {port.name: None for port in case.spec.ports if port.optional}
    case.call(capture, arguments=case.arguments(capture) | left_out)


def _masks(case: StageCase) -> None:
    """What is masked has no range and no key point, and stays masked."""
    capture = tiny_capture(Variant(masked=True))
    call = case.call(capture)
    value = call.value
    valid = capture.images[capture.names[0]].load_mask()
    if isinstance(value, RangeMap):
        wrong = int((value.valid & ~valid).sum())
        assert not wrong, f"{case.spec.name} gives {wrong} masked pixels a range"
    elif call.mask is not None:
        wrong = int((call.mask & ~valid).sum())
        assert not wrong, f"{case.spec.name} unmasks {wrong} pixels"
    elif isinstance(value, Features):
        found = pixel_from_ray(value.bearings, (valid.shape[0], valid.shape[1]))
        columns, rows = np.floor(found).astype(int).T
        near = valid | np.roll(valid, 1, axis=1) | np.roll(valid, -1, axis=1)
        near[1:] |= valid[:-1]
        wrong = int((~near[np.minimum(rows, valid.shape[0] - 1), columns % valid.shape[1]]).sum())
        assert not wrong, f"{case.spec.name} finds {wrong} key points where all is masked"


def _masked_content(case: StageCase) -> None:
    """Whatever masked pixels show, the result is the same: `Panorama.load` shows none of it, the file itself does."""
    size_hw = (64, 128) if case.spec.output is Features else case.size_hw
    first, second = (case.call(tiny_capture(Variant(size_hw, masked=True, scribbled=noise))) for noise in (False, True))
    if first.mask is not None and second.mask is not None:
        wrong = int((first.mask != second.mask).sum())
        assert not wrong, f"{case.spec.name} masks {wrong} pixels by what masked pixels show"
    else:
        same = first.digest == second.digest
        assert same, f"{case.spec.name} returns something else when masked pixels show something else"


def _rolls(case: StageCase) -> None:
    """Rolled pictures, with the cameras turned, give the rolled result: no border exists at the seam."""
    size_hw = (64, 128) if case.spec.output is Features else case.size_hw
    first, second = (case.call(tiny_capture(Variant(size_hw, rolled=columns))) for columns in (0, _ROLL))
    straight, rolled = first.value, second.value
    if first.mask is not None and second.mask is not None:
        share = float((first.mask == np.roll(second.mask, -_ROLL, axis=1)).mean())
    elif isinstance(straight, RangeMap) and isinstance(rolled, RangeMap):
        share = _same_ranges(straight.range, np.roll(rolled.range, -_ROLL, axis=1))
    else:
        assert isinstance(straight, Features)
        assert isinstance(rolled, Features)
        share = _same_bearings(straight, rolled, size_hw)
    least = _LEAST_ROLL_AGREEMENT[case.spec.output]
    assert share >= least, f"{case.spec.name}: {share:.0%} of the result rolls with the pictures, not {least:.0%}"


def _same_ranges(straight: NDArray[np.float32], rolled: NDArray[np.float32]) -> float:
    with np.errstate(invalid="ignore"):
        close = np.abs(straight / rolled - 1) < _LARGEST_ROLL_ERROR
    return float((close | (np.isnan(straight) & np.isnan(rolled))).mean())


def _same_bearings(straight: Features, rolled: Features, size_hw: tuple[int, int]) -> float:
    """Return the share of key points that are found within a pixel of where they should be."""
    _, turn = roll_panorama(np.zeros(size_hw, np.uint8), _ROLL)
    cosines = straight.bearings @ turn.T @ rolled.bearings.T
    return float((cosines.max(axis=1) > np.cos(np.pi / size_hw[0])).mean()) if cosines.size else 1.0


_LAWS: dict[str, Callable[[StageCase], None]] = {
    "declares itself": _declares_itself,
    "has settings that are values": _settings_are_values,
    "returns what it declares and leaves its inputs alone": _result,
    "returns the same bytes again and with more threads": _same_bytes,
    **{f"takes or refuses pictures {name}": partial(_any_size, variant=size) for name, size in _SIZES.items()},
    "takes or refuses nothing to see": _nothing_to_see,
    "takes or refuses inputs left out": _optional_inputs,
    "respects masks": _masks,
    "does not see what is masked": _masked_content,
    "rolls with its pictures": _rolls,
}


def _applies(what: str, spec: StageSpec) -> bool:
    own = {port.kind for port in spec.ports if port.cardinality is Cardinality.EACH}
    sees = {port.kind for port in spec.ports} & {Panorama, RangeMap} or spec.list_items is not None
    match what.split()[0]:
        case "takes" if "pictures" in what:
            return bool(sees)
        case "takes" if "left out" in what:
            return any(port.optional for port in spec.ports)
        case "respects" | "rolls":
            return spec.output in _LEAST_ROLL_AGREEMENT and bool(own & {Panorama, RangeMap})
        case "does":
            return any(port.kind is Panorama for port in spec.ports)
    return True


def _specs(stage: Stage) -> list[StageSpec]:
    if isinstance(stage, StageSpec):
        return [stage]
    if isinstance(stage, str):
        installed = Registry.installed()
        if stage not in installed.stages:
            raise UsageError(f"there is no stage {stage!r}; {installed.suggest(stage)}")
        return [installed.stages[stage]]
    if isinstance(stage, Path | ModuleType):
        registry = Registry()
        if isinstance(stage, Path):
            registry.add_file(stage)
        else:
            registry.add_module(stage, stage.__name__)
        return list(registry.stages.values())
    spec = spec_of(stage)
    if spec is None:
        raise UsageError(f"{stage!r} is not a stage: decorate it with @stage or @source")
    return [replace(spec)]
