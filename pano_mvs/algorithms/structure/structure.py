"""Find the structure of a place: the planes of all its groups of views."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated

import numpy as np

from pano_mvs.algorithms.structure.planes import find_planes
from pano_mvs.algorithms.structure.view import Picture, plane_view
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Poses, RangeMap
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.surfaces import Structure
from pano_mvs.scene.upright import states_y_down


@checks_settings
def find_structure(
    poses: Poses,
    range_maps: Mapping[str, RangeMap],
    load: Callable[[str], Picture],
    *,
    rng: np.random.Generator,
    max_relative_error: Annotated[float, Setting("maximum relative error of a range on a plane", gt=0, le=1)] = 0.02,
    min_share: Annotated[
        float, Setting("least extent of a plane, as a share of the sphere, in the mean over the views", gt=0, le=1)
    ] = 0.006,
) -> Structure:
    """Find the level and upright planes of a place.

    A group of poses whose frame does not state that y points down along gravity has no planes.

    Args:
        poses: of all views.
        range_maps: by name, those of all views that have one.
        load: returns the panorama of a view, (H, W, 3) RGB.
        rng: draws points and planes.
        max_relative_error: maximum relative error of a range on a plane.
        min_share: least extent of a plane, as a share of the sphere, in the mean over the views of a group.
    """
    planes, groups = [], []
    for number, group in enumerate(split_groups(poses)):
        named = [(idx, name) for idx, name in enumerate(group.names) if name in range_maps]
        if not named or not states_y_down(group.frame):
            continue
        views = [
            plane_view(range_maps[name], lambda name=name: load(name), group.cam_from_world(idx))  # type: ignore[misc]
            for idx, name in named
        ]
        share = min_share * len(views)
        found = find_planes(views, rng=rng, max_relative_error=max_relative_error, min_share=share)
        planes += found
        groups += [number] * len(found)
    return Structure(
        np.array([plane.normal for plane in planes]).reshape(-1, 3),
        np.array([plane.offset for plane in planes], np.float64),
        np.array([plane.uncertainty for plane in planes], np.float64),
        np.array(groups, np.int32),
    )
