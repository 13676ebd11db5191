"""Benches drawn at random: a uniaxial reference, positions set by hand, motion in bursts, clocks that run apart, a
filter that nobody states, hum and lost samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from calib import calibrate
from calib.model import Array
from tests.pair import Filter, flat, lowpass

RATE_HZ, STAY_S = 200.0, 30.0
G_MPS2, ANGLE_RAD = 9.81, np.deg2rad(0.2)  # positions are set to what is stated by default
PPM = {"in step": 0.0, "20 ppm": 20.0, "60 ppm": 60.0}


@dataclass(frozen=True, eq=False)
class Bench:
    """The tables of sensor and reference, the positions, and what is true."""

    sensor: tuple[Array, Array]
    reference: dict[str, Array]
    poses: list[dict[str, float]]
    stated: dict[str, str | float]
    S: Array
    Q: Array
    response: Filter


def filtered(x: Array, response: Filter) -> Array:
    """x (n, 3) behind an instrument; its own mirror image follows it, so that the ends meet."""
    frequency_hz = np.fft.rfftfreq(2 * len(x), 1.0 / RATE_HZ)
    frequency_hz[0] = 1e-9
    lines = np.fft.rfft(np.concatenate([x, x[::-1]]), axis=0) * response(frequency_hz)[:, None]
    return np.asarray(np.fft.irfft(lines, len(x) * 2, axis=0)[: len(x)])


def bench(seed: int) -> Bench:
    """Four to eight positions of STAY_S, each in a direction of its own, each with the transverse motion of its own."""
    random = np.random.default_rng([62, seed])
    number, order, kind = int(random.integers(4, 9)), int(random.integers(3)), str(random.choice(["a", "v", "ac"]))
    to_hz, level = float(random.uniform(4.0, 25.0)), float(np.exp(random.uniform(np.log(0.2), np.log(5.0))))
    noise, own_noise = np.exp(random.uniform(np.log([0.001, 0.0005]), np.log([0.1, 0.03]))).tolist()
    ppm, lag_s = float(random.choice(list(PPM.values()))), float(random.uniform(-0.02, 0.02))
    hum, lost, bursts = (float(random.choice([0.0, size])) for size in (0.3, 0.02, 1.0))
    S, Q = np.eye(3) + 0.02 * random.normal(size=(3, 3)), 0.2 * random.normal(size=3)
    response = lowpass(order, to_hz * float(random.uniform(1.5, 6.0))) if order else flat
    t = np.arange(round(STAY_S * RATE_HZ)) / RATE_HZ
    frequency_hz = np.fft.rfftfreq(len(t), 1.0 / RATE_HZ)
    felt, moved, poses = [], [], []
    for k in range(number):
        way, down = (x / np.linalg.norm(x) for x in random.normal(size=(2, 3)))
        way = np.roll([1.0, 0.0, 0.0], k) if k < 3 else way
        lines = np.fft.rfft(random.normal(size=len(t)))
        lines[(frequency_hz < 0.8) | (frequency_hz > to_hz)] = 0.0
        a = np.fft.irfft(lines, len(t)) * np.hanning(len(t)) ** 0.1
        a *= level / a.std() * (0.1 + np.clip(np.sin(2.0 * np.pi * t / 7.0), 0.0, 1.0) if bursts else 1.0)
        beside = way + np.cross(ANGLE_RAD * random.normal(size=3) + 0.01 * random.normal(size=3), way)
        leaning = down + np.cross(ANGLE_RAD * random.normal(size=3), down)
        felt.append(filtered(np.outer(a, beside) + G_MPS2 * leaning, response))
        lines = np.fft.rfft(a) / np.where(frequency_hz > 0.0, 2j * np.pi * frequency_hz, np.inf) ** (kind == "v")
        moved.append(np.fft.irfft(lines, len(t)))
        span = {"start_s": k * STAY_S + 1.0, "stop_s": (k + 1) * STAY_S - 1.0}
        poses.append(span | dict(zip(("dx", "dy", "dz", "gx", "gy", "gz"), [*way, *(G_MPS2 * down)], strict=True)))
    V, u = np.concatenate(felt) @ S.T + Q, np.concatenate(moved) * (1.0 + 0.001 * random.normal())
    at_s, stated = np.arange(len(u)) / RATE_HZ, dict[str, str | float]()
    if kind == "ac":
        corner_hz, twice_hz = 0.1, np.fft.rfftfreq(2 * len(u), 1.0 / RATE_HZ)
        passed = 1.0 / (1.0 + corner_hz / (1j * np.maximum(twice_hz, 1e-9)))
        u = np.fft.irfft(np.fft.rfft(u, 2 * len(u)) * passed, 2 * len(u))[: len(u)]
        stated = {"reference_coupling": "ac", "reference_corner_hz": corner_hz}
    u += own_noise * u.std() * random.normal(size=len(u))
    V += level * (noise * random.normal(size=V.shape) + hum * np.outer(np.sin(100.0 * np.pi * at_s), [1.0, 0.5, 0.2]))
    kept = random.random(len(u)) >= lost
    sensor = (at_s + lag_s)[kept] * (1.0 + ppm * 1e-6), V[kept]
    return Bench(sensor, {"time_s": at_s, kind[0]: u}, poses, stated, S, Q, response)


def beyond(seed: int) -> float | None:
    """The largest error over u; None where the data are refused."""
    drawn = bench(seed)
    found = calibrate(drawn.sensor, drawn.reference, poses=drawn.poses, **drawn.stated)
    if found.status != "valid":
        return None
    size = abs(drawn.response(np.array([found.reference_frequency_hz]))[0])
    errors = np.append((found.sensitivity - size * drawn.S).ravel(), found.offset - drawn.Q)
    return float(np.abs(errors / found.standard_uncertainty.ravel())[found.determined.ravel()].max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed",
    [
        2,
        pytest.param(1, marks=pytest.mark.thorough),
        *(pytest.param(k, marks=pytest.mark.nightly) for k in (0, 3, 4, 5, 6, 7)),
    ],
)
def test_a_drawn_bench_is_within_4_u(seed: int) -> None:
    largest = beyond(seed)
    assert largest is not None
    assert largest < 4.0


@pytest.mark.nightly
def test_few_of_six_benches_are_refused_or_beyond_4_u() -> None:
    """The limits are what was seen, with a margin: by chance alone 0.02 of them would be beyond 4 u."""
    largest = [beyond(seed) for seed in range(9, 68, 10)]
    told = np.array([one for one in largest if one is not None])
    assert len(told) >= 5
    assert (told > 4.0).sum() <= 1
    assert told.max() < 7.5
