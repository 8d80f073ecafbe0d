"""The output of a run as Python objects, which are loaded on first access."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.file_names import file_inside, item_problem
from pano_mvs.core.paths import is_file, is_folder
from pano_mvs.engine.cache.store import Store
from pano_mvs.geometry import Rigid3
from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_groups
from pano_mvs.io.ranges import read_confidence_png, read_range_tiff
from pano_mvs.results.records import Verdict, ViewSummary
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary, cache_of
from pano_mvs.results.verdict import verdict
from pano_mvs.scene import PointCloud, Poses, RangeMap
from pano_mvs.scene.files import group_file
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.pose_groups import join_groups


class RunOutput:
    """The output of a run: its summary, and poses, range maps and cloud, loaded on access.

    Values are loaded from the cache of the run or, if it was deleted, from the files in the output folder, if the
    workflow exports them. Values that the run did not produce are None.

    Attributes:
        out: the output folder.
        summary: what run.json holds.
        values: the values in the cache.
        written: files that this run wrote, relative to the output folder; empty for a run that was loaded.
    """

    def __init__(self, out: Path, summary: RunSummary, values: StoredValues, *, written: tuple[str, ...] = ()) -> None:
        self.out = out
        self.summary = summary
        self.values = values
        self.written = written

    @cached_property
    def verdict(self) -> Verdict:
        """Whether the result is reliable, with the findings of the report."""
        return self.summary.verdict or verdict(self.summary)

    @property
    def ok(self) -> bool:
        """Whether the run finished without failed or doubtful items."""
        return self.summary.ok

    @cached_property
    def poses(self) -> Poses | None:
        """The camera poses.

        Raises:
            InputError: if they cannot be read, or files cannot be named after one of the images.
        """
        poses = self.values.poses
        if poses is None and is_folder(self.out / "colmap") and not self._has_old_model():
            groups = read_groups(self.out)
            poses = join_groups(groups) if len(groups) > 1 else groups[0]
        # Names in a COLMAP model have not passed the checks of a source.
        for name in poses.names if poses is not None else ():
            if problem := item_problem(name):
                raise InputError(f"{self.out}: the poses contain an image that cannot be used: {problem}")
        return poses

    @cached_property
    def cloud(self) -> PointCloud | None:
        """The fused cloud; of several groups of cameras, `cloud.groups()` has the cloud of each."""
        cloud = self.values.cloud
        files = [group_file("cloud.ply", group) for group in range(max(1, len(self.summary.poses.groups)))]
        if cloud is None and all(self.has_file(name) for name in files):
            clouds = [read_ply(self.out / name) for name in files]
            cloud = PointCloud.of_groups(clouds) if len(clouds) > 1 else clouds[0]
        return cloud

    @cached_property
    def views(self) -> Views:
        """The views with a range map, by the names of their images."""
        return Views(self)

    def has_file(self, name: str) -> bool:
        """Return whether a file is in the output folder and not left over from an earlier run.

        Args:
            name: path relative to the output folder.
        """
        return name not in self.summary.left_over and file_inside(self.out, name) is not None

    def _has_old_model(self) -> bool:
        """Return whether the COLMAP model is left over from an earlier run."""
        models = [any(name.startswith("colmap/") for name in of) for of in (self.summary.left_over, self.summary.files)]
        return models == [True, False]

    def __repr__(self) -> str:
        """Return the folder, the workflow, and how the run ended."""
        return f"RunOutput({str(self.out)!r}, workflow {self.summary.workflow.name!r}: {self.verdict.outcome})"

    def _repr_html_(self) -> str:
        """Return the run for a notebook: the verdict, pictures of some views, and the stages."""
        from pano_mvs.results.notebook import run_html

        return run_html(self)


class Views(Mapping[str, "RunView"]):
    """The views of a run, by the names of their images. Their arrays are loaded on access."""

    def __init__(self, run: RunOutput) -> None:
        self._run = run
        self._summaries = {view.name: view for view in run.summary.views}

    def __getitem__(self, name: str) -> RunView:
        """Return the view of an image, a new object each time, so that its arrays are freed with it."""
        return RunView(self._run, self._summaries[name])

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the images."""
        return iter(self._summaries)

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self._summaries)

    def __repr__(self) -> str:
        """Return the number of views, and the first names."""
        names = list(self._summaries)
        return f"<{len(names)} views: {', '.join(names[:3])}{', …' if len(names) > 3 else ''}>"


