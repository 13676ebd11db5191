"""A sensor fixed in a building beside a tri-axial reference, or two: blocks as a gateway receives them, and the truth.

Data are generated in visits, for years. In each visit the building moves for one window, with a level and a direction
drawn for this visit. Between two visits nothing is generated, but clocks, sample numbers, temperature, tilt and drift
continue.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, DeviceInfo, SampleBlock
from hw.virtual.building_motion import BuildingMotion, BuildingSpectrum, ComplexArray
from hw.virtual.harm import HARMLESS, Harm, Role, Visit
from hw.virtual.noise import NoiseStream, generator
from hw.virtual.response import Response
from hw.virtual.schedule import STANDARD_GRAVITY_MPS2, rotation
from hw.virtual.timebase import Bursts, Clock

Array = NDArray[np.float64]
DAY_S = 86_400.0
YEAR_S = 365.0 * DAY_S
EPOCH_NS = 1_790_000_000_000_000_000  # UTC at time 0 of the building
TEMPERATURE_STEP_K = 1 / 16  # resolution of the thermometer in a common chip
STREAMS: dict[Role, tuple[NoiseStream, NoiseStream]] = {
    "sensor": (NoiseStream.SENSOR, NoiseStream.SENSOR_ARRIVAL),
    "reference": (NoiseStream.REFERENCE, NoiseStream.REFERENCE_ARRIVAL),
    "check": (NoiseStream.CHECK_REFERENCE, NoiseStream.CHECK_REFERENCE_ARRIVAL),
}


@dataclass(frozen=True, slots=True)
class BuildingDevice:
    """One of the devices: its clock and its white noise.

    It sends its samples in bursts of `burst`. `late` gives the delay of a burst after its newest sample. `response` is
    its response over frequency; None: it shows all frequencies alike. `filters`: what its driver states of it.
    """

    noise_mps2: float
    clock: Clock
    burst: int = 32
    late: Bursts = field(default_factory=Bursts)
    response: Response | None = None
    filters: tuple[str, ...] = ()

    def size(self, frequency_hz: float) -> float:
        """How much of a motion at this frequency it shows; 1 without a filter."""
        return 1.0 if self.response is None else float(abs(self.response(np.array([frequency_hz]))[0]))

    def bursts(self, time_s: float) -> int:
        """Number of complete bursts at `time_s`."""
        return int(self.clock.due(time_s)) // self.burst


@dataclass(frozen=True, slots=True)
class Weather:
    """Temperature of the sensor, degC: mean + season + day."""

    mean_degc: float = 15.0
    season_k: float = 10.0
    day_k: float = 4.0

    def at(self, time_s: float) -> float:
        """Temperature at `time_s`, degC."""
        turn = 2 * np.pi * time_s
        return float(self.mean_degc + self.season_k * np.sin(turn / YEAR_S) + self.day_k * np.sin(turn / DAY_S))


@dataclass(frozen=True, slots=True, eq=False)
class BuildingParameters:
    """True values of the building. Faults are off by default; the output is in m/s2, so S is near 1.

    - `rotation` (3, 3): R in a = R a_ref.
    - `gravity_mps2` (3,): what an ideal sensor reads at rest at time 0; `tilt_rad_a_day` (3,) turns this vector.
    - `steps`: (time in s, (3, 3) added to S from then on).
    - Direction of the motion: y of the reference; in the fraction `elsewhere` of the visits a random direction; with
      `all_axes` all three axes.
    - `across`: with motion along y, the share of it on x and z; the imaginary part is a quarter of a period ahead.
    """

    window_s: float = 120.0
    every_s: float = 3600.0  # from the start of one visit to the start of the next; 0: visits without a pause
    level_mps2: tuple[float, float] = (0.02, 0.3)  # rms, drawn log-uniformly for each visit
    band: BuildingSpectrum = field(default_factory=BuildingSpectrum)
    elsewhere: float = 0.0
    all_axes: bool = False
    across: tuple[complex, complex] = (0.0, 0.0)
    sensitivity: Array = field(default_factory=lambda: np.eye(3))
    sensitivity_a_day: Array = field(default_factory=lambda: np.zeros((3, 3)))
    steps: tuple[tuple[float, Array], ...] = ()
    offset: Array = field(default_factory=lambda: np.zeros(3))  # at `weather.mean_degc`
    offset_a_day: Array = field(default_factory=lambda: np.zeros(3))
    offset_per_k: Array = field(default_factory=lambda: np.zeros(3))
    lag_s: float = 0.0
    rotation: Array = field(default_factory=lambda: np.eye(3))
    gravity_mps2: Array = field(default_factory=lambda: np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2]))
    tilt_rad_a_day: Array = field(default_factory=lambda: np.zeros(3))
    weather: Weather = field(default_factory=Weather)
    reference_sensitivity: Array = field(default_factory=lambda: np.eye(3))  # (3, 3) applied to a_ref
    sensor: BuildingDevice = field(
        default_factory=lambda: BuildingDevice(0.005, Clock(200.0, rate_error=1e-4, offset_s=0.0013, wander=20e-6))
    )
    reference: BuildingDevice = field(
        default_factory=lambda: BuildingDevice(
            0.001, Clock(200.0, rate_error=-0.6e-4, offset_s=0.0004, wander=10e-6, wander_period_s=2700.0)
        )
    )
    check: BuildingDevice | None = None  # a second reference
    check_sensitivity: Array = field(default_factory=lambda: np.eye(3))  # as `reference_sensitivity`, of the second
    reference_steps: tuple[
        tuple[Role, float, float], ...
    ] = ()  # (which, time in s, factor of its indication from then)
    lead_s: float = 3.0  # data before and after each window, for guards and filters
    block_s: float = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class BuildingTruth:
    """True values at one time.

    `offset` (3,) is Q at the present temperature, `offset_at_mean` (3,) Q at the mean temperature. `mean_output` (3,) =
    S g + Q is the mean indication.
    """

    sensitivity: Array
    offset: Array
    offset_at_mean: Array
    gravity_mps2: Array
    temperature_degc: float
    mean_output: Array


class Building:
    """One building, determined by `parameters` and `seed`: visits do not depend on the order in which they are asked
    for.

    From visit `harmed_from` on, `harm` disturbs the devices.
    """

    def __init__(self, parameters: BuildingParameters, seed: int, harm: Harm = HARMLESS, harmed_from: int = 0) -> None:
        self.parameters = parameters
        self.seed = seed
        self.harm = harm
        self.harmed_from = harmed_from

    def infos(self) -> dict[str, DeviceInfo]:
        """The devices by name, in the order in which they are opened."""
        return {
            role: DeviceInfo(
                "serial-csv", "virtual", f"building-{role}", "m/s2", 3, instrument.clock.nominal_rate_hz,
                filters=instrument.filters,
            )
            for role, instrument in self._instruments().items()
        }  # fmt: skip

    def _instruments(self) -> dict[Role, BuildingDevice]:
        p = self.parameters
        devices: dict[Role, BuildingDevice | None] = {"sensor": p.sensor, "reference": p.reference, "check": p.check}
        return {role: instrument for role, instrument in devices.items() if instrument is not None}

    def span(self, visit: int) -> tuple[float, float]:
        """Start and end of the data of a visit, s."""
        p = self.parameters
        if not p.every_s:
            return visit * p.window_s, (visit + 1) * p.window_s
        start_s = visit * p.every_s
        return start_s, start_s + p.lead_s + p.window_s + p.lead_s

    def truth(self, time_s: float) -> BuildingTruth:
        """True values at `time_s`."""
        p = self.parameters
        days = time_s / DAY_S
        stepped = sum((change for since_s, change in p.steps if time_s >= since_s), np.zeros((3, 3)))
        sensitivity = p.sensitivity + days * p.sensitivity_a_day + stepped
        at_mean = p.offset + days * p.offset_a_day
        degc = p.weather.at(time_s)
        offset = at_mean + (degc - p.weather.mean_degc) * p.offset_per_k
        gravity = _turned(p.tilt_rad_a_day * days) @ p.gravity_mps2
        return BuildingTruth(sensitivity, offset, at_mean, gravity, degc, sensitivity @ gravity + offset)

    def size(self, frequency_hz: float) -> float:
        """The response of the harmed sensor over that of the reference at a frequency, by which it multiplies S."""
        p = self.parameters
        return self.harm.size(frequency_hz) * p.sensor.size(frequency_hz) / p.reference.size(frequency_hz)

    def level_mps2(self, visit: int) -> float:
        """Level of the motion in a visit, rms."""
        low, high = np.log(self.parameters.level_mps2)
        return float(np.exp(generator(self.seed, NoiseStream.BUILDING_MOTION, visit).uniform(low, high)))

    def visit(self, visit: int) -> list[SampleBlock]:
        """All blocks of a visit, of all devices, in order of arrival."""
        harm = self.harm if visit >= self.harmed_from else HARMLESS
        elsewhere = self._motion(visit, NoiseStream.BUILDING_HARM)
        motions: dict[Response | None, BuildingMotion] = {}
        blocks: list[SampleBlock] = []
        for role, instrument in self._instruments().items():
            if instrument.response not in motions:
                motions[instrument.response] = self._motion(visit, NoiseStream.BUILDING_MOTION, instrument.response)
            blocks += self._device(role, visit, harm, motions[instrument.response], elsewhere)
        return sorted(blocks, key=lambda block: block.t_monotonic_ns)

    def _motion(self, visit: int, stream: NoiseStream, response: Response | None = None) -> BuildingMotion:
        p = self.parameters
        random = generator(self.seed, stream, visit)
        level = float(np.exp(random.uniform(*np.log(p.level_mps2))))
        shape: Array | ComplexArray = np.eye(3) if p.all_axes else np.array([[0.0, 1.0, 0.0]])
        if random.random() < p.elsewhere:
            direction = random.standard_normal(3)
            shape = direction[None] / np.linalg.norm(direction)
        if any(p.across):
            shape = np.array([[p.across[0], 1.0, p.across[1]]])
        return BuildingMotion(random, p.band, self.span(visit), level, shape, response=response)

    def _device(
        self, role: Role, visit: int, harm: Harm, motion: BuildingMotion, elsewhere: BuildingMotion
    ) -> list[SampleBlock]:
        p = self.parameters
        instrument = self._instruments()[role]
        start_s, stop_s = self.span(visit)
        begun, done = instrument.bursts(start_s), instrument.bursts(stop_s)
        first = begun * instrument.burst
        taken_s = instrument.clock.times(first, (done - begun) * instrument.burst)
        due = first + instrument.burst * np.arange(1, done - begun + 1)
        reads_s = self._arrivals(role, visit, taken_s[instrument.burst - 1 :: instrument.burst])
        time_s = taken_s - (p.lag_s if role == "sensor" else 0.0)
        random = generator(self.seed, STREAMS[role][0], visit)
        noise = instrument.noise_mps2 * random.standard_normal((len(time_s), 3))
        seen = Visit(role, time_s, self.level_mps2(visit), elsewhere, random, first=visit == self.harmed_from)
        moved = harm.moved(seen, motion.at(time_s))
        values = harm.shown(seen, self._shown(role, (start_s + stop_s) / 2, moved) + noise)
        blocks, begin, oldest = [], 0, first
        for end in (np.flatnonzero(np.diff(reads_s // p.block_s, append=np.inf)) + 1).tolist():
            newest = int(due[end - 1])
            part = values[oldest - first : newest - first]
            blocks.append(self._block(role, oldest, part, reads_s[begin:end], due[begin:end]))
            begin, oldest = end, newest
        if visit and p.every_s:
            blocks[0] = replace(blocks[0], flags=BlockFlags.GAP)
        return harm.arrived(seen, blocks)

    def _arrivals(self, role: Role, visit: int, newest_s: Array) -> Array:
        """Arrival times (B,) of bursts with these newest samples (B,); they never decrease."""
        late = self._instruments()[role].late
        random, n = generator(self.seed, STREAMS[role][1], visit), len(newest_s)
        by = late.least_late_s + random.exponential(late.mean_late_s, n)
        by += (random.random(n) < late.stall_probability) * random.uniform(0.3, 1.0, n) * late.longest_stall_s
        return np.maximum.accumulate(newest_s + by)

    def _shown(self, role: Role, time_s: float, moved: Array) -> Array:
        """Indications (n, 3) without noise: V = S (R a_ref + g) + Q for the sensor, S_ref a_ref for the reference."""
        p = self.parameters
        if role != "sensor":
            sensitivity = p.reference_sensitivity if role == "reference" else p.check_sensitivity
            factors = [factor for which, since_s, factor in p.reference_steps if which == role and time_s >= since_s]
            return moved @ sensitivity.T * float(np.prod(factors))
        truth = self.truth(time_s)
        return moved @ (truth.sensitivity @ p.rotation).T + truth.mean_output

    def _block(self, role: Role, first: int, values: Array, reads_s: Array, due: NDArray[np.int64]) -> SampleBlock:
        p = self.parameters
        arrivals_ns = np.round(reads_s * 1e9).astype(np.int64)
        degc = round(p.weather.at(float(reads_s[-1])) / TEMPERATURE_STEP_K) * TEMPERATURE_STEP_K
        clock = self._instruments()[role].clock
        return SampleBlock(
            role, "boot", EPOCH_NS + int(arrivals_ns[-1]), first, clock.nominal_rate_hz, arrivals_ns,
            (due - first).astype(np.int32), np.ascontiguousarray(values),
            temperature_degc=degc if role == "sensor" else None,
        )  # fmt: skip


def _turned(vector_rad: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector."""
    angle = float(np.linalg.norm(vector_rad))
    return rotation(vector_rad / angle, angle) if angle else np.eye(3)
