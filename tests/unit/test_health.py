"""The gateway's status: counts, rates and clock from blocks with known truth; degraded with the reason."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.config import Config, parse_config
from agent.core.events import DeviceChange, Event, Gap, Tick
from agent.supervision.devices import DeviceWatch
from agent.supervision.health import (
    SILENT_S,
    GatewayStatus,
    Health,
    ProcessHealth,
    PublicationHealth,
    Queue,
    RecordingHealth,
    Situation,
)
from hw.block import BlockFlags, SampleBlock
from tests.unit.results import calibration, status, window

START_NS = 1_000_000_000_000
S = 1_000_000_000
RATE_HZ = 1003.3  # true; nominal is 1000


def config(**supervision: Any) -> Config:
    option = {"port": "/dev/null", "rate_hz": 1000, "axes": 3, "unit": "m/s2"}
    devices = [{"name": n, "driver": "serial-csv", "options": option} for n in ("mems", "reference")]
    raw = {
        "devices": devices,
        "channels": [{"sensor": "mems", "reference": "reference", "prior": {}}],
        "supervision": supervision,
    }
    return parse_config(raw, "test")


def change(device: str, state: Any, t_s: float = 0.0, message: str = "ADXL355") -> DeviceChange:
    t_ns = START_NS + int(t_s * S)
    return DeviceChange(device=device, state=state, message=message, t_monotonic_ns=t_ns, t_utc_ns=t_ns)


def block(device: str, k: int, flags: BlockFlags = BlockFlags.NONE, first: int | None = None) -> SampleBlock:
    """The k-th half second: 25 bursts of 20 samples each, that arrive late by up to 1 ms."""
    first = 500 * k if first is None else first
    count = np.arange(20, 501, 20, dtype=np.int32)
    late_s = np.random.default_rng(k).exponential(3e-4, 25)
    arrival_s = (first + count) / RATE_HZ + late_s
    arrival_ns = START_NS + np.sort(arrival_s * S).astype(np.int64)
    indications = np.zeros((500, 3), np.int32)
    return SampleBlock(
        device, "boot", 0, first, 1000.0, arrival_ns, count, indications, flags, temperature_degc=20 + k / 10
    )


def opened(*events: Event, settings: Config | None = None) -> Health:
    health = Health(settings or config(), "0.1", "run", START_NS)
    for event in (change("mems", "open"), change("reference", "open"), *events):
        health.update(event, [])
    return health


def well(**changed: Any) -> Situation:
    situation = Situation(
        queues={"pipeline": Queue(waiting=1, capacity=120), "recording": Queue(waiting=0, capacity=256)},
        recording=RecordingHealth(active=True, file="fieldcal-000001.mcap.active", size_bytes=1, fault=""),
        publication=PublicationHealth(enabled=True, connected=True, unpublished=0, fault=""),
        disk_free_bytes=10**10,
        process=ProcessHealth(rss_bytes=1, threads=1, open_files=1, cpu_s=0.1),
    )
    return msgspec.structs.replace(situation, **changed)


def report(health: Health, t_s: float, situation: Situation | None = None) -> GatewayStatus:
    now_ns, situation = START_NS + int(t_s * S), situation or well()
    return health.status(now_ns, now_ns, situation, *health.state(now_ns, situation, []))


def test_rates_counts_clock_and_temperature_are_the_devices_own() -> None:
    health = opened(*(block("mems", k) for k in range(60)), block("reference", 59, BlockFlags.RESTART))
    status_ = report(health, 30.0)
    assert (status_.state, status_.reasons, status_.uptime_s) == ("running", [], pytest.approx(30.0))
    mems = status_.devices["mems"]
    assert (mems.samples, mems.blocks, mems.gaps, mems.missing, mems.overruns) == (30_000, 60, 0, 0, 0)
    assert mems.temperature_degc == pytest.approx(25.9)
    # Over ten seconds, by arrivals that are late by 0.3 ms: 0.3 ms / 9.5 s of 1003 Hz is 0.03 Hz.
    assert mems.rate_hz == pytest.approx(RATE_HZ, abs=0.15)
    assert mems.lag_s == pytest.approx(30.0 - 30_000 / RATE_HZ, abs=0.003)
    assert mems.clock is not None
    assert abs(mems.clock.rate_hz - RATE_HZ) < 4 * mems.clock.u_rate_hz < 0.05
    assert mems.clock.residual_sd_s == pytest.approx(3e-4, rel=0.15)
    assert "mems 1003." in status_.line


def test_losses_are_counted_by_kind() -> None:
    first = block("mems", 0)
    health = opened(
        first,
        block("mems", 2, BlockFlags.GAP),  # 500 samples are missing
        block("mems", 3, BlockFlags.OVERRUN | BlockFlags.RESTART),
        block("mems", 5, BlockFlags.GAP | BlockFlags.RESTART),  # how many cannot be known
        block("mems", 6, BlockFlags.SATURATED),
        Gap(device="mems", t_monotonic_ns=START_NS, dropped=3, unit="lines", reason=""),
        Gap(device="mems", t_monotonic_ns=START_NS, dropped=4, unit="lines", reason=""),
        Gap(device="mems", t_monotonic_ns=START_NS, dropped=2, unit="blocks", reason=""),
        change("reference", "lost", 1.0, "EIO"),
        change("reference", "open", 2.0),
    )
    mems, reference = (report(health, 4.0).devices[name] for name in ("mems", "reference"))
    assert (mems.gaps, mems.missing, mems.overruns, mems.saturated) == (2, 500, 1, 1)
    assert mems.dropped == {"lines": 7, "blocks": 2}
    assert (reference.losses, reference.state, reference.rate_hz, reference.lag_s) == (1, "open", None, None)


def test_results_are_counted_by_sensor() -> None:
    health = opened()
    health.update(
        Tick(t_monotonic_ns=START_NS, t_utc_ns=0), [window(1), window(2, used=False), calibration(3), status(4)]
    )
    sensor = report(health, 1.0).sensors["mems"]
    assert (sensor.windows_used, sensor.windows_refused, sensor.calibrations, sensor.status) == (1, 1, 1, "VALID")


def test_it_starts_until_every_device_was_tried() -> None:
    health = Health(config(), "0.1", "run", START_NS)
    health.update(change("mems", "open"), [])
    assert not health.started
    assert (report(health, 1.0).state, report(health, 1.0).reasons) == ("starting", ["reference is not open yet"])
    health.update(change("reference", "lost", 0.5, "no such port"), [])
    assert health.started
    told = report(health, 1.0)
    assert (told.state, told.reasons) == ("degraded", ["reference is lost: no such port"])


def test_an_open_device_that_says_nothing_is_silent() -> None:
    health = opened(block("mems", 0), block("mems", 1))
    assert report(health, SILENT_S - 0.1).state == "running"
    silent = f"is silent for more than {SILENT_S:g} s"
    assert report(health, SILENT_S + 0.5).reasons == [f"reference {silent}"]
    assert report(health, SILENT_S + 1.5).reasons == [f"mems {silent}", f"reference {silent}"]


@pytest.mark.parametrize(
    ("situation", "reason"),
    [
        ({"recording": RecordingHealth(active=False, file="", size_bytes=0, fault="No space left")},
         "not recording: No space left"),
        ({"recording": RecordingHealth(active=True, file="x", size_bytes=1, fault="", space="less than 64 MB free")},
         "recordings: less than 64 MB free"),
        ({"disk_free_bytes": 10**8}, "less than 250 MB free on the disk of the data"),
        ({"publication": PublicationHealth(enabled=True, connected=False, unpublished=7, fault="")},
         "no Zenoh router, results wait in the store"),
        ({"publication": PublicationHealth(enabled=True, connected=True, unpublished=None, fault="")},
         "the store cannot be read"),
        ({"publication": PublicationHealth(enabled=True, connected=True, unpublished=0, fault="bad endpoint")},
         "publication: bad endpoint"),
        ({"queues": {"pipeline": Queue(waiting=61, capacity=120)}},
         "queue more than half full, the agent is too slow: pipeline"),
    ],
)  # fmt: skip
def test_what_is_not_well_is_said(situation: dict[str, Any], reason: str) -> None:
    told = report(opened(), 1.0, well(**situation))
    assert (told.state, told.reasons) == ("degraded", [reason])
    assert told.line == f"degraded: {reason}"


def test_what_cannot_be_measured_or_is_turned_off_is_no_fault() -> None:
    off = PublicationHealth(enabled=False, connected=False, unpublished=0, fault="")
    assert report(opened(), 1.0, well(publication=off, disk_free_bytes=None)).state == "running"
    assert report(opened(settings=config(least_disk_free="20 GB")), 1.0).state == "degraded"


def test_it_is_one_flat_object_of_json_without_nan() -> None:
    told = json.loads(msgspec.json.encode(report(opened(block("mems", 0)), 1.0)))
    assert {"site", "gateway", "state", "reasons", "advice", "devices", "sensors", "queues", "recording", "publication",
            "disk_free_bytes", "process", "mqtt", "uptime_s", "run_id", "version", "t_utc_ns"} == set(told)  # fmt: skip
    assert told["devices"]["reference"]["clock"] is None


def test_a_count_that_jumps_at_will_is_no_fault_of_the_supervision() -> None:
    watch = DeviceWatch()
    rng = np.random.default_rng(2)
    for k in range(40):
        wild = replace(block("mems", k), first_index=int(rng.integers(0, 2**40)))
        watch.on_block(wild)
        health = watch.health(START_NS + 60 * S)
        assert health.clock is None or np.isfinite([health.clock.rate_hz, health.clock.residual_sd_s]).all()


def test_options_that_are_not_good_are_in_the_status() -> None:
    fast = config().model_dump(mode="json")
    fast["devices"][0] |= {"driver": "adxl355", "options": {}}
    (advice,) = report(opened(settings=parse_config(fast, "test")), 1.0).advice
    assert advice.startswith("mems: rate_hz 1000 is above 800 Hz")
    assert report(opened(), 1.0).advice == []
