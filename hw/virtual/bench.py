"""Simulation of the paper's bench with known truth: samples of sensor and reference at any index."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hw.virtual.motion import ComplexArray
from hw.virtual.noise import BLOCK, ColouredNoise, NoiseStream, generator
from hw.virtual.parameters import BenchParameters, ReferenceParameters, SensorParameters
from hw.virtual.response import lowpass
from hw.virtual.scene import Scene
from hw.virtual.schedule import PoseInterval
from hw.virtual.timebase import Bursts, Clock

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """True values that an estimator should find.

    S in output unit per m/s2, Q and the offsets by position in output unit.
    """

    sensitivity: Array  # (3, 3)
    offset: Array  # (3,)
    lag_s: Array  # (3,) lag of the sensor behind the reference, without the delay of a low-pass filter
    rate_hz: float
    reference_rate_hz: float
    reference_sensitivity: float
    gravity_mps2: float
    theta_error_deg: Array  # (positions,) true minus nominal angle
    alpha_error_deg: Array
    offset_by_position: Array  # (positions, 3), added to `offset`


@dataclass(frozen=True, slots=True, eq=False)
class BenchRecording:
    """What a gateway would have recorded, and the truth. Stamps and times in s of the bench's clock."""

    sensor_stamp_s: Array  # (N,) when the gateway received the sample
    sensor_time_s: Array  # (N,) when the sensor took the sample
    v: Array  # (N, 3) indications, output unit
    temperature_degc: Array  # (N,)
    reference_stamp_s: Array  # (M,)
    reference_time_s: Array  # (M,)
    reference: Array  # (M, m) m/s2 or m/s
    poses: list[PoseInterval]
    truth: Truth


