"""Feature extractors: key points as bearings, unaffected by the seam and the poles."""

from __future__ import annotations

from pano_mvs.algorithms.features.sphorb import extract_sphorb
from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.api import Context, Each, Features, Panorama, Params, arguments_from, params_from, stage


@params_from(extract_sift)
class SiftParams(Params):
    """Settings of features.sift_tangent."""


@stage("features.sift_tangent")
def sift_tangent(image: Each[Panorama], params: SiftParams, ctx: Context) -> Features:
    """SIFT on the overlapping tangent tiles of an icosahedron."""
    features = extract_sift(
        image.load(),
        image.load_mask(),
        **arguments_from(extract_sift, params),
    )
    ctx.metric("keypoints", len(features))
    return features


@params_from(extract_orb)
class OrbParams(Params):
    """Settings of features.orb_tangent."""


@stage("features.orb_tangent")
def orb_tangent(image: Each[Panorama], params: OrbParams, ctx: Context) -> Features:
    """ORB on the overlapping tangent tiles of an icosahedron."""
    features = extract_orb(image.load(), image.load_mask(), **arguments_from(extract_orb, params))
    ctx.metric("keypoints", len(features))
    return features


@params_from(extract_sphorb)
class SphorbParams(Params):
    """Settings of features.sphorb."""


@stage("features.sphorb")
def sphorb(image: Each[Panorama], params: SphorbParams, ctx: Context) -> Features:
    """SPHORB: corners and binary descriptors on a geodesic grid of the sphere."""
    features = extract_sphorb(
        image.load(),
        image.load_mask(),
        **arguments_from(extract_sphorb, params),
    )
    ctx.metric("keypoints", len(features))
    return features
