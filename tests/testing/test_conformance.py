"""The contract tests catch stages that break the contract, each by its own test."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from pano_mvs.api import (
    Axis,
    Context,
    CostWindow,
    Each,
    Features,
    FilePart,
    Files,
    InputError,
    Names,
    One,
    Panorama,
    Params,
    Poses,
    RangeMap,
    Record,
    UsageError,
    stage,
    write_png,
)
from pano_mvs.core.errors import ContractError
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.testing.conformance import backend_contract_tests, check_stage, cost_contract_tests, stage_contract_tests
from pano_mvs.testing.tiny_capture import Variant, tiny_capture

DRAWS = np.random.default_rng()


class Loose(Params):
    """Settings that can be changed, and have no description."""

    model_config = ConfigDict(frozen=False, extra="ignore")

    bare: int = 1


class Doubled(Params):
    """A setting that is another one after JSON."""

    places: set[int] = Field(default={1}, description="some")
    doubled: float = Field(default=1.0, description="twice", validate_default=True)

    def model_dump_json(self, **options: Any) -> str:
        return super().model_dump_json(**options).replace("1.0", "2.0")


def bad(function: Callable[..., Any]) -> Callable[..., Any]:
    return stage(f"bad.{function.__name__}")(function)


@bad
def undocumented(x: Each[RangeMap]) -> RangeMap:
    return x


@bad
def undescribed(x: Each[RangeMap], params: Loose) -> RangeMap:
    """Settings without a description, which can be changed."""
    return x


@bad
def changed_by_json(x: Each[RangeMap], params: Doubled) -> RangeMap:
    """Settings that JSON changes."""
    return x


@stage("misnamed")
def misnamed(x: Each[RangeMap]) -> RangeMap:
    """A name without a kind."""
    return x


@bad
def another_kind(x: Each[RangeMap]) -> Features:
    """Not what it declares."""
    return cast(Features, x)


@bad
def unsound(x: Each[RangeMap]) -> RangeMap:
    """A record that is none."""
    return replace(x, confidence=np.full_like(x.confidence, 7))


@bad
def scribbles(x: Each[RangeMap]) -> RangeMap:
    """Its input is written to."""
    x.range[0] = 1.0
    return x


@bad
def forces(x: Each[RangeMap]) -> RangeMap:
    """Its input is written to by force."""
    copy = replace(x, range=x.range.copy(), confidence=x.confidence.copy())
    object.__setattr__(x, "range", x.range + 1)
    return copy


@bad
def elsewhere(x: Each[RangeMap]) -> Files:
    """A file that is not in the scratch folder."""
    return Files({"{item}.txt": Path(__file__)})


@bad
def never_written(x: Each[RangeMap], ctx: Context) -> Files:
    """A file that is not there."""
    return Files({"{item}.txt": ctx.scratch / "a.txt"})


@bad
def draws(x: Each[RangeMap]) -> RangeMap:
    """Random numbers of its own."""
    return replace(x, range=(x.range * DRAWS.uniform(1, 1.001)).astype(np.float32))


@bad
def counts_threads(x: Each[RangeMap], ctx: Context) -> RangeMap:
    """A result that depends on the number of threads."""
    return replace(x, range=(x.range * ctx.threads).astype(np.float32))


@bad
def reports_at_random(x: Each[RangeMap], ctx: Context) -> RangeMap:
    """A figure that is another one every time."""
    ctx.metric("luck", DRAWS.random())
    return x


@bad
def needs_room(x: Each[RangeMap]) -> RangeMap:
    """An index that small pictures do not have."""
    assert x.range[20, 40] != 0
    return x


@bad
def needs_something(x: Each[RangeMap]) -> RangeMap:
    """A median of nothing."""
    level = np.array(sorted(x.range[x.valid]))[0]
    return replace(x, range=np.maximum(x.range, level))


@bad
def needs_the_optional(x: Each[RangeMap], image: Each[Panorama] | None) -> RangeMap:
    """An optional input that it cannot do without."""
    assert image is not None
    return x


@bad
def fills_masked(x: Each[RangeMap], image: Each[Panorama]) -> RangeMap:
    """A range for every pixel."""
    ranges = np.where(x.valid, x.range, np.float32(1))
    return RangeMap(ranges, np.maximum(x.confidence, np.uint8(1)))


@bad
def unmasks(image: Each[Panorama], ctx: Context) -> Panorama:
    """A mask that forgets the one that is there."""
    path = ctx.scratch / "mask.png"
    write_png(path, np.full(image.size_hw, 255, np.uint8))
    return replace(image, mask_file=FilePart(path))


@bad
def sees_masked(image: Each[Panorama]) -> Features:
    """A key point in every column, just above the nadir."""
    height, width = image.size_hw
    angles = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    low = np.radians(-80)
    bearings = np.stack([np.cos(low) * np.sin(angles), np.full(width, -np.sin(low)), np.cos(low) * np.cos(angles)], -1)
    ones, colors = np.ones(width, np.float32), np.zeros((width, 3), np.uint8)
    return Features(bearings, np.ones((width, 2), np.float32), ones, ones, colors, "l2", (height, width))


@bad
def looks_behind_the_mask(x: Each[RangeMap], image: Each[Panorama]) -> RangeMap:
    """Ranges by the brightness of the file, tripod and all."""
    brightness = image.load_unmasked().mean() / 128
    return replace(x, range=(x.range * brightness).astype(np.float32))


@bad
def stops_at_the_seam(x: Each[RangeMap]) -> RangeMap:
    """A border where there is none."""
    keep: NDArray[np.bool_] = np.ones(x.range.shape, np.bool_)
    keep[:, : keep.shape[1] // 8] = False
    return RangeMap(np.where(keep & x.valid, x.range, np.nan).astype(np.float32), np.where(keep, x.confidence, 0))


@stage("bad.changes_libraries")
def changes_libraries(x: Each[RangeMap]) -> RangeMap:
    """OpenCV computes otherwise afterwards."""
    cv2.setUseOptimized(not cv2.useOptimized())
    return x


@stage("bad.leaves_a_thread")
def leaves_a_thread(x: Each[RangeMap]) -> RangeMap:
    """Something goes on afterwards."""
    threading.Thread(target=time.sleep, args=(1.0,), daemon=True).start()
    return x


def exporter(function: Callable[[Path, Poses, tuple[str, ...]], None]) -> Callable[..., Any]:
    @stage(f"bad.{function.__name__}")
    def export(poses: One[Poses], images: Names[Panorama], ctx: Context) -> Files:
        """Write something about the poses, in the world."""
        function(ctx.scratch, poses, tuple(images))
        return Files({path.name: path for path in sorted(ctx.scratch.iterdir())})

    export.__name__ = function.__name__
    return export


@exporter
def beside(scratch: Path, poses: Poses, images: tuple[str, ...]) -> None:
    Path("beside.txt").write_text("a file in the current folder")


@exporter
def unquoted(scratch: Path, poses: Poses, images: tuple[str, ...]) -> None:
    (scratch / "poses.json").write_text(f'["{poses.names[0]}"]')


@exporter
def flattened(scratch: Path, poses: Poses, images: tuple[str, ...]) -> None:
    for name in poses.names:
        (scratch / f"{name.partition('/')[0]}.bin").touch()


@exporter
def unregistered(scratch: Path, poses: Poses, images: tuple[str, ...]) -> None:
    (scratch / "images.bin").write_text("".join(images))


@exporter
def first_group(scratch: Path, poses: Poses, images: tuple[str, ...]) -> None:
    split_groups(poses)[0].centers.tofile(scratch / "centers.bin")


@exporter
def mixed_groups(scratch: Path, poses: Poses, images: tuple[str, ...]) -> None:
    poses.centers.tofile(scratch / "centers.bin")


@stage("bad.no_frame")
def no_frame(poses: One[Poses], ctx: Context) -> Files:
    """Write nothing."""
    return Files({})


BROKEN_BY = {
    undocumented: "declares itself",
    misnamed: "declares itself",
    undescribed: "declares itself|settings that are values",
    changed_by_json: "settings that are values",
    another_kind: "returns what it declares|returns the same|accepts or rejects|respects|rolls|leaves its process",
    unsound: "returns what it declares|returns the same|accepts or rejects|respects|rolls|leaves its process",
    scribbles: "returns what it declares|returns the same|accepts or rejects|respects|rolls|leaves its process",
    forces: "returns what it declares|returns the same|rolls",
    elsewhere: "returns what it declares|returns the same|accepts or rejects|leaves its process|scratch",
    never_written: "returns what it declares|returns the same|accepts or rejects|leaves its process|scratch",
    changes_libraries: "leaves its process",
    leaves_a_thread: "leaves its process",
    draws: "returns the same bytes",
    counts_threads: "returns the same bytes",
    reports_at_random: "returns the same bytes",
    needs_room: "accepts or rejects images (8|9)",
    needs_something: "accepts or rejects empty inputs",
    needs_the_optional: "accepts or rejects missing inputs",
    fills_masked: "respects masks",
    unmasks: "respects masks",
    sees_masked: "respects masks",
    looks_behind_the_mask: "does not depend on masked content",
    stops_at_the_seam: "rolls with",
    beside: "writes to its scratch folder only",
    unquoted: "accepts images of any name",
    flattened: "accepts images of any name",
    unregistered: "leaves out images without a pose|keeps groups",
    first_group: "keeps groups",
    mixed_groups: "keeps groups",
    no_frame: "states the frame",
}


@pytest.mark.parametrize("broken", BROKEN_BY, ids=lambda function: function.__name__)
def test_a_stage_that_breaks_its_contract_is_caught(
    broken: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where one of them writes
    caught = []
    for contract_test in stage_contract_tests(broken):
        if broken is forces:  # it changes what it is given
            tiny_capture.cache_clear()
        try:
            contract_test.check()
        except (AssertionError, ContractError, ValueError, IndexError):
            caught.append(contract_test.name)
    if broken is forces:
        tiny_capture.cache_clear()
    assert caught
    expected = BROKEN_BY[broken].split("|") if "(" not in BROKEN_BY[broken] else ["accepts or rejects images"]
    assert all(any(what in name for what in expected) for name in caught), caught


def test_rejecting_inputs_is_allowed_except_for_ordinary_ones() -> None:
    @stage("toy.refuses")
    def refuses(x: Each[RangeMap]) -> RangeMap:
        """Small pictures are refused."""
        if x.range.shape[0] < 32:
            raise InputError("too small: take larger pictures")
        return x

    check_stage(refuses)
    with pytest.raises(AssertionError, match="rejects ordinary inputs: too small"):
        check_stage(refuses, size_hw=(16, 32))


@dataclass(frozen=True, eq=False)
class Note(Record):
    """A kind of somebody's own."""

    axis: ClassVar[Axis | None] = Axis.IMAGE
    text: str