class RunView:
    """One view of a run.

    Attributes:
        name: of the image.
        summary: the entry of the view in run.json.
    """

    def __init__(self, run: RunOutput, summary: ViewSummary) -> None:
        self.name = summary.name
        self.summary = summary
        self._run = run

    @cached_property
    def _record(self) -> RangeMap | None:
        return self._run.values.range_map(self.name)

    @cached_property
    def range_map(self) -> NDArray[np.float32] | None:
        """Distances along the rays of the pixels, (H, W) float32 in scene units; NaN is invalid."""
        if self._record is not None:
            return self._record.range
        path = self._exported("range", ".tiff")
        return read_range_tiff(path) if path else None

    @cached_property
    def confidence(self) -> NDArray[np.uint8] | None:
        """Confidence of the ranges, (H, W) uint8: 0 invalid, 1–63 filled, 64–127 weak, 128–255 confirmed."""
        if self._record is not None:
            return self._record.confidence
        path = self._exported("confidence", ".png")
        return read_confidence_png(path) if path else None

    @cached_property
    def uncertainty(self) -> NDArray[np.float32] | None:
        """Standard deviations of the ranges divided by the ranges, (H, W) float32; NaN where there is no range.

        None if no stage compared the views.
        """
        if self._record is not None:
            known = self._record.uncertainty
            return None if known is None else known.astype(np.float32)
        path = self._exported("uncertainty", ".tiff")
        return read_range_tiff(path) if path else None

    @cached_property
    def image(self) -> NDArray[np.uint8] | None:
        """The panorama, (H, W, 3) uint8 RGB, at the size of its file."""
        panorama = self._run.values.panorama(self.name)
        if panorama is not None:
            return panorama.load()
        path = self._run.summary.source_file(self.name)
        return decode_image(path) if path is not None else None

    @property
    def cam_from_world(self) -> Rigid3 | None:
        """The pose: `x_in_cam = R x_in_world + t`."""
        poses = self._run.poses
        return poses.cam_from_world(poses.names.index(self.name)) if poses and self.name in poses.names else None

    @property
    def preview(self) -> Path | None:
        """The file in the output folder that shows the panorama and its range map; None if it is not in there."""
        return file_inside(self._run.out, self.summary.preview)

    def __repr__(self) -> str:
        """Return the name."""
        return f"RunView({self.name!r})"

    def _exported(self, folder: str, suffix: str) -> Path | None:
        """Return the exported file of the view, which has the image's extension in its name if that is necessary."""
        candidates = (f"{folder}/{self.name}{suffix}", f"{folder}/{PurePosixPath(self.name).with_suffix(suffix)}")
        return next((self._run.out / name for name in candidates if self._run.has_file(name)), None)


def load(out: str | Path, *, cache: str | Path | None = None) -> RunOutput:
    """Return the output of the latest run into a folder.

    >>> import pano_mvs
    >>> run = pano_mvs.load("out")
    >>> run.verdict.outcome, run.views["000.png"].image.shape
    ('Finished', (512, 1024, 3))

    Args:
        out: the output folder.
        cache: folder of the cache that the run used; None for $PANO_MVS_CACHE, or else the one that run.json names. It
            need not exist: exported files are read in its place.

    Raises:
        InputError: if the folder has no run.json that can be read, or `cache` is not a cache.
        StoreError: if the cache's list of runs is damaged.
    """
    out = Path(out)
    summary = RunSummary.read(out)
    root = cache_of(summary, Path(cache) if cache is not None else None)
    if is_file(root / "layout.json"):
        return RunOutput(out, summary, StoredValues.of_folder(out, summary, Store(root, for_reading=True)))
    if cache is not None:
        raise InputError(f"{root} is not a cache of pano_mvs. Give the cache that the run used")
    return RunOutput(out, summary, StoredValues(notes=[f"there is no cache in {root}"]))
