"""The output of a run as Python objects, which are loaded on first access, and as HTML for notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from html import escape
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

import pano_mvs
from pano_mvs.core.errors import InputError
from pano_mvs.core.file_names import file_inside, item_problem
from pano_mvs.core.paths import is_file, is_folder
from pano_mvs.core.text import duration_text
from pano_mvs.engine.cache.store import Store
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.preview import color_mapped, mark_unconfirmed, range_limits
from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_groups
from pano_mvs.io.ranges import read_confidence_png, read_range_tiff
from pano_mvs.results.figures import figure
from pano_mvs.results.pictures import Picture, evenly_spaced, picture
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
    """

    def __init__(self, out: Path, summary: RunSummary, values: StoredValues, *, written: tuple[str, ...] = ()) -> None:
        self.out = out  # the output folder
        self.summary = summary  # what run.json holds
        self.values = values  # the values in the cache
        # files that this run wrote, relative to the output folder; empty for a run that was loaded
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
        is_old, is_own = (
            any(name.startswith("colmap/") for name in of) for of in (self.summary.left_over, self.summary.files)
        )
        if poses is None and is_folder(self.out / "colmap") and not (is_old and not is_own):
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

    def share(self, folder: str | Path, options: pano_mvs.ShareOptions | None = None) -> pano_mvs.Shared:
        """Write a page with the cloud, the mesh, the cameras and the panoramas; see `pano_mvs.share_run`."""
        return pano_mvs.share_run(self, folder, options)

    def view(self, options: pano_mvs.ViewOptions | None = None) -> NDArray[np.uint8] | None:
        """View the run in a window until it is closed, or write an image of it; see `pano_mvs.view_run`."""
        shown: NDArray[np.uint8] | None = pano_mvs.view_run(self, options)
        return shown

    def has_file(self, name: str) -> bool:
        """Return whether a file is in the output folder and not left over from an earlier run.

        Args:
            name: path relative to the output folder.
        """
        return name not in self.summary.left_over and file_inside(self.out, name) is not None

    def __repr__(self) -> str:
        """Return the folder, the workflow, and how the run ended."""
        return f"RunOutput({str(self.out)!r}, workflow {self.summary.workflow.name!r}: {self.verdict.outcome})"

    def _repr_html_(self) -> str:
        """Return the run for a notebook: the verdict, pictures of some views, and the stages."""
        verdict = self.verdict
        title = f"<b>{escape(self.summary.workflow.name or 'pano-mvs')}</b>: {escape(verdict.outcome)}."
        judgement = f'<b style="color:{_COLORS[verdict.mood]}">{escape(verdict.judgement)}</b>'
        tiles = " · ".join(f"<b>{escape(tile.value)}</b> {escape(tile.label)}" for tile in verdict.tiles)
        findings = "".join(f"<li>{escape(found.text)} {escape(found.remedy)}</li>" for found in verdict.findings)
        names = ("run", "cached", "failed", "blocked")
        head = "".join(f"<th>{name}</th>" for name in ("stage", "use", *names, "time"))
        rows = "".join(
            f"<tr><td>{escape(stage.name)}</td><td>{escape(stage.use)}</td>"
            + "".join(f"<td>{figure(getattr(stage, name))}</td>" for name in names)
            + f"<td>{duration_text(stage.seconds)}</td></tr>"
            for stage in self.summary.stages
        )
        parts = [
            f"<p>{title} {judgement} {escape(verdict.sentence)}</p>",
            f"<p>{tiles}</p>" if tiles else "",
            f"<ul>{findings}</ul>" if findings else "",
            "".join(_view_html(self.views[name]) for name in evenly_spaced(list(self.views), 6)),
            f"<table><tr>{head}</tr>{rows}</table>" if rows else "",
            f"<p>{escape(str(self.out))}</p>",
        ]
        return f"<div>{''.join(parts)}</div>"


class Views(Mapping[str, "RunView"]):
    """The views of a run, by the names of their images. Their arrays are loaded on access."""

    def __init__(self, run: RunOutput) -> None:
        self._run = run
        self._summaries = {view.name: view for view in run.summary.views}

    def __getitem__(self, name: str) -> RunView:
        """Return the view of an image, a new object each time, so that its arrays are freed with it."""
        return RunView(self._run, self._summaries[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._summaries)

    def __len__(self) -> int:
        return len(self._summaries)

    def __repr__(self) -> str:
        """Return the number of views, and the first names."""
        names = list(self._summaries)
        return f"<{len(names)} views: {', '.join(names[:3])}{', …' if len(names) > 3 else ''}>"


class RunView:
    """One view of a run."""

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
        """Confidence of ranges, (H, W) uint8: 0 invalid, 1 mirror, 2 window, 3–63 filled, 64–127 weak, 128–255 sure."""
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
        return f"RunView({self.name!r})"

    def _exported(self, folder: str, suffix: str) -> Path | None:
        """Return the exported file of the view, which has the image's extension in its name if that is necessary."""
        candidates = (f"{folder}/{self.name}{suffix}", f"{folder}/{PurePosixPath(self.name).with_suffix(suffix)}")
        return next((self._run.out / name for name in candidates if self._run.has_file(name)), None)


_WIDTH = 320
_MAX_BYTES = 40_000
_COLORS = {"good": "#1a7f37", "fair": "#9a6700", "bad": "#cf222e", "": "inherit"}


def _view_html(view: RunView) -> str:
    pictures = _pictures(view)
    if not pictures:
        return ""
    shown = "".join(
        f'<img src="{small.uri}" width="{small.size_hw[1]}" height="{small.size_hw[0]}" alt="{what}">'
        for what, small in pictures
    )
    return (
        f'<figure style="display:inline-block;margin:4px">{shown}<figcaption>{escape(view.name)}</figcaption></figure>'
    )


def _pictures(view: RunView) -> Iterable[tuple[str, Picture]]:
    found = []
    if view.image is not None:
        found.append(("panorama", picture(view.image, width=_WIDTH, most_bytes=_MAX_BYTES)))
    if view.range_map is not None:
        colors = color_mapped(view.range_map, *range_limits(view.range_map))
        if view.confidence is not None:
            colors = mark_unconfirmed(colors, view.confidence)
        found.append(("range map", picture(colors, width=_WIDTH, most_bytes=_MAX_BYTES)))
    return found


def load(out: str | Path, *, cache: str | Path | None = None) -> RunOutput:
    """Return the output of the latest run into a folder.

    >>> import pano_mvs
    >>> run = pano_mvs.load("out")
    >>> run.verdict.outcome, run.views["000.png"].image.shape
    ('Finished', (512, 1024, 3))

    Args:
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
