"""A month on a road bridge with all settings at their defaults: wind, lorries, warm days, and what happens to devices.

The physics are those of a bridge, not of the model: a few modes that wind excites all the time, lorries whose axles
strike an expansion joint and bend the span, a level that follows wind and traffic, a body that warms later than the
thermometer in the chip. S, Q and the mount change as a sensor ages; devices are lost, swapped, struck and turned. There
are three still nights, a power cut of three hours after which the program starts again, and an earthquake that goes
over the sensor's range. The sensor is an ADXL355, or a chip of 12 bits whose noise is as large as the wind's motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from agent.config import Config
from benchmarks.online.config import building_config
from benchmarks.online.life import MAIN, House
from benchmarks.online.node import adxl355
from calib.geometry import AXES
from calib.model import Array
from hw.block import DeviceInfo, SampleBlock
from hw.virtual.building import DAY_S, Building, BuildingDevice, BuildingParameters, BuildingTruth, Weather
from hw.virtual.building_motion import BuildingMotion, ComplexArray
from hw.virtual.harm import Harm, Visit
from hw.virtual.noise import NoiseStream
from hw.virtual.response import Response
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2, rotation
from hw.virtual.timebase import Bursts, Clock

SEED, RUNS, DAYS = 350_000, 4, 30
HOUR_S, WINDOW_S, HOURS_A_DAY = 3600.0, 60.0, 24
GRID_HZ = 512.0  # of the motion: cubic pieces are then right to 2e-4 at the fastest mode, to 1e-6 below 10 Hz
# Natural frequency (Hz), damping ratio, shape (vertical, along, across) of the modes; the last ones are local.
MODES = (
    (1.9, 0.012, (1.0, 0.05, 0.1)),
    (2.7, 0.015, (0.1, 0.1, 1.0)),
    (4.6, 0.010, (0.8, 0.3, -0.4)),
    (7.3, 0.015, (-0.3, 1.0, 0.3)),
    (11.8, 0.02, (0.7, -0.2, 0.6)),
    (24.0, 0.03, (0.9, 0.3, 0.2)),
    (41.0, 0.04, (0.6, -0.4, 0.5)),
)
WIND_MPS2 = 0.02  # rms in the median hour
STRUCK = np.array([1.0, 0.2, 0.8, 0.3, 0.6, 0.5, 0.3])  # how far an axle moves each mode
SIDE = 0.4 * np.array([0.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0])  # and by how much more on one side of the road
LORRIES_A_MINUTE = (0.2, 4.0)  # at night and by day
JOINT_MPS, STRIKE_S = 3e-3, 0.004  # velocity that an axle of 10 t gives to a mode at the joint, and how long that lasts
BENT_MPS2, SPAN_M = 0.012, 40.0  # force over mass while the axle is on the span
WINDY = np.array([1.0, 0.6, 0.5, 0.35, 0.25, 0.05, 0.02])  # the part of the wind's level in each mode
LAG_OF_BODY_S = 3000.0  # by which S follows the thermometer
EVENTS = {"shock": 8, "turn": 13, "shift": 18, "swap": 23}  # day on which they happen, at noon
NAMES = {  # what is said of an event by name; the shock changes the output along one axis
    "shock": "% in output {axis} of the sensor",
    "turn": "a turn of the sensor",
    "shift": "the time between sensor and reference has shifted",
    "swap": "the reference is another device now",
}
SETTLED = 12  # windows after an event was told
LOST = (5.2, 5.6)  # days between which the reference is lost
CUT = (10.3, 10.42)  # days between which there is no power
STILL_NIGHTS, STILL_HOURS, STILL = (3, 11, 20), range(1, 5), 0.02  # of the wind's level; no lorry
QUAKE, QUAKE_MPS2, QUAKE_HZ = 27 * 24 + 15, 12.0, (0.7, 6.0)  # visit, largest rms, band; it lasts for some 20 s
SHOCK, TURN_DEG, SHIFT_S = 0.005, 0.3, 0.012
REFERENCES, SENSORS = ("DC", "AC", "vertical"), ("ADXL355", "12 bits")
DIGIT_MPS2, NOISE_OF_12_BITS_MPS2 = 0.00980665, 0.02  # 1 mg a digit; 200 ug a root hertz at 100 Hz
Job = tuple[str, str, int]  # reference, sensor, seed
CORNER_HZ = 0.05
TRANSVERSE_PCT = 50.0  # motion across, over the vertical one, as a vertical reference is told


class Moved:
    """Acceleration (m/s2) over time."""

    def __init__(self, pieces: Callable[[Array], Array]) -> None:
        self._pieces = pieces

    def at(self, time_s: Array) -> Array:
        """Acceleration (n, 3) at times (n,)."""
        return np.asarray(self._pieces(time_s))


class Bridge(Building):
    """The bridge; `parameters.weather` is the thermometer's, and S depends on the body by `s_per_k`. A `vertical`
    reference has one axis."""

    def __init__(
        self, parameters: BuildingParameters, seed: int, harm: Harm, s_per_k: float, vertical: bool = False
    ) -> None:
        super().__init__(parameters, seed, harm)
        self._s_per_k, self._vertical = s_per_k, vertical

    def infos(self) -> dict[str, DeviceInfo]:
        told = super().infos()
        return told | {"reference": replace(told["reference"], axes=1)} if self._vertical else told

    def visit(self, visit: int) -> list[SampleBlock]:
        blocks = super().visit(visit)
        if not self._vertical:
            return blocks
        return [
            replace(b, indications=b.indications[:, 2:].astype(np.float64)) if b.device == "reference" else b
            for b in blocks
        ]

    def truth(self, time_s: float) -> BuildingTruth:
        told, mean = super().truth(time_s), self.parameters.weather.mean_degc
        body_k = self.parameters.weather.at(time_s - LAG_OF_BODY_S) - mean
        S = told.sensitivity * (1.0 + self._s_per_k * body_k)
        return replace(told, sensitivity=S, mean_output=S @ told.gravity_mps2 + told.offset)

    def at_mean(self, time_s: float) -> Array:
        """S and Q (12,) at the mean temperature."""
        told = super().truth(time_s)
        return np.append(told.sensitivity.ravel(), told.offset_at_mean)

    def wind_mps2(self, visit: int) -> float:
        """Level of the wind's motion in a visit: it changes within some hours, around a level of the day."""
        smooth = np.exp(-np.abs(np.arange(-24, 25)) / 8.0)
        drawn = np.random.default_rng(self.seed).standard_normal(24 * DAYS + 100)[visit : visit + len(smooth)]
        level = float(WIND_MPS2 * np.exp(0.8 * drawn @ smooth / np.linalg.norm(smooth)))
        return STILL * level if _is_still(visit) else level

    def lorries(self, visit: int) -> int:
        """How many cross the bridge in a visit."""
        hour = visit % 24
        if _is_still(visit):
            return 0
        night, day = LORRIES_A_MINUTE
        rate = night + (day - night) * max(np.sin(np.pi * (hour - 5) / 16), 0.0)
        return int(np.random.default_rng([self.seed, visit]).poisson(rate * WINDOW_S / 60.0))

    def _motion(self, visit: int, stream: NoiseStream, response: Response | None = None) -> BuildingMotion:
        if stream != NoiseStream.BUILDING_MOTION:
            return Moved(np.zeros_like)  # type: ignore[return-value]  # nothing happens that needs it
        random, (start_s, stop_s) = np.random.default_rng([self.seed, int(stream), visit]), self.span(visit)
        pad_s = 15.0  # the bridge does not stand still before a window, nor an AC reference
        points = round((stop_s - start_s + 2.0 * pad_s) * GRID_HZ)
        time_s = start_s - pad_s + np.arange(points) / GRID_HZ
        frequency_hz = np.asarray(np.fft.rfftfreq(points, 1.0 / GRID_HZ), np.float64)
        forces = self._forces(visit, random, time_s)
        lines: ComplexArray = np.zeros((len(frequency_hz), 3), dtype=np.complex128)
        for (natural_hz, damping, shape), force in zip(MODES, forces, strict=True):
            s = 1j * frequency_hz / natural_hz
            lines += (s**2 / (s**2 + 2.0 * damping * s + 1.0) * np.fft.rfft(force))[:, None] * np.roll(shape, -1)
        if visit == QUAKE:
            lines += np.fft.rfft(_quake(random, time_s), axis=0)
        if response is not None:
            lines *= response(frequency_hz)[:, None]
        return Moved(CubicSpline(time_s, np.fft.irfft(lines, points, axis=0)))  # type: ignore[return-value]

    def _forces(self, visit: int, random: np.random.Generator, time_s: Array) -> Array:
        """(modes, n) force over mass of each mode, m/s2."""
        n, natural = len(time_s), np.array([hz for hz, _, _ in MODES])
        damping = np.array([ratio for _, ratio, _ in MODES])
        lines = np.fft.rfftfreq(n, 1.0 / GRID_HZ)
        gusts = np.fft.rfft(random.standard_normal((len(MODES), n))) / (1.0 + (lines / 1.5) ** 2) ** 0.5
        found: Array = np.fft.irfft(gusts, n).astype(np.float64)
        # White force f gives a mode the rms f sqrt(pi natural / (4 damping) / (rate / 2)).
        grows = np.sqrt(np.pi * natural / (4.0 * damping) / (GRID_HZ / 2.0)) / np.sqrt(1.0 + (natural / 1.5) ** 2)
        found *= (WINDY * self.wind_mps2(visit) / grows)[:, None]
        for _ in range(self.lorries(visit)):
            begin_s, speed_mps = random.uniform(time_s[0], time_s[-1]), random.uniform(12.0, 25.0)
            axles_m = np.cumsum(np.concatenate([[0.0], random.uniform(1.3, 5.5, random.integers(1, 5))]))
            side = 1.0 + random.uniform(-1.0, 1.0) * SIDE
            for at_m in axles_m.tolist():
                weight = random.uniform(0.4, 1.1) * STRUCK * side
                _axle(found, time_s, begin_s + at_m / speed_mps, SPAN_M / speed_mps, weight)
        return found

    def level_mps2(self, visit: int) -> float:
        return self.wind_mps2(visit)


