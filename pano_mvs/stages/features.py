"""Feature extractors: key points as bearings, unaffected by the seam and the poles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from pano_mvs.algorithms.features.sphorb import extract_sphorb
from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.algorithms.learned.aliked import extract_aliked, joined
from pano_mvs.algorithms.learned.networks import Networks, Provider
from pano_mvs.algorithms.poses.frame.upside_down import LEVEL_DEG, ups_of_picture
from pano_mvs.algorithms.poses.frame.walls import walls_of_picture
from pano_mvs.api import Context, Each, Features, InputPath, Panorama, Params, arguments_from, params_from, stage
from pano_mvs.scene import WeakImage


@stage("features.sift_tangent", settings=extract_sift)
def sift_tangent(image: Each[Panorama], params: Params, ctx: Context) -> Features:
    """SIFT on the overlapping tangent tiles of an icosahedron."""
    features = extract_sift(
        image.load(),
        image.load_mask(),
        **arguments_from(extract_sift, params),
    )
    ctx.metric("keypoints", len(features))
    return features


@stage("features.orb_tangent", settings=extract_orb)
def orb_tangent(image: Each[Panorama], params: Params, ctx: Context) -> Features:
    """ORB on the overlapping tangent tiles of an icosahedron."""
    features = extract_orb(image.load(), image.load_mask(), **arguments_from(extract_orb, params))
    ctx.metric("keypoints", len(features))
    return features


@stage("features.sphorb", settings=extract_sphorb)
def sphorb(image: Each[Panorama], params: Params, ctx: Context) -> Features:
    """SPHORB: corners and binary descriptors on a geodesic grid of the sphere."""
    features = extract_sphorb(
        image.load(),
        image.load_mask(),
        **arguments_from(extract_sphorb, params),
    )
    ctx.metric("keypoints", len(features))
    return features


class NetworkParams(Params):
    """Settings of stages that run neural networks in ONNX Runtime."""

    provider: Provider = Field(
        default="cpu", description="what the networks run on; others than cpu need another package of ONNX Runtime"
    )
    models: InputPath | None = Field(
        default=None, description="folder with network files of your own: named as those of the package, or COLMAP's"
    )

    @model_validator(mode="after")
    def _files_and_provider(self) -> NetworkParams:
        self.networks.check()
        return self

    @property
    def networks(self) -> Networks:
        """The network files and what executes them."""
        return Networks(self.models, self.provider)


@params_from(extract_aliked, own_last=True)
class AlikedParams(NetworkParams):
    """Settings of features.aliked."""

    only_weak: bool = Field(default=True, description="false ignores matches.weak: all images get learned key points")


def _aliked_memory(params: Params, inputs: Mapping[str, Any]) -> int:
    """Return the memory of the detector's maps, and of nothing for images that need no learned key points."""
    assert isinstance(params, AlikedParams)
    weak = inputs.get("weak")
    return 600 << 20 if weak is None or weak.wanted or not params.only_weak else 0


@stage("features.aliked", memory=_aliked_memory)
def aliked(
    image: Each[Panorama],
    features: Each[Features] | None,
    weak: Each[WeakImage] | None,
    params: AlikedParams,
    ctx: Context,
) -> Features:
    """Key points of the network ALIKED on level views around the horizon, for matches.lightglue.

    The network finds the same points on white walls, glass and in other light, where SIFT finds few. The camera is
    levelled by the lines in the panorama. Without any, its own up direction counts. Where these and brightness and
    texture leave open which way a turned camera was held, the network sees it with each likely direction up.
    The result begins with the key points of an earlier stage of features, if there is one. After matches.weak, images
    that need no learned key points keep theirs. The directions of walls in the picture are stored with them: they
    distinguish true relative poses from those of things that look alike.
    """
    if params.only_weak and weak is not None and features is not None and not weak.wanted:
        return features
    picture, mask = image.load(), image.load_mask()
    ups = ups_of_picture(picture, mask)
    if len(ups) > 1 or -ups[0][1] < np.cos(np.radians(LEVEL_DEG)):
        ctx.note(
            "{count} panoramas may be turned or upside down, by their lines, brightness and texture, so networks see "
            "them in each likely orientation"
        )
    found = extract_aliked(picture, mask, ups=ups, networks=params.networks, **arguments_from(extract_aliked, params))
    learned = replace(found, walls_from_cam=walls_of_picture(picture, mask, ups[0]))
    ctx.metric("keypoints", len(learned))
    return learned if features is None else joined(features, learned)
