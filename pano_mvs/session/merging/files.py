"""Read the blocks of a capture, and write the files of the merged one; clouds and range maps piece by piece."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from pano_mvs.algorithms.blocks import MergedBlocks, nearest_cameras
from pano_mvs.core.digest import digest_from_file
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.file_names import file_inside, path_inside
from pano_mvs.core.files import copy_file, replacing, write_text
from pano_mvs.core.paths import resolved
from pano_mvs.core.text import plural
from pano_mvs.geometry import Similarity3
from pano_mvs.io.colmap.reader import model_files, read_cameras, read_images
from pano_mvs.io.colmap.writer import write_colmap_model
from pano_mvs.io.ply import open_ply_points, write_ply_parts
from pano_mvs.io.point_selection import chunks
from pano_mvs.io.ranges import write_confidence_png, write_range_tiff
from pano_mvs.io.transforms_json import NerfstudioFrame, transforms_document
from pano_mvs.results.records import ViewSummary
from pano_mvs.results.run_output import RunOutput, RunView, load
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import PointCloud, Poses
from pano_mvs.scene.files import item_stems
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.upright import world_up, z_up_from_world


@dataclass(frozen=True, eq=False)
class Block:
    """One block, with its largest group of cameras."""

    run: RunOutput
    poses: Poses
    left_out: tuple[str, ...]  # names of the cameras in other groups

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
                yield cloud.some(part)

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
        largest = replace(
            largest,
            frame=run.summary.poses.frame or largest.frame,
            scale=run.summary.poses.scale or largest.scale,
            metric=run.summary.poses.metric,
            axes=run.summary.poses.axes,
            origin_lla=run.summary.poses.origin_lla,
            doubts={name: run.summary.poses.doubts[name] for name in largest.names if name in run.summary.poses.doubts},
        )
    return Block(run, largest, tuple(name for group in others for name in group.names))


@dataclass(frozen=True, eq=False)
class MergeFiles:
    """Writes a merged capture."""

    out: Path
    blocks: Sequence[Block]
    world_from_block: Sequence[Similarity3]  # the similarity of each
    merged: MergedBlocks
    # files that depend on the images and the stages of the blocks, relative to the folder
    written: set[str] = field(default_factory=set)

    def write_model(self, *, has_cloud: bool) -> None:
        """Write the COLMAP model colmap/sparse/0, transforms.json and poses.json.

        Args:
            has_cloud: whether cloud.ply was written.

        Raises:
            InputError: if the size of an image is unknown.
        """
        poses = self.merged.poses
        sizes: dict[str, tuple[int, int]] = {}
        for block in self.blocks:
            sizes |= block.sizes_hw()
        folder = path_inside(self.out, "colmap/sparse/0")
        folder.mkdir(parents=True, exist_ok=True)
        write_colmap_model(folder, poses, sizes)
        frames = [
            (name, cam_from_world, _frame(self._image_path(name, number), sizes[name]))
            for (name, cam_from_world), number in zip(poses.cameras.items(), self.merged.owner.tolist(), strict=True)
        ]
        turn = z_up_from_world(world_up(poses))
        document = transforms_document(
            "equirectangular",
            frames,
            depth_unit=1.0,
            file_from_world=turn,
            seed="cloud.ply" if has_cloud else "",
        )
        write_text(self.out / "transforms.json", json.dumps(document, indent=1))
        views = [
            {"id": idx, "image": name, "R": pose.rotation.tolist(), "t": pose.translation.tolist()}
            for idx, (name, pose) in enumerate(poses.cameras.items())
        ]
        write_text(self.out / "poses.json", json.dumps({"metric": poses.metric, "views": views}, indent=1))

    def write_cloud(self) -> int:
        """Write cloud.ply, in which each point is nearest to a camera of its own block; return the number of points."""
        if not any(block.has_cloud for block in self.blocks):
            return 0
        turn = z_up_from_world(world_up(self.merged.poses))
        with replacing(self.to_write("cloud.ply")) as temporary:
            return write_ply_parts(temporary, self._cloud_parts(), quality=True, uncertainty=True, file_from_world=turn)

    def write_ranges(self) -> list[ViewSummary]:
        """Write the range map of each camera from its own block, in the merged unit; return what run.json lists."""
        stems = item_stems(self.merged.poses.names)
        found = []
        for name, number in zip(self.merged.poses.names, self.merged.owner.tolist(), strict=True):
            block, scale = self.blocks[number], self.world_from_block[number].scale
            listed = {summary.name: summary for summary in block.run.summary.views}
            item = next((one for one in (name, stems[name]) if one in listed), None)
            view = block.run.views[item] if item is not None and item in block.run.views else None
            if view is None or not self._write_range(view, stems[name], scale):
                continue
            assert item is not None
            found.append(listed[item].model_copy(update={"name": name, "preview": self._preview(view, stems[name])}))
        return found

    def _write_range(self, view: RunView, stem: str, scale: float) -> bool:
        """Write the range map, confidence and uncertainty of a view; return whether it has a range map."""
        if view.range_map is None:
            return False
        range_file, confidence_file, uncertainty_file = map_files(stem)
        ranges = (view.range_map * np.float32(scale)).astype(np.float32)
        write_range_tiff(self.to_write(range_file), ranges)
        if view.confidence is not None:
            write_confidence_png(self.to_write(confidence_file), np.ascontiguousarray(view.confidence))
        if view.uncertainty is not None:
            write_range_tiff(self.to_write(uncertainty_file), np.ascontiguousarray(view.uncertainty))
        return True

    def _preview(self, view: RunView, stem: str) -> str:
        if view.preview is None:
            return ""
        name = f"preview/{stem}{view.preview.suffix}"
        copy_file(view.preview, self.to_write(name))
        return name

    def remove_stale(self, earlier: RunSummary) -> None:
        """Delete files of an earlier merge into the folder that this one has not written: they are in another world."""
        stems = item_stems(earlier.poses.registered)
        maps = (name for view in earlier.views if view.name in stems for name in map_files(stems[view.name]))
        old = {"cloud.ply", *maps, *(view.preview for view in earlier.views if view.preview)}
        for name in (old | earlier.files.keys()) - self.written:
            path = file_inside(self.out, name)
            if path and (name in old or digest_from_file(path) == earlier.files[name]):  # or else somebody's own
                path.unlink()

    def to_write(self, name: str) -> Path:
        """Return the path of a file that is about to be written, in its folder."""
        path = path_inside(self.out, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        self.written.add(name)
        return path

    def _cloud_parts(self) -> Iterator[PointCloud]:
        merged = self.merged
        centers = (merged.before or merged.poses).centers
        for number, (block, similarity) in enumerate(zip(self.blocks, self.world_from_block, strict=True)):
            for part in block.cloud_parts():
                moved = replace(
                    part,
                    points_in_world=similarity.apply(part.points_in_world).astype(np.float32),
                    normals_in_world=(part.normals_in_world.astype(np.float64) @ similarity.rotation.T).astype(
                        np.float32
                    ),
                    uncertainty=None if part.uncertainty is None else part.uncertainty * np.float32(similarity.scale),
                )
                camera_idx = nearest_cameras(moved.points_in_world, centers)
                own = merged.owner[camera_idx] == number
                moved, camera_idx = moved.some(own), camera_idx[own]
                if merged.before is not None:
                    points, normals = merged.move(moved.points_in_world, moved.normals_in_world, camera_idx)
                    moved = replace(
                        moved,
                        points_in_world=points.astype(np.float32),
                        normals_in_world=normals.astype(np.float32),
                    )
                yield moved

    def _image_path(self, name: str, number: int) -> str:
        path = self.blocks[number].run.summary.source_file(name)
        if path is None:
            return name
        return PurePosixPath(Path(os.path.relpath(resolved(path), resolved(self.out)))).as_posix()


def map_files(stem: str) -> tuple[str, str, str]:
    """Return the files of the range map, the confidence and the uncertainty of an image."""
    return f"range/{stem}.tiff", f"confidence/{stem}.png", f"uncertainty/{stem}.tiff"


def _frame(path: str, size_hw: tuple[int, int]) -> NerfstudioFrame:
    height, width = size_hw
    rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return NerfstudioFrame("equirectangular", path, "", "", (width, height), (width / 2, float(height)), rows)
