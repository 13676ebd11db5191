"""A simulated bridge for `benchmarks.site_watch`: powers in third octaves for each hour, from modes in three
directions.

The model knows modes, loads and sensors; it knows nothing of levels, shapes and norms, the words of the estimator.
In an hour the co-spectra of a sensor in a band are

    M = sum over modes m, n of phi_m phi_n^T Q_mn + noise

Q is the realised spectral matrix of the modal accelerations in this hour and band: its mean is an integral of load
times the response of an oscillator, with frequencies that move with the temperature; it scatters as the estimate
from an hour does (complex Wishart, 2 B T degrees of freedom). So modes beat in each sensor otherwise, and a band
with two modes has shapes that depend on the loads. Wind has a level for each hour, day and season; traffic has rush
hours and weekends.

Frequencies fall with the temperature of the structure, which follows that of the air within half a day, and rise more
where it freezes. The mass of the traffic lowers them, and something that nobody measures moves each by 0.1 % within
three days. The peak frequency of a window is that of the squared spectrum of all modes in it, and of what an
uncertain floor leaves of the noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.sparse import csr_array

from calib.model import Array
from calib.signal.spectra import LEAST_RATIO, THIRD_OCTAVE
from calib.site_watch.day import Hours

BANDS_HZ = 10.0 ** (np.arange(0, 14) / 10.0)  # 1 Hz to 20 Hz
FREQUENCY_HZ = np.array([1.12, 1.66, 2.45, 3.3, 4.3, 5.7, 7.3, 9.2, 11.8, 15.2])
# The direction of each mode (x along the bridge, y across, z vertical), and how many half waves it has.
DIRECTION = ["z", "y", "t", "y", "z", "t", "y", "z", "x", "z"]
HALF_WAVES = np.array([1, 1, 1, 2, 2, 2, 3, 3, 1, 4])
DAMPING = np.array([0.008, 0.01, 0.012, 0.01, 0.01, 0.012, 0.012, 0.012, 0.015, 0.015])
TEMPERATURE_DEGC = 10.0
SPAN_K = 20.0  # half of the range of a year
PER_DAY = 24
ACTING = 5  # modes that move a band
UNSEEN_H, LAG_H = 72.0, 12.0  # time constants: of what moves frequencies unseen, and of the structure's temperature
FREEZING = 3.0  # times as much as above do frequencies move below 0 °C
U_TOLD_NOISE = 0.05
GRID = 1.0 / 115.0  # third octaves, from point to point of a spectrum: 0.2 %
EXCITATIONS = "lane", "diversion", "speed", "works", "factory", "pumps"
LINE_HZ = 0.012  # half the width of a line of a minute under Hann's window


@dataclass(frozen=True)
class World:
    """What is stated of the world.

    `scatter` of the log amplitude of a sensor in an hour, all bands together, correlated over `scatter_h`;
    `shape_per_k`: how far shapes move; `noise`: of the power of the weakest third of the bands. `frequency_moves`: by
    temperature within a year; `frequency_scatter` of each mode, correlated over UNSEEN_H; `traffic_mass`: by how much
    the traffic of a rush hour lowers frequencies.
    """

    scatter: float = 0.0032
    scatter_h: float = 6.0
    shape_per_k: float = 2e-4
    noise: float = 0.1
    frequency_moves: float = 0.02
    frequency_scatter: float = 0.001
    traffic_mass: float = 0.001


@dataclass
class Damage:
    """From `day` on: `frequency` moves mode `mode`, `shape` changes the modes `modes` at the sensors, by these
    parts."""

    day: int
    frequency: float = 0.0
    mode: int = 1
    shape: float = 0.0
    modes: tuple[int, ...] = ()
    sensors: tuple[int, ...] = ()


@dataclass
class Excitation:
    """From `day` on the structure is excited otherwise; itself it has not changed.

    `traffic` (10,): the load that the traffic puts on each mode, over what it was. `rhythm` (24,): what is added to the
    log amplitude of the traffic in each hour of a day. `source` (10,): load that a source at one place puts on each
    mode in the hours in which it runs, over that of the traffic at level one. `near` (sensors, bands, 3): root of the
    power of the motion around the source that no mode has. `runs` (7, 24): in which hours of the week the source runs.
    """

    day: int
    traffic: Array
    rhythm: Array
    source: Array
    near: Array
    runs: NDArray[np.bool_]

    def at(self, day: int) -> NDArray[np.bool_]:
        """In which hours of a day the source runs, (24,)."""
        return np.asarray(self.runs[day % 7] & (day >= self.day))


@dataclass
class Bridge:
    """A site with its sensors. `days(n)` gives n days of hours; each call goes on."""

    seed: int
    sensors: int
    gateways: int
    world: World = field(default_factory=World)
    damage: Damage | None = None
    excitation: Excitation | None = None

    def __post_init__(self) -> None:
        self.random = random = np.random.default_rng(self.seed)
        n, m = self.sensors, len(FREQUENCY_HZ)
        self.gateway: NDArray[Any] = np.arange(n) * self.gateways // n
        self.clock_h = random.uniform(-1.0, 1.0, self.gateways) * (2.0 / 60.0)
        self.place = place = (np.arange(n) + random.uniform(0.2, 0.8, n)) / n * 0.94 + 0.03
        side = np.where(np.arange(n) % 2, 1.0, -1.0)
        self.shape = self._shapes(place, side)
        # Shapes move with the temperature smoothly along the bridge, for each mode and direction otherwise.
        wave = [np.cos(np.pi * k * place) for k in range(5)]
        self.slope, self.curvature = (
            np.einsum("kn,kam->nam", wave, random.normal(size=(5, 3, m)) / np.sqrt(3.0)) for _ in range(2)
        )
        self.moves = random.uniform(0.5, 1.0, m) * self.world.frequency_moves / 2.0
        self.wind = 10.0 ** random.uniform(-0.3, 0.3, m) * (FREQUENCY_HZ / 2.0) ** -1.0
        self.traffic = 10.0 ** random.uniform(-0.3, 0.3, m) * (FREQUENCY_HZ / 5.0) ** 0.5
        self.hour = 0
        self.slow = np.zeros(4)  # weather: temperature, wind, traffic of a day, wind of an hour
        self._table()
        self._noise()
        self.state = random.normal(size=(n, len(BANDS_HZ), 3))
        self.own = np.random.default_rng([self.seed, 1])  # of the frequencies alone
        self.unseen, self.warmth = self.own.normal(size=m), TEMPERATURE_DEGC

    def _shapes(self, place: Array, side: Array) -> Array:
        """(sensors, 3, modes): bending has a small part in the other directions, torsion moves y and z."""
        shapes = np.empty((len(place), 3, len(FREQUENCY_HZ)))
        for k, (direction, waves) in enumerate(zip(DIRECTION, HALF_WAVES, strict=True)):
            bend, turn = np.sin(np.pi * waves * place), np.cos(np.pi * waves * place)
            small = self.random.uniform(0.05, 0.2, 3)
            parts = {
                "x": (turn, small[1] * bend, small[2] * bend),
                "y": (small[0] * turn, bend, small[2] * side * bend),
                "z": (small[0] * turn, small[1] * bend, bend),
                "t": (small[0] * turn, 0.5 * bend, side * bend),
            }
            shapes[:, :, k] = np.stack(parts[direction], axis=1)
        return shapes

    def _table(self) -> None:
        """Log of each mode's acceleration power in each band for load one, over relative moves of its frequency."""
        self.at = np.linspace(-0.08, 0.08, 65)
        edge = np.append(BANDS_HZ, BANDS_HZ[-1] * 10**0.1) * 10**-0.05
        self.log_power = np.empty((len(FREQUENCY_HZ), len(BANDS_HZ), len(self.at)))
        for b in range(len(BANDS_HZ)):
            f = np.linspace(edge[b], edge[b + 1], 400)[:, None]
            for m, (f0, zeta) in enumerate(zip(FREQUENCY_HZ, DAMPING, strict=True)):
                own = f0 * (1.0 + self.at)[None, :]
                response = f**4 / ((own**2 - f**2) ** 2 + (2.0 * zeta * own * f) ** 2)
                self.log_power[m, b] = np.log(np.trapezoid(response, f, axis=0))
        self.width_hz = np.diff(edge)
        # Frequencies of the spectra in which peaks are sought; of each window its weight, and that times its place.
        self.grid_hz = BANDS_HZ[0] * 10.0 ** (0.1 * np.arange(-1.0, len(BANDS_HZ), GRID))
        place = 10.0 * np.log10(self.grid_hz[:, None] / BANDS_HZ)
        weight = np.maximum(1.0 - np.abs(place), 0.0) * (GRID * self.grid_hz * THIRD_OCTAVE)[:, None]
        self.windows = csr_array(np.hstack([weight, weight * place]).T)
        self.pairs = np.triu_indices(len(FREQUENCY_HZ))
        self.strongest = np.argsort(-self.log_power[:, :, 32], axis=0)[:ACTING].T

    def _noise(self) -> None:
        """Noise of all sensors: a part of the power that the weakest third of (sensor, band, axis) has at level one."""
        q = np.exp(self.log_power[:, :, 32]) * (self.wind + self.traffic)[:, None]
        power = np.einsum("nam,mb->nba", self.shape**2, q)
        ratio = power / self.width_hz[:, None]
        self.noise = self.world.noise * np.quantile(ratio, 1.0 / 3.0) * self.random.uniform(0.7, 1.4, (self.sensors, 3))

    def days(self, count: int) -> Iterator[Hours]:
        """Day after day, from where the last call ended."""
        for _ in range(count):
            yield self._day()

    def _weather(self) -> tuple[Array, Array, Array]:
        """Temperature, and log levels of the amplitude of wind and traffic, at the 25 hours of a day."""
        day, random = self.hour // PER_DAY, self.random
        season = np.cos(2.0 * np.pi * (day - 20.0) / 365.25)
        decay = np.array([0.8, 0.6, 0.3])
        self.slow[:3] = decay * self.slow[:3] + np.sqrt(1.0 - decay**2) * random.normal(size=3)
        h = np.arange(PER_DAY + 1.0)
        gust = np.empty(PER_DAY + 1)
        for k in range(PER_DAY + 1):
            gust[k] = self.slow[3] = 0.85 * self.slow[3] + 0.527 * random.normal()
        self.slow[3] = gust[PER_DAY - 1]
        degc = TEMPERATURE_DEGC - 13.0 * season + 4.0 * self.slow[0] + 4.0 * np.cos(2.0 * np.pi * (h - 15.0) / 24.0)
        level = 0.5 * np.log(5.0) * season  # five times between the seasons
        wind = level + 0.35 * self.slow[1] + 0.25 * gust
        rush = np.exp(-0.5 * ((h - 8.0) / 1.5) ** 2) + np.exp(-0.5 * ((h - 17.0) / 2.0) ** 2)
        week = -0.3 if day % 7 >= 5 else 0.0
        traffic = level + week + 0.1 * self.slow[2] + 0.8 * rush - 0.6 * (np.cos(2.0 * np.pi * (h - 2.0) / 24.0) > 0.6)
        return degc, wind, traffic

    def _day(self) -> Hours:
        n, bands, random = self.sensors, len(BANDS_HZ), self.random
        day = self.hour // PER_DAY
        degc, wind, traffic = self._weather()
        power = np.empty((PER_DAY, n, bands, 3), dtype=np.float32)
        cross = np.empty_like(power)
        away = (degc[:PER_DAY] - TEMPERATURE_DEGC) / SPAN_K
        shapes = self._moved_shapes(float(away.mean()), day)
        load, moved = self._loads(wind, traffic, day), self._moved(degc, traffic, day)
        root = self._modal_root(load, moved)  # (24, gateways, bands, modes)
        scatter = self._scatter()
        for b, modes in enumerate(self.strongest):
            # (24, n, 3, modes) of the realised motion: each mode's part, mixed by the scatter of an hour's spectra
            part = shapes[None, :, :, modes] * root[:, self.gateway, b][:, :, None, modes]
            mixed = np.matmul(part.reshape(PER_DAY, 3 * n, -1), self._realised(b, modes)).reshape(part.shape)
            factor = np.exp(scatter[:, :, b])
            for k, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
                into = power if k < 3 else cross
                into[:, :, b, k % 3] = (mixed[:, :, i] * part[:, :, j]).sum(axis=-1) * factor[..., i] * factor[..., j]
        if self.excitation is not None:
            near, runs = self.excitation.near, self.excitation.at(day)[:, None, None, None]
            power += runs * np.square(near)
            cross += runs * near[..., [0, 0, 1]] * near[..., [1, 2, 2]]
        freedom = self.width_hz[:, None] * 3600.0
        floor = (self.noise[None, :, None, :] * self.width_hz[:, None]).astype(np.float32)
        between = np.sqrt(power[..., [0, 0, 1]] * floor[..., [1, 2, 2]] / (2.0 * freedom))
        cross += between * random.standard_normal(cross.shape, dtype=np.float32)
        relative = np.sqrt((floor**2 + 2.0 * power * floor) / freedom)
        power += floor + relative * random.standard_normal(power.shape, dtype=np.float32)
        told = self.noise[None] * np.exp(U_TOLD_NOISE * random.standard_normal((PER_DAY, n, 3)))
        hours = self.hour + np.arange(PER_DAY)
        self.hour += PER_DAY
        inside = degc[:PER_DAY, None] + 0.3 * random.standard_normal((PER_DAY, n))
        frequency = self._frequency(shapes, load, moved, told - self.noise)
        return Hours(hours, power, cross, told, inside, None, frequency)  # type: ignore[arg-type] # whole numbers, and half the memory

    def _realised(self, b: int, modes: Array) -> Array:
        """(24, modes, modes): the estimate of an identity from an hour; real part of a complex Wishart matrix."""
        # A mode fills a part of its band: about pi zeta f.
        wide = np.minimum(self.width_hz[b], np.pi * DAMPING[modes] * FREQUENCY_HZ[modes])
        freedom = np.sqrt(wide[:, None] * wide) * 3600.0
        raw = self.random.standard_normal((PER_DAY, len(modes), len(modes)))
        symmetric = (raw + raw.transpose(0, 2, 1)) / np.sqrt(2.0)  # variance 1 off the diagonal, 2 on it
        return np.eye(len(modes)) + symmetric / np.sqrt(2.0 * freedom)

    def _loads(self, wind: Array, traffic: Array, day: int) -> Array:
        """(24, gateways, modes), as the clock of each gateway cuts the hours."""
        at = np.arange(PER_DAY)[:, None] + 0.5 + self.clock_h
        hours = np.arange(PER_DAY + 1.0)
        by_traffic, by_source = self.traffic, np.zeros((PER_DAY, 1, 1))
        if self.excitation is not None and day >= self.excitation.day:
            traffic = traffic + np.append(self.excitation.rhythm, self.excitation.rhythm[:1])
            by_traffic = self.traffic * self.excitation.traffic
            by_source = self.excitation.at(day)[:, None, None] * self.traffic * self.excitation.source
        return np.asarray(self.wind * np.exp(2.0 * np.interp(at, hours, wind))[..., None]
                          + by_traffic * np.exp(2.0 * np.interp(at, hours, traffic))[..., None]
                          + by_source)  # fmt: skip

    def _moved(self, degc: Array, traffic: Array, day: int) -> Array:
        """(24, modes): by how much each frequency is higher in each hour than at TEMPERATURE_DEGC."""
        keep, still = np.exp(-1.0 / UNSEEN_H), np.exp(-1.0 / LAG_H)
        moved = np.empty((PER_DAY, len(FREQUENCY_HZ)))
        for h in range(PER_DAY):
            self.warmth = still * self.warmth + (1.0 - still) * float(degc[h])
            self.unseen = keep * self.unseen + np.sqrt(1.0 - keep**2) * self.own.normal(size=moved.shape[1])
            frozen = (FREEZING - 1.0) * max(-self.warmth, 0.0)
            moved[h] = -self.moves * (self.warmth - TEMPERATURE_DEGC - frozen) / SPAN_K
            moved[h] += self.world.frequency_scatter * self.unseen - self.world.traffic_mass * np.exp(traffic[h] - 0.8)
        if self.damage is not None and day >= self.damage.day:
            moved[:, self.damage.mode] -= self.damage.frequency
        return moved

    def _at(self, table: Array, moved: Array) -> Array:
        """A table (modes, bands, at) in each hour: (24, modes, bands)."""
        place = np.clip((moved - self.at[0]) / (self.at[1] - self.at[0]), 0.0, len(self.at) - 1.001)
        low = np.floor(place).astype(int)
        part = (place - low)[..., None]
        k = np.arange(moved.shape[1])
        return np.asarray((1.0 - part) * table[k, :, low] + part * table[k, :, low + 1])

    def _modal_root(self, load: Array, moved: Array) -> Array:
        """Root of each mode's acceleration power in each band: (24, gateways, bands, modes)."""
        root = np.sqrt(load)[..., None] * np.exp(0.5 * self._at(self.log_power, moved))[:, None]
        return np.asarray(root.transpose(0, 1, 3, 2))

    def _frequency(self, shapes: Array, load: Array, moved: Array, floor_error: Array) -> Array:
        """Peak frequency of each window (24, n, bands, 3), as the log of it over the centre; NaN where the noise is too
        strong. All sensors see the same hour of a mode, so what its frequency scatters by is common to them."""
        n, bands, random = self.sensors, len(BANDS_HZ), self.own
        found = np.full((PER_DAY, n, 3, bands), np.nan)
        wide = np.hypot(DAMPING, LINE_HZ / FREQUENCY_HZ)  # as segments of a minute show it
        by_chance = np.sqrt(5.0 * DAMPING / (4.0 * np.pi * FREQUENCY_HZ * 3600.0))
        square, (one, other) = np.square(self.grid_hz), self.pairs
        for h in range(PER_DAY):
            own = (FREQUENCY_HZ * (1.0 + moved[h] + by_chance * random.standard_normal(len(wide))))[:, None]
            response = square**2 / ((own**2 - square) ** 2 + np.square(2.0 * wide[:, None] * own * self.grid_hz))
            power = (shapes**2 * load[h, self.gateway, None]).reshape(3 * n, -1)  # of the modes
            first = (power @ (self.windows @ response.T).T).reshape(n, 3, 2, bands)
            if len(power) < len(one):
                squared = self.windows @ np.square(power @ response).T
            else:  # the square of a sum of modes, by the integrals of each pair of them
                both = power[:, one] * power[:, other] * np.where(one == other, 1.0, 2.0)
                squared = self.windows @ (response[one] * response[other]).T @ both.T
            squared = squared.T.reshape(n, 3, 2, bands)
            noise = self.noise[..., None]
            scatter = np.square(noise) * np.sqrt(5.0 * self.width_hz / 3600.0)
            left = squared - 2.0 * floor_error[h, :, :, None, None] * first
            left = left + scatter[:, :, None] * np.array([[1.0], [0.4]]) * random.standard_normal(left.shape)
            counts = left[:, :, 0] > LEAST_RATIO * 2.0 * noise * first[:, :, 0]
            found[h] = THIRD_OCTAVE * np.where(counts, left[:, :, 1] / np.where(counts, left[:, :, 0], 1.0), np.nan)
        return found.transpose(0, 1, 3, 2)

    def _moved_shapes(self, away: float, day: int) -> Array:
        size = self.world.shape_per_k * SPAN_K
        shapes = self.shape * (1.0 + size * (self.slope * away + self.curvature * away**2))
        if self.damage is not None and day >= self.damage.day and self.damage.shape:
            signs = np.where(np.arange(len(self.damage.modes)) % 2, -1.0, 1.0)
            for i in self.damage.sensors:
                shapes[i][:, list(self.damage.modes)] *= 1.0 + self.damage.shape * signs
        return shapes

    def _scatter(self) -> Array:
        """(24, sensors, bands, 3): AR(1) for each, so large that all bands of an axis together have the stated one."""
        keep = np.exp(-1.0 / self.world.scatter_h)
        raw = self.random.standard_normal((PER_DAY, *self.state.shape), dtype=np.float32) * np.float32(
            np.sqrt(1.0 - keep**2)
        )
        out, _ = lfilter([1.0], [1.0, -keep], raw, axis=0, zi=keep * self.state[None])
        self.state = out[-1]
        return self.world.scatter * np.sqrt(len(BANDS_HZ)) * np.asarray(out)