def _is_still(visit: int) -> bool:
    return visit // 24 in STILL_NIGHTS and visit % 24 in STILL_HOURS


def _quake(random: np.random.Generator, time_s: Array) -> Array:
    """(n, 3) acceleration of the ground, which the bridge follows."""
    hz = np.fft.rfftfreq(len(time_s), 1.0 / GRID_HZ)
    lines = np.fft.rfft(random.standard_normal((len(time_s), 3)), axis=0)
    shaken = np.fft.irfft(np.where((hz >= QUAKE_HZ[0]) & (hz <= QUAKE_HZ[1]), 1.0, 0.0)[:, None] * lines, axis=0)
    middle_s = random.uniform(time_s[0] + 20.0, time_s[-1] - 20.0)
    grows = np.exp(-0.5 * ((time_s - middle_s) / 6.0) ** 2)
    return np.asarray(QUAKE_MPS2 / shaken.std() * grows[:, None] * shaken)


def _axle(forces: Array, time_s: Array, at_s: float, across_s: float, weight: Array) -> None:
    """Add the forces of an axle that strikes the joint at a time, and bends the span until it has crossed it."""
    on = slice(*np.searchsorted(time_s, [at_s - 0.03, at_s + across_s]).tolist())
    age_s = time_s[on] - at_s
    struck = np.exp(-0.5 * (age_s / STRIKE_S) ** 2) / (STRIKE_S * np.sqrt(2.0 * np.pi))
    bent = BENT_MPS2 * np.sin(np.pi * np.clip(age_s / across_s, 0.0, 1.0)) ** 2
    forces[:, on] += np.outer(weight, JOINT_MPS * struck + bent)


