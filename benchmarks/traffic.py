"""Windows beside traffic: is a firm sensor taken, and is one that slips or rattles refused as often as without?

    python -m benchmarks.traffic [--seeds N]

Each window has 60 s of sustained motion of 0.5 to 12 Hz with 0.02 to 0.1 m/s2 rms along each axis, at 200 Hz; with
traffic there are ten shocks a minute besides, each of 0.6 s and 0.1 m/s2 rms, of 15 to 50 Hz. The sensor has a low-pass
filter of 35 Hz, which is not known yet. What slips feels no more than `above` times the level of the sustained motion;
what rattles adds a noise of `share` of the level, 20 to 60 Hz, wherever the motion is above 1.5 times the level.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from calib.excitation.front_end import windows_of
from calib.geometry import beside
from calib.model import Array, Window
from calib.signal.instrument import Instrument
from calib.signal.samples import Samples
from calib.signal.stamps import clock_from_stamps

RATE_HZ, WINDOW_S, MARGIN_S = 200.0, 60.0, 3.0
SUSTAINED_HZ, SHOCK_HZ, CORNER_HZ = (0.5, 12.0), (15.0, 50.0), 35.0
LEVEL_MPS2 = (0.02, 0.1)
SHOCKS_A_MINUTE, SHOCK_MPS2, SHOCK_S = 10, 0.1, 0.3  # the last is the SD of the envelope
SENSOR_NOISE_MPS2, REFERENCE_NOISE_MPS2 = 5e-3, 1e-3
S_TRUE = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
SEEDS = 40

Fault = Callable[[np.random.Generator, Array, float], Array]


def sound(*drawn: Any) -> Array:
    """The mount is firm: what moves is felt."""
    return np.asarray(drawn[1])


def slips(above: float, _: np.random.Generator, felt: Array, level_mps2: float) -> Array:
    """Friction alone holds the sensor: it feels no more than `above` times the level."""
    size = np.maximum(np.linalg.norm(felt, axis=1, keepdims=True), np.finfo(float).tiny)
    return np.asarray(felt * np.minimum(1.0, above * level_mps2 / size))


def rattles(share: float, random: np.random.Generator, felt: Array, level_mps2: float) -> Array:
    """A loose part adds noise where the motion is strong."""
    strong = np.linalg.norm(felt, axis=1) > 1.5 * level_mps2
    return np.asarray(felt + share * level_mps2 * strong[:, None] * _noise(random, len(felt), (20.0, 60.0)))


def _noise(random: np.random.Generator, n: int, band_hz: tuple[float, float]) -> Array:
    """(n, 3) of rms 1 in a band."""
    hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    lines = random.normal(size=(len(hz), 3)) + 1j * random.normal(size=(len(hz), 3))
    lines[(hz < band_hz[0]) | (hz > band_hz[1])] = 0.0
    x = np.fft.irfft(lines, n, axis=0)
    return np.asarray(x / x.std())


def signals(seed: int, fault: Fault = sound, *, shocks: int = SHOCKS_A_MINUTE) -> tuple[Array, Array]:
    """Indications (n, 3) of the sensor and of the reference, in m/s2, at the same times."""
    random = np.random.default_rng([seed, 35])
    n = round((WINDOW_S + 2.0 * MARGIN_S) * RATE_HZ)
    t, hz = np.arange(n) / RATE_HZ, np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    level = float(np.exp(random.uniform(*np.log(LEVEL_MPS2))))
    u, bursts = level * _noise(random, n, SUSTAINED_HZ), _noise(random, n, SHOCK_HZ)
    at_s = random.uniform(0.0, t[-1], shocks)
    u = u + SHOCK_MPS2 * np.exp(-0.5 * ((t[:, None] - at_s) / SHOCK_S) ** 2).sum(axis=1)[:, None] * bursts
    moved = fault(random, u, level)
    passed = 1.0 / (1.0 + np.sqrt(2.0) * 1j * hz / CORNER_HZ - (hz / CORNER_HZ) ** 2)
    felt = np.fft.irfft(np.fft.rfft(moved, axis=0) * passed[:, None], n, axis=0)
    V = (felt + np.array([0.0, 0.0, 9.80665])) @ S_TRUE.T + SENSOR_NOISE_MPS2 * random.normal(size=(n, 3))
    return V, u + REFERENCE_NOISE_MPS2 * random.normal(size=(n, 3))


def window(seed: int, fault: Fault = sound, *, shocks: int = SHOCKS_A_MINUTE) -> list[Window]:
    """The windows of the front end in one minute; the response is not known."""
    V, u = signals(seed, fault, shocks=shocks)
    clock = clock_from_stamps(np.arange(len(V)) / RATE_HZ)
    sensor, reference = Samples("sensor", 0, V, clock), Samples("reference", 0, u, clock)
    pose = beside(np.eye(3), np.array([0.0, 0.0, 9.80665]))
    return windows_of(pose, sensor, reference, Instrument(), (MARGIN_S, MARGIN_S + WINDOW_S))


def taken(seeds: range, fault: Fault, shocks: int) -> int:
    """How many of the minutes have a window of at least half of it that is used."""
    found = (window(seed, fault, shocks=shocks) for seed in seeds)
    return sum(any(w.used and w.stop_s - w.start_s > 0.5 * WINDOW_S for w in own) for own in found)


KINDS: dict[str, Fault] = {
    "firm": sound,
    **{f"slips above {above:g} times the level": partial(slips, above) for above in (0.8, 1.5, 2.5)},
    **{f"rattles by {share:g} of the level": partial(rattles, share) for share in (0.5, 1.0, 2.0)},
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=SEEDS)
    seeds = range(parser.parse_args().seeds)
    print(f"| mount | taken of {len(seeds)} without traffic | with traffic |\n| --- | --- | --- |")
    for name, fault in KINDS.items():
        print(f"| {name} | {taken(seeds, fault, 0)} | {taken(seeds, fault, SHOCKS_A_MINUTE)} |", flush=True)


if __name__ == "__main__":
    main()
