"""Find the floors of a place before anything is swept at full resolution.

Small sweeps of all views find them where they have texture, to better than a percent of the camera's height. Ceilings
are mostly plain: found in the same way, they were up to 2 % off, and in the sweep plain pixels then confirmed them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pano_mvs.algorithms.panoramas import reduced_mask, reduced_panorama
from pano_mvs.algorithms.structure.planes import find_floors
from pano_mvs.algorithms.structure.view import ScenePlane, plane_view
from pano_mvs.algorithms.sweep.limits import agreed_ranges
from pano_mvs.algorithms.views import select_views
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.surfaces import Structure
from pano_mvs.scene.upright import states_y_down


def find_levels(
    poses: Poses, load: Callable[[str], Picture], load_mask: Callable[[str], Mask], *, rng: np.random.Generator
) -> Structure:
    """Return the floors that bound what the views of each group see, and no other planes.

    A group of poses whose frame does not state that y points down along gravity has none.

    Args:
        poses: of all views.
        load: returns the panorama of a view, (H, W, 3) RGB.
        load_mask: returns its mask, (H, W).
        rng: draws points and planes.
    """
    planes: list[ScenePlane] = []
    groups: list[int] = []
    for number, group in enumerate(split_groups(poses)):
        near = select_views(group, sources=4).neighbours
        if near and states_y_down(group.frame):
            planes += _levels_of(group, near, load, load_mask=load_mask, rng=rng)
            groups += [number] * (len(planes) - len(groups))
    return Structure(
        np.array([plane.normal for plane in planes]).reshape(-1, 3),
        np.array([plane.offset for plane in planes], np.float64),
        np.array([plane.uncertainty for plane in planes], np.float64),
        np.array(groups, np.int32),
    )


def _levels_of(
    group: Poses,
    near: Mapping[str, Sequence[str]],
    load: Callable[[str], Picture],
    *,
    load_mask: Callable[[str], Mask],
    rng: np.random.Generator,
) -> list[ScenePlane]:
    """Return the planes of one group; `near`: the sources of its views, each of which is a view itself."""
    names = list(near)
    cameras = [group.cameras[name] for name in names]
    pictures = [reduced_panorama(load(name), 512) for name in names]
    maps = agreed_ranges(
        pictures,
        cameras,
        [[names.index(other) for other in near[name] if other in near] for name in names],
        masks=[reduced_mask(load_mask(name), 512) for name in names],
    )
    views = [
        plane_view(ranges, lambda picture=picture: picture, camera)  # type: ignore[misc]
        for ranges, picture, camera in zip(maps, pictures, cameras, strict=True)
    ]
    return find_floors(views, rng=rng)
