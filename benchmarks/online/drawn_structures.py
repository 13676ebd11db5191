"""Structures that are drawn from a seed, on-line: what moves, how often, by which sensor and beside which reference.

    python -m benchmarks.online.drawn_structures [--first 0] [--structures 24] [--write]

The motions are those of towers, ships, floors, vehicles and cranes, as an engineer would sketch them: modes, waves,
tones that wander, blows and steps of people. The instruments are drawn beside them: a sensor with the filters of its
data sheet, with a filter that nobody states, of 12 or 16 bits, at 62.5 to 500 samples a second; a reference at 100 to
500, DC-coupled or with a stated corner, behind its own filter, with the noise of a seismometer or of a MEMS device; USB
that is late, warm days, and windows each minute, ten minutes or hour. All other settings are the defaults.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.online.bridge import Bridge, Happens, Moved, ac
from benchmarks.online.config import building_config
from benchmarks.online.life import House
from benchmarks.online.node import adxl355
from benchmarks.page import machine, write_part
from calib.model import Array
from hw.virtual.building import BuildingDevice, BuildingParameters, Weather
from hw.virtual.building_motion import BuildingMotion
from hw.virtual.noise import NoiseStream
from hw.virtual.response import Response, in_turn
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2, rotation
from hw.virtual.timebase import Bursts, Clock
from tests.pair import lowpass

GRID_HZ, PAD_S = 1024.0, 15.0  # of the motion
CORNER_HZ = 0.05  # of an AC-coupled reference, as bridge.ac has it
# From start to start in s (0: one after the other), and how many.
CADENCES = {"minute": (0.0, 150), "ten minutes": (600.0, 100), "hour": (3600.0, 60)}
OWN_CORNER = 0.35  # of its rate: where the reference's own filter has its corner
S_PER_K = 5e-5
PRIOR = {"sensitivity": 1.0, "u_main_pct": 1.5, "u_transverse_pct": 0.75, "u_offset_mps2": 0.3}


@dataclass(frozen=True, slots=True, eq=False)
class MotionDraw:
    """A window to be moved: times (n,) in s from its start, frequencies of their spectrum, what is drawn for it alone
    and for some windows in a row, and the hour of the day."""

    time_s: Array
    hz: Array
    random: np.random.Generator
    lasting: np.random.Generator
    of_day: int

    def shaped(self, power: Array, rms_mps2: float) -> Array:
        """(n, 3) random motion with this power (n // 2 + 1,) over frequency."""
        n = len(self.time_s)
        lines = np.fft.rfft(self.random.standard_normal((n, 3)), axis=0) * np.sqrt(power)[:, None]
        moved = np.fft.irfft(lines, n, axis=0)
        return np.asarray(rms_mps2 * moved / moved.std(axis=0))

    def modes(self, rms_mps2: float, *modes: tuple[float, float, float]) -> Array:
        """(n, 3) motion of modes (frequency in Hz, damping ratio, share of the power)."""
        return self.shaped(
            sum((share * _mode(self.hz, f, ratio) for f, ratio, share in modes), 0.0 * self.hz), rms_mps2
        )

    def tones(self, hz: float, wander: float, *tones: tuple[float, float]) -> Array:
        """(n, 3) a machine at a frequency that wanders: (multiple of it, m/s2)."""
        turns = np.cumsum(hz * (1.0 + wander * np.sin(2.0 * np.pi * self.time_s / 23.0))) / GRID_HZ
        phase, share = self.random.uniform(0.0, 1.0, (len(tones), 3)), self.random.uniform(0.3, 1.0, (len(tones), 3))
        each = [
            size * np.sin(2.0 * np.pi * (k * turns[:, None] + p)) * s
            for (k, size), p, s in zip(tones, phase, share, strict=True)
        ]
        return np.asarray(np.sum(each, axis=0))

    def blows(self, count: float, *rings: tuple[float, float, float]) -> Array:
        """(n, 3) so many blows, after each of which modes ring: (frequency in Hz, damping ratio, m/s2)."""
        found = np.zeros((len(self.time_s), 3))
        for at_s in self.random.uniform(self.time_s[0], self.time_s[-1], self.random.poisson(count)):
            after = self.time_s >= at_s
            age_s = self.time_s[after] - at_s
            for hz, ratio, size in rings:
                ring = np.exp(-2.0 * np.pi * hz * ratio * age_s) * np.sin(2.0 * np.pi * hz * age_s)
                found[after] += size * ring[:, None] * self.random.uniform(-1.0, 1.0, 3)
        return found


def _mode(hz: Array, natural_hz: float, ratio: float) -> Array:
    x = hz / natural_hz
    return np.asarray(x**4 / ((1.0 - x**2) ** 2 + (2.0 * ratio * x) ** 2) / (1.0 + (x / 4.0) ** 6))


def _waves(hz: Array, period_s: float) -> Array:
    """A sea of Pierson and Moskowitz, as acceleration."""
    x = np.maximum(hz, 0.01) * period_s
    return np.asarray(x**-5 * np.exp(-1.25 * x**-4) * hz**4 * (hz > 0.03) * (hz < 1.5))


def _people(draw: MotionDraw) -> Array:
    found = draw.modes(0.0015, (6.2, 0.03, 1.0), (9.4, 0.03, 0.5), (21.0, 0.04, 0.1))
    steps = 40.0 if 7 <= draw.of_day <= 18 else 2.0
    return found + draw.blows(steps, (6.2, 0.03, 0.03), (9.4, 0.05, 0.03))


def _vehicle(draw: MotionDraw) -> Array:
    power = _mode(draw.hz, 1.3, 0.1) + 0.5 * _mode(draw.hz, 6.5, 0.1) + 0.3 / (1.0 + ((draw.hz - 40.0) / 15.0) ** 2)
    return draw.shaped(power / (1.0 + (draw.hz / 80.0) ** 8), 1.5 if draw.lasting.random() < 0.8 else 2e-3)


def _ship(draw: MotionDraw) -> Array:
    waves = draw.shaped(_waves(draw.hz, 8.0 * np.exp(0.15 * draw.lasting.standard_normal())), 0.3)
    rattle = draw.shaped((draw.hz > 5.0) / (1.0 + (draw.hz / 60.0) ** 4), 0.01)
    return waves + rattle + draw.tones(1.9, 0.01, (1, 0.01), (4, 0.06), (8, 0.02)) + draw.blows(2.0, (2.7, 0.05, 0.5))


STRUCTURES: Mapping[str, Callable[[MotionDraw], Array]] = {
    "wind turbine": lambda draw: draw.modes(0.03, (0.31, 0.01, 1.0), (2.4, 0.01, 0.02), (3.1, 0.01, 0.01))
    + draw.tones(11.0 / 60.0, 0.01, (3, 0.05), (6, 0.02), (9, 0.02), (97, 0.02)),
    "platform at sea": lambda draw: draw.shaped(_waves(draw.hz, 9.0), 0.05)
    + draw.tones(24.9, 1e-3, (1, 0.02), (2, 0.01)),
    "floor of an office": _people,
    "ship": _ship,
    "vehicle": _vehicle,
    "chimney": lambda draw: draw.modes(0.02, (0.27, 0.006, 1.0), (1.4, 0.01, 0.1), (3.6, 0.01, 0.02)),
    "cable bridge": lambda draw: draw.modes(
        0.008, (0.8, 0.008, 1.0), (1.1, 0.008, 1.0), (2.3, 0.01, 0.5), (9.0, 0.02, 0.1)
    ),
    "crane": lambda draw: draw.modes(0.003, (1.1, 0.01, 1.0), (4.0, 0.02, 0.3))
    + draw.blows(1.5, (1.1, 0.02, 0.5), (14.0, 0.05, 0.4)),
}  # fmt: skip


class DrawnBuilding(Bridge):
    """One structure: `moved` makes its motion, which `mixed` (3, 3) spreads over the axes."""

    def __init__(
        self,
        parameters: BuildingParameters,
        seed: int,
        harm: Happens,
        moved: Callable[[MotionDraw], Array],
        mixed: Array,
    ) -> None:
        super().__init__(parameters, seed, harm, S_PER_K)
        self._moved, self._mixed = moved, mixed

    def _motion(self, visit: int, stream: NoiseStream, response: Response | None = None) -> BuildingMotion:
        if stream != NoiseStream.BUILDING_MOTION:
            return Moved(np.zeros_like)  # type: ignore[return-value]  # nothing happens that needs it
        start_s, stop_s = self.span(visit)
        n = round((stop_s - start_s + 2.0 * PAD_S) * GRID_HZ)
        time_s = np.arange(n) / GRID_HZ - PAD_S
        hz = np.asarray(np.fft.rfftfreq(n, 1.0 / GRID_HZ), np.float64)
        alone = np.random.default_rng([self.seed, 1, visit])
        lasting = np.random.default_rng([self.seed, 2, visit // 4])
        found = self._moved(MotionDraw(time_s, hz, alone, lasting, int(start_s / 3600.0) % 24)) @ self._mixed
        if response is not None:
            found = np.fft.irfft(np.fft.rfft(found, axis=0) * response(hz)[:, None], n, axis=0)
        return Moved(CubicSpline(start_s + time_s, found))  # type: ignore[return-value]


@dataclass(frozen=True, slots=True, eq=False)
class DrawnStructure:
    """What was drawn: a sentence of it, the building, how many windows it lives, and the keys of its channel."""

    said: str
    building: DrawnBuilding
    windows: int
    keys: Mapping[str, object]


def structure(seed: int) -> DrawnStructure:
    """Draw everything from the seed."""
    random = np.random.default_rng([seed, 64])
    name = list(STRUCTURES)[seed % len(STRUCTURES)]
    coupling, cadence = str(random.choice(["DC", "DC", "AC"])), str(random.choice(list(CADENCES)))
    kind = str(random.choice(["ADXL355", "ADXL355", "12 bits", "filter", "16 bits"]))
    rate_hz = float(random.choice([62.5, 125.0, 250.0, 500.0]))
    reference_hz = float(random.choice([100.0, 200.0, 500.0]))
    density = float(random.choice([2e-6, 2e-5, 1e-4]))
    late = (Bursts(), Bursts(0.002, 0.003, 0.002, 0.2), Bursts(0.01, 0.02, 0.01, 1.0))[random.integers(3)]
    every_s, windows = CADENCES[cadence]
    sensor = BuildingDevice(0.0, Clock(rate_hz, 3e-5 * random.standard_normal(), 0.0013, 2e-5), late=late)
    parameters = BuildingParameters(
        window_s=60.0, every_s=every_s, all_axes=True,
        sensitivity=np.eye(3) + np.where(np.eye(3), 0.01, 0.005) * random.standard_normal((3, 3)),
        offset=0.1 * random.standard_normal(3), offset_per_k=np.array([0.002, -0.001, 0.0015]),
        lag_s=0.002 * random.standard_normal(),
        rotation=rotation(np.array([0.0, 0.0, 1.0]), np.deg2rad(0.2) * random.standard_normal()),
        gravity_mps2=np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2]),
        weather=Weather(20.0, 0.0, float(random.choice([1.0, 4.0, 10.0]))),
        reference_sensitivity=np.diag(1.0 + 1e-3 * random.standard_normal(3)),
        sensor=_sensor(kind, sensor, random),
        reference=_reference(coupling, reference_hz, density, 3e-5 * random.standard_normal(), late),
    )  # fmt: skip
    digit = {"12 bits": 0.00980665, "16 bits": 0.0006}.get(kind, 0.0)
    mixed = np.diag(random.uniform(0.4, 1.2, 3)) @ np.linalg.qr(random.standard_normal((3, 3)))[0]
    nothing = Happens("nothing", range_mps2=80.0, digit_mps2=digit)
    building = DrawnBuilding(parameters, seed, nothing, STRUCTURES[name], mixed)
    corner = {"corner_hz": CORNER_HZ, "u_corner_hz": 0.05 * CORNER_HZ} if coupling == "AC" else {}
    said = f"{name}, {kind} at {rate_hz:g} Hz, {coupling} reference at {reference_hz:g} Hz, {density:g}, each {cadence}"
    return DrawnStructure(said, building, windows, {"prior": PRIOR, "certificate": {"u_sensitivity_pct": 0.1} | corner})


def _sensor(kind: str, own: BuildingDevice, random: np.random.Generator) -> BuildingDevice:
    noise_mps2, rate_hz = {"12 bits": 0.01, "16 bits": 0.005}.get(kind, 0.002), own.clock.nominal_rate_hz
    own = replace(own, noise_mps2=noise_mps2)
    if kind == "ADXL355":
        return adxl355(own, rate_hz)
    return replace(own, response=lowpass(2, random.uniform(0.15, 0.3) * rate_hz)) if kind == "filter" else own


def _reference(coupling: str, rate_hz: float, density: float, rate_error: float, late: Bursts) -> BuildingDevice:
    own = _own_filter(rate_hz)
    response = in_turn(own, ac) if coupling == "AC" else own
    noise_mps2 = density * np.sqrt(0.5 * rate_hz)
    return BuildingDevice(noise_mps2, Clock(rate_hz, rate_error, 0.0004), late=late, response=response)


def _own_filter(rate_hz: float) -> Response:
    """The filter that a reference has beside its stated corner."""
    return lowpass(6, OWN_CORNER * rate_hz)


@dataclass(frozen=True, slots=True)
class StructureLife:
    """How a structure went: the share of windows after which the status was each one, the largest error of a determined
    element of S and Q in force over its u, u of the main sensitivities at the end in % (the largest; NaN where none is
    in force), and how many elements are determined."""

    said: str
    status: Mapping[str, float]
    worst: float
    u_pct: float
    determined: int

    @property
    def row(self) -> str:
        """A row of the table."""
        shares = ", ".join(f"{name} {100.0 * share:.0f}" for name, share in self.status.items())
        return f"| {self.said} | {shares} | {self.worst:.1f} | {self.u_pct:.2f} | {self.determined} |"


def lived(made: DrawnStructure) -> StructureLife:
    """Simulate a structure."""
    house, count, worst = House(made.building, building_config(made.building, **made.keys)), Counter[str](), 0.0
    gateway, p = house.gateway, made.building.parameters
    own = _own_filter(p.reference.clock.nominal_rate_hz)
    for visit in range(made.windows):
        house.visit()
        count[gateway.status] += 1
        if (update := gateway.in_force) is None:
            continue
        truth = made.building.at_mean(made.building.span(visit)[1])
        hz = update.reference_frequency_hz
        truth[:9] *= p.sensor.size(hz) / abs(own(np.array([hz]))[0])  # the stated corner is undone
        error = np.abs(np.append(np.ravel(update.sensitivity), update.offset) - truth) / update.standard_uncertainty
        worst = max(worst, float(np.max(error, where=np.array(update.determined), initial=0.0)))
    u_pct, determined = np.nan, 0
    if (update := gateway.in_force) is not None:
        u_pct, determined = 100.0 * max(update.standard_uncertainty[k] for k in (0, 4, 8)), sum(update.determined)
    return StructureLife(
        made.said, {name: n / made.windows for name, n in count.most_common()}, worst, u_pct, determined
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0, help="seed of the first structure")
    parser.add_argument("--structures", type=int, default=24)
    parser.add_argument("--write", action="store_true", help="write docs/online-evidence.md")
    given = parser.parse_args()
    rows = [
        "| structure, sensor, reference (its noise in m/s2 per root Hz), windows | status, % of windows "
        "| worst error over u | u main, % | determined |",
        "| --- | --- | --- | --- | --- |",
    ]
    for seed in range(given.first, given.first + given.structures):
        rows.append(lived(structure(seed)).row)
        print(rows[-1], flush=True)
    if given.write:
        write_part("drawn structures", "\n".join([*rows, "", f"Seeds {given.first} to {seed}; {machine()}."]))


if __name__ == "__main__":
    main()
