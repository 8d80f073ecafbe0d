"""Ranges of a neural network for what no view saw."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field, model_validator

from pano_mvs.algorithms.learned.networks import Provider, open_network
from pano_mvs.api import (
    Context,
    Each,
    InputPath,
    Panorama,
    Params,
    RangeMap,
    arguments_from,
    params_from,
    stage,
)
from pano_mvs.stages.filters import bytes_per_pixel
from pano_mvs_prior.range_prior import fill_from_prior, network_values


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

    Such networks see one panorama. Their ranges are filled ones (confidence 3-63), never confirmed. Use it last, after
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
