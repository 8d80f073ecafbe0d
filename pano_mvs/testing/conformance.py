"""The contract of all stages, built-in or from plugins, as a list of tests for any test runner.

    @pytest.mark.parametrize("contract_test", stage_contract_tests(Path("my_filter.py")), ids=str)
    def test_keeps_the_contract(contract_test: ContractTest) -> None:
        contract_test.check()

Each test calls the stage on a tiny synthetic capture (`pano_mvs.testing.tiny_capture`), with inputs as earlier stages
might produce them. Where a test is about tiny images or empty inputs, the stage may reject its inputs with one of our
errors, such as InputError. Any other exception breaks the contract.

What plugins bring beside stages has contracts of its own, in the modules `command_contract`, `executor_contract`,
`observer_contract` and `reader_contract`, whose functions can be imported from here too.
"""

from __future__ import annotations

import inspect
import json
import multiprocessing
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pano_mvs.algorithms.sweep.backends.registry import SWEEP_BACKENDS
from pano_mvs.algorithms.sweep.costs import BUILTIN, SWEEP_COSTS, SweepCost, checked_cost
from pano_mvs.algorithms.sweep.windows import CostWindow
from pano_mvs.core.errors import UsageError
from pano_mvs.core.process_state import ProcessState
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import Cardinality, StageSpec, spec_of
from pano_mvs.geometry import pixel_from_ray, roll_panorama
from pano_mvs.scene import Features, Panorama, RangeMap
from pano_mvs.testing.command_contract import command_contract_tests
from pano_mvs.testing.contract import ContractTest, registered_names
from pano_mvs.testing.executor_contract import executor_contract_tests
from pano_mvs.testing.exporters import exporter_tests
from pano_mvs.testing.observer_contract import observer_contract_tests
from pano_mvs.testing.reader_contract import reader_contract_tests
from pano_mvs.testing.stage_calls import Call, StageCase, digest_of
from pano_mvs.testing.sweep_backends import CASES, agreement, cost_of_case, sweep_case
from pano_mvs.testing.tiny_capture import Variant, tiny_capture

__all__ = [
    "ContractTest",
    "backend_contract_tests",
    "check_stage",
    "command_contract_tests",
    "cost_contract_tests",
    "executor_contract_tests",
    "observer_contract_tests",
    "reader_contract_tests",
    "stage_contract_tests",
]


def cost_contract_tests(cost: Path | str) -> list[ContractTest]:
    """Return the contract tests of a sweep cost, given by name, or of all sweep costs that a plugin file registers.

    Raises:
        UsageError: if the file registers no sweep cost.
    """
    checks = {
        "is from 0 to 1 on images of any size": _cost_is_bounded,
        "is lower where images are the same": _cost_separates_same,
        "is the same when called again and does not modify its inputs": _cost_is_a_function,
    }
    return [
        ContractTest(f"{name} {what}", partial(check, name))
        for name in registered_names("sweep cost", cost)
        for what, check in checks.items()
    ]


def backend_contract_tests(backend: Path | str, *, device: str = "auto") -> list[ContractTest]:
    """Return the contract tests of a sweep backend; see `cost_contract_tests`.

    A backend must find the same winners as the numpy backend, and the same result when called again.
    """
    return [
        contract_test
        for name in registered_names("sweep backend", backend)
        for contract_test in (
            ContractTest(f"{name} agrees with the numpy backend", partial(_backend_agrees, name, device)),
            ContractTest(f"{name} returns the same when called again", partial(_backend_is_a_function, name, device)),
        )
    ]


def _cost_is_bounded(name: str) -> None:
    for size_hw in ((8, 16), (9, 18), (25, 50)):
        reference, warped, window = _cost_inputs(name, size_hw)
        checked_cost(_registered(name).function(reference, warped, window), size_hw, name)


def _cost_separates_same(name: str) -> None:
    reference, warped, window = _cost_inputs(name, (32, 64))
    same = _registered(name).function(reference, reference.astype(np.float64), window)
    other = _registered(name).function(reference, warped, window)
    assert same.mean() < 0.5 * other.mean(), (
        f"the cost {name} is {same.mean():.3f} of an image against itself and {other.mean():.3f} against another image"
    )


