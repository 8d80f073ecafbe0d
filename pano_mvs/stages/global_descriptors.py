"""Descriptors of whole images, by which pairs are chosen."""

from __future__ import annotations

from pano_mvs.algorithms.matching.vlad import vlad_descriptor
from pano_mvs.api import (
    Each,
    Features,
    GlobalDescriptor,
    Params,
    arguments_from,
    stage,
)


@stage("global.vlad", settings=vlad_descriptor)
def vlad(features: Each[Features], params: Params) -> GlobalDescriptor:
    """Compute a global descriptor of each panorama, for pairs.retrieval and loop closure."""
    return vlad_descriptor(features, **arguments_from(vlad_descriptor, params))
