"""What bundled plugins bring beside stages keeps the contracts of its doors, and is listed."""

from __future__ import annotations

import pytest

from pano_mvs.io.readers import CAPTURE_READERS
from pano_mvs.testing.conformance import (
    ContractTest,
    command_contract_tests,
    observer_contract_tests,
    reader_contract_tests,
)
from tests.cli.conftest import Command
from tests.cli.test_plugins_listing import rows

KEPT = [
    *observer_contract_tests("notify", values=["json://127.0.0.1:9"]),
    *reader_contract_tests("tour"),
    *reader_contract_tests("video"),
    *(
        # Each starts a process to see which libraries a command loads.
        one if "without loading" not in one.name else pytest.param(one, marks=pytest.mark.slow)
        for name in ("crate", "cache.push", "cache.pull", "plugin.remove")
        for one in command_contract_tests(name)
    ),
]


@pytest.mark.parametrize("contract_test", KEPT, ids=str)
def test_bundled_plugins_keep_their_contracts(contract_test: ContractTest) -> None:
    contract_test.check()


def test_bundled_plugins_have_a_row_each(pano_mvs: Command) -> None:
    result = pano_mvs("plugins", "--check")
    assert result.code == 0, result.text
    found = rows(result.text)
    assert found["pano_mvs_queues"] == [
        "bundled",
        "ok",
        "commands cache.pull, cache.push; executors dask, lsf, pbs, sge, slurm",
    ]
    assert found["pano_mvs_environments"] == [
        "bundled",
        "ok",
        "commands plugin.install, plugin.remove; functions install_plugin, plugin_environments, remove_plugin",
    ]
    assert found["pano_mvs_records"] == ["bundled", "ok", "command crate; observers notify, otel"]
    assert found["pano_mvs_video"] == ["bundled", "ok", "stage source.video; capture reader video"]


def test_capture_readers_of_bundled_plugins_are_known_by_name() -> None:
    assert {"tour", "video"} <= set(CAPTURE_READERS.names())
