"""Exports of level panoramas, and of virtual tours of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.faces.sampling import Facing, level_from_world, turned_panorama
from pano_mvs.api import All, Context, Each, Files, One, Panorama, Params, Pose, Poses, RangeMap, WorldAxes, stage
from pano_mvs.io.colmap.workspace import write_picture
from pano_mvs.io.images.metadata import add_level_gpano
from pano_mvs.io.ranges import write_range_tiff
from pano_mvs.scene.files import LevelPanorama, group_file, item_stems
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs_tours.tour_players import (
    Link,
    Scene,
    krpano_tour,
    marzipano_data,
    marzipano_page,
    pannellum_page,
    pannellum_tour,
)

_FOLDER = "panoramas"
Player = Literal["pannellum", "marzipano", "krpano"]


class PanoramasParams(Params):
    """Settings of export.panoramas."""

    facing: Facing = Field(
        default="north",
        description="what lies in the middle. north: north, or the world's z if no compass or GPS turned the world; "
        "path: the next panorama of the capture; own: what lay there before",
    )
    format: Literal["jpg", "png"] = Field(default="jpg", description="format of the pictures (JPEG: quality 95)")
    ranges: bool = Field(default=True, description="also write the ranges of each panorama, if there are any")


def panoramas_memory_bytes(_: Params, inputs: Mapping[str, Any]) -> int:
    """Return the memory for one panorama: its picture twice, and a band of rays."""
    height, width = inputs["image"].size_hw
    return int(12 * height * width + 200 * 256 * width)


@stage("export.panoramas", memory=panoramas_memory_bytes)
def panoramas(
    image: Each[Panorama],
    pose: Each[Pose],
    poses: One[Poses],
    range_map: Each[RangeMap] | None,
    params: PanoramasParams,
    ctx: Context,
) -> LevelPanorama:
    """Write each panorama level, facing north or along the path, as panoramas/<image>.jpg with GPano metadata.

    Pitch and roll are stated as 0 if the world was levelled, and the heading if north is known. The ranges along the
    rays of the turned picture are panoramas/range/<image>.tiff (float32, NaN invalid). Masked pixels show the
    surrounding colours and have no range. Pictures have the working resolution.
    """
    group = split_groups(poses)[pose.group]
    cam_from_world = pose.cam_from_world
    here = (group.translations == cam_from_world.translation).all(axis=1)
    here &= (group.rotations == cam_from_world.rotation).all(axis=(1, 2))
    to_level = level_from_world(group, params.facing)[int(np.flatnonzero(here)[0])]
    turn = to_level @ cam_from_world.rotation.T
    picture, size_hw = f"{_FOLDER}/{{item}}.{params.format}", image.size_hw
    files = {picture: ctx.scratch / f"panorama.{params.format}"}
    write_picture(files[picture], np.asarray(turned_panorama(image.load(), turn), np.uint8))
    is_north = group.axes is WorldAxes.NORTH
    heading = float(np.rad2deg(np.arctan2(to_level[2, 0], to_level[2, 2]))) if is_north else None
    add_level_gpano(files[picture], size_hw, heading_deg=heading, level=group.axes.is_level)
    if range_map is not None and params.ranges:
        valid = range_map.valid & image.load_mask()
        ranges = turned_panorama(
            np.where(valid, range_map.range, np.float32(np.nan)), turn, interpolation=cv2.INTER_NEAREST
        )
        target = f"{_FOLDER}/range/{{item}}.tiff"
        files[target] = ctx.scratch / "range.tiff"
        write_range_tiff(files[target], np.asarray(ranges, np.float32))
    return LevelPanorama(files, picture, tuple(map(tuple, to_level.tolist())), heading)


class TourExportParams(Params):
    """Settings of export.tour."""

    players: tuple[Player, ...] = Field(
        default=("pannellum",), description="programs whose configuration and page are written"
    )


@stage("export.tour")
def tour_of_panoramas(
    panoramas: All[LevelPanorama], poses: One[Poses], images: All[Panorama], params: TourExportParams, ctx: Context
) -> Files:
    """Write a tour of the level panoramas of export.panoramas, with links in the true directions of the neighbours.

    Two panoramas are linked unless a third one lies in the sphere between them (a Gabriel graph), so that every
    panorama of a group can be reached. One arrives looking in the direction in which one went. Further groups of poses
    are tours of their own: tour_1.json …
    """
    files: dict[str, Path] = {}
    stems = item_stems(images)
    for number, group in enumerate(split_groups(poses)):
        names = [name for name in group.names if name in panoramas]
        if not names:
            continue
        order = [group.names.index(name) for name in names]
        turns = np.array([panoramas[name].level_from_world for name in names])
        links = _links(group.centers[order], turns)
        scenes = [
            Scene(
                stems[name],
                panoramas[name].picture.format(item=stems[name]).removeprefix(f"{_FOLDER}/"),
                images[name].size_hw[1],
                panoramas[name].heading_deg,
                links[idx],
            )
            for idx, name in enumerate(names)
        ]
        for target, text in _texts(scenes, params.players, number).items():
            files[f"{_FOLDER}/{target}"] = ctx.scratch / target
            files[f"{_FOLDER}/{target}"].write_text(text, encoding="utf-8", newline="\n")
        if not number:
            ctx.metric("links", sum(map(len, links)))
    return Files(files)


def _texts(scenes: list[Scene], players: tuple[Player, ...], group: int) -> dict[str, str]:
    """Return the files of a tour by name."""
    texts: dict[str, str] = {}
    if "pannellum" in players:
        name = group_file("tour.json", group)
        texts[name] = json.dumps(pannellum_tour(scenes), indent=1, ensure_ascii=False)
        texts[group_file("tour.html", group)] = pannellum_page(name)
    if "marzipano" in players:
        name = group_file("marzipano.js", group)
        texts[name] = marzipano_data(scenes)
        texts[group_file("marzipano.html", group)] = marzipano_page(name)
    if "krpano" in players:
        texts[group_file("krpano.xml", group)] = krpano_tour(scenes)
    return texts


def _links(centers: NDArray[np.float64], level_from_world: NDArray[np.float64]) -> list[tuple[Link, ...]]:
    """Return the links of each panorama to its neighbours in the Gabriel graph, the nearest first."""
    tree, links = scipy.spatial.cKDTree(centers), []
    for idx, center in enumerate(centers):
        steps = centers - center
        lengths = np.linalg.norm(steps, axis=1)
        # The nearest camera to the middle of a pair is one of the two, up to rounding, or the pair is not linked.
        nearest, _ = tree.query(center + steps / 2)
        others = np.flatnonzero((lengths > 0) & (nearest >= lengths / 2 * (1 - 1e-9)))
        others = others[np.argsort(lengths[others], kind="stable")]
        own = [_direction_deg(level_from_world[idx] @ steps[other]) for other in others]
        there = [_direction_deg(level_from_world[other] @ steps[other]) for other in others]
        links.append(
            tuple(
                Link(int(other), *here, arriving[0]) for other, here, arriving in zip(others, own, there, strict=True)
            )
        )
    return links


def _direction_deg(ray: NDArray[np.float64]) -> tuple[float, float]:
    """Return the yaw to the right and the pitch upwards of a direction in level axes."""
    return (
        float(np.rad2deg(np.arctan2(ray[0], ray[2]))),
        float(np.rad2deg(np.arctan2(-ray[1], np.hypot(ray[0], ray[2])))),
    )
