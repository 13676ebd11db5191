"""Outputs that are stuck, as the agent tells them; what is quiet, coarse or shaken by a machine is not called stuck."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core.events import Result, StatusChange
from agent.core.raw_watch import RawWatch
from agent.core.stream import DeviceStream
from benchmarks.online.runner import EPOCH_NS
from benchmarks.stuck import MOTIONS, alarms
from calib.model import Array
from calib.signal.outputs import Outputs
from hw.block import SampleBlock
from tests.unit.drawn_recording import Devices, Recording, reports

SINCE_S, STAND_S, COARSE_MPS2 = 150.0, 40.0, 0.04
RATE_HZ, BURST = 100.0, 25


def recording(coarse: bool) -> Recording:
    """Four minutes in a building; a coarse sensor has noise of a tenth of its resolution."""
    made = Recording(1, Devices(sensor_noise_mps2=0.004 if coarse else 0.005), bench=False, stand_s=STAND_S)
    if coarse:
        made.V = COARSE_MPS2 * np.round(made.V / COARSE_MPS2)
    return made


def held(axes: list[int], since_s: float = SINCE_S, value: float | None = None) -> Callable[[Array, Array], None]:
    def change(t: Array, V: Array) -> None:
        late = t >= since_s
        V[np.ix_(np.flatnonzero(late), np.array(axes))] = V[late][0][axes] if value is None else value

    return change


def toggles(t: Array, V: Array) -> None:
    late = t >= SINCE_S
    V[late, 0] = COARSE_MPS2 * np.random.default_rng(1).integers(1, 3, late.sum())


def told(results: list[Result]) -> list[tuple[float, str]]:
    """When the agent told of the samples of the sensor, in s of the recording, and what."""
    changes = [r for r in results if isinstance(r, StatusChange) and r.reason.startswith("s: ")]
    return [((change.t_utc_ns - EPOCH_NS) * 1e-9, change.reason) for change in changes]


@pytest.mark.two_cases
@pytest.mark.parametrize(
    ("coarse", "change", "since_s", "words"),
    [
        (False, held([0]), SINCE_S, "x is stuck at {}"),
        (False, held([0], 0.0), 0.0, "x is stuck at {}"),
        (False, held([2], value=32767.0), SINCE_S, "z is stuck at 32767, an end of its range,"),
        (True, held([0]), SINCE_S, "x is stuck at {}"),
        (True, toggles, SINCE_S, "x only toggles between 0.04 and 0.08"),
    ],
    ids=["x", "x from the beginning", "full scale", "x of a coarse sensor", "two codes"],
)
def test_a_stuck_output_is_told_and_never_calibrated(
    coarse: bool, change: Callable[[Array, Array], None], since_s: float, words: str
) -> None:
    made = recording(coarse)
    change(made.sensor_s, made.V)
    results = made.through_agent()
    ((at_s, said),) = told(results)
    at = datetime.fromtimestamp(EPOCH_NS * 1e-9 + since_s, UTC).strftime("%H:%M UTC")
    assert said == f"s: {words.format(f'{made.V[-1, 0]:.10g}')} since {at}"
    assert since_s < at_s < since_s + 120.0
    used = [report.stop_s for report in reports(results) if report.used]
    assert len(used) == since_s // STAND_S
    assert all(stop_s <= since_s for stop_s in used)
    assert not any("fieldcal command accept" in r.reason for r in results if isinstance(r, StatusChange))


@pytest.mark.slow
def test_all_outputs_are_told() -> None:
    made = recording(coarse=False)
    held([0, 1, 2])(made.sensor_s, made.V)
    found = told(made.through_agent())
    assert [said.split(" since ")[0].split(" at ")[0] for _, said in found] == [f"s: {k} is stuck" for k in "xyz"]
    assert max(at_s for at_s, _ in found) < SINCE_S + 120.0


@pytest.mark.slow
def test_a_sound_coarse_sensor_is_not_called_stuck() -> None:
    results = recording(coarse=True).through_agent()
    assert told(results) == []
    assert all(report.used for report in reports(results))


@pytest.mark.parametrize(("motion", "noise"), [("still", 0.2), ("machine", 0.05)])
def test_a_quiet_sensor_of_12_bits_is_not_called_stuck(motion: str, noise: float) -> None:
    """`python -m benchmarks.stuck` does the same for a day. The machine runs from the beginning, along two axes."""
    assert alarms(1, 0.1, MOTIONS[motion], noise) == []


def watched(x: Array, bursts: int = BURST) -> Iterator[tuple[list[str], NDArray[np.bool_]]]:
    """Samples (n, 3) of a device, one block of 1 s after the other: what is told after each, and which outputs (3,) of
    it are marked in the corrected stream."""
    watch, stream, size = RawWatch(600.0), DeviceStream("s", 0), round(RATE_HZ)
    for first in range(0, len(x), size):
        count = np.arange(bursts, size + 1, bursts, dtype=np.int32)
        arrivals = np.round((first + count) / RATE_HZ * 1e9).astype(np.int64)
        block = SampleBlock("s", "boot", int(arrivals[-1]), first, RATE_HZ, arrivals, count, x[first : first + size])
        stream.update(block)
        yield watch.update(block, stream, np.zeros(3), 0), watch.suspect("s")


def fed(x: Array, bursts: int = BURST) -> list[str]:
    """What is told of the samples."""
    return [text for said, _ in watched(x, bursts) for text in said]


def marked(x: Array) -> NDArray[np.bool_]:
    """(n, 3) the outputs that are marked, of each block."""
    return np.array([suspect for _, suspect in watched(x)])


@pytest.mark.slow
def test_bursts_that_a_driver_gives_twice_are_told() -> None:
    x = np.random.default_rng(1).normal(size=(12_000, 3)).round(2)
    assert fed(x) == []
    for first in range(8000, 9000, 200):
        x[first + BURST : first + 2 * BURST] = x[first : first + BURST]
    (said,) = fed(x)
    assert said.startswith("s: its driver gave the same samples twice, 3 times within ")
    assert np.flatnonzero(marked(x).all(axis=1)).tolist() == np.flatnonzero(marked(x).any(axis=1)).tolist()
    assert np.flatnonzero(marked(x)[:, 0]).tolist() == [80, 82, 84, 86, 88]
    sine = np.sin(2.0 * np.pi * np.arange(12_000) / 5.0)[:, None] * [0.0, 500.0, 100.0]  # 20 Hz, locked to the clock
    assert fed(np.round(sine)) == []


def test_an_output_that_sticks_now_and_then_is_told() -> None:
    random = np.random.default_rng(2)
    x = random.normal(size=(30_000, 3)).round(2)
    seen = set[int]()
    for at in random.integers(9000, 29_900, 14).tolist():  # four a minute
        end = at + random.integers(20, 100)
        x[at:end, 0] = x[at, 0]
        seen |= {at // 100, end // 100}
    (said,) = fed(x)
    marks = marked(x)
    assert not marks[:, 1:].any()
    assert set(np.flatnonzero(marks[:, 0]).tolist()) <= seen
    assert marks[:, 0].sum() >= 14  # a stick that goes on into the next block is marked there, at least
    assert said.startswith("s: x sticks: it held one value for a short time, 3 times within ")


def test_bits_that_are_read_wrongly_are_told() -> None:
    random = np.random.default_rng(4)
    sound = np.round(100.0 * random.normal(size=(12_000, 3)) + [0.0, 0.0, 256_000.0])
    at, bit = random.random(sound.shape) < 0.01 / 3.0, random.integers(0, 20, sound.shape)
    flipped = np.where(at, (sound.astype(np.int64) ^ (1 << bit)).astype(np.float64), sound)
    (said,) = fed(flipped)
    assert said.startswith(
        "s: single samples are off by a power of two (a bit is read wrongly: check cable and bus), 1"
    )
    assert fed(0.3 * flipped[:6000])[0].startswith("s: single samples are off by a power of two")  # steps of 0.3
    wrong = (np.abs(flipped - sound) > 2.0**12).reshape(-1, 100, 3).any(axis=1)  # larger than anything in the noise
    assert marked(flipped)[60:][np.asarray(wrong)[60:]].mean() > 0.9
    assert not marked(sound).any()
    knocks = np.where(at, sound + 10.0 ** random.uniform(4.0, 5.7, sound.shape), sound)
    assert fed(knocks) == fed(sound) == []


def test_a_device_that_has_another_number_of_axes_begins_again() -> None:
    watch, stream, arrivals = RawWatch(600.0), DeviceStream("s", 0), np.array([10**9])
    for first, axes in ((0, 1), (100, 3), (200, 1)):
        x, count = np.zeros((100, axes)), np.array([100], dtype=np.int32)
        block = SampleBlock("s", "boot", 10**9, first, RATE_HZ, arrivals + first * 10**7, count, x)
        stream.update(block)
        assert watch.update(block, stream, np.zeros(axes), 0) == []


def test_a_restored_watch_goes_on_bit_for_bit() -> None:
    x = np.random.default_rng(3).normal(size=(9000, 3)).round(1)
    whole, first = Outputs(3), Outputs(3)
    for at in range(0, 9000, 90):
        whole.update(at, x[at : at + 90], RATE_HZ, np.array([90]), anew=False)
        first.update(at, x[at : at + 90], RATE_HZ, np.array([90]), anew=False)
        first = Outputs.restore(first.snapshot())
    for name, value in whole.snapshot().items():
        np.testing.assert_array_equal(first.snapshot()[name], value)
