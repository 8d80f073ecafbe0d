"""Stages with a unit for each image read what a unit needs, not the whole capture: time would grow as its square."""

from __future__ import annotations

from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import Cardinality

_WHOLE = {Cardinality.ALL, Cardinality.NAMES}
_OF_A_UNIT = {Cardinality.EACH, Cardinality.NEAR}


def test_no_stage_reads_all_items_in_each_of_its_units() -> None:
    """masks.moving read all images, ranges and poses: 5,000 panoramas took 10 minutes in a run with nothing to do."""
    specs = Registry.installed().stages.values()
    mixed = [
        spec.name
        for spec in specs
        if (found := {port.cardinality for port in spec.ports}) & _WHOLE and found & _OF_A_UNIT
    ]
    assert mixed == []
    assert any(spec.every_image for spec in specs)
