"""Place ordinary photographs among the panoramas."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.features.photograph import photograph_keypoints
from pano_mvs.algorithms.poses.colmap.localise import (
    KnownPoints,
    Localised,
    has_sift,
    known_points,
    localise_photograph,
)
from pano_mvs.algorithms.poses.photograph_alignment import PanoramaPatches, PhotographPatches
from pano_mvs.algorithms.poses.photograph_surface import SurfacePoints, surface_points
from pano_mvs.api import (
    All,
    Context,
    Features,
    InputError,
    InputPath,
    One,
    Panorama,
    Params,
    Poses,
    RangeMap,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.core.paths import is_file
from pano_mvs.io.images.captures import list_pictures
from pano_mvs.io.images.containers import read_container
from pano_mvs.io.images.exif import focal_from_exif
from pano_mvs.scene.image_files.image_file import decode_image
from pano_mvs.scene.photographs import Photographs
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.record import FilePart


def localise_memory_bytes(_: Params, inputs: Mapping[str, Any]) -> int:
    """Return the memory for a photograph and the key points of all panoramas, of which there are 8000 by default."""
    return 600_000_000 + 6_000_000 * len(inputs["ranges"])


@params_from(localise_photograph, own_last=True)
class LocaliseParams(Params):
    """Settings of poses.localise."""

    path: InputPath = Field(description="folder of photographs, or one photograph")
    min_confidence: int = Field(default=128, ge=1, le=255, description="minimum confidence of ranges (128: consistent)")


@stage("poses.localise", memory=localise_memory_bytes)
def localise(
    poses: One[Poses],
    features: All[Features],
    ranges: All[RangeMap],
    images: All[Panorama],
    params: LocaliseParams,
    ctx: Context,
) -> Photographs:
    """Find where ordinary photographs were taken, and their focal lengths, by the panoramas and their ranges.

    The key points of each photograph are matched with those of the most similar panoramas that have range maps.
    Photographs that cannot be localised reliably are left out, each with a reason. Only the largest group of poses is
    used.
    """
    group = split_groups(poses)[0]
    known: dict[str, KnownPoints] = {}
    surfaces: dict[str, SurfacePoints] = {}
    for idx, name in enumerate(group.names):
        if name in features and name in ranges and name in images and has_sift(features[name]):
            given = features[name], group.cam_from_world(idx), ranges[name]
            known[name] = known_points(*given, min_confidence=params.min_confidence)
            surfaces[name] = surface_points(*given, min_confidence=params.min_confidence)
    patches = PanoramaPatches(surfaces, lambda name: images[name].load())
    if not known:
        ctx.note("no panorama has both a range map and SIFT key points (features.sift_tangent)")
    folder, paths = _photographs(params.path)
    found: dict[str, tuple[tuple[int, int], Localised]] = {}
    rejected: dict[str, str] = {}
    for path in paths:
        name = path.relative_to(folder).as_posix()
        try:
            size_hw, result = _localised(path, known, patches, params=params, ctx=ctx)
        except InputError as error:
            result = str(error)
        if isinstance(result, Localised):
            found[name] = size_hw, result
        else:
            rejected[name] = result
            ctx.note(f"{name} was not localised: {result}")
    ctx.note(f"{len(found)} of {len(paths)} photographs were localised")
    ctx.metric("localised", len(found) / max(1, len(paths)))
    return _record(found, rejected, {path.relative_to(folder).as_posix(): path for path in paths}, ctx=ctx)


def _localised(
    path: Path, known: dict[str, KnownPoints], patches: PanoramaPatches, *, params: LocaliseParams, ctx: Context
) -> tuple[tuple[int, int], Localised | str]:
    data = FilePart(path).read_bytes()
    picture = decode_image(path, data)
    size_hw = (picture.shape[0], picture.shape[1])
    return size_hw, localise_photograph(
        photograph_keypoints(picture),
        size_hw,
        known,
        focal_px=focal_from_exif(read_container(data).exif, size_hw),
        patches=PhotographPatches(picture, patches),
        **arguments_from(localise_photograph, params),
        rng=ctx.rng,
    )


def _photographs(path: Path) -> tuple[Path, list[Path]]:
    """Return the folder to which names are relative, and the photographs."""
    if is_file(path):
        return path.parent, [path]
    return path.parent, list_pictures(path)


def _copied(path: Path, number: int, ctx: Context) -> FilePart:
    """Return a copy of a file, which the store takes over."""
    copy = ctx.scratch / f"photograph_{number}{path.suffix.lower()}"
    copy.write_bytes(FilePart(path).read_bytes())
    return FilePart(copy)


def _record(
    found: dict[str, tuple[tuple[int, int], Localised]],
    rejected: dict[str, str],
    paths: dict[str, Path],
    *,
    ctx: Context,
) -> Photographs:
    def each(values: Iterable[object], dtype: type[np.generic], *shape: int) -> NDArray[Any]:
        return np.array(list(values), dtype).reshape(len(found), *shape)

    results = [result for _, result in found.values()]
    return Photographs(
        names=tuple(found),
        sizes_hw=each((size_hw for size_hw, _ in found.values()), np.int32, 2),
        focals_px=each((result.focal_px for result in results), np.float64),
        radials=each((result.radial for result in results), np.float64),
        rotations=each((result.cam_from_world.rotation for result in results), np.float64, 3, 3),
        translations=each((result.cam_from_world.translation for result in results), np.float64, 3),
        inliers=each((result.inliers for result in results), np.int32),
        errors_px=each((result.error_px for result in results), np.float32),
        pictures=tuple(_copied(paths[name], number, ctx) for number, name in enumerate(found)),
        rejected=rejected,
    )
