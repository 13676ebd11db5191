"""A sensor and a tri-axial reference that move together, with any response over frequency between them.

Signals are made line by line of their spectra, so that a response acts exactly, whatever the estimator thinks of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, freqs, freqz, remez

from calib.excitation.front_end import Settings
from calib.geometry import beside
from calib.model import Array
from calib.recorded.poses import PoseInterval
from calib.recorded.table import ReferenceTable, SensorTable
from calib.recorded.tables import Making, Tables
from calib.signal.instrument import Instrument
from calib.signal.known_response import UNKNOWN, KnownResponse

Complex = NDArray[Any]  # complex numbers, of the precision that the function gives
Filter = Callable[[NDArray[Any]], Complex]

OFFSET = np.array([0.1, -0.2, 0.3])
BEYOND_S = 20.0  # at each end, so that no end of the record is an end of the motion


def flat(frequency_hz: NDArray[Any]) -> Complex:
    """Both respond alike."""
    return np.ones(len(frequency_hz), dtype=complex)


def lowpass(order: int, corner_hz: float) -> Filter:
    """A Butterworth filter."""
    b, a = butter(order, 2.0 * np.pi * corner_hz, analog=True)
    return lambda frequency_hz: np.asarray(freqs(b, a, 2.0 * np.pi * frequency_hz)[1])


def moving_mean(length_s: float) -> Filter:
    """The mean over the last `length_s`."""
    return lambda f: np.asarray(np.sinc(f * length_s) * np.exp(-1j * np.pi * f * length_s))


def sinc3(length_s: float) -> Filter:
    """Three moving means one after the other, as in a sigma-delta converter."""
    once = moving_mean(length_s)
    return lambda f: once(f) ** 3


def decimator(corner_hz: float, taps: int = 63) -> Filter:
    """A linear-phase FIR filter at 8 times its corner; its ripple in the pass band is 0.2 %."""
    rate_hz = 8.0 * corner_hz
    weights = remez(taps, [0.0, corner_hz, 1.6 * corner_hz, 0.5 * rate_hz], [1.0, 0.0], weight=[1, 10], fs=rate_hz)
    return lambda f: np.asarray(freqz(weights, worN=2.0 * np.pi * f / rate_hz)[1])


def resonance(frequency_hz: float, quality: float) -> Filter:
    """A mount that resonates."""
    return lambda f: np.asarray(1.0 / (1.0 - (f / frequency_hz) ** 2 + 1j * f / frequency_hz / quality))


def highpass(corner_hz: float, order: int = 1) -> Filter:
    """An AC-coupled instrument; a Butterworth filter."""
    b, a = butter(order, 2.0 * np.pi * corner_hz, "high", analog=True)
    return lambda frequency_hz: np.asarray(freqs(b, a, 2.0 * np.pi * frequency_hz)[1])


def both(one: Filter, other: Filter) -> Filter:
    """One filter after the other."""
    return lambda frequency_hz: one(frequency_hz) * other(frequency_hz)


Disturbance = Callable[[np.random.Generator, Array, float], tuple[Array, Array]]
NOTHING = np.zeros((1, 3))


def undisturbed(*_: object) -> tuple[Array, Array]:
    """Nothing is added."""
    return NOTHING, NOTHING


def hum(frequency_hz: float, amplitude_mps2: float) -> Disturbance:
    """A tone in the sensor alone, as from the mains."""

    def added(random: np.random.Generator, u: Array, rate_hz: float) -> tuple[Array, Array]:
        tone = np.sin(2.0 * np.pi * (frequency_hz * np.arange(len(u)) / rate_hz + random.uniform()))
        return amplitude_mps2 * tone[:, None] * np.array([1.0, 0.5, -0.7]), NOTHING

    return added


def rattle(frequency_hz: float, amplitude_mps2: float) -> Disturbance:
    """A loose part that hits when the motion along x exceeds 1.5 m/s2, and rings in the sensor alone."""

    def added(random: np.random.Generator, u: Array, rate_hz: float) -> tuple[Array, Array]:
        beyond = np.abs(u[:, 0]) > 1.5
        hits = (
            random.normal(1.0, 0.3, len(u))
            * random.choice([-1.0, 1.0], len(u))
            * np.diff(beyond, prepend=False)
            * beyond
        )
        cycles = np.arange(int(6.0 * rate_hz / frequency_hz)) * frequency_hz / rate_hz
        rings = np.convolve(hits, np.exp(-cycles / 1.5) * np.sin(2.0 * np.pi * cycles))[: len(u)]
        return amplitude_mps2 * rings[:, None] * np.array([1.0, 0.4, -0.6]), NOTHING

    return added


def noise(density: Callable[[NDArray[Any]], NDArray[Any]], *, of_reference: bool = False) -> Disturbance:
    """Noise whose amplitude density at frequencies in Hz is `density`, in m/s2 per root Hz."""

    def added(random: np.random.Generator, u: Array, rate_hz: float) -> tuple[Array, Array]:
        frequency_hz = np.fft.rfftfreq(len(u), 1.0 / rate_hz)
        frequency_hz[0] = frequency_hz[1]
        size = density(frequency_hz) * np.sqrt(0.25 * len(u) * rate_hz)
        lines = random.normal(size=(3, len(size))) + 1j * random.normal(size=(3, len(size)))
        made = np.fft.irfft(lines * size, len(u)).T
        return (NOTHING, made) if of_reference else (made, NOTHING)

    return added


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """The files of both, S at the reference frequency, and that frequency in Hz."""

    files: Tables
    sensitivity: Array
    reference_frequency_hz: float


def pair(
    seed: int,
    response: Filter,
    *,
    of_outputs: Filter = flat,
    of_reference: Filter = flat,
    band_hz: tuple[float, float] = (0.5, 10.0),
    rate_hz: float = 100.0,
    seconds: float = 120.0,
    level_mps2: float = 1.0,
    noise_mps2: float = 0.01,
    reference_noise_mps2: float = 0.0,
    reference_error: float = 0.0,
    known: KnownResponse = UNKNOWN,
    disturbed: Disturbance = undisturbed,
    reference_late_s: float = 0.0,
    stated_noise_mps2: float = 0.0,
    skirts: int = 0,
) -> Pair:
    """Random motion in `band_hz`, the same power at all its frequencies; `reference_error` is relative.

    The sensor's input axes show the motion through `response`, its outputs through `of_outputs`, and the reference
    through `of_reference`, each alike in all axes (F,) or by axis (3, F).
    `known`: what is stated of the filters, whatever they are. `disturbed`: what is added to both signals. The samples
    of the reference are taken `reference_late_s` after those of the sensor. `stated_noise_mps2`: what is stated of its
    noise. `skirts`: the order of the Butterworth filters at both ends of `band_hz` that shape the motion; 0 lets it end
    there.
    """
    random = np.random.default_rng(seed)
    n = int((seconds + 2.0 * BEYOND_S) * rate_hz)
    frequency_hz = np.fft.rfftfreq(n, 1.0 / rate_hz)
    frequency_hz[0] = 1e-9
    moved = np.asarray((frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1]), dtype=float)
    if skirts:
        moved = np.abs(highpass(band_hz[0], skirts)(frequency_hz) * lowpass(skirts, band_hz[1])(frequency_hz))
    lines = (random.normal(size=(3, len(moved))) + 1j * random.normal(size=(3, len(moved)))) * moved
    lines *= level_mps2 / np.fft.irfft(lines, n).std()
    middle_hz = float(np.sqrt(band_hz[0] * band_hz[1]))
    at_middle, outputs_at_middle, reference_at_middle = (
        np.abs(own(np.array([middle_hz]))) for own in (response, of_outputs, of_reference)
    )
    sensitivity = np.eye(3) + 0.02 * random.normal(size=(3, 3))
    inside = slice(int(BEYOND_S * rate_hz), int((BEYOND_S + seconds) * rate_hz))
    shown = lines * of_reference(frequency_hz) / reference_at_middle
    u = np.fft.irfft(shown * np.exp(2j * np.pi * frequency_hz * reference_late_s), n).T[inside]
    felt = sensitivity @ (lines * response(frequency_hz) / at_middle)
    V = np.fft.irfft(felt * of_outputs(frequency_hz) / outputs_at_middle, n).T[inside] + OFFSET
    V += noise_mps2 * random.normal(size=V.shape)
    u = u * (1.0 + reference_error) + reference_noise_mps2 * random.normal(size=u.shape)
    to_sensor, to_reference = disturbed(random, u, rate_hz)
    V, u = V + to_sensor, u + to_reference
    time_s = np.arange(len(u)) / rate_hz
    pose = beside(np.eye(3))
    files = Tables(
        SensorTable("sensor.csv", time_s, V),
        ReferenceTable("reference.csv", time_s + reference_late_s, u, "acceleration", "ax_mps2"),
        [PoseInterval(0.0, float(time_s[-1]), pose)],
        Instrument(noise=stated_noise_mps2, known=known),
        Making(Settings(bands=True)),
    )
    return Pair(files, sensitivity, middle_hz)
