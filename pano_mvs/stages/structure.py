"""Ranges where pictures are plain: the planes of a place, and a neural network of the user's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field, model_validator

from pano_mvs.algorithms.learned.networks import Provider, open_network
from pano_mvs.algorithms.learned.range_prior import fill_from_prior, network_values
from pano_mvs.algorithms.structure.lay import lay_structure
from pano_mvs.algorithms.structure.planes import find_structure
from pano_mvs.api import (
    All,
    Context,
    Each,
    InputPath,
    Near,
    One,
    Panorama,
    Params,
    Pose,
    Poses,
    RangeMap,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.scene.pose_groups import require_one_group
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from pano_mvs.scene.structure import Structure
from pano_mvs.stages.memory import bytes_per_pixel


@params_from(find_structure)
class ScenePlanesParams(Params):
    """Settings of depth.scene_planes."""


@stage("depth.scene_planes")
def scene_planes(
    poses: One[Poses], ranges: All[RangeMap], images: All[Panorama], params: ScenePlanesParams, ctx: Context
) -> Structure:
    """Find the level and upright planes of a place in all range maps, and place them by the lines where they meet.

    Use it after poses.level: without known gravity, there are none.
    """
    found = find_structure(
        poses,
        ranges,
        lambda name: images[name].load(),
        rng=ctx.rng,
        **arguments_from(find_structure, params),
    )
    ctx.metric("planes", len(found))
    return found


@params_from(lay_structure, own_last=True)
class StructureParams(Params):
    """Settings of depth.structure."""

    enabled: bool = Field(default=True, description="false returns the range maps unchanged")


@stage("depth.structure", memory=bytes_per_pixel(200, each_source=12))
def structure(
    range_map: Each[RangeMap],
    image: Each[Panorama],
    pose: Each[Pose],
    sources: Near[RangeMap],
    source_poses: Near[Pose],
    planes: One[Structure],
    params: StructureParams,
    ctx: Context,
) -> RangeMap:
    """Move pixels to the planes of depth.scene_planes that they show, unless other views contradict.

    Confirmed pixels with texture move only a little, those without texture farther. Masked pixels get no range.
    """
    require_one_group(pose, source_poses)
    result, share = range_map, 0.0
    if params.enabled and len(planes):
        result, share = lay_structure(
            range_map,
            image.load(),
            planes,
            cam_from_world=pose.cam_from_world,
            sources=sources,
            source_poses=[other.cam_from_world for other in source_poses],
            group=pose.group,
            valid=image.load_mask(),
            **arguments_from(lay_structure, params),
        )
    ctx.metric("on_planes", share)
    ctx.metric("completeness", float(result.valid.mean()))
    ctx.metric("consistent", float((result.confidence >= CONSISTENT_CONFIDENCE[0]).mean()))
    return result


@params_from(network_values, fill_from_prior, own_last=True)
class PriorParams(Params):
    """Settings of depth.prior."""

    network: InputPath = Field(description="ONNX file of a network that estimates ranges from one panorama")
    provider: Provider = Field(
        default="cpu", description="what the network runs on; others than cpu need another package of ONNX Runtime"
    )

    @model_validator(mode="after")
    def _is_usable(self) -> PriorParams:
        open_network(self.network, self.provider).picture_input()
        return self


def _prior_memory(params: Params, inputs: Mapping[str, Any]) -> int:
    """Return the memory of the alignment, and about that of a large network."""
    return bytes_per_pixel(300)(params, inputs) + (2 << 30)


@stage("depth.prior", memory=_prior_memory)
def prior(range_map: Each[RangeMap], image: Each[Panorama], params: PriorParams, ctx: Context) -> RangeMap:
    """Fill what no view saw with the ranges of a neural network of your own, aligned to the ranges that views measured.

    Such networks see one panorama. Their ranges are filled ones (confidence 1-63), never confirmed. Use it last, after
    depth.structure. Where the network agrees with the measured ranges no better than a constant range would, the map
    stays as it is.
    """
    picture = image.load()
    network = open_network(params.network, params.provider)
    values = network_values(network, picture, **arguments_from(network_values, params))
    result, error = fill_from_prior(
        range_map, picture, values, valid=image.load_mask(), **arguments_from(fill_from_prior, params)
    )
    if error == float("inf"):
        ctx.note("the network's ranges do not agree with the measured ones, so that they are not used")
    else:
        ctx.metric("prior_error", error)
    ctx.metric("completeness", float(result.valid.mean()))
    return result
