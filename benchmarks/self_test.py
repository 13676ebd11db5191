"""The self-test as a witness, on the twins: what it says of a change of the sensitivity after a week.

    python -m benchmarks.self_test [--devices 16] [--write]

All is simulated; no device has been seen. Each device stands on a structure that sways (SWAY_MPS2, 0.5 to 3 Hz), and
tests itself each night through its driver and its twin. Its response follows the temperature by its own coefficients
and the supply voltage with a power near that of the data sheet. The supply depends on the temperature and wanders.
After LEARNED nights and WEEK more, the watch asks the self-test of a change that began a week ago. A change of the
sensitivity multiplies all indications, so it is put into the responses of the last week.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from agent.acquisition.self_testing import shown_by
from agent.core.events import SelfTestReport, SelfTestRun
from agent.core.outcome import ResultSource
from agent.core.self_tests import self_test_report
from benchmarks.page import write_part
from calib.model import Array
from calib.site_watch.day import Day, SelfTests
from calib.site_watch.together import ALL
from calib.site_watch.verdicts import SensorVerdict, witnessed
from calib.site_watch.watch import SiteWatch
from calib.site_watch.witnesses import Witness
from hw.adxl345 import Adxl345, Adxl345Options
from hw.lsm6dso import Lsm6dso, Lsm6dsoOptions
from hw.virtual.adxl345_twin import Adxl345Twin
from hw.virtual.kernel import I2CBus, installed
from hw.virtual.lsm6dso_twin import Lsm6dsoTwin

LEARNED, WEEK = 60, 7  # nights
SWAY_MPS2 = 0.02  # standard deviation of the structure's motion on each axis
RESPONSE_PER_K, CURVED_PER_K2 = 1e-3, 1e-5  # standard deviation of the coefficients of a response
SUPPLY_PER_K, SUPPLY_WANDER, SUPPLY_DAYS = 5e-5, 3e-3, 30.0  # of a regulator; the wander has this correlation time
POWER = 0.05  # relative standard deviation of the power of the supply, of a part and axis from the data sheet
U_SUPPLY_PCT = 1.0  # as a channel states it by default
T = TypeVar("T")

KINDS: dict[str, tuple[Any, Any, Any, float, float]] = {
    "ADXL345": (Adxl345, Adxl345Options(rate_hz=100.0), Adxl345Twin, 100.0, 256.0),
    "LSM6DSO": (Lsm6dso, Lsm6dsoOptions(rate_hz=104.0, range_g=4, address=0x6A), Lsm6dsoTwin, 104.0, 8192.0),
}


class Device:
    """A device with its own coefficients, in time that its driver's sleep lets pass."""

    def __init__(self, kind: str, seed: int) -> None:
        driver, options, twin, self._rate_hz, self._counts_per_g = KINDS[kind]
        self._random, self._t_s = np.random.default_rng(seed), 0.0
        self._per_k = self._random.normal(0.0, RESPONSE_PER_K, 3)
        self._curved = self._random.normal(0.0, CURVED_PER_K2, 3)
        self._sway_hz, self._phase = self._random.uniform(0.5, 3.0, 3), self._random.uniform(0.0, 2.0 * np.pi, 3)
        self.degc, self.supply = 20.0, 1.0
        raw = {"temperature_raw": lambda _: round(256.0 * (self.degc - 25.0))} if kind == "LSM6DSO" else {}
        made = twin(self._counts, self._due, lambda: self._t_s, electrostatic=self._electrostatic, **raw)
        self._bus = I2CBus({options.address: made})
        self.sensor = driver("s", options, clock=self._clock, sleep=self._sleep)
        self._exponent = np.zeros(3)
        self._power = self._random.normal(1.0, POWER, 3)

    def night(self) -> SelfTestReport:
        """The result of a self-test now."""
        with installed({"/dev/i2c-1": self._bus}):
            self.sensor.open()
            self._exponent = self._power * self.sensor._self_test().supply_exponent
            shown = shown_by(self.sensor, _called, lambda: False)
            self.sensor.close()
        run = SelfTestRun(device="s", state="done", t_monotonic_ns=0, t_utc_ns=0, **shown)
        return self_test_report(ResultSource("s", "", "count", 0), run, U_SUPPLY_PCT)

    def _electrostatic(self, _: float) -> Array:
        warmer = self.degc - 20.0
        return np.asarray((1.0 + self._per_k * warmer + self._curved * warmer**2) * self.supply**self._exponent)

    def _counts(self, first: int, n: int) -> NDArray[np.int32]:
        t = np.arange(first, first + n)[:, None] / self._rate_hz
        sway = SWAY_MPS2 / 9.80665 * np.sqrt(2.0) * np.sin(2.0 * np.pi * self._sway_hz * t + self._phase)
        g = np.array([0.02, -0.03, 1.0]) + sway + 0.003 * self._random.standard_normal((n, 3))
        return np.asarray(np.rint(self._counts_per_g * g), np.int32)

    def _due(self, t_s: float) -> int:
        return int(t_s * self._rate_hz)

    def _clock(self) -> tuple[int, int]:
        self._t_s += 2e-5
        return round(self._t_s * 1e9), round(self._t_s * 1e9)

    def _sleep(self, seconds: float) -> None:
        self._t_s += max(seconds, 0.0)


