"""Stages that misbehave on the workers of a dask cluster."""

from __future__ import annotations

import sys

import pytest

from tests.engine.running.test_misbehaviour import (
    FATAL,
    MISBEHAVIOURS,
    Misbehaved,
    check_others,
    check_reasons,
    misbehave,
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="signals, limits and /proc of Linux"),
    pytest.mark.filterwarnings("ignore"),
]


@pytest.fixture(scope="module")
def misbehaved(tmp_path_factory: pytest.TempPathFactory) -> Misbehaved:
    return misbehave(tmp_path_factory.mktemp("misbehaved"), "dask", MISBEHAVIOURS | FATAL)


def test_a_unit_that_misbehaves_fails_with_the_reason(misbehaved: Misbehaved) -> None:
    check_reasons(misbehaved)


def test_the_others_go_on_and_the_cache_stays_readable(misbehaved: Misbehaved) -> None:
    check_others(misbehaved)
