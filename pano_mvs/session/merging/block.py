"""A block of a capture: the output folder of a run over some of its images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import resolved
from pano_mvs.core.text import plural
from pano_mvs.io.colmap.reader import model_files, read_cameras, read_images
from pano_mvs.io.ply import open_ply_points
from pano_mvs.io.thinning import chunks
from pano_mvs.results.records import PosesSummary
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.scene import PointCloud, Poses
from pano_mvs.scene.pose_groups import split_groups


@dataclass(frozen=True, eq=False)
class Block:
    """One block, with its largest group of cameras.

    Attributes:
        run: its output.
        poses: of the largest group.
        left_out: names of the cameras in other groups.
    """

    run: RunOutput
    poses: Poses
    left_out: tuple[str, ...]

    @property
    def name(self) -> str:
        """Its folder, as given."""
        return str(self.run.out)

    def sizes_hw(self) -> dict[str, tuple[int, int]]:
        """Return the (height, width) of the images, from the cache or the COLMAP model.

        Raises:
            InputError: if the size of an image is in neither.
        """
        sizes = {}
        for name in self.poses.names:
            panorama = self.run.values.panorama(name)
            if panorama is not None:
                sizes[name] = panorama.source_size_hw
        if len(sizes) < len(self.poses.names):
            sizes = self._model_sizes() | sizes
        missing = [name for name in self.poses.names if name not in sizes]
        if missing:
            raise InputError(
                f"{self.name}: the size of {missing[0]} is unknown, because its cache was deleted and the run exported "
                "no COLMAP model. Run the block again with export.colmap"
            )
        return sizes

    @property
    def has_cloud(self) -> bool:
        """Whether the run has a cloud, in a file or in the cache."""
        return self.run.has_file("cloud.ply") or self.run.values.cloud is not None

    def cloud_parts(self) -> Iterator[PointCloud]:
        """Yield parts of the cloud of the largest group: cloud.ply, or else the cloud in the cache; nothing without."""
        if self.run.has_file("cloud.ply"):
            yield from open_ply_points(self.run.out / "cloud.ply").cloud_chunks()
        elif self.run.values.cloud is not None:
            cloud = self.run.values.cloud.groups()[0]
            for part in chunks(len(cloud)):
                yield PointCloud(
                    cloud.points_in_world[part],
                    cloud.normals_in_world[part],
                    cloud.colors_rgb[part],
                    cloud.view_counts[part],
                    None if cloud.confidence is None else cloud.confidence[part],
                    uncertainty=None if cloud.uncertainty is None else cloud.uncertainty[part],
                )

    def _model_sizes(self) -> dict[str, tuple[int, int]]:
        files = model_files(self.run.out / "colmap" / "sparse" / "0")
        if files is None:
            return {}
        cameras, images = read_cameras(files[0]), read_images(files[1])
        return {image.name: cameras[image.camera_id].size_hw for image in images.values() if image.camera_id in cameras}


def load_blocks(outs: Sequence[Path], cache: Path | None = None) -> list[Block]:
    """Return the blocks in output folders.

    Args:
        outs: the output folders of runs, in any order.
        cache: folder of the cache that all of them used; None for the one that each run.json names.

    Raises:
        UsageError: if there are fewer than two folders, or one is given twice.
        InputError: if a folder has no run, the run has no poses, or files cannot be named after one of its images.
    """
    if len(outs) < 2:
        raise UsageError("give two or more output folders to merge")
    seen: dict[Path, Path] = {}
    for out in outs:
        if resolved(out) in seen:
            raise UsageError(f"{out} and {seen[resolved(out)]} are the same folder")
        seen[resolved(out)] = out
    return [_loaded(out, cache) for out in outs]


def _loaded(out: Path, cache: Path | None) -> Block:
    run = load(out, cache=cache)
    poses = run.poses
    if poses is None or not poses.names:
        raise InputError(
            f"{out}: no poses: the cache of the run was deleted and it exported no COLMAP model. Run it again"
            if run.summary.poses.registered
            else f"{out}: the run has no poses. Look at its report.html"
        )
    largest, *others = split_groups(poses)
    if len(largest.names) < 2:
        raise InputError(f"{out}: only {len(largest.names)} {plural(len(largest.names), 'image')} has a pose")
    if run.values.poses is None:
        largest = _as_stated(largest, run.summary.poses)
    return Block(run, largest, tuple(name for group in others for name in group.names))


def _as_stated(poses: Poses, stated: PosesSummary) -> Poses:
    """Return the poses of a COLMAP model with what run.json states about them, which the model does not hold."""
    return replace(
        poses,
        frame=stated.frame or poses.frame,
        scale=stated.scale or poses.scale,
        metric=stated.metric,
        doubts={name: stated.doubts[name] for name in poses.names if name in stated.doubts},
    )
