"""Captures in blocks: divided, run, watched and merged."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pano_mvs as pano_mvs_package
from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import InputError, PanoMvsError, RunStoppedError, UsageError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.cache.unit_times import CaptureSize
from pano_mvs.engine.executors.choose import EXECUTORS, ExecutorKind, ExecutorRequest, ExecutorSize
from pano_mvs.engine.executors.protocol import Executor
from pano_mvs.engine.running.events import Warned
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.engine.stages.params import key_fields
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.geometry import Rigid3, ray_grid, similarity_from_points
from pano_mvs.io.images.captures import list_pictures
from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.results.records import FailedUnit, StageOutcome
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.results.summary import RunSummary
from pano_mvs.session.planning import reference_times
from pano_mvs.session.progress import BlockStarted, Divided, Event, EventReader, RunFinished
from pano_mvs.session.running import run_session
from pano_mvs.session.session import Session
from pano_mvs.testing.room import capture_poses, default_room, range_along
from tests.algorithms.blocks.walked_blocks import some_world
from tests.algorithms.blocks.walked_blocks import walk as walked
from tests.cli.conftest import SMALL, Command, Outcome, deliverables, run_json
from tests.session.merging.written_blocks import write_block
from tests.synthetic.capture_files import write_capture

BLOCKS = ("--block-size", "12", "--block-overlap", "5")
"""26 images in three blocks."""


@dataclass
class Runs:
    """Stands in for runs: writes what the run of a block would.

    Attributes:
        seen: block to the images in its folder, in the order of the runs.
        ends: block to the error with which its run ends.
        codes: block to the exit code of its run, if it is not 0.
        registered: block to the numbers of its images that have a pose, if it is not all of them.
        rough: block to the stages of the run that solved its rough poses.
        rough_ends: block to the error with which that run ends.
        rough_registered: as `registered`, for these runs.
        cameras: of the walk; None for a circle.
    """

    seen: dict[str, list[str]] = field(default_factory=dict)
    ends: dict[str, BaseException] = field(default_factory=dict)
    codes: dict[str, int] = field(default_factory=dict)
    registered: dict[str, list[int]] = field(default_factory=dict)
    rough: dict[str, tuple[str, ...]] = field(default_factory=dict)
    rough_ends: dict[str, BaseException] = field(default_factory=dict)
    rough_registered: dict[str, list[int]] = field(default_factory=dict)
    cameras: dict[str, Rigid3] | None = None

    def __call__(self, session: Session, *_: Any) -> RunOutput:
        Store(session.store_root)
        params: Any = session.workflow.stages["images"].params
        block, out = session.out.name, session.out
        images = sorted(path.name for path in params.path.iterdir())
        if out.parent.name == "rough":
            self.rough[block] = session.run_options.until
            if block in self.rough_ends:
                raise self.rough_ends[block]
            shutil.rmtree(out, ignore_errors=True)
            chosen = self.rough_registered.get(block) or [int(name[:3]) for name in images]
            write_block(out, chosen, some_world(int(block[-1])), cameras=self.cameras)
            return load(out)
        self.seen[block] = images
        if block in self.ends:
            raise self.ends[block]
        shutil.rmtree(out, ignore_errors=True)
        chosen = self.registered.get(block) or [int(name[:3]) for name in self.seen[block]]
        write_block(out, chosen, some_world(int(block[-1])), cameras=self.cameras)
        stage = StageOutcome(name="images", use="source.folder", params={"path": str(params.path)})
        code = self.codes.get(block, 0)
        update = {"stages": (stage,), "exit_code": code, "stopped": "too few matches" if code == 4 else ""}
        RunSummary.read(out).model_copy(update=update).write(out)
        return load(out)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Runs:
    found = Runs()
    monkeypatch.setattr("pano_mvs.cli.run.command.run_session", found)
    monkeypatch.setattr("pano_mvs.session.captures.run_session", found)
    return found


@pytest.fixture
def small_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine on which at most 15 of the images of `walk`, of one pixel each, are solved within memory."""
    params = Registry.installed().stages["poses.scaled_translation"].params_type()
    unit = reference_times().expected_unit(
        "poses.scaled_translation",
        CaptureSize(15, 1.0),
        settings=digest_from_value(key_fields(params)[0]),
        threads=1,
        whole=True,
    )
    assert unit is not None
    limit = "pano_mvs.engine.executors.choose.total_memory_bytes"
    monkeypatch.setattr(limit, lambda: int(12 * unit.stored_bytes) + 1)


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """The folder of a walk of 26 images, which nothing reads."""
    folder = tmp_path / "walk"
    folder.mkdir()
    for number in range(26):
        (folder / f"{number:03d}.png").write_bytes(b"x")
    return folder


