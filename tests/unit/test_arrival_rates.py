"""What a run says of a device that sends at another rate than the configuration states."""

from __future__ import annotations

import numpy as np
import pytest

from agent.acquisition.arrival_rates import ArrivalRates
from agent.core.events import DeviceChange, Event
from hw.block import SampleBlock

STATED_HZ = 100.0
OPENED = DeviceChange(device="laser", state="open", t_monotonic_ns=0, t_utc_ns=0, info_json="{}")


def blocks(rate_hz: float, seconds: float, *, begin_s: float = 0.0, waiting: int = 0) -> list[Event]:
    """Blocks each half second; with the first come `waiting` samples that a buffer held."""
    size, index = round(rate_hz / 2), 0
    made: list[Event] = []
    for k in range(round(2 * seconds)):
        n = size + (waiting if k == 0 else 0)
        at = np.array([(begin_s + 0.5 * k) * 1e9], dtype=np.int64)
        count = np.array([n], dtype=np.int32)
        made.append(SampleBlock("laser", "boot", 0, index, STATED_HZ, at, count, np.zeros((n, 1))))
        index += n
    return made


def said(*events: Event) -> list[str]:
    rates = ArrivalRates()
    return [told for event in events for told in rates.messages(event)]


@pytest.mark.parametrize("rate_hz", [1000.0, 200.0, 50.0])
def test_another_rate_is_told_once_with_both(rate_hz: float) -> None:
    (line,) = said(OPENED, *blocks(rate_hz, 60.0))
    assert line.startswith(f"laser: {rate_hz:g} samples a second arrive, 100 are stated: correct rate_hz")


@pytest.mark.parametrize("rate_hz", [90.0, 100.0, 110.0])
def test_an_oscillator_may_be_off_and_a_buffer_full(rate_hz: float) -> None:
    assert said(OPENED, *blocks(rate_hz, 60.0, waiting=5000)) == []


def test_the_time_without_a_device_is_not_counted() -> None:
    gone = DeviceChange(device="laser", state="lost", t_monotonic_ns=0, t_utc_ns=0, info_json="{}")
    assert said(OPENED, *blocks(100.0, 5.0), gone, OPENED, *blocks(100.0, 30.0, begin_s=300.0)) == []
