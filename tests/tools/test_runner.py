"""`python -m tools` lists the scripts and runs them with their options."""

from __future__ import annotations

import pytest

from tools.__main__ import main, scripts


def test_the_list_has_a_line_for_each_script_of_a_group(capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    every = capsys.readouterr().out
    main(["stress"])
    listed = capsys.readouterr().out
    for name, summary in scripts().items():
        assert summary.endswith(".")
        assert f"{name} " in every
        assert (f"{name} " in listed) == name.startswith("stress ")
    assert {"mutation", "export_networks", "benchmarks poses.tours.houses"} <= scripts().keys()


@pytest.mark.parametrize(("words", "option"), [(["stress", "kills"], "--executor"), (["mutation"], "--sample")])
def test_help_shows_the_options(
    words: list[str], option: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", [])  # a script that reads the command line itself gets its own
    with pytest.raises(SystemExit, match="0"):
        main([*words, "--help"])
    assert option in capsys.readouterr().out


def test_unknown_scripts_are_refused() -> None:
    with pytest.raises(SystemExit, match="there is no script benchmarks kills"):
        main(["benchmarks", "kills"])
