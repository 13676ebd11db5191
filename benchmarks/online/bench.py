"""A bench day: a person turns the sensor from stop to stop at unknown times.

`fieldcal calibrate` is run for comparison.

The stops are on a clamp at two inclinations; each stop is visited twice. Quantities that an operator knows to 0.2 deg
or 0.05 m/s2 have errors of this size, drawn once per run. The agent gets the samples, the list of stops, and S and Q of
a data sheet. `fieldcal calibrate` gets the same samples as files, the same data sheet, and the time and position of
every stop.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from click.testing import CliRunner

from agent.cli.calibrate import calibrate
from agent.cli.simulate import write_files
from agent.config import Config, parse_config
from agent.core.events import CalibrationUpdate, StatusChange, WindowReport
from benchmarks.online.clamp import bench_events
from benchmarks.online.runner import Run
from calib.model import PARAMETERS, Array
from hw.virtual.bench import Bench
from hw.virtual.noise import NoiseStream
from hw.virtual.presets import plain
from hw.virtual.schedule import Schedule, clamped
from hw.virtual.spread import Spread, drawn

SEED, RUNS = 1, 20
RATES_HZ = (1000.0, 200.0)
STOPS = tuple((theta_deg, alpha_deg) for theta_deg in (35.0, 55.0) for alpha_deg in (0.0, 120.0, 240.0))
HOLD_S, TURN_S, ROUNDS = 25.0, 4.0, 2
AFTER_S = 12.0  # time into the next turn, by which the last stop has ended
# As in a data sheet: main sensitivities to 5 %, transverse 3 %, zero-g offset 50 mg.
U_MAIN_PCT, U_TRANSVERSE_PCT, U_OFFSET_MPS2 = 5.0, 3.0, 0.5
FREE_GATE = {"least_determined": 3}  # without stated angles S_xy and S_yx cannot be determined
MAIN = [0, 4, 8]
KINDS = (
    ("main sensitivity", "%", MAIN),
    ("transverse sensitivity", "%", [k for k in range(9) if k not in MAIN]),
    ("offset", "mm/s2", list(range(9, len(PARAMETERS)))),
)
KNOWN = Spread(
    angle_deg=0.2,
    theta_deg=0.2,
    theta_position_deg=0.1,
    alpha_common_deg=0.1,
    offset_mps2=0.05,
    reference_pct=0.1,
    transverse_motion_pct=1.0,
)


@dataclass(frozen=True, slots=True, eq=False)
class Day:
    """Results of one day: of the agent and of `fieldcal calibrate`, (12,) in m/s2 and 1, and the u of the latter."""

    online: Array
    offline: Array
    u: Array
    truth: Array
    positions: Sequence[str]
    windows: tuple[int, int]

    @property
    def apart(self) -> Array:
        """Differences (12,) between the results, divided by u."""
        return np.abs(self.online - self.offline) / self.u


def world(seed: int, rate_hz: float = RATES_HZ[0]) -> Bench:
    """The bench of the day. Sensor and reference sample at `rate_hz` and are read like the drivers of hw read."""
    p = plain(seed)
    assert p.sensor.bursts is not None
    assert p.reference.bursts is not None
    stands = tuple(clamped(theta_deg, alpha_deg, HOLD_S) for theta_deg, alpha_deg in STOPS)
    turned = replace(
        p,
        schedule=Schedule(stands, TURN_S, p.schedule.start_s),
        sensor=replace(
            p.sensor,
            clock=replace(p.sensor.clock, nominal_rate_hz=rate_hz),
            bursts=replace(p.sensor.bursts, apart_s=1.0 / rate_hz),
        ),
        reference=replace(
            p.reference,
            clock=replace(p.reference.clock, nominal_rate_hz=rate_hz),
            bursts=replace(p.reference.bursts, apart_s=1.0 / rate_hz),
        ),
    )
    return Bench(drawn(turned, KNOWN, np.random.default_rng([seed, NoiseStream.PRESET])), seed)


def config(bench: Bench, **keys: Any) -> Config:
    """Configuration with stops but without times. `keys` are further keys of the channel."""
    sensor = bench.parameters.sensor
    devices = [
        {
            "name": name,
            "driver": "serial-csv",
            "options": {"port": name, "rate_hz": sensor.clock.nominal_rate_hz, "axes": axes, "unit": unit},
        }
        for name, axes, unit in (("sensor", 3, sensor.unit), ("reference", 1, "m/s2"))
    ]
    prior = {"sensitivity": sensor.nominal_sensitivity, "u_main_pct": U_MAIN_PCT, "u_offset_mps2": U_OFFSET_MPS2}
    channel: dict[str, Any] = {
        "sensor": "sensor",
        "reference": "reference",
        "prior": prior | {"u_transverse_pct": U_TRANSVERSE_PCT},
        "certificate": {"stability_pct": 0.0},  # the virtual reference does not drift
        "uncertainty": {"theta_position_deg": KNOWN.theta_position_deg},
        "temperature": {"offset_order": 0},  # `fieldcal calibrate` has no temperature model
        "positions": [{"theta_deg": theta_deg, "alpha_deg": alpha_deg} for theta_deg, alpha_deg in STOPS],
    }
    return parse_config({"devices": devices, "channels": [channel | keys], "zenoh": {"enabled": False}}, "bench day")


def day(seed: int, rate_hz: float = RATES_HZ[0]) -> Day:
    """Simulate one day and calibrate it in both ways."""
    bench = world(seed, rate_hz)
    duration_s = bench.parameters.schedule.duration_s(ROUNDS) + AFTER_S
    update, reports = online(bench, duration_s)
    told = offline(bench, duration_s)
    scale = bench.parameters.sensor.nominal_sensitivity
    found = np.append(np.ravel(update.sensitivity), update.offset)
    return Day(
        online=found / scale,
        offline=np.append(np.ravel(told["sensitivity"]), told["offset"]) / scale,
        u=np.sqrt(np.diag(told["covariance"])) / scale,
        truth=np.append(bench.truth.sensitivity.ravel(), bench.truth.offset) / scale,
        positions=[r.position if r.used else "" for r in reports],
        windows=(sum(r.used for r in reports), sum(w["used"] for w in told["windows"])),
    )


def online(bench: Bench, duration_s: float, **keys: Any) -> tuple[CalibrationUpdate, list[WindowReport]]:
    """The agent's last calibration, and its windows. Raises ValueError if there is no calibration."""
    run = Run(config(bench, **keys))
    updates, reports, said = [], [], ""
    for event in bench_events(bench, bench.recording(duration_s)):
        for result in run.feed(event):
            if isinstance(result, CalibrationUpdate):
                updates.append(result)
            elif isinstance(result, WindowReport):
                reports.append(result)
            elif isinstance(result, StatusChange):
                said = result.reason
    run.close()
    if not updates:
        raise ValueError(f"no calibration: {said}")
    return updates[-1], reports


