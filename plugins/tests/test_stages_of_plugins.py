"""The stages of bundled plugins keep the contract, and all that is written down of stages is there."""

from __future__ import annotations

import pytest

from pano_mvs.core.doors import own_packages
from pano_mvs.session.session import presets_folder
from pano_mvs.testing.conformance import ContractTest
from tests.golden.record import case_names, read_recorded
from tests.presets import usable_presets
from tests.testing.test_builtin_stages import contract_tests

PACKAGES = sorted(own_packages() - {"pano_mvs"})


@pytest.mark.parametrize("contract_test", [test for package in PACKAGES for test in contract_tests(package)])
def test_keeps_the_contract(contract_test: ContractTest) -> None:
    contract_test.check()


def test_every_stage_that_is_written_down_exists() -> None:
    assert set(read_recorded()) == {*case_names()}


def test_every_preset_can_be_run() -> None:
    """The core's tests of presets are about those whose stages are there: here, all."""
    assert usable_presets() == sorted(presets_folder().glob("*.yaml"))
