"""Place ordinary photographs among the panoramas."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from pano_mvs.algorithms.features.tangent import PhotographKeypoints, photograph_keypoints
from pano_mvs.algorithms.learned.networks import Networks
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
    UsageError,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.core.paths import is_file, is_folder
from pano_mvs.io.images.captures import PICTURE_SUFFIXES, files_below, list_pictures
from pano_mvs.io.images.metadata import focal_from_exif, read_container
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.photographs import Photographs
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from pano_mvs.scene.record import FilePart
from pano_mvs.stages.features import NetworkParams
from pano_mvs_photographs.alignment import PanoramaPatches, PhotographPatches
from pano_mvs_photographs.learned_matches import PhotographView, match_photograph, view_of_photograph
from pano_mvs_photographs.localise import Localised, localise_photograph
from pano_mvs_photographs.panoramas import KnownPoints, LocatedPanoramas

# Photographs whose panoramas are chosen together: the larger, the less often the panoramas are read.
_BLOCK = 32


def localise_memory_bytes(params: Params, inputs: Mapping[str, Any]) -> int:
    """Return the memory for a block of photographs and the panoramas in memory, of 8000 key points (the default)."""
    assert isinstance(params, LocaliseParams)
    candidates, count = params.candidates, len(inputs["ranges"])
    photographs = _BLOCK if 0 < candidates < count else 1
    kept = LocatedPanoramas.kept(candidates, count)
    return 900_000_000 + 7_000_000 * photographs + 6_000_000 * kept


@params_from(localise_photograph, own_last=True)
class LocaliseParams(NetworkParams):
    """Settings of poses.localise."""

    path: InputPath = Field(description="folder of photographs, or one photograph")
    candidates: int = Field(
        default=20, ge=0, description="number of most similar panoramas to match each photograph with; 0: all"
    )
    min_confidence: int = Field(
        default=CONSISTENT_CONFIDENCE[0], ge=1, le=255, description="minimum confidence of ranges (128: consistent)"
    )

    @field_validator("path")
    @classmethod
    def _has_photographs(cls, path: Path) -> Path:
        """Refuse a folder without photographs with the workflow, before anything is computed."""
        if is_folder(path) and not any(file.suffix.lower() in PICTURE_SUFFIXES for file in files_below(path, [])):
            kinds = ", ".join(sorted(suffix.lstrip(".") for suffix in PICTURE_SUFFIXES))
            raise UsageError(
                f"{path}: no photographs here. Supported formats: {kinds}; folders called masks are skipped"
            )
        return path


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
    used. If the panoramas have key points of features.aliked, networks match them with the photographs, too.
    """
    group = split_groups(poses)[0]
    panoramas = LocatedPanoramas(
        {name: group.cam_from_world(idx) for idx, name in enumerate(group.names) if name in images},
        features,
        ranges,
        min_confidence=params.min_confidence,
        candidates=params.candidates,
    )
    if not panoramas:
        ctx.note("no panorama has both a range map and SIFT key points (features.sift_tangent)")
    patches = PanoramaPatches(panoramas.surface, lambda name: images[name].load())
    folder, paths = _photographs(params.path)
    named = {path.relative_to(folder).as_posix(): path for path in paths}
    found: dict[str, _Found] = {}
    rejected: dict[str, str] = {}
    for name, result in _results(named, panoramas, patches, features=features, params=params, ctx=ctx):
        if isinstance(result, str):
            rejected[name] = result
            ctx.note(f"{name} was not localised: {result}")
        else:
            found[name] = result
    ctx.note(f"{len(found)} of {len(paths)} photographs were localised")
    ctx.metric("localised", len(found) / max(1, len(paths)))
    return _record(found, rejected, named, ctx=ctx)


class _Found(NamedTuple):
    size_hw: tuple[int, int]
    localised: Localised


class _Photograph(NamedTuple):
    size_hw: tuple[int, int]
    focal_px: float | None
    keypoints: PhotographKeypoints
    patches: PhotographPatches
    view: PhotographView | None


