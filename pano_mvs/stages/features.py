"""Feature extractors: key points as bearings, free of the seam and of the poles."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.api import Context, Each, Features, Panorama, Params, stage


class SiftParams(Params):
    """Settings of features.sift_tangent."""

    max_keypoints: int = Field(default=8000, ge=8, description="the best so many, spread over the sphere")
    contrast_threshold: float = Field(default=0.004, ge=0, description="lower finds more on plain walls")
    root: bool = Field(default=True, description="RootSIFT descriptors")


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

    max_keypoints: int = Field(default=8000, ge=8, description="the best so many, spread over the sphere")


@stage("features.orb_tangent")
def orb_tangent(image: Each[Panorama], params: OrbParams, ctx: Context) -> Features:
    """ORB on the overlapping tangent tiles of an icosahedron."""
    features = extract_orb(image.load(), image.load_mask(), max_keypoints=params.max_keypoints)
    ctx.metric("keypoints", len(features))
    return features