def _cost_is_a_function(name: str) -> None:
    reference, warped, window = _cost_inputs(name, (25, 50))
    reference.flags.writeable = warped.flags.writeable = False
    first, second = (np.asarray(_registered(name).function(reference, warped, window)).tobytes() for _ in range(2))
    assert first == second, f"the cost {name} returns something else when called again"


def _backend_agrees(name: str, device: str) -> None:
    shares = [agreement(number, name, device=device) for number in _cases(name)]
    mean = float(np.mean(shares))
    assert mean >= 0.99, f"{name} agrees with the numpy backend in {mean:.1%} of the pixels"


def _backend_is_a_function(name: str, device: str) -> None:
    number = next(_cases(name))
    first, second = (sweep_case(number).swept(name, device=device) for _ in range(2))
    assert first.range.tobytes() == second.range.tobytes(), f"{name} returns other ranges when called again"


def _cases(name: str) -> Iterator[int]:
    """Yield some cases whose cost the backend supports, spread over all cases."""
    costs = SWEEP_BACKENDS.get(name).costs
    able = [number for number in range(CASES) if costs is None or cost_of_case(number) in costs]
    if not able:
        raise UsageError(f"{name} supports none of the built-in costs, which are needed to compare backends")
    yield from able[:: max(1, len(able) // 5)]


def _cost_inputs(name: str, size_hw: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.float64], CostWindow]:
    """Return two different images as the cost receives them, and windows of 5 × 5 pixels."""
    first, second = (picture.copy() for picture in tiny_capture(Variant(size_hw)).pictures[:2])
    if not _registered(name).colors:
        first, second = first[..., 1:2].copy(), second[..., 1:2].copy()
    return first, second.astype(np.float64), CostWindow.of(size_hw, 2, spherical=True)


def _registered(name: str) -> SweepCost:
    if name in BUILTIN:
        raise UsageError(f"the sweep cost {name!r} is built in: each backend has its own implementation of it")
    return SWEEP_COSTS.get(name)


Stage = StageSpec | Callable[..., Any] | ModuleType | Path | str

_SIZES = {
    "8×16": Variant((8, 16)),
    "9×18": Variant((9, 18)),
    "25×50": Variant((25, 50)),
    "cropped": Variant(cropped=True),
    "of two sizes": Variant(mixed=True),
}
_ROLL = 16
_MIN_ROLL_AGREEMENT = {RangeMap: 0.95, Features: 0.5, Panorama: 0.99}


def stage_contract_tests(
    stage: Stage,
    *,
    settings: Mapping[str, Any] | None = None,
    inputs: Mapping[str, Any] | None = None,
    size_hw: tuple[int, int] = (32, 64),
) -> list[ContractTest]:
    """Return the contract tests of a stage, or of all stages of a file or module.

    Args:
        stage: the decorated function, the file or module that holds it, its spec, or the name of an installed stage.
        settings: replace the defaults; `{capture}` in a string stands for the folder of the tiny capture, which holds
            images/, truth/poses.json and truth/depth.npz.
        inputs: port name to a value, for ports of your own kinds.
        size_hw: image size, for stages that need larger images than these.

    Raises:
        UsageError: if there is no such stage.
        PluginError: if a file cannot be loaded.
    """
    return [
        ContractTest(f"{case.spec.name} {what}", partial(check, case))
        for case in (StageCase(spec, settings or {}, inputs or {}, size_hw) for spec in _specs(stage))
        for what, check in (_CONTRACT | exporter_tests(case.spec)).items()
        if what not in _CONTRACT or _applies(what, case.spec)
    ]


def check_stage(
    stage: Stage,
    *,
    settings: Mapping[str, Any] | None = None,
    inputs: Mapping[str, Any] | None = None,
    size_hw: tuple[int, int] = (32, 64),
) -> None:
    """Run all contract tests of a stage; see `stage_contract_tests`.

    Raises:
        AssertionError: at the first test that fails.
        Exception: any other exception that the stage raises.
    """
    for contract_test in stage_contract_tests(stage, settings=settings, inputs=inputs, size_hw=size_hw):
        contract_test.check()


# Several tests need the results of the same calls, and some stages take seconds.
@cache
def _first_call(case: StageCase) -> tuple[Call, list[str], bool]:
    """Return the result for the ordinary capture, the inputs that changed, and whether the settings did."""
    arguments = case.arguments(case.capture)
    before = {name: digest_of(value) for name, value in arguments.items()}
    params = case.params(case.capture).model_dump_json()
    call = case.call(case.capture, arguments=arguments)
    changed = [name for name, value in arguments.items() if digest_of(value) != before[name]]
    return call, changed, case.params(case.capture).model_dump_json() != params


@cache
def _second_call(case: StageCase) -> tuple[Call, tuple[str, ...], list[str], list[str]]:
    """Return the same again, what changed in the process, and the names of threads and processes that run on."""
    _first_call(case)  # what the stage loads at its first call may change more
    before, threads = ProcessState.now(), set(threading.enumerate())
    call = case.call(case.capture)
    changes = before.restore()
    left = [thread.name for thread in threading.enumerate() if thread not in threads]
    return call, changes, left, [child.name for child in multiprocessing.active_children()]


@cache
def _call_on(case: StageCase, variant: Variant) -> Call:
    """Return the result for a variant of the capture."""
    return _first_call(case)[0] if variant == case.capture.variant else case.call(tiny_capture(variant))


def _declares_itself(case: StageCase) -> None:
    """The stage has a name of the form kind.name, a docstring, and a description of every setting."""
    spec = case.spec
    assert re.fullmatch(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)+", spec.name), f"{spec.name!r} is not kind.name"
    assert spec.doc, f"{spec.name} has no docstring"
    bare = [name for name, info in spec.params_type.model_fields.items() if not info.description]
    assert not bare, f"settings of {spec.name} without a description: {', '.join(bare)}"
    assert inspect.isfunction(spec.function), f"{spec.name} is not a plain function; workers look it up by its name"


def _settings_are_values(case: StageCase) -> None:
    """The settings have valid defaults, survive JSON, are immutable, and reject unknown names."""
    params = case.params(case.capture)
    again = type(params).model_validate(json.loads(params.model_dump_json(by_alias=True)))
    assert again == params, f"settings of {case.spec.name} do not survive JSON: {params} became {again}"
    assert params.model_config.get("frozen"), f"settings of {case.spec.name} are not frozen: derive them from Params"
    unknown = params.model_dump(by_alias=True) | {"no_such_setting": 1}
    try:
        type(params).model_validate(unknown)
    except ValidationError:
        return
    raise AssertionError(f"settings of {case.spec.name} accept an unknown setting")


def _result(case: StageCase) -> None:
    """The stage returns what it declares, accepts read-only inputs, and does not modify its inputs and settings."""
    call, changed, settings_changed = _first_call(case)
    assert call.refusal is None, f"{case.spec.name} rejects ordinary inputs: {call.refusal}"
    assert not changed, f"{case.spec.name} modifies its inputs {', '.join(changed)}"
    assert not settings_changed, f"{case.spec.name} modifies its settings"


def _same_bytes(case: StageCase) -> None:
    """The result is the same again and with three threads: random numbers from ctx.rng, sums in a fixed order."""
    digests = [_first_call(case)[0].digest, _second_call(case)[0].digest, case.call(case.capture, threads=3).digest]
    assert digests[0] == digests[1], (
        f"{case.spec.name} returns something else when called again: draw from ctx.rng only"
    )
    assert digests[0] == digests[2], f"{case.spec.name} returns something else with three threads"


def _leaves_its_process(case: StageCase) -> None:
    """The stage changes nothing that other stages compute with, and leaves no thread or process behind."""
    _, changes, threads, left = _second_call(case)
    assert not changes, f"{case.spec.name} changes {', '.join(changes)} in its process; runs undo this after every unit"
    assert not threads, f"{case.spec.name} leaves the threads {', '.join(threads)} running; other units run beside them"
    assert not left, f"{case.spec.name} leaves the processes {', '.join(left)} running; they end with its worker"


def _any_size(case: StageCase, variant: Variant) -> None:
    """The stage returns a valid result or raises one of our errors."""
    case.call(tiny_capture(variant))


def _nothing_to_see(case: StageCase) -> None:
    """The same if everything is masked and earlier stages found nothing."""
    case.call(tiny_capture(Variant(blank=True)))


def _optional_inputs(case: StageCase) -> None:
    """The same without the optional inputs."""
    capture = case.capture
    left_out = {port.name: None for port in case.spec.ports if port.optional}
    case.call(capture, arguments=case.arguments(capture) | left_out)


def _masks(case: StageCase) -> None:
    """Masked pixels have no range and no key point, and stay masked."""
    capture = tiny_capture(Variant(masked=True))
    call = _call_on(case, capture.variant)
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
        assert not wrong, f"{case.spec.name} finds {wrong} key points in masked areas"


def _masked_content(case: StageCase) -> None:
    """The result does not depend on the content of masked pixels, which `Panorama.load` hides but the file shows."""
    size_hw = (64, 128) if case.spec.output is Features else case.size_hw
    first, second = (_call_on(case, Variant(size_hw, masked=True, scribbled=noise)) for noise in (False, True))
    if first.mask is not None and second.mask is not None:
        wrong = int((first.mask != second.mask).sum())
        assert not wrong, f"{case.spec.name} masks {wrong} pixels depending on the content of masked pixels"
    else:
        same = first.digest == second.digest
        assert same, f"{case.spec.name} returns something else if the content of masked pixels changes"


def _rolls(case: StageCase) -> None:
    """Rolled images with rotated cameras give the rolled result: there is no border at the seam."""
    size_hw = (64, 128) if case.spec.output is Features else case.size_hw
    first, second = (_call_on(case, Variant(size_hw, rolled=columns)) for columns in (0, _ROLL))
    straight, rolled = first.value, second.value
    if first.mask is not None and second.mask is not None:
        share = float((first.mask == np.roll(second.mask, -_ROLL, axis=1)).mean())
    elif isinstance(straight, RangeMap) and isinstance(rolled, RangeMap):
        share = _same_ranges(straight.range, np.roll(rolled.range, -_ROLL, axis=1))
    else:
        assert isinstance(straight, Features)
        assert isinstance(rolled, Features)
        _, turn = roll_panorama(np.zeros(size_hw, np.uint8), _ROLL)
        cosines = straight.bearings @ turn.T @ rolled.bearings.T
        share = float((cosines.max(axis=1) > np.cos(np.pi / size_hw[0])).mean()) if cosines.size else 1.0
    least = _MIN_ROLL_AGREEMENT[case.spec.output]
    assert share >= least, f"{case.spec.name}: {share:.0%} of the result rolls with the images; {least:.0%} is needed"


def _same_ranges(straight: NDArray[np.float32], rolled: NDArray[np.float32]) -> float:
    with np.errstate(invalid="ignore"):
        close = np.abs(straight / rolled - 1) < 0.01
    return float((close | (np.isnan(straight) & np.isnan(rolled))).mean())


_CONTRACT: dict[str, Callable[[StageCase], None]] = {
    "declares itself": _declares_itself,
    "has settings that are values": _settings_are_values,
    "returns what it declares and does not modify its inputs": _result,
    "returns the same bytes again and with more threads": _same_bytes,
    "leaves its process as it was": _leaves_its_process,
    **{f"accepts or rejects images {name}": partial(_any_size, variant=size) for name, size in _SIZES.items()},
    "accepts or rejects empty inputs": _nothing_to_see,
    "accepts or rejects missing inputs": _optional_inputs,
    "respects masks": _masks,
    "does not depend on masked content": _masked_content,
    "rolls with its images": _rolls,
}


def _applies(what: str, spec: StageSpec) -> bool:
    own = {port.kind for port in spec.ports if port.cardinality is Cardinality.EACH}
    sees = {port.kind for port in spec.ports} & {Panorama, RangeMap} or spec.list_items is not None
    match what.split()[0]:
        case "accepts" if "images" in what:
            return bool(sees)
        case "accepts" if "missing" in what:
            return any(port.optional for port in spec.ports)
        case "respects" | "rolls":
            return spec.output in _MIN_ROLL_AGREEMENT and bool(own & {Panorama, RangeMap})
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
