"""The mechanisms of the dense stages that an ablation switches on and off, one line each."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from unittest import mock


@dataclass(frozen=True)
class Mechanism:
    """One mechanism, and how to run a workflow without it.

    Attributes:
        item: number of the requirement that it belongs to, which orders the table.
        name: for the table.
        settings: `STAGE.PARAM=VALUE …` that switch it off, or on if it is not one of the defaults.
        stages: changes of the workflow's stages, in the notation of workflows; None removes a stage.
        constants: values for constants that are no settings, by their full names.
        is_default: whether the workflow has it; otherwise, the changes switch it on.
        needs: "rig" or "soft" if it matters only where something moves with the camera, or where images are soft; only
            such places are measured then.
        drops_uncertainty: whether the cloud is fused without the uncertainty of the ranges.
    """

    item: str
    name: str
    settings: str = ""
    stages: Mapping[str, Any] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    is_default: bool = True
    needs: Literal["", "rig", "soft"] = ""
    drops_uncertainty: bool = False

    def workflow(self, base: str, folder: Path) -> str:
        """Return the workflow with the changes of stages: a file in the folder, or the base if there are none."""
        if not self.stages:
            return base
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{''.join(letter if letter.isalnum() else '_' for letter in self.name)}.yaml"
        parent = str(Path(base).resolve()) if Path(base).suffix else base
        content = {"pano_mvs": 1, "extends": parent, "stages": dict(self.stages)}
        path.write_text(json.dumps(content), encoding="utf-8")  # JSON is YAML
        return str(path)

    @contextmanager
    def changed_constants(self) -> Iterator[None]:
        """Change the constants for a while."""
        with ExitStack() as stack:
            for name, value in self.constants.items():
                stack.enter_context(mock.patch(name, value))
            yield


_ONE_ROUND: Mapping[str, Any] = dict.fromkeys(("first_smooth", "first_planes", "plain"))
FULL = Mechanism("", "the workflow as it is")
# Add a mechanism with one line. Removed stages: name the producers of the stages behind them, if these name it in `in`.
MECHANISMS = (
    Mechanism("1", "better half of the sources", "depth.combination=sum"),
    Mechanism("1", "weights of the sources", "slanted.view_weights=false"),
    Mechanism("1", "exchange between views", stages={"exchanged": None, "checked": {"in": {"range_map": "plain"}}}),
    Mechanism("2", "planes even in parallax", "depth.spacing=inverse"),
    Mechanism(
        "2",
        "near limit of half a baseline",
        constants={"pano_mvs.algorithms.sweep.hypotheses._NEAREST_BASELINES": 2.0},
    ),
    Mechanism("2", "windows of equal solid angle", "depth.spherical_window=false"),
    Mechanism("3", "P2 that follows the picture", "depth.p2_contrast=0"),
    Mechanism(
        "3", "P2 by squared contrast of colours", "depth.p2_falloff=inverse depth.p2_contrast=15 depth.edges=grey"
    ),
    Mechanism("3", "averages of similar colours", "depth.edge_support=1"),
    Mechanism("3", "pixels that neighbours support", "smooth.keep_supported=false"),
    Mechanism("3", "low penalties", "depth.p1=80 depth.p2=1600"),
    Mechanism("3", "gradients beside census", "depth.cost=census"),
    Mechanism("3", "free space of other views", stages={"visible": None}),
    Mechanism(
        "4",
        "second round on plain surfaces",
        stages={
            **_ONE_ROUND,
            "exchanged": {"in": {"range_map": "sky", "sources": "slanted"}},
            "checked": {"in": {"range_map": "exchanged", "sources": "slanted"}},
        },
    ),
    Mechanism(
        "4",
        "slanted planes",
        stages={
            **_ONE_ROUND,
            "slanted": None,
            "exchanged": {"in": {"range_map": "sky", "sources": "depth"}},
            "checked": {"in": {"range_map": "exchanged", "sources": "depth"}},
        },
    ),
    Mechanism(
        "4", "the sharp resolution", "depth.scale=nominal slanted.scale=nominal checked.scale=nominal", needs="soft"
    ),
    Mechanism("4", "several resolutions", "depth.multiscale=false slanted.multiscale=false", needs="soft"),
    Mechanism("4", "parallel planes", "planes.parallel_share=0"),
    Mechanism("4", "coarse to fine", "depth.levels=2", is_default=False),
    Mechanism(
        "4",
        "planes on plain walls",
        stages={
            "planes": None,
            "first_planes": None,
            "plain": {"in": {"range_map": "slanted", "filtered": "first_smooth"}},
        },
    ),
    Mechanism("5", "sky", "sky.enabled=false"),
    Mechanism("6", "mask of what moves with the camera", "static.enabled=false", needs="rig"),
    Mechanism("6", "mask of the operator", "people.enabled=false", needs="rig"),
    Mechanism("7", "uncertainty in the cloud", drops_uncertainty=True),
    Mechanism("7", "limit of the uncertainty", "cloud.max_uncertainty=null"),
    Mechanism("7", "smoothing of the cloud", "cloud.smooth=false"),
    Mechanism("8", "fill from the background", stages={"filled": None}),
    Mechanism("8", "bilateral solver", stages={"smooth": None}),
)