def _called(method: Callable[..., T], **arguments: Any) -> T:
    return method(**arguments)


def nights(kind: str, devices: int) -> tuple[list[SelfTests], Array]:
    """The self-tests of some devices, each night, and the temperature of the site on these days."""
    random, site = np.random.default_rng(len(kind)), [Device(kind, 100 + seed) for seed in range(devices)]
    begin, weather, wander = random.uniform(0.0, 365.0), 0.0, random.normal(0.0, SUPPLY_WANDER, devices)
    keep, found, degrees = np.exp(-1.0 / SUPPLY_DAYS), [], []
    for night in range(LEARNED + WEEK):
        weather = 0.7 * weather + random.normal(0.0, 2.0)
        degc = 10.0 + 8.0 * np.sin(2.0 * np.pi * (begin + night) / 365.0) + weather
        wander = keep * wander + random.normal(0.0, SUPPLY_WANDER * np.sqrt(1.0 - keep**2), devices)
        told = []
        for i, device in enumerate(site):
            device.degc = degc + random.normal(0.0, 0.5)
            device.supply = 1.0 + SUPPLY_PER_K * (device.degc - 20.0) + wander[i]
            told.append(device.night())
        response = np.abs([one.response_mps2 for one in told])
        u, supply = np.array([one.u_response_mps2 for one in told]), np.array([one.u_supply_pct for one in told])
        found.append(SelfTests(np.log(response), u / response, supply / 100.0,
                               np.array([one.temperature_degc for one in told])))  # fmt: skip
        degrees.append(degc + random.normal(0.0, 1.0))
    return found, np.array(degrees)


def witness(found: list[SelfTests], degrees: Array, direction: int, told: float, true: float) -> list[Witness]:
    """What the self-test of each device says where the structure tells `told`, and the sensor has changed by `true`."""
    n = len(found[0].log_response)
    watch = SiteWatch(np.zeros(n), np.array([1.0]))
    axes = slice(0, 3) if direction == ALL else direction
    nothing = np.full((n, 1, 6), np.nan)
    for night, tests in enumerate(found):
        response = tests.log_response.copy()
        if night >= LEARNED:
            response[:, axes] += np.log1p(true)
        shown = SelfTests(response, tests.u, tests.u_supply, tests.temperature_degc)
        level, noise = np.full((1, 3), np.nan), np.full((n, 3), np.nan)
        day = Day(night, nothing, np.full((n, 1, 6), np.inf), level, noise, float(degrees[night]), None, shown)
        watch.update(day)
    verdict = SensorVerdict("sensitivity", "", np.log1p(told), 0.002, LEARNED, direction=direction)
    return [next(w for w in witnessed(watch, i, verdict).witnesses if w.name == "self-test") for i in range(n)]


def table(devices: int) -> str:
    """A line for each kind and change."""
    rows = [
        "| device | the structure tells | what has changed | agrees | silent | contradicts | u (median) |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for kind in KINDS:
        found, degrees = nights(kind, devices)
        for direction, what, size in ((0, "x", 0.005), (0, "x", 0.01), (ALL, "x, y and z", 0.01),
                                      (ALL, "x, y and z", 0.05)):  # fmt: skip
            for true, who in ((-size, "the sensor"), (0.0, "the structure at it")):
                said = witness(found, degrees, direction, -size, true)
                count = Counter(one.says for one in said)
                known = [one.u for one in said if np.isfinite(one.u)]
                u = f"{100.0 * np.median(known):.2f} %" if known else "above half of it"
                told = " | ".join(f"{count[says]}" for says in ("agrees", "silent", "contradicts"))
                rows.append(f"| {kind} | {what}: -{100.0 * size:g} % | {who} | {told} | {u} |")
    return "\n".join(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, default=16)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    text = f"`python -m benchmarks.self_test --devices {given.devices}`; simulated.\n\n{table(given.devices)}"
    if given.write:
        write_part("self-test", text)
    else:
        print(text)
