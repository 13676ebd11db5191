"""The virtual bench of `fieldcal run`: whose calibration is whose."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from agent.cli.main import run_cli
from agent.cli.run import lateness_s, virtual_bench
from agent.core.events import Gap
from agent.core.identity import identity_of
from agent.terminal.watch import RunView
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


def test_a_slow_computer_gets_devices_of_250_hz_and_gaps_are_told_with_their_cause(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with virtual_bench("plain", 1, slow=True) as (config, truth):
        assert [device.options["rate_hz"] for device in config.devices] == [250.0, 250.0]
        gap = Gap(device="mems", t_monotonic_ns=0, dropped=36, unit="bytes", reason="FIFO overrun while it was read")
        for known in (truth, None):
            with RunView(config, "bench", known) as watch:
                for _ in range(3):
                    watch.update(gap, [])
    told = [line for line in capsys.readouterr().out.splitlines() if "slow" in line or "dropped" in line]
    assert told[0].startswith("this computer is too slow for the simulation: 1 gap in the samples so far; ")
    assert told[1:] == 3 * ["mems: 36 bytes dropped: FIFO overrun while it was read"]  # of real devices
    assert 0.0 <= lateness_s() < 10.0


@pytest.mark.parametrize("duration", ["nan", "inf", "0", "-1", "soon"])
def test_a_duration_that_is_no_time_is_refused(duration: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["run", "--duration", duration]) == 2
    assert "--duration" in capsys.readouterr().err
