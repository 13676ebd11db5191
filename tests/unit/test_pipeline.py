"""The pipeline with devices that are not what the configuration takes them for."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from agent.config import parse_config
from agent.core.events import CalibrationUpdate, DeviceChange, Output, StatusChange, Tick, WindowReport
from agent.core.pipeline import Pipeline
from hw.block import BlockFlags, DeviceInfo, SampleBlock

SECOND = 1_000_000_000
EPOCH_NS = 1_790_000_000 * SECOND
SENSITIVITY = np.array([[1.01, 0.02, 0.0], [0.0, 0.99, -0.01], [0.03, 0.0, 1.02]])
OFFSET = np.array([0.1, -0.2, 0.3])
POSE_S = 4.0
ALPHAS_DEG = (0.0, 30.0, 120.0)
# Angles and offsets are as stated here: what is looked at is time.
EXACT = {
    "angle_deg": 0,
    "theta_deg": 0,
    "alpha_common_deg": 0,
    "transverse_motion_pct": 0,
    "offset_mps2": 1e-3,
    "gravity_mps2": 0,
}


def pipeline(reference: bool, rate_hz: float) -> Pipeline:
    poses: list[dict[str, Any]] = [{"gravity_mps2": g} for g in ((0, 0, 9.8), (9.8, 0, 0), (0, 9.8, 0), (0, -9.8, 0))]
    if reference:
        poses = [{"theta_deg": 35, "alpha_deg": alpha} for alpha in ALPHAS_DEG]
    schedule = [{"start_s": POSE_S * k, "stop_s": POSE_S * k + POSE_S} | form for k, form in enumerate(poses)]
    channel: dict[str, Any] = {
        "sensor": "s",
        "prior": {"u_main_pct": 20},
        "uncertainty": EXACT,
        "gravity_mps2": 9.80665,
        "poses": schedule,
    }
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": rate_hz}} for n in "sr"]
    config = parse_config({"devices": devices, "channels": [channel | ({"reference": "r"} if reference else {})]}, "")
    return Pipeline.begin(config, "run", 0, 0, {})


def opened(device: str, t_s: float, *, axes: Any = 3, serial_number: str = "") -> DeviceChange:
    info = DeviceInfo("serial-csv", "serial-csv", serial_number, "m/s2", axes, 100.0)
    now_ns = round(t_s * SECOND)
    return DeviceChange(
        device=device,
        state="open",
        t_monotonic_ns=now_ns,
        t_utc_ns=EPOCH_NS + now_ns,
        info_json=json.dumps(asdict(info)),
    )


def lost(device: str, t_s: float) -> DeviceChange:
    now_ns = round(t_s * SECOND)
    return DeviceChange(
        device=device, state="lost", t_monotonic_ns=now_ns, t_utc_ns=EPOCH_NS + now_ns, message="unplugged"
    )


def tick(t_s: float) -> Tick:
    return Tick(t_monotonic_ns=round(t_s * SECOND), t_utc_ns=EPOCH_NS + round(t_s * SECOND))


def block(
    device: str, first: int, values: np.ndarray, *, nominal_hz: float, true_hz: float, step: int = 1
) -> SampleBlock:
    """Consecutive samples, each in a burst of its own 1 ms after it was taken; sample i has the number `step` * i."""
    n = len(values)
    arrivals = ((first + np.arange(n)) / true_hz * SECOND).astype(np.int64) + SECOND // 1000
    count = np.arange(1, n + 1, dtype=np.int32)
    return SampleBlock(
        device,
        "boot",
        EPOCH_NS + int(arrivals[-1]),
        first * step,
        nominal_hz,
        arrivals,
        count,
        np.ascontiguousarray(values),
    )


def motion(t_s: np.ndarray) -> np.ndarray:
    return 3.0 * np.sin(2 * np.pi * 2.3 * t_s)


def felt(t_s: np.ndarray) -> np.ndarray:
    """What the sensor on the clamp shows, (n, 3), by Eqs. (9)-(11) as printed."""
    pose = np.minimum((t_s // POSE_S).astype(int), len(ALPHAS_DEG) - 1)
    theta, alpha = np.radians(35.0), np.radians(np.array(ALPHAS_DEG))[pose]
    a, g = motion(t_s), 9.80665
    sin_t, cos_t = np.full_like(alpha, np.sin(theta)), np.full_like(alpha, np.cos(theta))
    along = np.column_stack([-np.sin(alpha) * cos_t, -np.cos(alpha) * cos_t, sin_t])
    up = np.column_stack([-np.sin(alpha) * sin_t, -np.cos(alpha) * sin_t, -cos_t])
    return (along * a[:, None] + up * g) @ SENSITIVITY.T + OFFSET


def played(
    *,
    reference: bool = True,
    axes: tuple[int, int] = (3, 1),
    nominal_hz: float = 100.0,
    true_hz: float = 100.0,
    step: int = 1,
) -> list[Output]:
    """All results of a run through the schedule."""
    found = pipeline(reference, nominal_hz)
    noise = np.random.default_rng(1)
    results = found.step(opened("s", 0.0, axes=axes[0])) + found.step(opened("r", 0.0, axes=axes[1]))
    n = round(true_hz / 2)
    for k in range(round(2 * POSE_S * 4) + 6):
        t_s = (k * n + np.arange(n)) / true_hz
        values = {
            "r": np.repeat(motion(t_s)[:, None], axes[1], axis=1),
            "s": (felt(t_s) + noise.normal(0, 1e-3, (n, 3)))[:, : axes[0]],
        }
        for device, of_device in values.items():
            results += found.step(
                block(
                    device, k * n, of_device, nominal_hz=nominal_hz, true_hz=true_hz, step=step if device == "s" else 1
                )
            )
    return results


@pytest.mark.slow
@pytest.mark.parametrize("true_hz", [50.0, 100.0, 200.0])
def test_a_device_at_half_or_double_its_stated_rate_is_calibrated_all_the_same(true_hz: float) -> None:
    update = [r for r in played(true_hz=true_hz) if isinstance(r, CalibrationUpdate)][-1]
    # What is left: 1 ms of arrival that the reference has too, resampling at 4 % of the rate, the first 20 bursts.
    assert np.abs(np.array(update.sensitivity) - SENSITIVITY).max() < 2e-3
    assert np.abs(np.array(update.offset) - OFFSET).max() < 5e-3  # an error of S times gravity is in it


@pytest.mark.parametrize(
    ("reference", "axes", "reason"),
    [
        (True, (1, 1), "s has 1 axis, this pose needs 3"),
        (True, (3, 3), "the reference r has 3 axes, this pose needs 1"),
        (False, (1, 1), "s has 1 axis, this pose needs 3"),
    ],
)
def test_a_wrong_number_of_axes_is_a_reason_and_not_the_end(
    reference: bool, axes: tuple[int, int], reason: str
) -> None:
    windows = [r for r in played(reference=reference, axes=axes) if isinstance(r, WindowReport)]
    assert len(windows) >= 3
    assert {(w.used, w.reason) for w in windows} == {(False, reason)}


def test_a_sequence_that_counts_microseconds_is_a_reason_and_not_a_full_memory() -> None:
    windows = [r for r in played(step=10_000) if isinstance(r, WindowReport)]
    assert len(windows) == 3
    assert {w.reason for w in windows} == {"s: its sample numbers and arrivals do not make a clock"}


def statuses(results: Sequence[Output]) -> list[str]:
    return [r.status for r in results if isinstance(r, StatusChange)]


def test_an_open_port_is_no_sensor_that_speaks() -> None:
    found = pipeline(reference=False, rate_hz=100.0)
    assert statuses(found.step(opened("s", 0.0))) == ["UNCALIBRATED"]
    assert statuses(found.step(lost("s", 1.0))) == ["INVALID"]
    for t_s in (2.0, 3.0):  # it opens and is gone, again and again
        assert statuses(found.step(opened("s", t_s)) + found.step(tick(t_s)) + found.step(lost("s", t_s))) == []
    spoken = block("s", 400, np.zeros((50, 3)), nominal_hz=100.0, true_hz=100.0)
    assert statuses(found.step(opened("s", 4.0)) + found.step(spoken)) == ["UNCALIBRATED"]


def test_another_device_at_the_port_is_said_before_it_speaks() -> None:
    found = pipeline(reference=False, rate_hz=100.0)
    found.step(opened("s", 0.0, serial_number="A"))
    found.step(lost("s", 1.0))
    assert statuses(found.step(opened("s", 2.0, serial_number="B"))) == ["UNCALIBRATED"]


def test_silence_turns_the_status_invalid_by_tick_and_a_block_ends_it() -> None:
    found = pipeline(reference=False, rate_hz=100.0)
    found.step(opened("s", 0.0))
    found.step(block("s", 0, np.zeros((50, 3)), nominal_hz=100.0, true_hz=100.0))  # up to 0.491 s; silence_s is 5
    assert statuses(found.step(tick(5.4))) == []
    assert statuses(found.step(tick(5.6))) == ["INVALID"]
    assert statuses(found.step(tick(6.6))) == []
    spoken = block("s", 700, np.zeros((50, 3)), nominal_hz=100.0, true_hz=100.0)
    assert statuses(found.step(spoken)) == ["UNCALIBRATED"]


def test_a_window_in_which_the_sensor_was_at_the_end_of_its_range_is_not_used() -> None:
    def verdicts(flags: BlockFlags) -> list[tuple[bool, str]]:
        found = pipeline(reference=False, rate_hz=100.0)
        results = found.step(opened("s", 0.0))
        noise = np.random.default_rng(1)
        for k in range(10):
            values = noise.normal((0.0, 0.0, 9.8), 0.01, (50, 3))
            whole = block("s", 50 * k, values, nominal_hz=100.0, true_hz=100.0)
            results += found.step(replace(whole, flags=flags if k == 4 else BlockFlags.NONE))
        return [(r.used, r.reason) for r in results if isinstance(r, WindowReport)]

    assert verdicts(BlockFlags.NONE) == [(True, "")]
    assert verdicts(BlockFlags.SATURATED) == [(False, "the sensor was at the end of its range")]
