"""Matches between two models, and the model that two aligned ones form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.joining.cross_matches import CrossMatches, stacked
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.geometry import Rigid3, Similarity3, angle_between, geodesic_angle

_SAME_TURN_RAD, _SAME_DIRECTION_RAD = float(np.deg2rad(2.0)), float(np.deg2rad(4.0))


def cross_matches(
    first: PlacedModel, second: PlacedModel, matches: Mapping[tuple[int, int], NDArray[np.int32]]
) -> CrossMatches:
    """Return matches between the images of two models, with the rays and known ranges of both.

    Args:
        first: a model.
        second: another model of the same capture, which shares no image with the first one.
        matches: (image of the first model, image of the second one) to (M, 2) positions of key points.
    """
    parts = []
    for (one, other), found in sorted(matches.items()):
        cameras = first.cameras[one], second.cameras[other]
        both = ((first, one, cameras[0]), (second, other, cameras[1]))
        parts.append(
            CrossMatches(
                cameras=np.tile(np.array([[one, other]], np.intp), (len(found), 1)),
                keypoints=np.asarray(found, np.int32),
                centers=np.tile(np.stack([camera.center for camera in cameras])[None], (len(found), 1, 1)),
                rays=np.stack(
                    [
                        model.pairs.bearings[image][found[:, side]] @ camera.rotation
                        for side, (model, image, camera) in enumerate(both)
                    ],
                    axis=1,
                ),
                ranges=np.stack(
                    [model.known_ranges(image)[found[:, side]] for side, (model, image, _) in enumerate(both)], axis=1
                ),
            )
        )
    return stacked(parts)


def joined_model(first: PlacedModel, second: PlacedModel, first_from_second: Similarity3) -> PlacedModel:
    """Return the cameras, chosen geometries and ranges of two models in the world of the first one."""
    model = first.copy()
    within = {edge: found for edge, found in second.pairs.geometries.items() if second.cameras.keys() >= {*edge}}
    model.pairs = replace(first.pairs, geometries={**first.pairs.geometries, **within})
    scale, turn = first_from_second.scale, first_from_second.rotation
    for image, camera in second.cameras.items():
        center = first_from_second.apply(camera.center[None])[0]
        model.cameras[image] = Rigid3.from_center(camera.rotation @ turn.T, center)
        model.set_ranges(image, scale * second.known_ranges(image))
    model.chosen |= second.chosen
    return model


def are_apart(alignments: tuple[Similarity3, Similarity3], first: PlacedModel, second: PlacedModel) -> bool:
    """Return whether two alignments put the second model at different places in the world of the first one."""
    one, other = alignments
    if float(geodesic_angle(one.rotation, other.rotation)) > _SAME_TURN_RAD:
        return True
    centers = np.array([camera.center for camera in second.cameras.values()])
    origin = np.mean([camera.center for camera in first.cameras.values()], axis=0)
    offsets = one.apply(centers) - origin, other.apply(centers) - origin
    return bool(angle_between(*offsets).max() > _SAME_DIRECTION_RAD)
