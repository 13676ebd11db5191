"""A sensor without a reference: its calibration stays in force, U grows, and each hour says what was seen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.config import Config
from agent.core.events import Acceleration, Event, Result, WatchReport
from agent.core.pipeline import Pipeline
from agent.core.watch import SensorWatch
from agent.recording.messages import decode, encode, schema_of, topic_of
from calib.estimate.correction import Law
from calib.model import scale_of
from calib.signal.spectra import bands_of
from hw.block import BlockFlags, SampleBlock
from tests.building_windows import GRAVITY
from tests.clamp_windows import Q_TRUE, S_TRUE
from tests.unit.mounted_site import EPOCH_NS, SECOND, Site, begun, said, site_config, updates

HOUR_NS = 3600 * SECOND
WALK, DRIFT = 1e-3, 2e-3  # of S a day; of Q m/s2 a day
PROCESS = {"sensitivity_pct": 100.0 * WALK, "offset_rate_mps2": DRIFT, "offset_rate_walk_mps2": 0.0, "offset_mps2": 0.0}
U_S, U_Q = 2e-3, 0.01
PRIOR = {
    "sensitivity": S_TRUE.ravel().tolist(), "u_sensitivity": [U_S] * 9,
    "offset_mps2": (Q_TRUE / scale_of(S_TRUE.ravel())).tolist(),    "u_offset_mps2": U_Q, "calibrated": "2026-09-01",
}  # fmt: skip
CALIBRATED_NS = 1_788_220_800 * SECOND  # 2026-09-01


def watched_config(**more: Any) -> Config:
    """The channel of `site_config` without its reference."""
    beside = {"reference": None, "rotation": None, "rotation_gravity_mps2": None}
    return site_config(**{"process": PROCESS, **beside, **more})


class World:
    """Blocks of a sensor at rest, in noise of 5 mm/s2 that is white, from an event on."""

    def __init__(self, t_s: float = 0.0, seed: int = 1, rate_hz: float = 10.0) -> None:
        self._random, self.t_s, self.rate_hz, self.first = np.random.default_rng(seed), t_s, rate_hz, 0
        self._fresh = True

    def block(self, seconds: float = 20.0, degc: float | None = 21.0, **more: Any) -> SampleBlock:
        n = round(seconds * self.rate_hz)
        V = (GRAVITY + 0.005 * self._random.standard_normal((n, 3))) @ S_TRUE.T + Q_TRUE
        self.t_s += seconds
        end_ns = round(self.t_s * SECOND)
        flags = BlockFlags.RESTART if self._fresh else BlockFlags.NONE
        self._fresh = False
        made = SampleBlock(
            "s", "boot", EPOCH_NS + end_ns, self.first, self.rate_hz, np.array([end_ns]), np.array([n], dtype=np.int32),
            V, flags=flags, temperature_degc=degc,
        )  # fmt: skip
        self.first += n
        return replace(made, **more)


def opened(site: Site) -> list[Result]:
    return site.open("s")


def hours(results: list[Result]) -> list[WatchReport]:
    return [r for r in results if isinstance(r, WatchReport)]


def run(config: Config, blocks: list[SampleBlock]) -> tuple[Site, list[Result]]:
    site = Site(config)
    opened(site)
    for block in blocks:
        site.step(block)
    return site, site.results


@pytest.mark.slow
def test_the_calibration_that_was_made_beside_a_reference_stays_in_force() -> None:
    beside = begun(site_config(certificate={"u_sensitivity_pct": 0.5, "quantity": "acceleration"}))
    made = updates(beside.play(6))[-1]
    site = Site(watched_config(), beside.kept(), day=100.0)
    [again] = updates(opened(site))
    assert (again.sensitivity, again.offset, again.covariance) == (made.sensitivity, made.offset, made.covariance)
    assert (again.made, again.date_utc_ns) == (made.made, made.t_utc_ns)
    assert said(site.results) == [("VALID", "restored from the previous run; no reference: watched")]
    site.play(1, devices="s")
    site.wait(3600)  # the hour of the blocks ends; they are silent then, which is another matter
    [hour] = hours(site.results)
    assert (hour.calibration_run_id, hour.calibration_sequence) == made.made
    days = (site.pipeline._channels[0]._time.utc_ns - made.t_utc_ns) // HOUR_NS / 24.0
    u_xx = np.hypot(made.standard_uncertainty[0], scale_of(np.ravel(made.sensitivity)) * WALK * np.sqrt(days))
    assert hour.u_main_pct[0] == pytest.approx(100.0 * u_xx / made.sensitivity[0][0], rel=1e-9)
    assert days > 99.0
    back = Site(site_config(certificate={"u_sensitivity_pct": 0.5}), site.kept(), day=101.0)
    back.open("r")
    back.open("s")
    assert np.allclose(updates(back.play(3))[-1].sensitivity, S_TRUE, atol=3e-3)


def test_a_stated_calibration_is_in_force_from_the_start_and_its_u_grows_with_its_date() -> None:
    site = Site(watched_config(prior=PRIOR, acceleration="publish"))
    [update] = updates(opened(site))
    assert np.array_equal(update.sensitivity, S_TRUE)
    assert update.standard_uncertainty == pytest.approx([U_S] * 9 + [scale_of(S_TRUE.ravel()) * U_Q] * 3)
    assert all(update.determined)
    assert (update.date_utc_ns, update.made) == (CALIBRATED_NS, (update.run_id, update.sequence))
    assert said(site.results) == [("VALID", "s opened; no reference: watched")]
    days = (EPOCH_NS - CALIBRATED_NS) // HOUR_NS / 24.0
    [block] = [o for o in site.pipeline.step(World().block(degc=None)) if isinstance(o, Acceleration)]
    scale = scale_of(S_TRUE.ravel())
    u_z2 = U_S**2 + (scale * WALK) ** 2 * days  # at rest g alone is felt, on x, y and z as GRAVITY says
    u_q2 = scale**2 * (U_Q**2 + (DRIFT * days) ** 2)
    inverse = np.linalg.inv(S_TRUE)
    expected = (u_z2 * GRAVITY @ GRAVITY + u_q2) * inverse @ inverse.T
    assert block.covariance == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
def test_the_calibration_is_told_once_a_day_with_the_u_that_it_has_then() -> None:
    world = World(t_s=20.0, rate_hz=2.0)
    blocks = [world.block(1800.0) for _ in range(2 * 50)]
    _, results = run(watched_config(prior=PRIOR), blocks)
    first, *later = updates(results)
    assert len(later) == 2
    for update in later:
        days = (update.t_utc_ns - CALIBRATED_NS) // HOUR_NS / 24.0
        assert update.made == first.made
        assert update.sensitivity == first.sensitivity
        walked = scale_of(S_TRUE.ravel()) * WALK * np.sqrt(days)
        assert update.standard_uncertainty[0] == pytest.approx(np.hypot(U_S, walked), rel=1e-6)
    assert {(r.calibration_run_id, r.calibration_sequence) for r in hours(results)} == {first.made}
    assert len(hours(results)) in (49, 50)


def test_another_visit_is_in_force_as_soon_as_it_is_stated() -> None:
    site = Site(watched_config(prior=PRIOR))
    [first] = updates(opened(site))
    kept = site.kept()
    same = Site(watched_config(prior=PRIOR | {"u_main_pct": 1.0}), kept, day=1.0)
    assert [u.made for u in updates(opened(same))] == [first.made]
    visit = PRIOR | {"sensitivity": (1.01 * S_TRUE).ravel().tolist(), "calibrated": "2026-09-20"}
    later = Site(watched_config(prior=visit), kept, day=1.0)
    [*_, update] = updates(opened(later))
    assert np.array_equal(update.sensitivity, 1.01 * S_TRUE)
    assert update.made == (update.run_id, update.sequence)
    assert said(later.results)[0][0] == "VALID"


def test_a_stated_calibration_that_is_older_than_one_beside_the_reference_is_not_used() -> None:
    beside = begun(site_config())
    made = updates(beside.play(6))[-1]
    site = Site(watched_config(prior=PRIOR), beside.kept(), day=1.0)
    assert [u.made for u in updates(opened(site))] == [made.made]


@pytest.mark.slow
def test_without_any_calibration_the_sensor_is_watched_in_the_unit_of_the_prior() -> None:
    world = World(t_s=20.0)
    _, results = run(watched_config(), [world.block() for _ in range(400)])
    [(status, reason)] = said(results)
    assert status == "UNCALIBRATED"
    assert "no reference: watched" in reason
    assert "prior.calibrated" in reason
    assert updates(results) == []
    assert {r.calibration_sequence for r in hours(results)} == {0}


@pytest.mark.slow
def test_an_hour_tells_mean_noise_power_and_temperature() -> None:
    world = World(seed=3)
    degrees = [20.0 + 0.01 * k for k in range(1000)]
    _, results = run(watched_config(prior=PRIOR), [world.block(40.0, degc) for degc in degrees])
    first, *whole = hours(results)
    assert first.hour_utc_ns == EPOCH_NS // HOUR_NS * HOUR_NS
    assert [r.hour_utc_ns - first.hour_utc_ns for r in whole] == [k * HOUR_NS for k in range(1, len(whole) + 1)]
    bands = bands_of(10.0)
    width_hz = np.diff(bands.edges_hz)[:, 0]
    for r in whole:
        assert (r.samples, r.segments, r.missing, r.clipped, r.stuck, r.duration_s) == (36000, 60, 0, 0, 0, 3600.0)
        # 5 mm/s2 in 36000 samples: u of the mean is 0.026 mm/s2
        assert np.abs(np.array(r.mean_mps2) - GRAVITY).max() < 5.0 * 0.005 / 190.0
        assert 0.6 < np.array(r.mean_scatter_mps2).mean() / (0.005 / np.sqrt(36000.0)) < 1.4
        assert r.temperature_scatter_degc == pytest.approx(0.01 * 90 / np.sqrt(12.0), rel=0.01)
    found = np.mean([np.reshape(r.band_power, (3, -1)) for r in whole], axis=0)
    assert found[:, 5:] / (2.5e-5 * width_hz / 5.0)[5:] == pytest.approx(np.ones((3, len(width_hz) - 5)), abs=0.12)
    assert np.mean([r.noise_psd for r in whole], axis=0) == pytest.approx(np.full(3, 2.5e-5 / 5.0), rel=0.05)
    cross = np.mean([np.reshape(r.cross_power, (3, -1)) for r in whole], axis=0)
    assert np.abs(cross[:, 5:] / (2.5e-5 * width_hz / 5.0)[5:]).max() < 0.15
    assert whole[0].band_hz == bands.centre_hz.tolist()


def test_the_hour_of_a_fast_device_lasts_an_hour() -> None:
    """A rate one per cent above the nominal one makes more samples, and no longer hour."""
    world, watch = World(), SensorWatch()
    law = Law(np.append(S_TRUE.ravel(), np.zeros(3)), np.eye(12))
    begin_ns = EPOCH_NS // HOUR_NS * HOUR_NS + HOUR_NS
    ends_s = 40.0 + 39.6 * np.arange(92)
    made = [replace(world.block(40.0), t_utc_ns=begin_ns + round(end_s * SECOND)) for end_s in ends_s.tolist()]
    [hour] = [told for block in made if (told := watch.update(block, np.zeros(3, dtype=bool), law))]
    assert (hour.counts["samples"], hour.duration_s) == (36400, 3600.0)


@pytest.mark.slow
def test_missing_clipped_and_stuck_samples_are_counted_and_their_minutes_left_out() -> None:
    world = World(t_s=60.0)
    blocks = []
    for k in range(360):
        made = world.block()
        if k in (40, 41):
            made = replace(made, flags=BlockFlags.SATURATED)
        if k == 100:
            world.first += 5  # few: bridged
        if k == 140:
            world.first += 100  # many: another segment begins
        if k in (200, 300):
            made = replace(made, flags=BlockFlags.RESTART)
        blocks.append(made)
    _, results = run(watched_config(prior=PRIOR), blocks)
    told = hours(results)[-1] if len(hours(results)) == 1 else hours(results)[0]
    whole = [sum(getattr(r, name) for r in hours(results)) for name in ("clipped", "missing")]
    assert whole == [400, 105]
    assert 0 < told.segments < 60
    assert np.abs(np.array(told.mean_mps2) - GRAVITY).max() < 1e-3


@pytest.mark.slow
def test_an_output_that_is_stuck_is_counted_and_gives_no_numbers() -> None:
    world = World()
    blocks = [world.block() for _ in range(40)]
    held = [replace(own, indications=own.indications * [1, 1, 0] + [0, 0, 9.0]) for own in blocks[4:]]
    _, results = run(watched_config(prior=PRIOR), [*blocks[:4], *held, *(world.block() for _ in range(180))])
    assert hours(results)[0].stuck > 10 * 600


@pytest.mark.slow
def test_silence_ends_an_hour_and_says_nothing_more() -> None:
    world = World(t_s=20.0)
    site, _ = run(watched_config(prior=PRIOR), [world.block() for _ in range(10)])
    site.t_s = 300
    site.wait(3600 + 1300)
    assert len(hours(site.results)) == 1
    assert hours(site.results)[0].samples == 2000
    assert said(site.results)[-1][0] == "INVALID"


@pytest.mark.slow
def test_utc_that_steps_back_a_little_opens_no_hour_twice_and_a_wrong_year_does_not_stop_the_hours() -> None:
    world = World(t_s=0.0, rate_hz=2.0)
    blocks = [world.block() for _ in range(600)]
    second = SECOND
    begun = next(k for k, b in enumerate(blocks) if (b.t_utc_ns - 20 * second) // HOUR_NS > EPOCH_NS // HOUR_NS)
    steps = [replace(b, t_utc_ns=b.t_utc_ns - (30 * second if k > begun else 0)) for k, b in enumerate(blocks)]
    assert (steps[begun + 1].t_utc_ns - 20 * second) // HOUR_NS == EPOCH_NS // HOUR_NS, "back into the hour before"
    numbers = [r.hour_utc_ns for r in hours(run(watched_config(prior=PRIOR), steps)[1])]
    assert len(set(numbers)) == len(numbers) >= 3
    year = 365 * 86400 * second
    wrong = [replace(b, t_utc_ns=b.t_utc_ns + (year if k < 100 else 0)) for k, b in enumerate(blocks)]
    numbers = [r.hour_utc_ns for r in hours(run(watched_config(prior=PRIOR), wrong)[1])]
    assert numbers[0] > EPOCH_NS + year // 2
    assert all(number < EPOCH_NS + year // 2 for number in numbers[1:])
    assert len(numbers) >= 3


def events_of_two_hours() -> list[Event]:
    world = World(t_s=1.0, seed=5)
    found: list[Event] = []
    for k in range(180):
        made = world.block(5.0 if k in (98, 99) else 40.0, None if k % 7 == 0 else 20.0 + k % 3)
        if k in (50, 98):
            world.first += 3  # before event 100 a segment is open in which some are bridged
        if k == 90:
            made = replace(made, flags=BlockFlags.RESTART)
        if k == 120:
            made = replace(made, flags=BlockFlags.SATURATED)
        found.append(made)
    return found


@pytest.mark.slow
def test_a_pipeline_restored_at_any_event_goes_on_bit_for_bit() -> None:
    config = watched_config(prior=PRIOR)
    site = Site(config)
    opened(site)
    ahead, events = site.pipeline, events_of_two_hours()
    copies: list[Pipeline] = []
    for k, event in enumerate(events):
        if k in (0, 50, 100, 150):
            copies.append(Pipeline.restore(config.model_dump_json(), ahead.snapshot()))
            assert copies[-1].snapshot() == ahead.snapshot()
        outputs = [encode(1, o) for o in ahead.step(event)]
        for copy in copies:
            assert [encode(1, o) for o in copy.step(event)] == outputs
    assert all(copy.snapshot() == ahead.snapshot() for copy in copies)


@pytest.mark.slow
def test_the_result_is_recorded_as_it_is() -> None:
    world = World(t_s=20.0)
    _, results = run(watched_config(prior=PRIOR), [world.block(20.0, None) for _ in range(300)])
    for report in hours(results):
        data = encode(7, report)
        number, back = decode(schema_of(topic_of(report)), data)
        assert (number, encode(7, back)) == (7, data)
        assert isinstance(back, WatchReport)
        assert (back.band_power, back.gravity) == (report.band_power, report.gravity)


def test_a_channel_with_a_reference_or_positions_is_not_watched() -> None:
    site = begun(site_config())
    site.play(1)
    site.wait(3700)
    assert hours(site.results) == []
    rests = [{"gravity_mps2": [0.0, 0.0, 9.80665]}, {"gravity_mps2": [0.0, 9.80665, 0.0]}]
    assert not watched_config(positions=rests).channels[0].watched
    assert watched_config().channels[0].watched


@pytest.mark.slow
def test_memory_of_a_channel_at_one_kilohertz_is_bounded() -> None:
    world = World(t_s=0.0, rate_hz=1000.0)
    site, _ = run(watched_config(prior=PRIOR), [world.block(10.0) for _ in range(60)])
    [channel] = site.pipeline._channels
    assert channel._watched is not None
    held = channel._watched.snapshot()
    segments = sum(own[name].nbytes for own in held["segments"] for name in ("mean", "power", "floor"))
    assert channel._watched._held.nbytes + segments * 60 // max(len(held["segments"]), 1) < 1_000_000


@pytest.mark.slow
def test_another_device_begins_anew() -> None:
    world = World(t_s=20.0)
    site, _ = run(watched_config(prior=PRIOR), [world.block() for _ in range(90)])
    site.t_s = 1900
    site.open("s", "B")
    other = World(t_s=1920.0, seed=9)
    for _ in range(200):
        site.step(other.block())
    [hour, *_] = hours(site.results)
    assert hour.samples == 44 * 200, "of the new device alone, from 1920 s to the end of the hour at 2800 s"


@pytest.mark.thorough
def test_what_the_mean_was_at_the_calibration_is_known_after_a_restart() -> None:
    """A week before the restart, and two days after it with z less by half a per cent."""
    config, kept, sayings = watched_config(prior=PRIOR), dict[str, bytes](), list[str]()
    for days, share in ((7.2, 1.0), (2.0, 0.995)):
        site, world = Site(config, kept, day=10.0 - days), World(t_s=10.0, rate_hz=2.0)
        opened(site)
        for _ in range(round(days * 48)):
            made = world.block(1800.0)
            utc_ns = made.t_utc_ns + round((10.0 - days) * 86_400) * SECOND
            site.step(
                replace(made, t_utc_ns=utc_ns, indications=(made.indications - Q_TRUE) * [1.0, 1.0, share] + Q_TRUE)
            )
        sayings.append(hours(site.results)[-1].gravity)
        kept = {memory.identity: memory.state for memory in site.pipeline.all_memories()}
    assert sayings[0] == ""
    assert "the sensitivity of z by -0.5 %" in sayings[1]
