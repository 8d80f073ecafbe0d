"""Feature extractors: key points as bearings, unaffected by the seam and the poles."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.features.sphorb import extract_sphorb
from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.api import Context, Each, Features, Panorama, Params, stage


class SiftParams(Params):
    """Settings of features.sift_tangent."""

    max_keypoints: int = Field(default=8000, ge=8, description="maximum number, spread over the sphere by strength")
    contrast_threshold: float = Field(
        default=0.004, ge=0, description="lower values find more key points on plain walls"
    )
    root: bool = Field(default=True, description="use RootSIFT descriptors")


@stage("features.sift_tangent")
def sift_tangent(image: Each[Panorama], params: SiftParams, ctx: Context) -> Features:
    """SIFT on the overlapping tangent tiles of an icosahedron."""
    features = extract_sift(
        image.load(),
        image.load_mask(),
        max_keypoints=params.max_keypoints,
        contrast_threshold=params.contrast_threshold,
        root=params.root,
    )
    ctx.metric("keypoints", len(features))
    return features


class OrbParams(Params):
    """Settings of features.orb_tangent."""

    max_keypoints: int = Field(default=8000, ge=8, description="maximum number, spread over the sphere by strength")


@stage("features.orb_tangent")
def orb_tangent(image: Each[Panorama], params: OrbParams, ctx: Context) -> Features:
    """ORB on the overlapping tangent tiles of an icosahedron."""
    features = extract_orb(image.load(), image.load_mask(), max_keypoints=params.max_keypoints)
    ctx.metric("keypoints", len(features))
    return features


class SphorbParams(Params):
    """Settings of features.sphorb."""

    max_keypoints: int = Field(default=10_000, ge=8, description="maximum number, spread over the sphere by strength")
    fast_threshold: int = Field(default=5, ge=1, le=254, description="lower values find more key points on plain walls")


@stage("features.sphorb")
def sphorb(image: Each[Panorama], params: SphorbParams, ctx: Context) -> Features:
    """SPHORB: corners and binary descriptors on a geodesic grid of the sphere."""
    features = extract_sphorb(
        image.load(),
        image.load_mask(),
        max_keypoints=params.max_keypoints,
        fast_threshold=params.fast_threshold,
    )
    ctx.metric("keypoints", len(features))
    return features