def otherwise(bridge: Bridge, kind: str, day: int, random: np.random.Generator) -> Excitation:
    """A change of the excitation from `day` on, of one of the kinds EXCITATIONS.

    Of a lane that is closed the traffic turns the bridge more, or less; of a diversion there is less traffic, or more,
    and heavier vehicles; another speed moves its spectrum. Works, a factory and pumps are sources at one place: modes
    that move there are excited, and the motion around it decays along the bridge. Works run by day and on five days,
    a factory at night, pumps always and in a few bands.
    """
    modes, bands = len(FREQUENCY_HZ), len(BANDS_HZ)
    traffic = 10.0 ** random.normal(0.0, 0.05, modes)
    rhythm, source = np.zeros(PER_DAY), np.zeros(modes)
    near, runs = np.zeros((bridge.sensors, bands, 3)), np.zeros((7, PER_DAY), dtype=bool)
    if kind == "lane":
        parts = {"t": random.uniform(0.25, 4.0), "y": random.uniform(0.5, 2.0), "z": random.uniform(0.7, 1.4), "x": 1.0}
        traffic *= [parts[direction] for direction in DIRECTION]
    elif kind == "diversion":
        traffic *= random.choice([0.1, 0.3, 0.5, 2.0, 3.0]) * (FREQUENCY_HZ / 4.0) ** random.uniform(-0.3, 0.3)
        rhythm = random.uniform(-0.4, 0.4) * np.cos(2.0 * np.pi * (np.arange(PER_DAY) - 12.0) / 24.0)
    elif kind == "speed":
        traffic *= (FREQUENCY_HZ / 4.0) ** (random.choice([-1.0, 1.0]) * random.uniform(0.4, 1.0))
    else:
        traffic = np.ones(modes)
        place, strength = random.uniform(0.1, 0.9), 10.0 ** random.uniform(-1.0, 0.3)
        spectrum = 10.0 ** random.normal(0.0, 0.3, bands)
        if kind == "pumps":
            spectrum[random.permutation(bands)[random.integers(1, 4) :]] = 0.0
        moves = np.square(np.sin(np.pi * HALF_WAVES * place))
        of = [{"z": 1.0, "t": 0.5, "y": 0.1, "x": 0.05}[direction] for direction in DIRECTION]
        own = np.abs(np.log(FREQUENCY_HZ[:, None] / BANDS_HZ)).argmin(axis=1)  # the band of each mode
        source = strength * moves * of * spectrum[own]
        usual = np.einsum("nam,mb->nba", bridge.shape**2, np.exp(bridge.log_power[:, :, 32]) * bridge.traffic[:, None])
        reach = np.exp(-np.abs(bridge.place - place) / random.uniform(0.03, 0.15))
        push = random.normal(size=3) * [0.3, 0.5, 1.0]
        near = np.sqrt(strength * spectrum * np.median(usual, axis=(0, 2)))[:, None] * reach[:, None, None] * push
        hours = np.arange(PER_DAY)
        by_day, by_night = (hours >= 7) & (hours < 17), (hours >= 22) | (hours < 6)
        runs[:] = {"works": by_day, "factory": by_night, "pumps": hours >= 0}[kind]
        runs[5:] &= kind != "works"
    return Excitation(day, traffic, rhythm, source, near, runs)


