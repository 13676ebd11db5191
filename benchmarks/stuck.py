"""Outputs that do not change: what is called stuck of sound sensors, and after what time of dead ones.

    python -m benchmarks.stuck [--hours H]

A sensor of 12 bits (0.0098 m/s2 a step, 100 Hz) is fixed in a building beside a reference with noise of 1 mm/s2. Its
noise is a share of one step, and its mean drifts by three steps a day and by one step within an hour. The building is
still, sways along y, or a machine shakes it at 31 Hz along y and z from time to time.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator

import numpy as np

from agent.core.raw_watch import RawWatch
from agent.core.stream import DeviceStream
from calib.model import Array
from hw.block import SampleBlock

STEP_MPS2, RATE_HZ, BLOCK_S, BURST = 0.0098, 100.0, 5.0, 25
NOISE = (0.05, 0.2, 0.5, 0.9)  # of the sensor, in steps
REFERENCE_NOISE_MPS2 = 1e-3
Motion = Callable[[Array], Array]


def still(t: Array) -> Array:
    """Nothing moves."""
    return np.zeros((len(t), 3))


def sways(t: Array) -> Array:
    """0.05 m/s2 at 1.3 Hz along y, with a fiftieth of it along x; an hour of two."""
    on = (t // 3600.0 % 2.0)[:, None]
    return np.asarray(on * 0.05 * np.sin(2.0 * np.pi * 1.3 * t)[:, None] * [0.02, 1.0, 0.1])


def machine(t: Array) -> Array:
    """0.1 m/s2 at 31.3 Hz along y and z, 40 minutes in each hour; it begins running."""
    on = (t % 3600.0 < 2400.0)[:, None]
    return np.asarray(on * 0.1 * np.sin(2.0 * np.pi * 31.3 * t)[:, None] * [0.02, 1.0, 0.7])


MOTIONS: dict[str, Motion] = {"still": still, "sways": sways, "machine": machine}


def counts(random: np.random.Generator, t: Array, motion: Motion, noise: float) -> Array:
    """Indications (n, 3) of the sensor in counts."""
    drift = 3.0 * t[:, None] / 86400.0 + 0.5 * np.sin(2.0 * np.pi * t[:, None] / 3600.0 + np.arange(3))
    exact = (motion(t) + np.array([0.0, 0.0, 9.80665])) / STEP_MPS2 + drift
    return np.asarray(np.round(exact + noise * random.normal(size=exact.shape)))


class Site:
    """The watch of a sensor beside its reference, fed second by second."""

    def __init__(self) -> None:
        self.watch = RawWatch(600.0)
        self._streams = {name: DeviceStream(name, 0) for name in ("sensor", "reference")}
        self.told: list[tuple[float, str]] = []

    def feed(self, first: int, sensor: Array, reference: Array) -> None:
        """One block of each device."""
        for name, x in (("reference", reference), ("sensor", sensor)):
            count = np.arange(BURST, len(x) + 1, BURST, dtype=np.int32)
            arrivals = np.round((first + count) / RATE_HZ * 1e9).astype(np.int64)
            block = SampleBlock(name, "boot", int(arrivals[-1]), first, RATE_HZ, arrivals, count, x)
            stream = self._streams[name]
            stream.update(block)
            stream.forget_before(stream.newest_arrival_s or 0.0)
            motion, expected = self.watch.motion("reference"), np.zeros(3)
            if name == "sensor" and motion is not None:
                expected = np.sqrt(np.maximum(np.diag(motion), 0.0)) / STEP_MPS2
            told = self.watch.update(block, stream, expected, 0)
            self.told += [(arrivals[-1] * 1e-9, said) for said in told]


def seconds(seed: int, hours: float, motion: Motion, noise: float) -> Iterator[tuple[int, Array, Array]]:
    """(number of the first sample, sensor in counts, reference in m/s2) of each block."""
    random, size = np.random.default_rng([seed, 12]), round(BLOCK_S * RATE_HZ)
    for first in range(0, round(hours * 3600.0 * RATE_HZ), size):
        t = (first + np.arange(size)) / RATE_HZ
        yield first, counts(random, t, motion, noise), motion(t) + REFERENCE_NOISE_MPS2 * random.normal(size=(size, 3))


def alarms(seed: int, hours: float, motion: Motion, noise: float) -> list[tuple[float, str]]:
    """What is told of a sound sensor, and when in s."""
    site = Site()
    for first, sensor, reference in seconds(seed, hours, motion, noise):
        site.feed(first, sensor, reference)
    return site.told


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=24.0)
    hours = parser.parse_args().hours
    print(f"| building | noise in steps | told of a sound sensor in {hours:g} h |\n| --- | --- | --- |")
    for name, motion in MOTIONS.items():
        for noise in NOISE:
            print(f"| {name} | {noise:g} | {len(alarms(1, hours, motion, noise))} |", flush=True)


if __name__ == "__main__":
    main()