def _results(
    paths: Mapping[str, Path],
    panoramas: LocatedPanoramas,
    patches: PanoramaPatches,
    *,
    features: Mapping[str, Features],
    params: LocaliseParams,
    ctx: Context,
) -> Iterator[tuple[str, _Found | str]]:
    """Yield each photograph that is localised, and the reason for each other one, by name.

    In large captures, the panoramas are read once for each block of photographs.
    """
    block = _BLOCK if panoramas.chooses else 1
    networks = params.networks if any(features[name].learned for name in features) else None
    for names in (list(paths)[start : start + block] for start in range(0, len(paths), block)):
        read = {name: _read(paths[name], patches, networks) for name in names}
        readable = {name: photograph for name, photograph in read.items() if isinstance(photograph, _Photograph)}
        chosen = panoramas.most_similar([photograph.keypoints.descriptors for photograph in readable.values()])
        of_name = dict(zip(readable, chosen, strict=True))
        del readable
        for name in names:
            photograph = read.pop(name)  # what it computes is freed before the next one
            if isinstance(photograph, str):
                yield name, photograph
                continue
            known = panoramas.points(of_name[name])
            result = localise_photograph(
                photograph.keypoints,
                photograph.size_hw,
                known,
                learned=_learned_matches(photograph, known, features, networks=networks),
                focal_px=photograph.focal_px,
                patches=photograph.patches,
                **arguments_from(localise_photograph, params),
                rng=ctx.rng,
            )
            yield name, result if isinstance(result, str) else _Found(photograph.size_hw, result)


def _learned_matches(
    photograph: _Photograph,
    known: Mapping[str, KnownPoints],
    features: Mapping[str, Features],
    *,
    networks: Networks | None,
) -> dict[str, NDArray[np.int32]]:
    """Return the matches that the network finds with each panorama, as positions among its known points."""
    if networks is None or photograph.view is None:
        return {}
    found = {}
    first = len(photograph.keypoints.pixels_px) - len(photograph.view.pixels_px)
    for name, points in known.items():
        matches = match_photograph(photograph.view, features[name], networks=networks)
        there = np.full(len(features[name]), -1)
        there[points.keypoints_idx] = np.arange(len(points.keypoints_idx))
        of_point = there[matches[:, 1]]
        found[name] = np.stack([matches[:, 0] + first, of_point], axis=1)[of_point >= 0].astype(np.int32)
    return found


def _read(path: Path, patches: PanoramaPatches, networks: Networks | None) -> _Photograph | str:
    """Return a photograph, or the reason why it cannot be read."""
    try:
        data = FilePart(path).read_bytes()
        picture = decode_image(path, data)
        size_hw = (picture.shape[0], picture.shape[1])
        focal_px = focal_from_exif(read_container(data).exif, size_hw)
    except InputError as error:
        return str(error)
    keypoints, view = photograph_keypoints(picture), None
    if networks is not None:
        view = view_of_photograph(picture, networks=networks)
        keypoints = PhotographKeypoints(
            np.concatenate([keypoints.pixels_px, view.pixels_px]),
            np.concatenate([keypoints.descriptors, view.descriptors]),
        )
    return _Photograph(size_hw, focal_px, keypoints, PhotographPatches(picture, patches), view)


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
    found: dict[str, _Found],
    rejected: dict[str, str],
    paths: dict[str, Path],
    *,
    ctx: Context,
) -> Photographs:
    def each(values: Iterable[object], dtype: type[np.generic], *shape: int) -> NDArray[Any]:
        return np.array(list(values), dtype).reshape(len(found), *shape)

    results = [one.localised for one in found.values()]
    return Photographs(
        names=tuple(found),
        sizes_hw=each((one.size_hw for one in found.values()), np.int32, 2),
        focals_px=each((result.focal_px for result in results), np.float64),
        radials=each((result.radial for result in results), np.float64),
        rotations=each((result.cam_from_world.rotation for result in results), np.float64, 3, 3),
        translations=each((result.cam_from_world.translation for result in results), np.float64, 3),
        inliers=each((result.inliers for result in results), np.int32),
        errors_px=each((result.error_px for result in results), np.float32),
        pictures=tuple(_copied(paths[name], number, ctx) for number, name in enumerate(found)),
        rejected=rejected,
    )