def test_blocks_run_one_after_the_other_and_are_merged(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS)
    assert result.code == 0, result.text
    assert [*runs.seen] == ["block_1", "block_2", "block_3"]
    names = [f"{number:03d}.png" for number in range(26)]
    assert runs.seen["block_1"] == names[:12]
    assert runs.seen["block_3"] == names[14:]
    assert "block 2 of 3: 12 images, 007.png to 018.png, in out/blocks/block_2" in result.flat
    assert "merging 3 blocks into out" in result.flat
    assert "26 cameras," in result.text
    assert result.text.endswith("next:\n  pano-mvs view out\n")
    assert read_poses(Path("out")).names == tuple(names)
    assert load(Path("out")).summary.source_folder == walk


def test_events_name_the_blocks_and_the_end(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    command = ("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS)
    assert pano_mvs(*command).code == 0
    *blocks, end = [event for _, event in EventReader(Path("out/blocks")).read()[1]]
    assert blocks == [
        BlockStarted(f"{folder}block_{number}", number, 3, images=12, images_left=36 - 12 * number)
        for folder in ("rough/", "")
        for number in (1, 2, 3)
    ]
    assert isinstance(end, RunFinished)
    assert end.exit_code == 0
    runs.ends["block_2"] = KeyboardInterrupt()
    assert pano_mvs(*command).code == 130
    *blocks, end = [event for _, event in EventReader(Path("out/blocks")).read()[1]]
    assert len(blocks) == 2
    assert isinstance(end, RunFinished)
    assert end.exit_code == 130
    result = pano_mvs("watch", "out")
    assert result.code == 130
    assert "block 2 of 3, 12 images" in result.flat


@pytest.mark.slow
def test_the_same_command_resumes_and_replaces_the_links(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    command = ("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS)
    runs.ends["block_2"] = RunStoppedError("the disk is full")
    result = pano_mvs(*command)
    assert result.code == RunStoppedError.exit_code
    assert [*runs.seen] == ["block_1", "block_2"]
    assert "error: block_2: the disk is full" in result.flat
    assert "give the same command again" in result.flat
    alone = result.flat.partition("This block alone: ")[2]
    assert alone == "pano-mvs run quickstart --images out/blocks/images/block_2 --out out/blocks/block_2"
    assert not Path("out/run.json").exists()
    runs.ends.clear()
    (walk / "025.png").unlink()
    assert pano_mvs(*command).code == 0
    assert runs.seen["block_3"][-1] == "024.png"
    assert len(read_poses(Path("out")).names) == 25
    assert pano_mvs(*command).code == 0, "a merged folder is replaced"


@pytest.mark.parametrize("end", [RunStoppedError("the disk is full"), None])
def test_with_keep_going_the_other_blocks_run(
    end: PanoMvsError | None, pano_mvs: Command, runs: Runs, walk: Path
) -> None:
    if end is None:
        runs.codes["block_1"] = 4
    else:
        runs.ends["block_1"] = end
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS, "--keep-going")
    assert result.code == 4
    assert f"error: block_1: {end or 'too few matches'}" in result.flat
    assert [*runs.seen] == ["block_1", "block_2", "block_3"]
    assert "not merged, because block_1 did not finish" in result.flat
    assert not Path("out/run.json").exists()


def test_failed_items_of_a_block_are_in_the_exit_code(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    runs.codes["block_2"] = 3
    assert pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS).code == 3
    assert run_json(Path("out"))["exit_code"] == 0


def test_a_failed_merge_is_not_hidden_by_failed_items(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    """Exit code 3 says that there are results: the larger of 2 and 3 said so without any."""
    runs.codes["block_1"] = 3
    runs.registered["block_3"] = list(range(20, 26))
    command = ("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS, "--keep-going")
    result = pano_mvs(*command)
    assert "out/blocks/block_3: shares 0 registered cameras" in result.flat
    assert result.code == 2
    runs.ends["block_3"] = InputError("no images")
    assert pano_mvs(*command).code == 2


def test_a_run_without_blocks_does_not_replace_merged_results(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    assert pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS).code == 0
    written = Path("out/run.json").read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pano_mvs.cli.run.command.run_session", run_session)
        result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out", "--block-size", "0")
    assert result.code == 2
    assert "--out out: holds results that were merged from 3 blocks" in result.flat
    assert "Leave out --block-size 0" in result.flat
    assert Path("out/run.json").read_bytes() == written


STOPPED = RunStoppedError("the disk is full")
REASON = (
    "26 panoramas are run in 3 blocks of at most 11, since all at once, stage sift_poses would take about 8 B of 5 B "
    "of memory; --block-size 0 forbids it"
)


@pytest.mark.usefixtures("small_memory")
def test_a_capture_that_memory_does_not_hold_is_divided(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out")
    assert result.code == 0, result.text
    assert result.flat.startswith(REASON)
    assert [*runs.seen] == ["block_1", "block_2", "block_3"]
    assert len(load(Path("out")).summary.poses.registered) == 26
    first = EventReader(Path("out/blocks")).read()[1][0][1]
    assert first == Divided(REASON)
    assert runs.rough == dict.fromkeys(runs.seen, ("sift_poses",))


@pytest.mark.usefixtures("small_memory")
def test_plan_and_dry_run_say_how_a_capture_is_divided(pano_mvs: Command, walk: Path) -> None:
    for command in (("plan",), ("run", "--dry-run")):
        result = pano_mvs(*command, "quickstart", "--images", walk, "--out", "out")
        assert result.code == 0, result.text
        assert result.flat.startswith(REASON)
        assert "block 3 of 3: 11 images, 015.png to 025.png, in out/blocks/block_3" in result.flat
    assert not Path("out").exists()


@pytest.mark.usefixtures("small_memory")
def test_block_size_0_runs_all_images_at_once(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    runs.ends["out"] = STOPPED
    pano_mvs("run", "quickstart", "--images", walk, "--out", "out", "--block-size", "0")
    assert {block: len(names) for block, names in runs.seen.items()} == {"out": 26}
    assert not runs.rough


def test_a_capture_that_memory_holds_is_not_divided(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    runs.ends["out"] = STOPPED
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out")
    assert result.text == "error: the disk is full\n"
    assert [*runs.seen] == ["out"]


def test_the_division_of_an_earlier_run_is_kept(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    """Memory differs between machines, and forecasts learn: another division would compute everything again."""
    runs.ends["block_2"] = RunStoppedError("the disk is full")
    pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS)
    runs.ends.clear()
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out")
    assert result.code == 0, result.text
    assert "out holds blocks of at most 12 images, in which this run continues" in result.flat
    assert "block 3 of 3" in result.flat


@pytest.mark.usefixtures("small_memory")
@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--refresh", "depth:001.png"), "cannot be divided into blocks: --only and"),
        (("--out", "mine"), "cannot be divided into blocks: --out mine: the folder holds something else"),
    ],
)
def test_a_capture_that_cannot_be_divided_is_run_with_a_warning(
    options: tuple[str, str], reason: str, pano_mvs: Command, runs: Runs, walk: Path
) -> None:
    Path("mine").mkdir()
    Path("mine/notes.txt").touch()
    runs.ends = {"quickstart": STOPPED, "mine": STOPPED}
    result = pano_mvs("run", "quickstart", "--images", walk, *options)
    assert result.flat.startswith("warning: all at once, stage sift_poses would take about")
    assert reason in result.flat
    assert len(runs.seen) == 1


def test_even_small_blocks_may_not_fit(
    pano_mvs: Command, runs: Runs, walk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pano_mvs.engine.executors.choose.total_memory_bytes", lambda: 1)
    runs.ends["out"] = STOPPED
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out")
    assert "even that of blocks of 7 images would not do" in result.flat
    assert [*runs.seen] == ["out"]


@pytest.mark.usefixtures("small_memory")
@pytest.mark.parametrize("memory_bytes", [0, 64_000_000_000])
def test_the_memory_of_workers_counts(
    pano_mvs: Command, runs: Runs, walk: Path, memory_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is that of a job, or unknown, as with the workers of a scheduler."""
    kind = ExecutorKind(_not_started, size=lambda _request: ExecutorSize(2, 1, memory_bytes))
    monkeypatch.setitem(EXECUTORS._builtin, "elsewhere", kind)
    runs.ends["out"] = STOPPED
    command = ("run", "quickstart", "--images", walk, "--out", "out", "--executor", "elsewhere")
    assert "blocks" not in pano_mvs(*command).text
    assert [*runs.seen] == ["out"]


def _not_started(_store: Store, _request: ExecutorRequest) -> Executor:
    raise AssertionError("the run itself is replaced")


@pytest.mark.slow
def test_events_of_all_blocks_are_printed(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS, "--json")
    assert result.code == 0, result.text
    events = [json.loads(line) for line in result.text.splitlines()]
    assert [event["event"] for event in events] == [*["block_started"] * 6, "run_finished"]
    runs.codes["block_2"] = 3
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS, "--json")
    assert result.code == json.loads(result.text.splitlines()[-1])["exit_code"] == 3


@pytest.mark.slow
@pytest.mark.usefixtures("small_memory")
def test_a_run_from_python_is_divided_as_well(runs: Runs, walk: Path, tmp_path: Path) -> None:
    events: list[Event] = []
    output = pano_mvs_package.run("quickstart", walk, tmp_path / "out", progress=events.append)
    assert output.out == tmp_path / "out"
    assert output.summary.merged is not None
    assert events[0] == Divided(REASON)
    runs.codes["block_2"] = 4
    stopped = pano_mvs_package.run("quickstart", walk, tmp_path / "other", block_size=14, block_overlap=4)
    assert stopped.summary.stopped == "too few matches"
    assert stopped.out.name == "block_2"
    runs.ends["out"] = STOPPED
    (tmp_path / "mine/out").mkdir(parents=True)
    (tmp_path / "mine/out/notes.txt").touch()
    warnings: list[Event] = []
    with pytest.raises(RunStoppedError, match="the disk is full"):
        pano_mvs_package.run("quickstart", walk, tmp_path / "mine/out", progress=warnings.append)
    assert isinstance(warnings[0], Warned)
    with pytest.raises(UsageError, match=r"block_size=5: a block needs at least 7 images"):
        pano_mvs_package.run("quickstart", walk, block_size=5)


@pytest.mark.slow
def test_blocks_overlap_where_the_path_returns(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    """The path goes to and fro, so the last images are beside the first."""
    centers = [(float(min(idx, 29 - idx)), 0.0, 0.3 * (idx > 14)) for idx in range(30)]
    rotations = [camera.rotation for camera in walked(30).values()]
    runs.cameras = {
        f"{idx:03d}.png": Rigid3.from_center(rotation, center)
        for idx, (rotation, center) in enumerate(zip(rotations, centers, strict=True))
    }
    command = ("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS)
    assert pano_mvs(*command).code == 0
    assert sum(int(name[:3]) >= 14 for name in runs.seen["block_1"]) >= 3
    assert sum(int(name[:3]) < 12 for name in runs.seen["block_3"]) >= 3
    rough, runs.rough = runs.rough, {}
    assert len(rough) == 3
    seen = dict(runs.seen)
    for again in (command, command[:-4]):
        assert pano_mvs(*again).code == 0
        assert not runs.rough, "rough poses are solved once"
        assert runs.seen == seen


def test_without_rough_poses_the_blocks_are_as_they_were(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    """A later stage may correct what does not fit; the last merge says so otherwise."""
    runs.rough_registered["block_3"] = list(range(20, 26))
    assert pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS).code == 0
    assert [len(names) for names in runs.seen.values()] == [12, 12, 12]


def test_a_block_without_rough_poses_ends_the_command(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    runs.rough_ends["block_2"] = STOPPED
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS)
    assert result.code == 4
    assert "error: rough/block_2: the disk is full" in result.flat
    assert not runs.seen


def test_an_interrupt_ends_the_command(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    runs.ends["block_2"] = KeyboardInterrupt()
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS, "--keep-going")
    assert result.code == 130
    assert [*runs.seen] == ["block_1", "block_2"]
    assert "To continue, run the same command again" in result.flat


def test_blocks_that_cannot_be_merged_are_named(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    runs.registered["block_3"] = list(range(20, 26))
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS)
    assert result.code == 2
    assert "out/blocks/block_3: shares 0 registered cameras" in result.flat
    assert "All blocks have run; their results are in out/blocks" in result.flat


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (
            ("--block-size", "0", "--block-overlap", "5"),
            "--block-overlap: only blocks have this. Give --block-size N as well",
        ),
        (("--block-loop", "--block-poses", "x"), "--block-loop, --block-poses: only blocks have this"),
        (("--block-size", "5"), "a block needs at least 7 images"),
        (("--block-size", "12", "--block-overlap", "6"), "must be less than half of the size of a block, 12"),
        (("--block-size", "26"), "its 26 images fit into one block of 26. Run them without blocks"),
        ((*BLOCKS, "--json", "--dry-run"), "--dry-run prints a table, not events: leave out --json"),
        ((*BLOCKS, "--only", "depth:001.png"), "--images out/blocks/images/block_1 --out out/blocks/block_1"),
        ((*BLOCKS, "--refresh", "depth:001.png"), "name units of one run"),
        ((*BLOCKS, "--until", "features"), "--block-size --until features: blocks are merged by their poses"),
    ],
)
def test_options_that_do_not_fit_together_are_refused(
    options: tuple[str, ...], reason: str, pano_mvs: Command, runs: Runs, walk: Path
) -> None:
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *options)
    assert result.code == 2
    assert reason in result.flat
    assert not Path("out").exists()
    assert runs.seen == {}


def test_another_source_than_a_folder_is_not_divided(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    assert pano_mvs("plugin", "new", "source", "film").code == 0
    Path("film.yaml").write_text(
        "pano_mvs: 1\nextends: quickstart\nplugins: [film.py]\nstages: {images: {use: source.film}}\n"
    )
    result = pano_mvs("run", "film.yaml", "--images", walk, "--out", "out", *BLOCKS)
    assert result.code == 2
    assert "this workflow has source.film. Extract the frames" in result.flat
    assert not Path("out").exists()
    assert runs.seen == {}


def test_folders_in_use_are_refused_before_anything_runs(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    command = ("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS)
    Path("out/blocks").mkdir(parents=True)
    with output_lock(Path("out/blocks")):
        result = pano_mvs(*command)
    assert result.code == 4
    assert "another run is writing into out/blocks" in result.flat
    Path("out/mine.txt").write_text("x")
    result = pano_mvs(*command)
    assert result.code == 2
    assert "--out out: the folder holds something else" in result.flat
    assert runs.seen == {}


def test_masks_in_the_folder_do_not_count_as_images(pano_mvs: Command, runs: Runs, walk: Path) -> None:
    (walk / "own").mkdir()
    (walk / "own/000.png.png").write_bytes(b"x")
    options = ("--set", f"images.masks={walk / 'own'}", *BLOCKS)
    assert pano_mvs("run", "quickstart", "--images", walk, "--out", walk / "out", *options).code == 0
    assert sorted({name for names in runs.seen.values() for name in names}) == [f"{n:03d}.png" for n in range(26)]
    assert pano_mvs("run", "quickstart", "--images", walk, "--out", walk / "out", *options).code == 0


def test_a_dry_run_shows_the_blocks_and_writes_nothing(
    pano_mvs: Command, walk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned = []

    def plan(session: Session, *_: Any, **__: Any) -> None:
        params: Any = session.workflow.stages["images"].params
        planned.append((session.out.as_posix(), len(list_pictures(params.path))))

    monkeypatch.setattr("pano_mvs.cli.blocks_command.show_dry_run", plan)
    result = pano_mvs("run", "quickstart", "--images", walk, "--out", "out", *BLOCKS, "--dry-run")
    assert result.code == 0, result.text
    assert "block 3 of 3: 12 images, 014.png to 025.png, in out/blocks/block_3" in result.flat
    assert planned == [(f"out/blocks/block_{number}", 12) for number in (1, 2, 3)]
    assert not Path("out").exists()


@pytest.mark.slow
def test_a_rendered_capture_in_blocks_is_one_model_and_resumes_from_the_cache(
    pano_mvs: Command, tmp_path: Path
) -> None:
    cameras = capture_poses(8, spread=0.4)
    write_capture(tmp_path / "capture", default_room(), cameras, size_hw=(48, 96))
    command = (
        "run", "known_poses", "--images", tmp_path / "capture/images", "--out", "out", "--cache", "cache",
        "--set", f"poses.path={tmp_path / 'capture/truth/poses.json'}", "--set", "depth.planes=16",
        "--set", "features.max_keypoints=400", "--executor", "serial", "--block-size", "7", "--block-overlap", "3",
        "--set", "views.sources=2", "--set", "depth.near=0.4", "--set", "depth.far=8",
    )  # fmt: skip

    def checked(result: Outcome) -> dict[str, bytes]:
        assert result.code in (0, 3), result.text
        return deliverables(Path("out"))

    written = checked(pano_mvs(*command))
    poses = read_poses(Path("out"))
    assert len(poses.names) == 8
    centers = np.array([camera.center for camera in cameras])
    room_from_merged = similarity_from_points(poses.centers, centers)
    np.testing.assert_allclose(room_from_merged.apply(poses.centers), centers, atol=1e-3)
    shutil.rmtree("out/blocks/block_2")
    again = pano_mvs(*command)
    assert checked(again) == written
    assert again.text.count("nothing to compute") == 2
    result = pano_mvs("report", "out")
    assert result.code == 0, result.text
    assert "panoramas are not in" not in result.text


def test_merge_prints_the_agreement_and_what_it_wrote(pano_mvs: Command, tmp_path: Path) -> None:
    write_block(tmp_path / "one", list(range(12)), some_world(1))
    write_block(tmp_path / "two", list(range(7, 20)), some_world(2))
    result = pano_mvs("merge", tmp_path / "one", tmp_path / "two", "--out", tmp_path / "both")
    assert result.code == 0, result.text
    words = result.text.split()
    assert "20 cameras," in result.text
    assert "20 range maps, cloud of 3,000 points" in " ".join(words)
    assert str(tmp_path / "both" / "report.html") in "".join(words)


def test_merge_names_an_image_that_it_lacks(pano_mvs: Command, tmp_path: Path) -> None:
    write_block(tmp_path / "one", list(range(12)), some_world(1))
    write_block(tmp_path / "two", list(range(7, 20)), some_world(2))
    lost = FailedUnit(stage="images", item="020.png", cause="it is damaged")
    RunSummary.read(tmp_path / "two").model_copy(update={"failures": (lost,)}).write(tmp_path / "two")
    result = pano_mvs("merge", tmp_path / "one", tmp_path / "two", "--out", tmp_path / "both")
    assert result.code == 3
    assert "1 image without a pose, such as 020.png: it is damaged" in result.flat
    assert "1 of 21 panoramas has no pose" in (tmp_path / "both/report.html").read_text(encoding="utf-8")


@pytest.fixture
def merged(pano_mvs: Command, tmp_path: Path) -> Path:
    """Two merged blocks."""
    write_block(tmp_path / "one", list(range(12)), some_world(1))
    write_block(tmp_path / "two", list(range(7, 20)), some_world(2))
    assert pano_mvs("merge", tmp_path / "one", tmp_path / "two", "--out", tmp_path / "both").code == 0
    return tmp_path / "both"


def test_the_report_of_a_merge_is_written_again_without_a_cache(pano_mvs: Command, merged: Path) -> None:
    before = (merged / "report.html").read_text(encoding="utf-8")
    (merged / "report.html").unlink()
    result = pano_mvs("report", merged)
    assert result.code == 0, result.text
    assert (merged / "report.html").read_text(encoding="utf-8") == before


def test_a_merge_is_put_into_metres_by_a_block(pano_mvs: Command, merged: Path) -> None:
    for measured in ((), ("000.png", "005.png", "3m"), ("--camera-height", "1.6m")):
        result = pano_mvs("scale", merged, *measured)
        assert result.code == 2
        block = merged.parent
        assert f"pano-mvs scale {block / 'one'} A B 3.42m" in result.flat
        assert f"pano-mvs merge {block / 'one'} {block / 'two'} --out {merged}" in result.flat


def test_a_merge_in_metres_is_corrected_by_its_blocks(pano_mvs: Command, merged: Path) -> None:
    summary = RunSummary.read(merged)
    metric = summary.poses.model_copy(update={"metric": True, "scale": "metres, by GPS"})
    summary.model_copy(update={"poses": metric}).write(merged)
    result = pano_mvs("scale", merged)
    assert result.code == 2
    assert "is in metres (metres, by GPS). To correct the lengths, correct each block" in result.flat


def test_the_status_of_merged_blocks_is_that_of_each(pano_mvs: Command, merged: Path) -> None:
    result = pano_mvs("status", merged)
    assert result.code == 0, result.text
    assert result.flat.startswith("merged ")
    assert "from 2 blocks: exit code 0" in result.flat
    for name in ("one", "two"):
        assert f"block {merged.parent / name}: latest run" in result.flat


def test_a_command_that_needs_a_workflow_names_the_blocks(pano_mvs: Command, merged: Path) -> None:
    result = pano_mvs("inspect", merged, "000.png", "1", "1")
    assert result.code == 2
    assert f"is merged from blocks, each of which is a run of its own. Give a block: {merged.parent}" in result.flat


def test_split_prints_the_commands_that_follow(pano_mvs: Command, tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    for number in range(20):
        (tmp_path / f"walk/{number}.png").write_bytes(b"x")
    folder = tmp_path / "my blocks"
    result = pano_mvs("split", tmp_path / "walk", "--out", folder, "--size", "12", "--overlap", "4")
    assert result.code == 0, result.text
    assert f"--images '{folder}/block_2' --out out/block_2" in result.text
    assert "--out out/block_2" in result.text
    assert "then: pano-mvs merge out/block_1 out/block_2 --out out/merged" in " ".join(result.text.split())
    assert (folder / "block_2/19.png").read_bytes() == b"x"


@pytest.mark.slow
def test_blocks_of_a_rendered_room_become_one_model_of_it(pano_mvs: Command, tmp_path: Path) -> None:
    room, cameras = default_room(), capture_poses(8, spread=0.4)
    write_capture(tmp_path / "capture", room, cameras, size_hw=(96, 192))
    result = pano_mvs(
        "split", tmp_path / "capture/images", "--out", tmp_path / "blocks", "--size", "7", "--overlap", "3"
    )
    assert result.code == 0, result.text
    for number in (1, 2):
        block = pano_mvs(
            "run", "quickstart", "--images", tmp_path / f"blocks/block_{number}", "--out", f"out/{number}",
            "--cache", tmp_path / "cache", *SMALL, "--set", "weak.learned=never", "--set", "previews=null",
            "--set", "depth.near=1", "--set", "depth.far=40",
        )  # fmt: skip
        assert block.code in (0, 3), block.text
    result = pano_mvs("merge", "out/1", "out/2", "--out", "out/merged")
    assert result.code == 0, result.text
    poses = read_poses(Path("out/merged"))
    assert len(poses.names) == 8
    centers = np.array([camera.center for camera in cameras])
    room_from_merged = similarity_from_points(poses.centers, centers)
    offsets = np.linalg.norm(room_from_merged.apply(poses.centers) - centers, axis=1)
    assert offsets.max() < 0.01
    ranges = read_range_tiff(Path("out/merged/range/007.tiff")) * room_from_merged.scale
    rays = cameras[7].rotation.T @ ray_grid(ranges.shape).reshape(-1, 3).T
    errors = np.abs(ranges.ravel() / range_along(room, cameras[7].center, rays.T) - 1)
    assert np.nanmedian(errors) < 0.025
    cloud = read_ply(Path("out/merged/cloud.ply"))
    parts = [len(read_ply(Path(f"out/{number}/cloud.ply"))) for number in (1, 2)]
    assert max(parts) / 2 < len(cloud) < sum(parts)
