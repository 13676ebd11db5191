"""What a session of `fieldcal bench` takes: angles of its options, and the samples of its devices."""

from __future__ import annotations

import numpy as np
import pytest

from agent.bench.capture import Capture
from agent.cli.main import run_cli
from agent.config import parse_config
from hw.block import BlockFlags, SampleBlock

RATE_HZ = 100.0
OPTIONS = {"port": "/dev/none", "rate_hz": RATE_HZ}


@pytest.mark.parametrize("angle", ["-360.5", "360.5"])
def test_an_angle_of_more_than_one_turn_is_refused(angle: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_cli(["bench", f"--thetas=35,{angle}"]) == 2
    assert "angles lie between -360 and 360 deg" in capsys.readouterr().err


def test_samples_that_the_device_counted_and_nobody_got_are_rows_of_nan() -> None:
    device = {"name": "imu", "driver": "serial-csv", "options": OPTIONS}
    channels = [
        {
            "sensor": "imu",
            "prior": {"u_main_pct": 20},
            "poses": [{"start_s": 0, "stop_s": 9, "gravity_mps2": [0, 0, 9.8]}],
        }
    ]
    capture = Capture(parse_config({"devices": [device], "channels": channels}, "test"), ["imu"])
    for first, degc in ((0, 20.0), (7, 21.0)):  # samples 4, 5 and 6 are missing
        arrival_ns = np.array([10**18 + first], np.int64)
        burst = arrival_ns, np.array([4], np.int32)
        capture._take(
            SampleBlock("imu", "boot", 0, first, RATE_HZ, *burst, np.full((4, 3), degc), BlockFlags.NONE, None, degc)
        )
    found = capture.record()["imu"]
    np.testing.assert_array_equal(found.values[:, 0], [20.0] * 4 + [np.nan] * 3 + [21.0] * 4)
    np.testing.assert_array_equal(found.temperature_degc, [20.0] * 4 + [21.0] * 7)
    assert len(found.time_s) == 11