def changed(
    hours: Hours, sensor: NDArray[Any], factor: float, axes: tuple[int, ...] = (0, 1, 2), first: int = 0
) -> Hours:
    """The same hours with another sensitivity of these axes of some sensors, from hour `first` of the day on."""
    power, cross, noise = hours.power.copy(), hours.cross.copy(), hours.noise_psd.copy()
    scale = np.ones(3)
    scale[list(axes)] = factor
    for i in np.atleast_1d(sensor):
        power[first:, i] *= scale**2
        cross[first:, i] *= scale[[0, 0, 1]] * scale[[1, 2, 2]]
        noise[first:, i] *= scale**2
    return replace(hours, power=power, cross=cross, noise_psd=noise)


def turned(hours: Hours, sensor: int, axis: int, angle_rad: float) -> Hours:
    """The same hours with one sensor turned about one of its axes; its noise keeps its axes."""
    width = np.diff(np.append(BANDS_HZ, BANDS_HZ[-1] * 10**0.1) * 10**-0.05)
    noise = hours.noise_psd[:, sensor, None, :] * width[:, None]
    j, k = [(1, 2), (2, 0), (0, 1)][axis]
    R = np.eye(3)
    R[j, j] = R[k, k] = np.cos(angle_rad)
    R[j, k], R[k, j] = np.sin(angle_rad), -np.sin(angle_rad)
    power, cross = hours.power.copy(), hours.cross.copy()
    M = np.zeros((*power.shape[:1], power.shape[2], 3, 3))
    M[..., [0, 1, 2], [0, 1, 2]] = power[:, sensor] - noise
    M[..., [0, 0, 1], [1, 2, 2]] = M[..., [1, 2, 2], [0, 0, 1]] = cross[:, sensor]
    M = R @ M @ R.T
    power[:, sensor] = M[..., [0, 1, 2], [0, 1, 2]] + noise
    cross[:, sensor] = M[..., [0, 0, 1], [1, 2, 2]]
    return replace(hours, power=power, cross=cross)
