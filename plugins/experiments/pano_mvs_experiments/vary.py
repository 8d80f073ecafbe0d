"""Run a workflow with each combination of settings, over one or more captures, and compare the results.

Each combination and capture is an ordinary run with an output folder of its own. All runs share one cache, so that what
is equal is computed once.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import InputError, PanoMvsError, StoreError, UsageError, WorkflowError
from pano_mvs.core.file_names import plain_title
from pano_mvs.core.files import OUTPUT_MARK, make_folder, write_text
from pano_mvs.core.paths import children, exists, is_file, is_folder, reason_of, resolved
from pano_mvs.core.text import shortened_list
from pano_mvs.core.yaml_text import did_you_mean
from pano_mvs.engine.cache.dropping import dropping_after
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import executor_size
from pano_mvs.engine.running.events import ignore
from pano_mvs.engine.running.output_lock import LOCK_NAME, output_lock
from pano_mvs.engine.stages.params import files_of, key_fields
from pano_mvs.engine.workflows.resolved import resolved_yaml
from pano_mvs.results.origin import ORIGIN, Origin
from pano_mvs.results.summary import INTERRUPTED, RUN_JSON, RunSummary
from pano_mvs.session.captures import is_early, run_open_session
from pano_mvs.session.observers import OBSERVERS
from pano_mvs.session.planning import plan_session
from pano_mvs.session.progress import Progress
from pano_mvs.session.python_calls import as_names, names_arguments, overrides_from_settings
from pano_mvs.session.running import Execution
from pano_mvs.session.session import DEFAULT_OPTIONS, RunOptions, Session, check_output, open_session
from pano_mvs_experiments.grid import (
    MAX_COMBINATIONS,
    Combination,
    Value,
    combinations_from_file,
    combinations_from_yaml,
    located,
    names_of,
)
from pano_mvs_experiments.seeds import SEED_KEY, drawing_stages, seed_overrides
from pano_mvs_experiments.vary_page import vary_page
from pano_mvs_experiments.vary_results import (
    METRICS,
    SCHEMA,
    Best,
    CaptureResult,
    CombinationResult,
    Variation,
    VariedRun,
    averages_of,
    best_of,
    default_metrics,
    direction_of,
    metrics_of,
)

VARY_JSON, VARY_CSV, VARY_HTML = "vary.json", "vary.csv", "vary.html"
_OWN_FILES = {VARY_JSON, VARY_CSV, VARY_HTML, OUTPUT_MARK, LOCK_NAME, ORIGIN}


@dataclass(frozen=True, slots=True, kw_only=True)
class VaryRequest:
    """What an experiment varies, and over what."""

    workflow: str  # a workflow file or the name of a preset
    out: Path
    images: Sequence[Path] = ()  # the captures; empty for that of the workflow
    settings: Mapping[str, Value] = field(default_factory=dict)  # STAGE.PARAM to what all runs have in common
    combinations: Sequence[Combination] = ()
    seeds: int = 1  # number of seeds of each combination
    metrics: Sequence[str] = ()  # to show, as STAGE.METRIC or of `METRICS`; empty for the default
    best: str = ""  # METRIC[:max|min] by which the best is chosen; empty for none
    cache: Path | None = None
    run_options: RunOptions = DEFAULT_OPTIONS


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """A run of an experiment before it begins."""

    capture: str  # name of the capture
    combination: str  # name of the combination
    seed: int
    session: Session

    @property
    def label(self) -> str:
        """The folder of the run below that of the experiment."""
        return f"{self.capture}/{self.session.out.name}"


@dataclass(frozen=True, slots=True)
class Experiment:
    """An experiment that has been checked."""

    request: VaryRequest
    captures: Mapping[str, Path | None]  # by name
    combinations: Mapping[str, Combination]  # by name, without duplicates
    dropped: Mapping[str, str]  # combination that was left out to the one that it equals
    runs: tuple[PlannedRun, ...]
    is_repeatable: bool  # whether no stage draws random numbers

    @property
    def varied(self) -> tuple[str, ...]:
        """The settings that vary, as STAGE.PARAM."""
        return tuple(dict.fromkeys(target for each in self.combinations.values() for target in each))


def prepare(request: VaryRequest) -> Experiment:
    """Check an experiment, and return its runs; nothing is computed or written.

    Raises:
        WorkflowError: with every setting that cannot be used, and its place.
        UsageError: if an option, the output folder or the folder of a run cannot be used.
        InputError: if a capture cannot be used.
    """
    combinations = list(request.combinations) or [{}]
    names = names_of(combinations)
    captures = _captures(request)
    problems: list[str] = []
    sessions: dict[tuple[str, int], Session] = {}
    for capture, images in captures.items():
        for idx, combination in enumerate(combinations):
            out = request.out / capture / names[idx]
            try:
                sessions[capture, idx] = _open(request, combination, images=images, out=out)
            except PanoMvsError as error:
                found = error.problems if isinstance(error, WorkflowError) else [str(error)]
                problems += _with_places(found, {**request.settings, **combination})
    if problems:
        raise WorkflowError(list(dict.fromkeys(problems)))
    kept, dropped = _without_duplicates(names, [sessions[next(iter(captures)), idx] for idx in range(len(names))])
    is_repeatable = not any(drawing_stages(session.workflow) for session in sessions.values())
    _check_seeds(request, combinations, is_repeatable=is_repeatable)
    _check_metrics(request, list(sessions.values()))
    runs = [
        _seeded(
            request, PlannedRun(capture, names[idx], seed, sessions[capture, idx]), combinations[idx], images=images
        )
        for capture, images in captures.items()
        for idx in kept
        for seed in range(request.seeds)
    ]
    experiment = Experiment(
        request, captures, {names[idx]: combinations[idx] for idx in kept}, dropped, tuple(runs), is_repeatable
    )
    for session in sessions.values():
        request.run_options.applied_to(session.workflow, session.graph)
    _check_out(experiment, runs[0].session)
    for run in runs:
        check_output(run.session)
        _check_run_folder(run.session)
    return experiment


def _open(
    request: VaryRequest, combination: Combination, *, images: Path | None, out: Path, seeded: Sequence[str] = ()
) -> Session:
    values = {**request.settings, **combination}
    return open_session(
        request.workflow,
        overrides=[*(f"{target}={value.text}" for target, value in values.items()), *seeded],
        images=images,
        cache=request.cache,
        out=out,
        run_options=request.run_options,
    )


def _seeded(request: VaryRequest, run: PlannedRun, combination: Combination, *, images: Path | None) -> PlannedRun:
    """Return a run with the random numbers of its seed, in a folder of its own."""
    if run.seed == 0:
        return run
    out = run.session.out.with_name(f"{run.session.out.name},seed={run.seed}")
    seeded = seed_overrides(run.session.workflow, run.seed)
    return replace(run, session=_open(request, combination, images=images, out=out, seeded=seeded))


def _with_places(problems: Sequence[str], values: Combination) -> list[str]:
    """Return messages with the place where a value is written instead of the option that passes it on."""
    return [_with_place(problem, values) for problem in problems]


def _with_place(problem: str, values: Combination) -> str:
    for target, value in values.items():
        option, written = f"--set {target}", f"--set {target}={value.text}"[: len("--set ") + 80]
        if value.place == option:
            continue
        for shown in (written, option):
            if problem.startswith(f"{shown}:"):
                return f"{value.place}{problem.removeprefix(shown)}"
    return problem


def _captures(request: VaryRequest) -> dict[str, Path | None]:
    """Return the captures by a name: that of the folder, with those above it where two have the same.

    Raises:
        UsageError: if a capture is given twice.
    """
    if not request.images:
        return {"capture": None}
    folders = [resolved(path) for path in request.images]
    if twice := [path for idx, path in enumerate(folders) if path in folders[:idx]]:
        raise UsageError(f"--images {twice[0]}: this capture is given twice; give each once")
    names = [_title(path, 1) for path in folders]
    parts = 1
    while len({name.casefold() for name in names}) < len(names) and parts < max(len(path.parts) for path in folders):
        parts += 1
        names = [_title(path, parts) for path in folders]
    if len({name.casefold() for name in names}) < len(names):
        names = [f"{name}-{digest_from_value(str(path))[:8]}" for name, path in zip(names, folders, strict=True)]
    return dict(zip(names, request.images, strict=True))


def _title(path: Path, parts: int) -> str:
    return plain_title("_".join(part for part in path.parts[-parts:] if part != path.anchor)) or "capture"


def _without_duplicates(names: Sequence[str], sessions: Sequence[Session]) -> tuple[list[int], dict[str, str]]:
    """Return the positions of combinations that differ from all earlier ones, and the others with what they equal."""
    first: dict[str, int] = {}
    dropped: dict[str, str] = {}
    for idx, session in enumerate(sessions):
        earlier = first.setdefault(resolved_yaml(session.workflow, session.graph), idx)
        if earlier != idx:
            is_known = names[idx] in dropped or names[idx] == names[earlier]
            dropped[f"{names[idx]} (number {idx + 1})" if is_known else names[idx]] = names[earlier]
    return list(first.values()), dropped


def _check_seeds(request: VaryRequest, combinations: Sequence[Combination], *, is_repeatable: bool) -> None:
    if request.seeds < 1:
        raise UsageError(f"--seeds {request.seeds}: give a number from 1")
    if request.seeds == 1:
        return
    if is_repeatable:
        raise UsageError(
            f"--seeds {request.seeds}: no stage of this workflow draws random numbers, so that all seeds give the same "
            "result. Leave out --seeds"
        )
    targets = [target for each in (request.settings, *combinations) for target in each]
    if own := next((target for target in targets if target.endswith(f".{SEED_KEY}")), ""):
        raise UsageError(f"--seeds {request.seeds} and {own} both set the seed; leave out one of them")


def _check_metrics(request: VaryRequest, sessions: Sequence[Session]) -> None:
    """Check that metrics begin with the name of a stage or are those of a run; metrics are known only after a run."""
    stages = list(dict.fromkeys(stage for session in sessions for stage in session.workflow.stages))
    chosen = {name: f"--metric {name[:80]}" for name in request.metrics}
    if request.best:
        chosen[direction_of(request.best)[0]] = f"--best {request.best[:80]}"
    for name, place in chosen.items():
        if name in METRICS or any(name.startswith(f"{stage}.") for stage in stages):
            continue
        if "." not in name:
            raise UsageError(f"{place}: write STAGE.METRIC, or one of {', '.join(METRICS)}")
        stage = name.rpartition(".")[0]
        raise UsageError(f"{place}: no stage {stage[:80]!r}.{did_you_mean(stage, stages)}")


def _check_out(experiment: Experiment, session: Session) -> None:
    """Refuse a folder that holds something else than an experiment with the same workflow and settings."""
    out = experiment.request.out
    if not exists(out):
        return
    if not is_folder(out):
        raise UsageError(f"--out {out}: this is a file. Give a new or an empty folder")
    names = {path.name for path in children(out)}
    if not names - _OWN_FILES and VARY_JSON not in names:
        return
    if not is_file(out / VARY_JSON):
        what = "the output of a run" if RUN_JSON in names else shortened_list(sorted(names))
        raise UsageError(f"--out {out}: holds {what} and no {VARY_JSON}. Give a new or an empty folder")
    path = out / VARY_JSON
    try:
        found = json.loads(path.read_bytes())
        name, file = str(found["workflow"]["name"]), str(found["workflow"]["path"])
        is_known = found["schema"] == SCHEMA and isinstance(found["runs"], list)
        varied = [str(one) for one in found["varied"]]
        captures = {str(key): str(value) for key, value in found["captures"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UsageError(
            f"{path} is not the {VARY_JSON} of an experiment ({reason_of(error)}). Give another --out"
        ) from error
    if not is_known:
        raise UsageError(f"{path} was written by another version of pano_mvs. Give another --out")
    if (name, file) != (session.workflow.name, _path_of(session)):
        raise UsageError(f"--out {out}: holds an experiment with another workflow, {name} ({file}). Give another --out")
    # More settings, other values and more captures continue an experiment; results would be lost in these cases.
    if not set(varied) <= set(experiment.varied):
        before, now = (", ".join(one) or "nothing" for one in (varied, experiment.varied))
        raise UsageError(
            f"--out {out}: holds an experiment that varies {before}; this one varies {now}. Give another --out"
        )
    own = {resolved(one) for one in experiment.captures.values() if one is not None}
    if lost := [
        name for name, one in captures.items() if name not in experiment.captures and resolved(Path(one)) not in own
    ]:
        raise UsageError(
            f"--out {out}: holds an experiment over {shortened_list(lost)}, which this one leaves out. "
            "Give another --out"
        )


def _path_of(session: Session) -> str:
    return str(resolved(session.workflow.path)) if session.workflow.path is not None else ""


def _check_run_folder(session: Session) -> None:
    """Refuse the folder of a run with other settings or another capture."""
    try:
        summary = RunSummary.read(session.out)
    except InputError:
        return  # the run replaces what cannot be read
    if summary.merged is not None:
        return
    remedy = "Move or delete this folder, or give another --out"
    before, now = _settings(summary.workflow.overrides), _settings(session.workflow.overrides)
    differing = [target for target in {**before, **now} if before.get(target) != now.get(target)]
    if differing:
        target = differing[0]
        shown = [f"{target}={values[target]}" if target in values else f"no {target}" for values in (before, now)]
        raise UsageError(
            f"{session.out}: holds the run of another combination: it has {shown[0]}, and this one has {shown[1]}. "
            f"{remedy}"
        )
    for stage in summary.stages:
        entry, path = session.workflow.stages.get(stage.name), stage.params.get("path")
        if entry is None or entry.spec.list_items is None or not isinstance(path, str):
            continue
        own = [resolved(one) for one in files_of(entry.params).get("path", ())]
        if own and resolved(Path(path)) not in own:
            raise UsageError(f"{session.out}: holds a run over another capture, {path}. {remedy}")


def _settings(overrides: Sequence[str]) -> dict[str, str]:
    pairs = (override.partition("=") for override in overrides)
    return {target.strip(): value for target, _, value in pairs if target.strip() != "images.path"}


@dataclass(frozen=True, slots=True)
class PlannedUnits:
    """The units that a run would compute, without those that earlier runs of the experiment would compute."""

    run: PlannedRun
    units: int
    cached: int
    # "" if the number is exact, "up to" if results may turn out equal, "about" if further units depend on results
    bound: Literal["", "up to", "about"]

    @property
    def shown(self) -> str:
        """The number of units as text."""
        return f"{self.bound} {self.units}".strip() if self.units else "0"


def planned_units(experiment: Experiment) -> list[PlannedUnits]:
    """Return what each run would compute, each distinct unit counted once, in the first run that needs it.

    Units whose inputs are not known yet count as equal if all settings on which they depend are equal.
    """
    seen: set[tuple[str, str]] = set()
    found = []
    for run in experiment.runs:
        plan = plan_session(run.session)
        identities = _identities(run.session)
        expected = {one.stage: one.units for one in plan.forecasts}
        units, is_open, may_follow = 0, False, False
        for stage in plan.stages:
            own = {(identities[stage.name], item) for item in (*stage.run, *stage.may_run)}
            if stage.open and (whole := (identities[stage.name], "…")) not in seen:
                seen.add(whole)
                is_open = True
                units += max(0, (expected.get(stage.name) or 0) - len(own))
            units += len(own - seen)
            may_follow |= any((identities[stage.name], item) not in seen for item in stage.may_run)
            seen |= own
        bound: Literal["", "up to", "about"] = "about" if is_open else "up to" if may_follow else ""
        found.append(PlannedUnits(run, units, sum(len(stage.cached) for stage in plan.stages), bound))
    return found


def planned_json(experiment: Experiment, planned: Sequence[PlannedUnits]) -> dict[str, object]:
    """Return what each run would compute as a JSON value."""
    runs = [
        {
            "capture": each.run.capture,
            "combination": each.run.combination,
            "settings": {
                target: value.shown for target, value in experiment.combinations[each.run.combination].items()
            },
            "seed": each.run.seed,
            "out": str(each.run.session.out),
            "cached": each.cached,
            "units": each.units,
            "bound": each.bound,
        }
        for each in planned
    ]
    return {"runs": runs, "dropped": dict(experiment.dropped), "units": sum(each.units for each in planned)}


def _identities(session: Session) -> dict[str, str]:
    """Return a digest of each stage: of its settings, and of those of all stages that feed it."""
    found: dict[str, str] = {}
    for name in session.graph.order:
        entry, edges = session.workflow.stages[name], session.graph.edges[name]
        plain, paths = key_fields(entry.params)
        sources = files_of(entry.params) if entry.spec.list_items is not None else paths
        found[name] = digest_from_value(
            [
                entry.spec.name,
                plain,
                {key: [str(resolved(path)) for path in each] for key, each in sources.items()},
                entry.policy.rng_seed,
                {port: [found[edge.producer], edge.exploded] for port, edge in edges.items()},
            ]
        )
    return found


@dataclass(frozen=True, slots=True)
class Watch:
    """What is called while an experiment runs."""

    # number of a run, from 1, and the run, to a context within which it runs, and that receives its events
    around: Callable[[int, PlannedRun], AbstractContextManager[Progress]]
    ended: Callable[[VariedRun], None] = ignore


def run_experiment(
    experiment: Experiment,
    execution: Execution,
    watch: Watch,
    *,
    observers: Mapping[str, tuple[str, ...]],
    stop: bool = False,
) -> Variation:
    """Run an experiment, write vary.json, vary.csv and vary.html after each run, and return the results.

    Args:
        stop: whether the first run that does not finish is the last.

    Raises:
        StoreError: if the output folder cannot be written, or another experiment is running in it.
    """
    executor_size(execution.request)
    for name in observers:
        OBSERVERS.check(name)
    out = experiment.request.out
    done = [_not_run(run) for run in experiment.runs]
    make_folder(out)
    roots = [run.session.store_root for run in experiment.runs]
    with output_lock(out), dropping_after(roots):  # they share units
        write_text(out / OUTPUT_MARK, "")
        Origin("vary").write(out)
        _write(variation_of(experiment, done))
        for idx, run in enumerate(experiment.runs):
            try:
                with watch.around(idx + 1, run) as progress:
                    done[idx] = _ran(run, execution, observers=observers, progress=progress)
            except KeyboardInterrupt:
                done[idx] = replace(done[idx], exit_code=INTERRUPTED, stopped="interrupted")
                _write(variation_of(experiment, done))
                raise
            _write(variation_of(experiment, done))
            watch.ended(done[idx])
            if stop and not done[idx].is_finished:
                break
        return variation_of(experiment, done)


def _not_run(run: PlannedRun) -> VariedRun:
    return VariedRun(run.capture, run.combination, run.seed, run.session.out)


def _ran(
    run: PlannedRun, execution: Execution, *, observers: Mapping[str, tuple[str, ...]], progress: Progress
) -> VariedRun:
    """Run one combination over one capture; an error that ends it is in the result."""
    try:
        output = run_open_session(run.session, execution, observers=observers, progress=progress)
    except PanoMvsError as error:
        return replace(_not_run(run), exit_code=error.exit_code, stopped=str(error))
    summary = output.summary
    seconds = None if is_early(summary.exit_code) else _computing_seconds(run.session, summary)
    return replace(
        _not_run(run),
        exit_code=summary.exit_code,
        stopped=summary.stopped,
        seconds=summary.seconds,
        units=summary.units,
        metrics=metrics_of(summary, seconds),
    )


def _computing_seconds(session: Session, summary: RunSummary) -> float | None:
    """Return the computing time of all units of a run, as each was measured when it was computed; None if unknown."""
    own = str(resolved(session.out))
    try:
        store = Store(session.store_root, for_reading=True)
        keys = next((entry.keys for entry in store.runs.entries() if entry.out == own and not entry.pinned), {})
        records = [store.read_record(key) for units in keys.values() for key in units.values()]
    except StoreError:  # such as one that is damaged meanwhile
        return None
    found = [record.seconds for record in records if record is not None]
    return math.fsum(found) if found and len(found) == summary.units.run + summary.units.cached else None


def variation_of(experiment: Experiment, runs: Sequence[VariedRun]) -> Variation:
    """Return the results of an experiment, of which some runs may not have begun."""
    request, session = experiment.request, experiment.runs[0].session
    metrics = tuple(request.metrics) or default_metrics(runs)
    if request.best:
        metrics = tuple(dict.fromkeys([*metrics, direction_of(request.best)[0]]))
    combinations = _results(experiment, runs, metrics)
    several = list(experiment.captures) if len(experiment.captures) > 1 else []
    by_capture = {}
    for capture in several:
        own = _results(experiment, [run for run in runs if run.capture == capture], metrics)
        by_capture[capture] = CaptureResult(own, _best(experiment, own, captures=1))
    return Variation(
        out=request.out,
        workflow=session.workflow.name,
        workflow_path=_path_of(session),
        settings={target: value.text for target, value in request.settings.items()},
        varied=experiment.varied,
        captures={name: "" if path is None else str(path) for name, path in experiment.captures.items()},
        seeds=request.seeds,
        dropped=experiment.dropped,
        metrics=metrics,
        combinations=combinations,
        runs=tuple(runs),
        best=_best(experiment, combinations, captures=len(experiment.captures)),
        by_capture=by_capture,
    )


def _results(
    experiment: Experiment, runs: Sequence[VariedRun], metrics: Sequence[str]
) -> tuple[CombinationResult, ...]:
    """Return what some runs found, for each combination."""
    found = []
    for name, combination in experiment.combinations.items():
        own = [run for run in runs if run.combination == name]
        codes = [run.exit_code for run in own if run.exit_code is not None]
        settings = {target: value.shown for target, value in combination.items()}
        found.append(CombinationResult(name, settings, max(codes, default=None), averages_of(own, metrics)))
    return tuple(found)


def _best(experiment: Experiment, combinations: Sequence[CombinationResult], *, captures: int) -> Best | None:
    by = experiment.request.best
    if not by:
        return None
    return best_of(combinations, by, captures=captures, is_repeatable=experiment.is_repeatable)


def _write(variation: Variation) -> None:
    text = json.dumps(variation.to_json(), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(variation.out / VARY_JSON, f"{text}\n")
    write_text(variation.out / VARY_CSV, variation.to_csv())
    write_text(variation.out / VARY_HTML, vary_page(variation))


def combined(first: Sequence[Combination], second: Sequence[Combination]) -> list[Combination]:
    """Return each combination of one list with each of another; an empty list changes nothing.

    Raises:
        UsageError: if both set the same setting, or there are too many.
    """
    if not first or not second:
        return [*first, *second]
    for target, value in {target: value for each in first for target, value in each.items()}.items():
        other = next((each[target] for each in second if target in each), None)
        if other is not None:
            raise UsageError(f"{other.place}: {target} is set twice, also by {value.place}; leave out one of them")
    if len(first) * len(second) > MAX_COMBINATIONS:
        raise UsageError(
            f"{len(first) * len(second)} combinations are too many; at most {MAX_COMBINATIONS} are possible. "
            "Give fewer values"
        )
    return [{**one, **other} for one in first for other in second]


@names_arguments
def vary(
    workflow: str | Path,
    images: str | Path | Sequence[str | Path] = (),
    out: str | Path = "out/vary",
    *,
    grid: Mapping[str, Sequence[object]] | None = None,
    combinations: Sequence[Mapping[str, object]] | None = None,
    random: Mapping[str, object] | None = None,
    file: str | Path | None = None,
    settings: Mapping[str, object] | None = None,
    seeds: int = 1,
    metrics: str | Sequence[str] = (),
    best: str = "",
    cache: str | Path | None = None,
    executor: str | Execution = "",
    workers: int | None = None,
    until: str | Sequence[str] = (),
    stop: bool = False,
    progress: Progress | None = None,
    observers: Mapping[str, str | Sequence[str]] | None = None,
) -> Variation:
    """Run a workflow with each combination of settings, and return the results; cached results are reused.

    Runs that fail do not raise an error: their exit codes are in the results.

        found = pano_mvs.vary("quickstart", ["photos/hall", "photos/attic"], grid={"depth.planes": [64, 128, 192]})
        found["planes=64"].averages["completeness"].mean

    Args:
        workflow: name of a preset, or a workflow file.
        images: folders of panoramas; empty for that of the workflow.
        out: output folder: new, empty, or that of the same experiment, which is resumed.
        grid: `STAGE.PARAM` to its values; all combinations are run.
        combinations: each a mapping of `STAGE.PARAM` to its value.
        random: `{"count": N, "seed": S, "settings": {…}}`, with a list of values of each setting, or
            `{"min": …, "max": …, "log": True, "integer": True}`.
        file: a YAML file with `grid`, `list` or `random`.
        settings: settings of all runs, as in `pano_mvs.run`.
        seeds: number of seeds of each combination, from 1.
        metrics: STAGE.METRIC, or a metric of a run (`METRICS`); empty for the scores if there is truth, else for the
            default. One name may be given as a text, as for `until`.
        best: `METRIC[:max|min]` by which the best combination is chosen.
        cache: see `pano_mvs.run`, as for `executor`, `workers`, `until` and `observers`.
        stop: whether the first run that does not finish is the last.
        progress: called with each event of each run.

    Raises:
        WorkflowError: with every setting that cannot be used.
        UsageError: if another argument, the output folder or the folder of a run cannot be used.
        InputError: if a capture or the file cannot be read.
        StoreError: if the output folder cannot be written.
    """
    found: list[Combination] = []
    for key, value in (("grid", grid), ("list", combinations), ("random", random)):
        if value is not None:
            name = "combinations" if key == "list" else key
            root = replace(located({}, name), value={key: located(value, name)})
            found = combined(found, combinations_from_yaml(root))
    if file is not None:
        found = combined(found, combinations_from_file(Path(file)))
    fixed = (override.partition("=") for override in overrides_from_settings(settings or {}))
    given = [images] if isinstance(images, str | Path) else images
    request = VaryRequest(
        workflow=str(workflow),
        out=Path(out),
        images=tuple(Path(path) for path in given),
        settings={target: Value(text, f"--set {target}") for target, _, text in fixed},
        combinations=found,
        seeds=seeds,
        metrics=as_names(metrics),
        best=best,
        cache=None if cache is None else Path(cache),
        run_options=RunOptions(until=as_names(until)),
    )
    execution = executor if isinstance(executor, Execution) else Execution(executor)
    execution = replace(execution, workers=workers or execution.workers)

    @contextmanager
    def around(_number: int, _run: PlannedRun) -> Iterator[Progress]:
        yield progress or ignore

    wanted = {name: as_names(values) for name, values in (observers or {}).items()}
    return run_experiment(prepare(request), execution, Watch(around), observers=wanted, stop=stop)