@dataclass(frozen=True, slots=True, eq=False)
class Happens(Harm):
    """What happens to the devices by day. After the turn the outputs are `turn` (3, 3) times what they were; S is near
    1, so that this is a sensor that is turned with its mount."""

    turn: Array = field(default_factory=lambda: np.eye(3))
    range_mps2: float = 19.6
    digit_mps2: float = 0.0  # 0: finer than the noise

    def shown(self, visit: Visit, values: Array) -> Array:
        days = float(visit.time_s[0]) / DAY_S
        if visit.role != "sensor":
            return values
        if days >= EVENTS["turn"] + 0.5:
            values = values @ self.turn.T
        if self.digit_mps2:
            values = self.digit_mps2 * np.round(values / self.digit_mps2)
        return np.clip(values, -self.range_mps2, self.range_mps2)

    def arrived(self, visit: Visit, blocks: list[Any]) -> list[Any]:
        days = float(visit.time_s[0]) / DAY_S
        if CUT[0] <= days < CUT[1] or (visit.role == "reference" and LOST[0] <= days < LOST[1]):
            return []
        if visit.role == "sensor" and days >= EVENTS["shift"] + 0.5:
            late = round(SHIFT_S * 1e9)
            return [
                replace(b, burst_t_monotonic_ns=b.burst_t_monotonic_ns + late, t_utc_ns=b.t_utc_ns + late)
                for b in blocks
            ]
        return blocks


