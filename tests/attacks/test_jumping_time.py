"""A recording in which the time jumps by years: windows that nobody could see are jumped over, not enumerated."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from agent.config import Config, ConfigError, parse_config
from agent.core.events import Event, Tick
from agent.core.pipeline import Pipeline
from agent.core.stream import DeviceStream
from agent.recording.messages import MessageError, decode, encode
from hw.block import BlockFlags, SampleBlock
from tests.properties import happenings

SECOND = 1_000_000_000
YEAR_NS = 366 * 86_400 * SECOND
ORIGIN_NS = happenings.ORIGIN_NS
MOST_RESULTS = 300
CPU_LIMIT_S = 5.0


def block(at_ns: int, first_index: int, rate_hz: float = 50.0, flags: BlockFlags = BlockFlags.NONE) -> SampleBlock:
    values = np.tile([0.0, 0.0, 9.8], (25, 1)) + np.random.default_rng(first_index % 1000).normal(0, 0.01, (25, 3))
    counts, arrivals = np.array([25], np.int32), np.array([at_ns], np.int64)
    return SampleBlock("s", "boot", happenings.EPOCH_NS + at_ns, first_index, rate_hz, arrivals, counts, values, flags,
                       None, None)  # fmt: skip


def site(**channel: Any) -> Config:
    held = {"sensor": "s", "prior": {}, "window_s": 1.0, "guard_s": 0.1, **channel}
    devices = [{"name": "s", "driver": "serial-csv", "options": {"port": "s", "rate_hz": 50.0}}]
    return parse_config({"devices": devices, "channels": [held]}, "test")


POSES = [
    {"start_s": 0, "stop_s": 2, "gravity_mps2": (0, 0, 9.8)},
    {"start_s": 2, "stop_s": 4, "gravity_mps2": (9.8, 0, 0)},
]
STOPS = [{"gravity_mps2": (0, 0, 9.8)}, {"gravity_mps2": (9.8, 0, 0)}, {"gravity_mps2": (0, 9.8, 0)}]
SITES = {
    "poses that repeat": lambda: site(poses=POSES, poses_repeat_s=4.0),
    "one long pose": lambda: site(poses=[{"start_s": 0, "stop_s": 1e9, "gravity_mps2": (0, 0, 9.8)}]),
    "positions that are found": lambda: site(positions=STOPS),
}


def jumps(years: int) -> list[Event]:
    start = [block(ORIGIN_NS + k * SECOND // 2, 25 * k, flags=BlockFlags.RESTART if not k else BlockFlags.NONE)
             for k in range(12)]  # fmt: skip
    later = ORIGIN_NS + 6 * SECOND + years * YEAR_NS
    tick = Tick(t_monotonic_ns=later, t_utc_ns=happenings.EPOCH_NS + later)
    return [*start, block(later, 300), tick, block(later + SECOND, 325)]


@pytest.mark.parametrize("name", SITES)
@pytest.mark.parametrize("years", [3, 250])
def test_years_are_jumped_over(name: str, years: int) -> None:
    pipeline = Pipeline.begin(SITES[name](), "run", ORIGIN_NS, 0, {})
    began_s = time.process_time()
    most = 0
    for event in jumps(years):
        most = max(most, len(pipeline.step(event)))
        again = Pipeline.restore(SITES[name]().model_dump_json(), pipeline.snapshot())
        assert again.snapshot() == pipeline.snapshot()
    assert most < MOST_RESULTS
    assert time.process_time() - began_s < CPU_LIMIT_S


def test_after_a_jump_windows_are_made_again() -> None:
    pipeline = Pipeline.begin(SITES["poses that repeat"](), "run", ORIGIN_NS, 0, {})
    events = jumps(3)
    at_ns = events[-1].t_monotonic_ns
    told: list[Any] = []
    for event in [*events, *(block(at_ns + k * SECOND // 2, 325 + 25 * k) for k in range(1, 30))]:
        told = [*told, *pipeline.step(event)] if event.t_monotonic_ns > at_ns else [*pipeline.step(event), *told][:0]
    windows = [result for result in told if result.what == "window"]
    assert 5 < len(windows) < MOST_RESULTS
    assert windows[-1].stop_s > 3 * 365 * 86_400


def test_a_pose_later_than_any_time_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"poses\.0\.start_s"):
        site(poses=[{"start_s": 1e300, "stop_s": 2e300, "gravity_mps2": (0, 0, 9.8)}])


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, 1e7, 1e300, float("inf"), float("nan")])
def test_a_block_with_an_impossible_rate_is_refused(rate_hz: float) -> None:
    with pytest.raises(MessageError, match="nominal_rate_hz is"):
        decode("fieldcal.v1.RawBlock", encode(1, block(ORIGIN_NS, 0, rate_hz)))


def test_a_few_samples_with_a_large_gap_take_little_memory() -> None:
    """At a rate of 1 MHz, a window of 600 s with two blocks of 25 samples would have 14 GB of gaps."""
    stream = DeviceStream("s", ORIGIN_NS)
    stream.update(block(ORIGIN_NS + SECOND, 0, 1e6, BlockFlags.RESTART))
    stream.update(block(ORIGIN_NS + 601 * SECOND, 600_000_000, 1e6))
    cut = stream.cut(0.0, 601.0)
    assert cut is None or not cut.in_time
