"""A building beside a road: lorries shake it at 15 to 50 Hz in some windows, and the sensor has a filter at 35 Hz.

The band in which S is estimated, and the frequency at which it holds, must not depend on which windows have lorries.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline

from agent.core.events import CalibrationUpdate, StatusChange, WindowReport
from benchmarks.online.config import building_config
from benchmarks.online.node import Node, Stated, Timing, node
from benchmarks.online.runner import EPOCH_NS, Run, visits
from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel, Wander
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import Array, Pose, Window
from calib.state.state import State
from calib.windows.bands import band_sums, beside_noise
from calib.windows.record import Record
from calib.windows.sums import window_sums
from hw.virtual.building import Building, BuildingParameters
from hw.virtual.building_motion import BuildingMotion, BuildingSpectrum
from hw.virtual.noise import NoiseStream
from hw.virtual.response import Response
from tests.pair import lowpass

SEED, RUNS, WINDOWS = 340_000, 20, 8
RATE_HZ = 200.0
TIMING = Timing(60.0, 3600.0, WINDOWS)
FAST_HZ = (15.0, 50.0)  # of the bumps
LASTING = 4.0  # cycles until a bump is strongest; after four times as many it is a fifth of that
A_MINUTE = 10
LEVEL, BAND = (0.02, 0.1), BuildingSpectrum(0.5, 12.0)
PEAK_MPS2 = 0.04
FILTER = lowpass(4, 35.0)
POINTS_A_PERIOD = 64  # of the fastest bump: cubic pieces are then accurate to 1e-6
# Nobody states the sensor's filter: the lag is stated as unknown to 20 ms.
STATED = Stated(main_pct=3.0, transverse_pct=1.5, reference_pct=0.3, lag_s=0.02)
BOUND_PCT = 100.0 / float(np.hypot(1.0 / 0.003, 1.0 / 0.03))  # u of S by its prior and one reference
ORDERS: dict[str, Sequence[int]] = {"the first": (0,)}  # visits with lorries
Job = tuple[str, int]

# At the level of records, without a front end: each letter is a window.
RECORDS = (
    "........", "W.......", ".W......", "WWW.....", "WWWW....",
    "W.W.W.W.", "B.......", ".BBBBBBB", "BBBBBBBB", "BWB.BW.B",
)  # fmt: skip
WINDOW_S = 60
S = np.array([[1.02, 0.01, -0.005], [0.004, 0.98, 0.008], [-0.01, 0.006, 1.01]])
MEAN = np.append(np.eye(3).ravel(), np.zeros(3))
U = np.append(np.where(np.eye(3).ravel() > 0, 0.03, 0.015), np.full(3, 20.0))
PRIORS = Priors(gravity_mps2=0.03, offset_mps2=1e-3, lag_window_s=0.0, reference=0.003, lag_s=0.02)
DELAY_S = 2.6131 / (2.0 * np.pi * 35.0)  # of the filter, at 0 Hz
CALM_HZ = (0.5, 12.0)


class Shaken:
    """Acceleration (m/s2) of a building and of bumps beside it, as a device with a response shows both."""

    def __init__(self, quiet: BuildingMotion, bumps: CubicSpline) -> None:
        self._quiet, self._bumps = quiet, bumps

    def at(self, time_s: Array) -> Array:
        """Acceleration (n, 3) at times (n,)."""
        return np.asarray(self._quiet.at(time_s) + self._bumps(time_s))


class Roadside(Building):
    """A building with `A_MINUTE` bumps a minute in the visits `busy`, each along a direction of its own."""

    def __init__(self, parameters: BuildingParameters, seed: int, busy: Collection[int]) -> None:
        super().__init__(parameters, seed)
        self._busy = busy

    def _motion(self, visit: int, stream: NoiseStream, response: Response | None = None) -> BuildingMotion:
        quiet = super()._motion(visit, stream, response)
        if visit not in self._busy:
            return quiet
        return Shaken(quiet, self._bumps(visit, response))  # type: ignore[return-value]

    def _bumps(self, visit: int, response: Response | None) -> CubicSpline:
        random, (start_s, stop_s) = np.random.default_rng([self.seed, visit]), self.span(visit)
        rate_hz = POINTS_A_PERIOD * FAST_HZ[1]
        time_s = start_s + np.arange(round((stop_s - start_s) * rate_hz)) / rate_hz
        moved = np.zeros((len(time_s), 3))
        for begin_s in random.uniform(start_s, stop_s, round((stop_s - start_s) / 60.0 * A_MINUTE)):
            fast_hz, way = random.uniform(*FAST_HZ), random.standard_normal(3)
            age = np.maximum(time_s - begin_s, 0.0) * fast_hz
            swell = age / LASTING * np.exp(1.0 - age / LASTING)
            moved += np.outer(PEAK_MPS2 * swell * np.sin(2.0 * np.pi * age), way / np.linalg.norm(way))
        if response is not None:
            frequency_hz = np.asarray(np.fft.rfftfreq(len(moved), 1.0 / rate_hz), np.float64)
            moved = np.fft.irfft(response(frequency_hz)[:, None] * np.fft.rfft(moved, axis=0), len(moved), axis=0)
        return CubicSpline(time_s, moved)


def roadside(seed: int, busy: Collection[int], timing: Timing = TIMING) -> Node:
    """A node whose building has lorries in the visits `busy`; its sensor has the filter."""
    drawn = node(seed, all_axes=True, stated=STATED, timing=timing)
    parameters = drawn.building.parameters
    sensor, reference = (
        replace(one, clock=replace(one.clock, nominal_rate_hz=RATE_HZ))
        for one in (parameters.sensor, parameters.reference)
    )
    sensor = replace(sensor, response=FILTER)
    parameters = replace(parameters, level_mps2=LEVEL, band=BAND, sensor=sensor, reference=reference)
    building = Roadside(parameters, seed, busy)
    return Node(building, building_config(building, **drawn.stated.keys()), drawn.stated)


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """One run: how many windows were `taken`, `held` and `refused`, `u_pct` of the main sensitivities (3,), their
    errors over u, the frequencies at which S held in the calibrations in force, and the status in the end."""

    job: Job
    taken: int
    held: int
    refused: int
    u_pct: Array
    over_u: Array
    frequencies_hz: tuple[float, ...]
    status: str


def one(job: Job) -> Outcome:
    """Simulate one run."""
    order, seed = job
    drawn = roadside(seed, ORDERS[order])
    run, updates, reports, status = Run(drawn.config), list[CalibrationUpdate](), list[WindowReport](), ""
    for event in visits(drawn.building, range(WINDOWS)):
        for result in run.feed(event):
            if isinstance(result, CalibrationUpdate):
                updates.append(result)
            elif isinstance(result, StatusChange):
                status = result.status
            elif isinstance(result, WindowReport):
                reports.append(result)
    run.close()
    taken = sum(report.used for report in reports)
    held = sum("innovation_chi2" in report.numbers for report in reports) - taken
    refused = len(reports) - taken - held
    if not updates:
        nothing = np.full(3, np.nan)
        return Outcome(job, taken, held, refused, nothing, nothing, (), status)
    newest = updates[-1]
    main, u = np.diag(newest.sensitivity), np.array(newest.standard_uncertainty)[[0, 4, 8]]
    truth = drawn.building.truth((newest.t_utc_ns - EPOCH_NS) * 1e-9)
    right = drawn.building.size(newest.reference_frequency_hz) * np.diag(truth.sensitivity)
    frequencies_hz = tuple(dict.fromkeys(update.reference_frequency_hz for update in updates))
    return Outcome(job, taken, held, refused, 100.0 * u / main, (main - right) / u, frequencies_hz, status)


def jobs(runs: int) -> list[Job]:
    """All runs: each order with the same seeds."""
    return [(order, SEED + run) for order in ORDERS for run in range(runs)]


@lru_cache(maxsize=64)
def window(seed: int, kind: str = ".", calm_hz: tuple[float, float] = CALM_HZ) -> Window:
    """A minute of random motion in `calm_hz`, 0.05 m/s2 on each axis. `kind`: beside it 0.03 m/s2 in FAST_HZ all the
    time ("W"), or in three bumps of a second, four times as strong ("B"). The sensor has the filter, whose delay is
    taken out."""
    random, n = np.random.default_rng(seed), round(RATE_HZ * WINDOW_S)
    frequency_hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)

    def moved(band_hz: tuple[float, float], level_mps2: float) -> Array:
        lines = random.normal(size=(3, len(frequency_hz))) + 1j * random.normal(size=(3, len(frequency_hz)))
        lines[:, (frequency_hz < band_hz[0]) | (frequency_hz > band_hz[1])] = 0.0
        motion = np.fft.irfft(lines, n)
        return np.asarray(level_mps2 / motion.std() * motion)

    u = moved(calm_hz, 0.05)
    if kind != ".":
        bumps = np.zeros(n)
        for begin_s in (11.0, 23.0, 41.0):
            bumps[round(begin_s * RATE_HZ) :][: round(RATE_HZ)] = np.hanning(round(RATE_HZ))
        u += moved(FAST_HZ, 0.03) * (4.0 * bumps if kind == "B" else 1.0)
    lines = np.fft.rfft(u)
    du = np.fft.irfft(lines * 2j * np.pi * frequency_hz, n)
    late = FILTER(frequency_hz) * np.exp(2j * np.pi * frequency_hz * DELAY_S)
    V = np.fft.irfft(S @ (lines * late), n) + 0.0005 * random.normal(size=u.shape)
    in_bands = band_sums(u.T, du.T, V.T, RATE_HZ)
    assert in_bands is not None
    bands = beside_noise(in_bands, np.full(3, np.inf))
    edges = np.linspace(0, n, WINDOW_S + 1).astype(int)
    pose = Pose("beside", np.eye(3), np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2]))
    return Window(0.0, WINDOW_S, pose, window_sums(u.T, du.T, V.T, edges), True, "", n, 0, bands=bands)


def after(windows: Sequence[Window], band_hz: tuple[float, float] | None = None) -> State:
    """The state of a sensor after these windows, one an hour."""
    still = Wander({**Wander.none().values, "offset_rate_mps2": 1e-9})
    state = State(MEAN, U, PRIORS, still, TemperatureModel(), fixed=True, band_hz=band_hz)
    for k, own in enumerate(windows):
        take(state, own, k)
    return state


def take(state: State, own: Window, k: int) -> None:
    """The state takes window number `k`."""
    state.update(Record.of(own, k / 24.0, state.lag_s(), to_hz=state.motion_to_hz))


def judged(state: State) -> tuple[float, float]:
    """The largest u of a main sensitivity over the bound, and the largest error over u."""
    found = state.result()
    main, u = np.diag(found.sensitivity), found.standard_uncertainty[[0, 4, 8]]
    size = float(abs(FILTER(np.array([state.reference_frequency_hz]))[0]))
    return float((100.0 * u / main).max() / BOUND_PCT), float(np.abs((main - size * np.diag(S)) / u).max())


def of_records(job: Job) -> tuple[str, float, float, float]:
    """One run at the level of records: its order, what `judged` tells, and the frequency of S."""
    order, seed = job
    state = after([window(100 * seed + k, kind) for k, kind in enumerate(order)])
    return order, *judged(state), state.reference_frequency_hz


def records_table(found: Sequence[tuple[str, float, float, float]]) -> str:
    """One row for each order of the windows."""
    lines = [
        "| windows, as records | seeds | u of main S over the bound: mean, most | worst error, u | S holds at, Hz |",
        "| --- | --- | --- | --- | --- |",
    ]
    for order in dict.fromkeys(each[0] for each in found):
        u, error, at_hz = np.array([each[1:] for each in found if each[0] == order]).T
        lines.append(
            f"| `{order}` | {len(u)} | {u.mean():.3f}, {u.max():.3f} | {error.max():.2f} | "
            f"{at_hz.min():.2f} to {at_hz.max():.2f} |"
        )
    return "\n".join(lines)


def table(found: Sequence[Outcome]) -> str:
    """One row for each order."""
    lines = [
        f"| visits with lorries, of {WINDOWS} | runs | taken / held / refused | runs ending HELD | u of main S over "
        "the bound: mean, most | worst error, u | frequency of S, Hz |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for order in dict.fromkeys(o.job[0] for o in found):
        own = [o for o in found if o.job[0] == order]
        taken, held, refused = (sum(getattr(o, name) for o in own) for name in ("taken", "held", "refused"))
        u, over_u = (np.array([getattr(o, name) for o in own]) for name in ("u_pct", "over_u"))
        newest_hz = [o.frequencies_hz[-1] for o in own if o.frequencies_hz]
        lines.append(
            f"| {order} | {len(own)} | {taken} / {held} / {refused} | "
            f"{sum(o.status == 'HELD' for o in own)} | {np.nanmean(u) / BOUND_PCT:.3f}, "
            f"{np.nanmax(u) / BOUND_PCT:.3f} | {np.nanmax(np.abs(over_u)):.1f} | "
            f"{min(newest_hz):.2f} to {max(newest_hz):.2f} |"
        )
    return "\n".join(lines)