def ac(frequency_hz: Array) -> ComplexArray:
    """The response of an AC-coupled reference."""
    s = 1j * np.asarray(frequency_hz) / CORNER_HZ
    return np.asarray(s / (1.0 + s))


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """The bridge, the same with a `later` reference, the configuration, and the turn (3, 3) of the sensor."""

    bridge: Bridge
    later: Bridge
    config: Config
    turn: Array

    def truth(self, time_s: float, frequency_hz: float) -> Array:
        """S at a frequency and Q (12,), at the mean temperature."""
        found = self.bridge.at_mean(time_s)
        S, Q = found[:9].reshape(3, 3) * self.bridge.parameters.sensor.size(frequency_hz), found[9:]
        turn = self.turn if time_s >= (EVENTS["turn"] + 0.5) * DAY_S else np.eye(3)
        return np.append((turn @ S).ravel(), turn @ Q)


def world(seed: int, reference: str, sensor: str = SENSORS[0], transverse_pct: float = TRANSVERSE_PCT) -> World:
    """Draw everything from the seed. The configuration states what an operator knows, and no walks."""
    random = np.random.default_rng([seed, 5])
    axis = random.standard_normal(3)
    turn = rotation(axis / np.linalg.norm(axis), np.deg2rad(TURN_DEG))
    S = np.eye(3) + np.where(np.eye(3), 0.01, 0.005) * random.standard_normal((3, 3))
    step = SHOCK * random.choice([-1.0, 1.0]) * np.diag(np.eye(3)[random.integers(3)]) * S
    usb = Bursts(least_late_s=0.002, mean_late_s=0.003, stall_probability=0.002, longest_stall_s=0.2)
    lean = rotation(np.array([1.0, 0.0, 0.0]), np.deg2rad(0.1) * random.standard_normal())
    parameters = BuildingParameters(
        window_s=WINDOW_S, every_s=HOUR_S, all_axes=True, sensitivity=S,
        steps=(((EVENTS["shock"] + 0.5) * DAY_S, step),),
        offset=0.1 * random.standard_normal(3), offset_a_day=np.array([2e-4, -2e-4, 2e-4]),
        offset_per_k=np.array([0.002, -0.001, 0.0015]) * random.uniform(0.5, 1.5),
        lag_s=0.002 * random.standard_normal(),
        rotation=rotation(np.array([0.0, 0.0, 1.0]), np.deg2rad(0.2) * random.standard_normal()),
        gravity_mps2=lean @ np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2]),
        tilt_rad_a_day=np.deg2rad(0.1) / 30.0 * np.append(random.standard_normal(2), 0.0),
        weather=Weather(20.0, 0.0, random.uniform(2.5, 5.0)),
        reference_sensitivity=_reads(random),
        sensor=_sensor(sensor, 3e-5 * random.standard_normal(), usb),
        reference=BuildingDevice(
            0.0005, Clock(200.0, 3e-5 * random.standard_normal(), 0.0004), late=usb,
            response=ac if reference == "AC" else None,
        ),
    )  # fmt: skip
    digit = DIGIT_MPS2 if sensor == SENSORS[1] else 0.0
    harm, s_per_k = Happens("what happens", turn=turn, digit_mps2=digit), 1e-4 * random.uniform(0.3, 1.0)
    vertical = reference == "vertical"
    made = Bridge(parameters, seed, harm, s_per_k, vertical)
    later = Bridge(replace(parameters, reference_sensitivity=_reads(random)), seed, harm, s_per_k, vertical)
    corner = {"corner_hz": CORNER_HZ, "u_corner_hz": 0.05 * CORNER_HZ} if reference == "AC" else {}
    prior = {"sensitivity": 1.0, "u_main_pct": 1.5, "u_transverse_pct": 0.75, "u_offset_mps2": 0.3}
    keys: dict[str, Any] = {"prior": prior, "certificate": {"u_sensitivity_pct": 0.1} | corner}
    if vertical:
        pose = {"direction": [0.0, 0.0, 1.0], "gravity_mps2": [0.0, 0.0, STANDARD_GRAVITY_MPS2]}
        always = {"start_s": 0.0, "stop_s": 1e9}
        unknown = {"rotation": None, "rotation_gravity_mps2": None}
        keys |= {"poses": [pose | always], "uncertainty": {"transverse_motion_pct": transverse_pct}} | unknown
    config = building_config(made, **keys)
    return World(made, later, config, turn)


