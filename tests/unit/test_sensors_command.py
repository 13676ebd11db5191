"""`fieldcal sensors`: every driver with every option."""

from __future__ import annotations

import json
from typing import Any

import pytest

from agent.cli.main import run_cli
from hw.sensor import BUILT_IN, load_driver
from tests.unit.test_hw_registry import GOOD, install


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert run_cli(["sensors", *arguments, "--json", "-"]) == 0
    return dict(json.loads(capsys.readouterr().out))


def test_json_has_the_schema_that_the_configuration_is_checked_by(capsys: pytest.CaptureFixture[str]) -> None:
    drivers = {driver["name"]: driver for driver in printed(capsys)["drivers"]}
    assert set(drivers) >= set(BUILT_IN)
    for name in BUILT_IN:
        assert drivers[name]["options"] == load_driver(name).options_model.model_json_schema()
        assert drivers[name]["description"]
        for option, schema in drivers[name]["options"]["properties"].items():
            assert "default" in schema or option in drivers[name]["options"]["required"]
    assert drivers["adxl355"]["units"] == {
        "rate_hz": "Hz",
        "range_g": "g",
        "bus_khz": "kHz",
        "spi_mhz": "MHz",
        "poll_interval_s": "s",
    }


def test_every_option_says_what_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    silent = {
        f"{driver['name']}.{option}"
        for driver in printed(capsys)["drivers"]
        for option, schema in driver["options"]["properties"].items()
        if not schema.get("description")
    }
    assert silent == set()


def test_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["sensors", "adxl345", "serial-csv"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "adxl345: the ADXL345 on I2C or SPI, read through its FIFO."
    (range_line,) = [line for line in lines if line.startswith("  range_g")]
    assert range_line.split()[:8] == ["range_g", "g", "16", "2", "4", "8", "16", "range,"]
    (port,) = [line for line in lines if line.startswith("  port ")]
    assert port.split()[:3] == ["port", "required", "string"]


def test_an_unknown_driver_is_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["sensors", "adxl355", "adxl999"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("fieldcal sensors: no driver 'adxl999'; available drivers: adxl345, ")


def test_plug_ins_are_shown_and_a_broken_one_says_why(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, "kx134", GOOD, monkeypatch)
    install(tmp_path, "shattered", "1 / 0", monkeypatch)
    drivers = {driver["name"]: driver for driver in printed(capsys)["drivers"]}
    assert drivers["kx134"]["built_in"] is False
    assert "ZeroDivisionError" in drivers["shattered"]["fault"]
    assert run_cli(["sensors", "shattered"]) == 0
    assert "cannot be loaded: ZeroDivisionError" in capsys.readouterr().out
