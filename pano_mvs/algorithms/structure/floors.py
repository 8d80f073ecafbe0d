"""Find the floors of a place before anything is swept at full resolution.

Small sweeps of all views find them where they have texture, to better than a percent of the camera's height. Ceilings
are mostly plain: found in the same way, they were up to 2 % off, and in the sweep plain pixels then confirmed them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pano_mvs.algorithms.panoramas import reduced_mask, reduced_panorama
from pano_mvs.algorithms.structure.planes import find_floors
from pano_mvs.algorithms.structure.view import ScenePlane, plane_view
from pano_mvs.algorithms.sweep.limits import agreed_ranges
from pano_mvs.algorithms.views import select_views
from pano_mvs.scene import Panorama, Poses
from pano_mvs.scene.pose_groups import split_groups, with_cameras
from pano_mvs.scene.surfaces import Structure


def floors_of_groups(poses: Poses, images: Mapping[str, Panorama], *, rng: np.random.Generator) -> Structure:
    """Return the floors that bound what the views of each group see, and no other planes.

    A group of poses whose world is not known to be level has none.

    Args:
        poses: of all views.
        images: by name; views without one are left out.
        rng: draws points and planes.
    """
    planes: list[ScenePlane] = []
    groups: list[int] = []
    for number, group in enumerate(split_groups(poses)):
        seen = with_cameras(group, np.array([name in images for name in group.names], np.bool_))
        near = select_views(seen, sources=4).neighbours
        if near and group.axes.is_level:
            planes += _floors_of(seen, near, images, rng=rng)
            groups += [number] * (len(planes) - len(groups))
    return Structure(
        np.array([plane.normal for plane in planes]).reshape(-1, 3),
        np.array([plane.offset for plane in planes], np.float64),
        np.array([plane.uncertainty for plane in planes], np.float64),
        np.array(groups, np.int32),
    )


def _floors_of(
    group: Poses, near: Mapping[str, Sequence[str]], images: Mapping[str, Panorama], *, rng: np.random.Generator
) -> list[ScenePlane]:
    """Return the planes of one group; `near`: the sources of its views, each of which is a view itself."""
    names = list(near)
    cameras = [group.cameras[name] for name in names]
    pictures = [reduced_panorama(images[name].load(), 512) for name in names]
    maps = agreed_ranges(
        pictures,
        cameras,
        [[names.index(other) for other in near[name]] for name in names],
        masks=[reduced_mask(images[name].load_mask(), 512) for name in names],
    )
    views = [
        plane_view(ranges, lambda picture=picture: picture, camera)  # type: ignore[misc]
        for ranges, picture, camera in zip(maps, pictures, cameras, strict=True)
    ]
    return find_floors(views, rng=rng)