def test_a_kind_of_ones_own_is_given() -> None:
    @stage("toy.shout")
    def shout(note: Each[Note], image: Each[Panorama]) -> Note:
        """Louder."""
        return Note(note.text.upper())

    check_stage(shout, inputs={"note": Note("here")})
    with pytest.raises(UsageError, match=r"no Note: give one as inputs=\{'note'"):
        check_stage(shout)


def test_what_is_no_stage_is_refused() -> None:
    with pytest.raises(UsageError, match="is not a stage"):
        stage_contract_tests(len)
    with pytest.raises(UsageError, match=r"did you mean 'filters\.median'"):
        stage_contract_tests("filters.medain")


PARTS = """\
import numpy as np
from pano_mvs.api import *


@register_sweep_cost("law_{0}")
def cost(reference, warped, window):
    {1}


@register_sweep_backend("law_{0}", costs=["sad"])
def backend(work):
    from pano_mvs.algorithms.sweep.backends.numpy_backend import find_winners
    from dataclasses import replace
    winners = find_winners(work)
    return replace(winners, plane=np.zeros_like(winners.plane))
"""


@pytest.mark.parametrize(
    ("name", "body", "contract_test", "why"),
    [
        ("large", "return np.abs(reference - warped)[..., 0]", "from 0 to 1", "must return .* from 0 to 1"),
        (
            "constant",
            "return np.full(reference.shape[:2], 0.5)",
            "lower where images are the same",
            "is 0.500 of an image against itself and 0.500 against another image",
        ),
        (
            "random",
            "return np.random.default_rng().random(reference.shape[:2]) * (reference[..., 0] != warped[..., 0])",
            "the same when called again",
            "something else when called again",
        ),
    ],
)
def test_a_part_that_breaks_its_contract_is_caught(
    tmp_path: Path, name: str, body: str, contract_test: str, why: str
) -> None:
    path = tmp_path / f"{name}.py"
    path.write_text(PARTS.format(name, body))
    (broken,) = [each for each in cost_contract_tests(path) if contract_test in each.name]
    with pytest.raises((AssertionError, ContractError), match=why):
        broken.check()


@pytest.mark.slow
def test_a_backend_that_finds_something_else_is_caught(tmp_path: Path) -> None:
    path = tmp_path / "backend.py"
    path.write_text(PARTS.format("backend", "return np.zeros(reference.shape[:2])"))
    agreement, again = backend_contract_tests(path)
    with pytest.raises(AssertionError, match="agrees with the numpy backend in"):
        agreement.check()
    again.check()


def test_built_in_costs_have_no_laws_of_plugins() -> None:
    with pytest.raises(UsageError, match="'census' is built in"):
        cost_contract_tests("census")[0].check()
    assert CostWindow.of((8, 16), 1, spherical=True).columns.shape == (8, 3)


def test_a_rolled_capture_is_the_same_place() -> None:
    straight, rolled = tiny_capture(), tiny_capture(Variant(rolled=16))
    for one, other in zip(straight.poses, rolled.poses, strict=True):
        np.testing.assert_allclose(one.center, other.center, atol=1e-12)
    np.testing.assert_array_equal(np.roll(straight.pictures[1], 16, axis=1), rolled.pictures[1])
    np.testing.assert_array_equal(straight.points_in_world, rolled.points_in_world)