def _sensor(name: str, rate_error: float, late: Bursts) -> BuildingDevice:
    if name == SENSORS[1]:
        return BuildingDevice(NOISE_OF_12_BITS_MPS2, Clock(200.0, rate_error, 0.0013, 2e-5), late=late)
    return adxl355(BuildingDevice(0.003, Clock(250.0, rate_error, 0.0013, 2e-5), late=late), 250.0)


def _reads(random: np.random.Generator) -> Array:
    return np.diag(1.0 + 1e-3 * random.standard_normal(3))


@dataclass(frozen=True, slots=True, eq=False)
class Hour:
    """After one window: the status, what was said since the window before, S and Q in force (12,) with u, which of them
    are determined, and the true values."""

    status: str
    said: Sequence[str]
    value: Array
    u: Array
    determined: NDArray[np.bool_]
    truth: Array

    @property
    def worst(self) -> float:
        """The largest error of a determined element over its u."""
        return float(np.max(np.abs(self.value - self.truth) / self.u, where=self.determined, initial=0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Month:
    """One run. `valid`, `held`: the shares of windows after which the status was so. `beyond`: in how many windows the
    worst element in force was beyond 3 u and 4 u while VALID; `unseen`: how many of the latter were between an event
    and the window that told it. `u_pct` of the main sensitivities that are determined, before the
    first event and in the end, relative.

    Of each event that was `told` by name: after how many windows, the error of the change of S after twelve more
    windows (see `error_of_change`), and what was said.
    """

    job: Job
    valid: float
    held: float
    beyond: tuple[int, int]
    unseen: int
    u_pct: tuple[float, float]
    told: dict[str, tuple[int, float, str]]


def one(job: Job) -> Month:
    """Simulate a month."""
    reference, sensor, seed = job
    own = world(seed, reference, sensor)
    house, hours = House(own.bridge, own.config), list[Hour]()
    gateway = house.gateway
    for visit in range(DAYS * HOURS_A_DAY):
        before = len(gateway.reasons)
        if visit == at_visit("swap"):
            house.fit(own.later, "B")
            house.plug()
        if visit == round(CUT[1] * HOURS_A_DAY):
            house.restart(own.config)
        house.visit()
        said, update = gateway.reasons[before:], gateway.in_force
        truth = own.truth(own.bridge.span(visit)[1], 0.0 if update is None else update.reference_frequency_hz)
        if update is None:  # nothing is in force before the first window is taken
            hours.append(Hour(gateway.status, said, truth, np.full(12, np.inf), np.zeros(12, dtype=bool), truth))
            continue
        value, determined = np.append(np.ravel(update.sensitivity), update.offset), np.array(update.determined)
        u = np.array(update.standard_uncertainty)
        hours.append(Hour(gateway.status, said, value, u, determined, truth))
    return month(job, hours)


def month(job: Job, hours: Sequence[Hour]) -> Month:
    """What a run shows."""
    told, unseen = dict[str, tuple[int, float, str]](), 0
    for event in EVENTS:
        first = at_visit(event)
        before = hours[first - 1]
        if event == "shock":
            axis = AXES[int(np.argmax(np.abs((hours[first].truth - before.truth)[MAIN])))]
        name = NAMES[event].format(axis=axis)
        found = ((k, text) for k in range(first, first + HOURS_A_DAY) for text in hours[k].said if name in text)
        k, text = next(found, (first + HOURS_A_DAY, ""))
        unseen += sum(hour.status == "VALID" and hour.worst > 4.0 for hour in hours[first:k])
        if text:
            told[event] = k - first + 1, error_of_change(before, hours[k + SETTLED]), text
    beyond = [sum(hour.worst > most and hour.status == "VALID" for hour in hours) for most in (3.0, 4.0)]
    share = {name: sum(hour.status == name for hour in hours) / len(hours) for name in ("VALID", "HELD")}
    u_pct = _u_main_pct(hours[at_visit("shock") - 1]), _u_main_pct(hours[-1])
    return Month(job, share["VALID"], share["HELD"], (beyond[0], beyond[1]), unseen, u_pct, told)


def _u_main_pct(hour: Hour) -> float:
    """The largest of the determined main sensitivities, relative."""
    told = np.flatnonzero(hour.determined[MAIN])
    return 100.0 * float(np.max((hour.u[MAIN] / np.abs(hour.value[MAIN]))[told], initial=0.0))


def error_of_change(before: Hour, later: Hour) -> float:
    """The largest error of the change of a determined S, over u of the change: that of the later S, or of what it was
    told since then, where that is more. (After a step of the sensor or of its one reference u of S covers both.)"""
    error = (later.value - before.value) - (later.truth - before.truth)
    u = np.sqrt(np.maximum(later.u**2, before.u**2 - later.u**2))
    return float(np.max(np.abs(error / u)[:9], where=(before.determined & later.determined)[:9], initial=0.0))


def at_visit(event: str) -> int:
    """The first visit after an event."""
    return round((EVENTS[event] + 0.5) * HOURS_A_DAY)


def jobs(runs: int) -> list[Job]:
    """All runs: each kind of reference and of sensor with the same seeds."""
    return [(reference, sensor, SEED + run) for sensor in SENSORS for reference in REFERENCES for run in range(runs)]


def table(found: Sequence[Month]) -> str:
    """One row for each run, and what was said of its events."""
    lines = [
        "| reference, sensor, seed | VALID, % of windows | HELD, % | VALID beyond 3 u, 4 u "
        "| of these before an event was told "
        "| u of main S, %: day 8, end | " + " | ".join(f"{event}: told after, error" for event in EVENTS) + " |",
        "| --- |" + " --- |" * (5 + len(EVENTS)),
    ]
    for run in found:
        told = [
            f"{run.told[event][0]} windows, {run.told[event][1]:.1f} u" if event in run.told else "not told"
            for event in EVENTS
        ]
        three, four = run.beyond
        lines.append(
            f"| {_name(run.job)} | {100.0 * run.valid:.1f} | {100.0 * run.held:.1f} | {three}, {four} "
            f"| {run.unseen} | {run.u_pct[0]:.3f}, {run.u_pct[1]:.3f} | {' | '.join(told)} |"
        )
    said = [f"- {_name(run.job)}, {event}: {text}" for run in found for event, (_, _, text) in run.told.items()]
    return "\n".join([*lines, "", *said])


def _name(job: Job) -> str:
    reference, sensor, seed = job
    return f"{reference}, {sensor}, {seed - SEED}"