def offline(bench: Bench, duration_s: float) -> dict[str, Any]:
    """Output of `fieldcal calibrate --json -`. Raises ValueError if the data are refused."""
    with TemporaryDirectory() as name:
        directory = Path(name)
        write_files(bench, directory, duration_s, {})
        (directory / "prior.json").write_text(json.dumps(_data_sheet(bench.parameters.sensor.nominal_sensitivity)))
        files = [
            part
            for option in ("sensor", "reference", "poses", "prior")
            for part in (f"--{option}", str(directory / f"{option}.{'json' if option == 'prior' else 'csv'}"))
        ]
        known = ["--u-theta-position-deg", str(KNOWN.theta_position_deg), "--json", "-"]
        result = CliRunner().invoke(calibrate, [*files, *known], standalone_mode=False)
    if result.return_value:
        raise ValueError(result.output)
    told: dict[str, Any] = json.loads(result.stdout)
    return told


def _data_sheet(nominal: float) -> dict[str, Any]:
    share = np.where(np.eye(3).ravel() > 0, U_MAIN_PCT, U_TRANSVERSE_PCT) / 100.0
    covariance = np.diag((nominal * np.append(share, np.full(3, U_OFFSET_MPS2))) ** 2)
    known = {"sensitivity": nominal * np.eye(3), "offset": np.zeros(3), "covariance": covariance}
    return {name: value.tolist() for name, value in known.items()}


def table(days: Sequence[Day], rate_hz: float) -> str:
    """The largest values of all days at one rate, by kind of parameter."""
    apart = np.array([day.apart for day in days])
    off = np.array([np.abs(day.online - day.truth) / day.u for day in days])
    u = np.array([day.u for day in days])
    windows = np.array([day.windows for day in days])
    lines = [
        f"{len(days)} days at {rate_hz:g} Hz. Each day has {len(STOPS)} stops, which are visited {ROUNDS} times for "
        f"{HOLD_S:g} s. Windows taken: {windows[:, 0].sum()} on-line, {windows[:, 1].sum()} by `fieldcal calibrate`.",
        "",
        "| | mean u of `calibrate` | largest difference between on-line and `calibrate`, in u "
        "| rms of this difference, in u | rms error of on-line, in u |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, unit, k in KINDS:
        size = (100.0 if unit == "%" else 1000.0) * u[:, k].mean()
        rms = [float(np.sqrt(np.mean(part[:, k] ** 2))) for part in (apart, off)]
        lines.append(f"| {name} | {size:.2g} {unit} | {apart[:, k].max():.2f} | {rms[0]:.2f} | {rms[1]:.2f} |")
    return "\n".join(lines)


def free_day(seed: int) -> tuple[Array, Array]:
    """One day on a clamp with unknown angles: errors over u (12,), and u (12,) in m/s2 and 1."""
    bench = world(seed)
    scale = bench.parameters.sensor.nominal_sensitivity
    update, _ = online(bench, bench.parameters.schedule.duration_s(ROUNDS) + AFTER_S, positions="free", gate=FREE_GATE)
    found = np.append(np.ravel(update.sensitivity), update.offset)
    truth = np.append(bench.truth.sensitivity.ravel(), bench.truth.offset)
    u = np.array(update.standard_uncertainty)
    return (found - truth) / u, u / scale


def free_table(days: Sequence[tuple[Array, Array]]) -> str:
    """Errors of all days, by kind of parameter."""
    errors, u = (np.array(part) for part in zip(*days, strict=True))
    inside = 100.0 * np.mean(np.abs(errors) <= 2.0)
    lines = [
        f'{len(days)} days with `positions = "free"` at {RATES_HZ[0]:g} Hz; {inside:.1f} % of all errors within 2 u.',
        "",
        "| | mean u of on-line | rms error, in u | largest error, in u |",
        "| --- | --- | --- | --- |",
    ]
    for name, unit, k in KINDS:
        size = (100.0 if unit == "%" else 1000.0) * u[:, k].mean()
        off = errors[:, k]
        lines.append(f"| {name} | {size:.2g} {unit} | {np.sqrt(np.mean(off**2)):.2f} | {np.abs(off).max():.2f} |")
    return "\n".join(lines)
