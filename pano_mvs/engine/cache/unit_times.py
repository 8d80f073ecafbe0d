"""How long the units of each stage took in earlier runs with a cache, and how much they stored.

Estimates of later runs start from these samples: one for each run and stage that computed something, the latest eight
of each stage, in the file `unit-times.json`. Losing the file costs only estimates.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from statistics import median

from pano_mvs.core.files import checked_body, read_regular, write_checked
from pano_mvs.core.paths import stat_of
from pano_mvs.scene.image_header import image_kind, stated_size_of_file

FILE_NAME = "unit-times.json"
_MAX_SAMPLES = 8


@dataclass(frozen=True, slots=True)
class CaptureSize:
    """The size of a capture, by which times are scaled."""

    images: int
    pixels: float  # of one image in the median; the bytes of its file if it is not an image file

    @staticmethod
    def of_files(images: Sequence[Collection[Path]]) -> CaptureSize:
        """Measure the images of a source, given the files of each; of many, only some are opened."""
        step = max(1, -(-len(images) // 9))
        sizes = [max(map(_file_size, files)) for files in images[::step] if files]
        return CaptureSize(len(images), max(1.0, median(sizes)) if sizes else 1.0)


@dataclass(frozen=True, slots=True)
class Sample:
    """The units of one stage that one run computed."""

    settings: str  # digest of the settings of the stage
    threads: int  # that each unit could use
    images: int
    pixels: float
    units: int
    seconds: float  # that a unit took in the mean
    stored_bytes: float  # that a unit stored in the mean


@dataclass(frozen=True, slots=True)
class ExpectedUnit:
    """What a unit is expected to take: seconds, and bytes in the cache."""

    seconds: float
    stored_bytes: float


class UnitTimes:
    """The samples of one cache."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._samples = _read(path)
        self._new: list[tuple[str, Sample]] = []

    def add(self, stage: str, sample: Sample) -> None:
        """Add what a run measured of a stage (its name in the registry)."""
        self._new.append((stage, sample))
        self._samples.setdefault(stage, []).append(sample)

    def save(self) -> None:
        """Add the new samples to the file, to which other runs may have added in the meantime.

        Raises:
            StoreError: if the file cannot be written.
        """
        if not self._new:
            return
        samples = _read(self._path)
        for stage, sample in self._new:
            samples[stage] = [*samples.pop(stage, []), sample][-_MAX_SAMPLES:]
        value = {stage: [astuple(sample) for sample in found] for stage, found in list(samples.items())[-1000:]}
        body = json.dumps(value, allow_nan=False).encode()
        write_checked(self._path, body, temporary_in=self._path.parent / "tmp")
        self._samples, self._new = samples, []

    def expected_unit(
        self, stage: str, size: CaptureSize, *, settings: str, threads: int, whole: bool
    ) -> ExpectedUnit | None:
        """Return what a unit is expected to take, or None if no earlier run computed this stage.

        The three samples that are most similar count: with the same settings and threads if possible, then of a
        capture of similar size. Times and sizes are scaled by the pixels of an image.

        Args:
            stage: name of the stage in the registry.
            whole: whether the unit reads the whole capture, so that the number of images counts too.
        """
        similar = self._similar(stage, size, settings=settings, threads=threads)
        if not similar:
            return None
        scales = [
            size.pixels / sample.pixels * (size.images / max(1, sample.images) if whole else 1.0) for sample in similar
        ]
        return ExpectedUnit(
            median(sample.seconds * scale for sample, scale in zip(similar, scales, strict=True)),
            median(sample.stored_bytes * scale for sample, scale in zip(similar, scales, strict=True)),
        )

    def expected_pairs(self, stage: str, images: int, *, settings: str) -> int | None:
        """Return the expected number of units of a stage that computes pairs, or None without experience.

        If a similar run computed all pairs of its images, all pairs are expected, otherwise the same number per image.
        """
        similar = self._similar(stage, CaptureSize(images, 1.0), settings=settings, threads=0)
        if not similar:
            return None
        sample = similar[0]
        if sample.units == sample.images * (sample.images - 1) // 2:
            return images * (images - 1) // 2
        return min(round(sample.units / max(1, sample.images) * images), images * (images - 1) // 2)

    def _similar(self, stage: str, size: CaptureSize, *, settings: str, threads: int) -> list[Sample]:
        """Return the most similar samples, the best first; all have settings and threads in the same relation."""

        def kind(sample: Sample) -> tuple[bool, bool]:
            return sample.settings != settings, sample.threads != threads

        def distance(sample: Sample) -> float:
            pixels = abs(math.log(size.pixels / sample.pixels))
            return pixels + abs(math.log(max(1, size.images) / max(1, sample.images)))

        latest_first = self._samples.get(stage, [])[::-1]
        found = sorted(latest_first, key=lambda sample: (kind(sample), distance(sample)))
        return [sample for sample in found if kind(sample) == kind(found[0])][:3]


def _file_size(path: Path) -> float:
    try:
        with path.open("rb") as stream:
            is_image = image_kind(stream.read(64)) is not None
    except OSError:
        return 1.0
    stated = stated_size_of_file(path) if is_image else None
    if stated is not None:
        height, width = stated
        return float(height * width)
    found = stat_of(path)
    return float(found.st_size) if found is not None else 1.0


def _read(path: Path) -> dict[str, list[Sample]]:
    """Return the samples in a file; none if it is missing or damaged."""
    try:
        value = json.loads(checked_body(read_regular(path)))
        return {str(stage): [_sample(entry) for entry in found] for stage, found in value.items()}
    except (OSError, ValueError, TypeError, AttributeError, OverflowError, RecursionError):
        return {}


def _sample(entry: list[object]) -> Sample:
    sample = Sample(*entry)  # type: ignore[arg-type]  # checked below
    counts, sizes = (sample.threads, sample.images, sample.units), (sample.seconds, sample.stored_bytes, sample.pixels)
    if not isinstance(sample.settings, str) or not all(type(count) is int for count in counts):
        raise TypeError("not a sample")
    if not all(0 <= number < 1e15 for number in (*counts, *sizes)) or not sample.pixels >= 1:
        raise ValueError("a number is not possible")
    return sample
