"""Put all panoramas of a tour into one house."""

from __future__ import annotations

import json
from collections import Counter
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pano_mvs.api import All, Context, Files, One, Panorama, Poses, RoomOutline, stage
from pano_mvs.core.text import plural, shortened_list
from pano_mvs.io.house_file import HOUSE_FILE, house_document
from pano_mvs.scene import House, PlacedBy
from pano_mvs_tours.house_of_links import house_of_links

_WIDTH_PX = 1024  # of the pictures in which lines of walls are found


@stage("house.links", memory="300MB")
def links(poses: One[Poses], images: All[Panorama], rooms: All[RoomOutline] | None, ctx: Context) -> House:
    """Find where the groups of cameras and the single panoramas of a virtual tour stand in one house, by its links.

    Links in the tour's configuration say in which direction other scenes lie, and those that stand on the floor roughly
    how far away; walls at right angles say how each scene is turned. Such places are good enough for a plan and for
    walking from room to room; they are not poses, and are not exported as such. The rooms of features.rooms, in heights
    of the camera, belong to the house.
    """
    house = house_of_links(
        poses,
        {name: image.links for name, image in images.items()},
        {name: partial(_picture, image) for name, image in images.items()},
        up_in_cam={name: image.up_in_cam for name, image in images.items() if image.up_in_cam is not None},
        rooms=rooms,
    )
    counts = Counter(house.placed_by)
    ctx.metric("by_links", counts[PlacedBy.LINKS])
    if counts[PlacedBy.LINKS]:
        by_links = [name for name, by in zip(house.names, house.placed_by, strict=True) if by == PlacedBy.LINKS]
        stand = plural(len(by_links), "panorama stands", "panoramas stand")
        ctx.note(
            f"links of the tour say where {len(by_links)} {stand} that matches do not join with the others: "
            f"{shortened_list(by_links)}"
        )
    return house


def _picture(image: Panorama) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    small = image.at_width(_WIDTH_PX)
    return small.load(), small.load_mask()


@stage("export.house")
def house_file(house: One[House], ctx: Context) -> Files:
    """Write house.json: where all panoramas of a virtual tour stand in one house, and what says so.

    Nothing is written unless links of the tour place some of them.
    """
    if PlacedBy.LINKS not in house.placed_by:
        return Files({})
    path = ctx.scratch / HOUSE_FILE
    path.write_text(json.dumps(house_document(house), indent=1) + "\n", encoding="utf-8")
    return Files({HOUSE_FILE: path})
