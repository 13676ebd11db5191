"""Modules load without the garbage collector, which runs again afterwards, whatever happens."""

from __future__ import annotations

import gc
import importlib

import pytest

from agent.cli.loading import loading
from agent.cli.main import run_cli


def test_the_collector_waits_only_while_modules_load() -> None:
    assert gc.isenabled()
    with pytest.raises(ModuleNotFoundError), loading():
        importlib.import_module("agent.cli.nothing")
    with loading():
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.disable()
    try:
        with loading():
            pass
        assert not gc.isenabled()  # who has switched it off decides when it runs again
    finally:
        gc.enable()


def test_a_command_runs_with_the_collector(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["sensors"]) == 0
    assert "adxl355" in capsys.readouterr().out
    assert gc.isenabled()


def test_a_misspelled_command_is_answered_with_the_one_that_is_meant(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["calibrat"]) == 2
    assert "there is no command 'calibrat': did you mean 'calibrate'?" in capsys.readouterr().err
    assert run_cli(["xyzzy"]) == 2
    assert "No such command 'xyzzy'" in capsys.readouterr().err