class Bench:
    """One bench, determined by `parameters` and `seed`: samples do not depend on the order in which they are asked for.

    Raises ValueError if the parameters contradict each other.
    """

    def __init__(self, parameters: BenchParameters, seed: int) -> None:
        self.parameters = parameters
        self.seed = seed
        sensor, reference = parameters.sensor, parameters.reference
        if reference.channels == 3 and reference.quantity != "acceleration":
            raise ValueError("a tri-axial reference must measure acceleration")
        self._scene = Scene(parameters, seed)
        self._coloured = ColouredNoise(seed, sensor.coloured_phi) if sensor.coloured_noise_mps2 else None
        self._sensor_response = _sensor_response(sensor, parameters.motion.frequency_hz)
        self._reference_response = _highpass(reference.highpass_hz, parameters.motion.frequency_hz)
        # a live twin and its port ask for neighbouring samples many times
        self._sensor_block = lru_cache(maxsize=4)(self._make_sensor_block)
        self._reference_block = lru_cache(maxsize=4)(self._make_reference_block)

    @property
    def truth(self) -> Truth:
        """True values of this bench."""
        p = self.parameters
        sensor, positions = p.sensor, len(p.schedule.stands)
        by_position = sensor.offset_by_position_mps2
        theta_error_deg, alpha_error_deg = p.clamp.of_positions(positions)
        return Truth(
            sensitivity=sensor.sensitivity.copy(),
            offset=sensor.offset.copy(),
            lag_s=np.array(sensor.lag_s) - p.reference.lag_s,
            rate_hz=sensor.clock.rate_hz,
            reference_rate_hz=p.reference.clock.rate_hz,
            reference_sensitivity=p.reference.sensitivity,
            gravity_mps2=p.gravity_mps2,
            theta_error_deg=theta_error_deg,
            alpha_error_deg=alpha_error_deg,
            offset_by_position=np.zeros((positions, 3))
            if by_position is None
            else sensor.nominal_sensitivity * by_position,
        )

    @property
    def poses(self) -> list[PoseInterval]:
        """Nominal positions of the first repetition; the schedule repeats every `parameters.schedule.period_s`."""
        return self.parameters.schedule.poses(self.parameters.schedule.duration_s(1))

    def forget(self) -> None:
        """Compute all samples anew, after the schedule has changed what comes."""
        self._sensor_block.cache_clear()
        self._reference_block.cache_clear()

    def sensor_times(self, first: int, n: int) -> Array:
        """True times (n,) of samples first .. first + n - 1, s."""
        return self.parameters.sensor.clock.times(first, n)

    def sensor_samples_due(self, t_s: float) -> int:
        """Number of samples that the sensor has taken by `t_s`."""
        return int(self.parameters.sensor.clock.due(t_s))

    def sensor_values(self, first: int, n: int) -> Array:
        """Indications (n, 3) in output unit."""
        return _cut(self._sensor_block, first, n)

    def sensor_counts(self, first: int, n: int) -> NDArray[np.int32]:
        """Indications (n, 3) as multiples of the resolution. Raises ValueError for a sensor without a resolution."""
        resolution = self.parameters.sensor.resolution
        if resolution <= 0:
            raise ValueError("this sensor has no counts: its resolution is 0 (not quantised)")
        return np.rint(self.sensor_values(first, n) / resolution).astype(np.int32)

    def reference_times(self, first: int, n: int) -> Array:
        """True times (n,) of the reference's samples first .. first + n - 1, s."""
        return self.parameters.reference.clock.times(first, n)

    def reference_samples_due(self, t_s: float) -> int:
        """Number of samples that the reference has taken by `t_s`."""
        return int(self.parameters.reference.clock.due(t_s))

    def reference_values(self, first: int, n: int) -> Array:
        """Indications (n, m) of the reference, m/s2 or m/s."""
        return _cut(self._reference_block, first, n)

    def recording(self, duration_s: float) -> BenchRecording:
        """Everything that a gateway receives from time 0 to `duration_s`. Poses: those whose hold ends by then."""
        p = self.parameters
        sensor_stamp = self._stamps(p.sensor.clock, p.sensor.bursts, NoiseStream.SENSOR_ARRIVAL, duration_s)
        reference_stamp = self._stamps(p.reference.clock, p.reference.bursts, NoiseStream.REFERENCE_ARRIVAL, duration_s)
        n, m = len(sensor_stamp), len(reference_stamp)
        sensor_time = self.sensor_times(0, n)
        return BenchRecording(
            sensor_stamp_s=sensor_stamp,
            sensor_time_s=sensor_time,
            v=self.sensor_values(0, n),
            temperature_degc=p.temperature.at(sensor_time),
            reference_stamp_s=reference_stamp,
            reference_time_s=self.reference_times(0, m),
            reference=self.reference_values(0, m),
            poses=p.schedule.poses(duration_s),
            truth=self.truth,
        )

    def _stamps(self, clock: Clock, bursts: Bursts | None, stream: NoiseStream, until_s: float) -> Array:
        if bursts is None:
            return clock.times(0, int(clock.due(until_s)))
        return bursts.stamps(clock, bursts.arrivals(self.seed, stream, until_s))

    def _make_sensor_block(self, block: int) -> Array:
        """V = S(T) a(t - lag) + Q(T, position, window) + noise; then quantised and limited to the range."""
        p, sensor = self.parameters, self.parameters.sensor
        t = self.sensor_times(block * BLOCK, BLOCK)
        warmer = p.temperature.at(t)[:, None] - p.temperature.mean_degc
        v = np.empty((BLOCK, 3))
        lag = np.array(sensor.lag_s)
        for delay in np.unique(lag):
            felt = self._scene.felt(t - delay, self._sensor_response, gravity=sensor.highpass_hz is None)
            v[:, lag == delay] = felt @ sensor.sensitivity[lag == delay].T
        v *= 1 + sensor.sensitivity_per_k * warmer
        added = sensor.offset_per_k_mps2 * warmer + self._window_offsets(t)
        if sensor.noise_mps2:
            added += sensor.noise_mps2 * generator(self.seed, NoiseStream.SENSOR, block).normal(size=(BLOCK, 3))
        if self._coloured is not None:
            added += sensor.coloured_noise_mps2 * self._coloured.block(block)
        v += sensor.offset + sensor.nominal_sensitivity * added
        return _quantised(np.clip(v, -sensor.limit, sensor.limit), sensor.resolution)

    def _window_offsets(self, t_s: Array) -> Array:
        """Offset of the mounting (n, 3), m/s2, by position and by window."""
        sensor = self.parameters.sensor
        offset = np.zeros((len(t_s), 3))
        for span in self._scene.spans(t_s):
            if sensor.offset_by_position_mps2 is not None:
                offset[span.part] += sensor.offset_by_position_mps2[self._scene.position_of(span.window)]
            if sensor.offset_by_window_mps2:
                draw = generator(self.seed, NoiseStream.WINDOW_OFFSET, span.window).normal(size=3)
                offset[span.part] += sensor.offset_by_window_mps2 * draw
        return offset

    def _make_reference_block(self, block: int) -> Array:
        reference = self.parameters.reference
        t = self.reference_times(block * BLOCK, BLOCK)
        values = reference.sensitivity * self._reference_input(reference, t - reference.lag_s)
        if reference.noise:
            values += reference.noise * generator(self.seed, NoiseStream.REFERENCE, block).normal(size=values.shape)
        return _quantised(values, reference.resolution)

    def _reference_input(self, reference: ReferenceParameters, t_s: Array) -> Array:
        """Quantity at the reference (n, m): along the slide if uniaxial, all three axes if it is beside the sensor."""
        if reference.rotation is None:
            velocity, acceleration = self._scene.slide(t_s, self._reference_response)
            return (velocity if reference.quantity == "velocity" else acceleration)[:, :1]
        gravity = reference.feels_gravity and reference.highpass_hz is None
        return self._scene.felt(t_s, self._reference_response, gravity=gravity, knocks=False) @ reference.rotation


def _cut(block_of: Callable[[int], Array], first: int, n: int) -> Array:
    """Rows first .. first + n - 1 of the blocks that `block_of` returns, as a copy."""
    last = first + n
    blocks = range(first // BLOCK, max(first, last - 1) // BLOCK + 1)
    return np.concatenate([block_of(b)[max(first - b * BLOCK, 0) : max(last - b * BLOCK, 0)] for b in blocks])


def _quantised(values: Array, resolution: float) -> Array:
    return np.asarray(np.rint(values / resolution) * resolution) if resolution else values


def _highpass(corner_hz: float | None, frequency_hz: Array) -> ComplexArray | None:
    """Response of a first-order high-pass filter at the frequencies of the motion; None without a corner."""
    if corner_hz is None:
        return None
    s = 1j * frequency_hz / corner_hz
    return np.asarray(s / (1 + s), dtype=np.complex128)


def _sensor_response(sensor: SensorParameters, frequency_hz: Array) -> ComplexArray | None:
    """Response of the sensor's filters at the frequencies of the motion; None without a filter.

    The second-order filter is a Butterworth filter.
    """
    highpass = _highpass(sensor.highpass_hz, frequency_hz)
    own = None if sensor.lowpass_hz is None else lowpass(sensor.lowpass_order, sensor.lowpass_hz)
    passed = [of(frequency_hz) for of in (own, sensor.response) if of is not None]
    found = [*([] if highpass is None else [highpass]), *passed]
    return np.asarray(np.prod(found, axis=0)) if found else None
