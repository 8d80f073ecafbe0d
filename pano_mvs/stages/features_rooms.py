"""The rooms around single panoramas, from their pictures alone.

They have a module of their own because they know planes: a change of their code would compute all key points again.
"""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.structure.room_outlines import ceilings_of, lines_of, outline_of
from pano_mvs.api import All, Ceilings, Context, Each, One, Panorama, Params, RoomLines, RoomOutline, stage

_WIDTH_PX = 1024  # of the pictures in which lines are found


class RoomParams(Params):
    """Settings of features.room_lines."""

    only_linked: bool = Field(
        default=False, description="leave out panoramas without links of a virtual tour that state directions"
    )


@stage("features.room_lines", memory="300MB")
def room_lines(image: Each[Panorama], params: RoomParams, ctx: Context) -> RoomLines:
    """Find the vertical, the directions of walls, and how high the ceiling may be, by the lines of a panorama."""
    if params.only_linked and all(link.direction_deg is None for link in image.links):
        return RoomLines.unknown()
    small = image.at_width(_WIDTH_PX)
    found = lines_of(small.load(), small.load_mask(), image.up_in_cam)
    if found.wall_rad is None:
        ctx.note("{count} panoramas show no walls at right angles, so that their rooms are not known")
    return found


@stage("features.ceilings")
def ceilings(lines: All[RoomLines]) -> Ceilings:
    """Combine what the lines of all panoramas say of the height of ceilings: mostly, one capture has one height."""
    return ceilings_of(lines.values())


@stage("features.rooms", memory="300MB")
def rooms(image: Each[Panorama], lines: Each[RoomLines], ceilings: One[Ceilings], ctx: Context) -> RoomOutline:
    """Find the outline of the room around a panorama, in heights of its camera above the floor.

    One picture is enough, since the lines where walls meet floor and ceiling show how far away they are. All panoramas
    of the capture say how high ceilings are. Openings, curved walls and walls at other angles are not known.
    """
    if lines.wall_rad is None:
        return RoomOutline.unknown(lines.cam_from_level)
    outline = outline_of(image.at_width(_WIDTH_PX).load(), lines, ceilings)
    ctx.metric("ceiling", outline.ceiling or 0.0)
    return outline
