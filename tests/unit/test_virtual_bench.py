"""The virtual bench of `fieldcal run`: whose calibration is whose."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from agent.cli.main import run_cli
from agent.cli.run import virtual_bench
from agent.core.identity import identity_of
from hw.sensor import load_driver


def identity(preset: str, seed: int) -> str:
    """Of the sensor, as the agent would read it."""
    with virtual_bench(preset, seed) as (config, _):
        device = config.devices[0]
        factory = load_driver(device.driver)
        sensor = factory(device.name, factory.options_model.model_validate(device.options))
        info = sensor.open()
        sensor.close()
    return identity_of(json.dumps(asdict(info)))


def test_a_calibration_is_kept_for_the_same_bench_and_no_other() -> None:
    first = identity("plain", 1)
    assert identity("plain", 1) == first
    assert len({first, identity("plain", 2), identity("faulty", 1)}) == 3


@pytest.mark.parametrize("duration", ["nan", "inf", "0", "-1", "soon"])
def test_a_duration_that_is_no_time_is_refused(duration: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["run", "--duration", duration]) == 2
    assert "--duration" in capsys.readouterr().err
