"""A day of a site in binary: what `calib.site_watch` needs of it, in 6 values of two numbers for each sensor and
band.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from agent.site_watch.hour import SelfTestLine, WatchHour, grid, places, values
from calib.model import Array
from calib.signal.spectra import THIRD_OCTAVE
from calib.site_watch.day import HOURS, Day, Hours, SelfTests, Visits, day_of

Made = tuple[str, int]  # CalibrationUpdate.made: run and sequence
SHAPES = {
    "value": "nb6",
    "u": "nb6",
    "level": "b3",
    "log_noise": "n3",
    "mean": "n3",
    "u_main": "n",
    "main": "n3",
    "frequency": "nb3",
    "self_test": "n3",
    "self_test_u": "n3",
    "self_test_supply": "n3",
    "self_test_degc": "n",
    "lag_h": "n",
    "contrast": "n3",
    "frequency_contrast": "nb3",
}
SELF_TEST = "self_test", "self_test_u", "self_test_supply", "self_test_degc"  # as the fields of SelfTests
EMPTY = {"frequency", "lag_h", "contrast", "frequency_contrast", *SELF_TEST}  # arrays that may be left out


class DaySum(msgspec.Struct, array_like=True, kw_only=True):
    """A day of n sensors in b bands. `sensors`: their numbers; `bands`: third octaves n of 10^(n/10) Hz.

    `value` (n, b, 6) to `mean` (n, 3): the fields of calib.site_watch.day.Day, as little-endian float32. `made`: the
    calibration of each sensor in force at the end of the day; `u_main` (n,): its relative standard uncertainty then;
    `main` (n, 3): its main sensitivities, NaN where they are not known. `self_test` and the others: the fields of
    calib.site_watch.day.SelfTests; empty where no sensor has tested itself. `frequency` (n, b, 3): that of Day; empty
    where no result tells one. `lag_h` (n,): that of Day; empty where no clock is off. `contrast` (n, 3),
    `frequency_contrast` (n, b, 3): those of Day; empty in sums of earlier versions, the second also as `frequency`.
    """

    number: int
    sensors: list[int]
    bands: list[int]
    temperature_degc: float
    made: list[Made]
    value: bytes
    u: bytes
    level: bytes
    log_noise: bytes
    mean: bytes
    u_main: bytes
    main: bytes
    self_test: bytes = b""
    self_test_u: bytes = b""
    self_test_supply: bytes = b""
    self_test_degc: bytes = b""
    frequency: bytes = b""
    lag_h: bytes = b""
    contrast: bytes = b""
    frequency_contrast: bytes = b""

    def array(self, name: str) -> Array:
        """One of the arrays. Raises ValueError where its length is not that of its shape."""
        sizes = {"n": len(self.sensors), "b": len(self.bands), "3": 3, "6": 6}
        shape = [sizes[k] for k in SHAPES[name]]
        if name in EMPTY and not getattr(self, name):
            return np.full(shape, np.nan)
        return np.frombuffer(getattr(self, name), dtype="<f4").astype(float).reshape(shape)


def summed(
    number: int,
    hours: Iterable[tuple[int, WatchHour]],
    mains: Mapping[tuple[int, Made], Array],
    self_tests: Mapping[int, SelfTestLine],
) -> DaySum:
    """The sum of day `number` from the hours of its sensors, in any order, each once.

    `mains`: main sensitivities of calibrations, by sensor and `made`. `self_tests` of the day, by sensor.
    """
    rows = sorted(hours, key=lambda row: (row[1].hour, row[0]))
    sensors = sorted({i for i, _ in rows})
    bands = sorted({band for _, hour in rows for band in grid(hour.band_hz)})
    n, at = len(sensors), {i: k for k, i in enumerate(sensors)}
    place = {band: k for k, band in enumerate(bands)}
    power, cross = (np.full((HOURS, n, len(bands), 3), np.nan) for _ in range(2))
    frequency = np.full_like(power, np.nan)
    noise, mean, degc = np.full((HOURS, n, 3), np.nan), np.full((HOURS, n, 3), np.nan), np.full((HOURS, n), np.nan)
    made: list[Made] = [("", 0)] * n
    u_main = np.full(n, np.nan)
    for i, hour in rows:
        h, k, own = hour.hour - HOURS * number, at[i], [place[band] for band in grid(hour.band_hz)]
        power[h, k, own] = _matrix(hour.band_power)
        cross[h, k, own] = _matrix(hour.cross_power)
        if hour.peak_frequency_hz:
            frequency[h, k, own] = THIRD_OCTAVE * np.reshape(places(hour), (3, -1)).T
        noise[h, k] = values(hour.noise_psd)
        mean[h, k] = values(hour.mean_mps2) if hour.mean_mps2 else np.nan
        degc[h, k] = math.nan if hour.temperature_degc is None else hour.temperature_degc
        made[k], u_main[k] = hour.made, hour.u_main
    day = day_of(
        Hours(HOURS * number + np.arange(HOURS, dtype=float), power, cross, noise, degc, mean, frequency), _hz(bands)
    )
    main = [mains.get((i, made[k]), np.full(3, np.nan)) for i, k in at.items()]
    parts = {"value": day.value, "u": day.u, "level": day.level, "log_noise": day.log_noise, "mean": day.mean_mps2,
             "contrast": day.contrast, "u_main": u_main, "main": np.array(main),
             **_self_tests(sensors, self_tests)}  # fmt: skip
    if np.isfinite(frequency).any():
        parts["frequency"], parts["frequency_contrast"] = day.frequency, day.frequency_contrast
    if day.lag_h is not None:
        parts["lag_h"] = day.lag_h
    return DaySum(number=number, sensors=sensors, bands=bands, temperature_degc=day.temperature_degc, made=made,
                  **{name: np.asarray(part, dtype="<f4").tobytes() for name, part in parts.items()})  # fmt: skip


def _self_tests(sensors: Sequence[int], found: Mapping[int, SelfTestLine]) -> dict[str, Array]:
    """The arrays of a sum; nothing where no sensor has tested itself."""
    told = [(k, found[i]) for k, i in enumerate(sensors) if i in found and found[i].usable]
    if not told:
        return {}
    arrays = {name: np.full((len(sensors), 3) if SHAPES[name] == "n3" else len(sensors), np.nan) for name in SELF_TEST}
    for k, line in told:
        response = np.abs(values(line.response_mps2))
        response[~(response > 0.0)] = np.nan
        degc = math.nan if line.temperature_degc is None else line.temperature_degc
        shown = np.log(response), values(line.u_response_mps2) / response, values(line.u_supply_pct) / 100.0, degc
        for name, value in zip(SELF_TEST, shown, strict=True):
            arrays[name][k] = value
    return arrays


@dataclass(frozen=True, slots=True, eq=False)
class SiteDay:
    """A day of all sensors of a site, the visits in it, and `u_main` (n,): relative standard uncertainty of the
    calibration that was in force last; NaN where none was stated."""

    day: Day
    visits: Visits
    u_main: Array


def days_of(sums: Iterable[DaySum], sensors: Sequence[int], bands: Sequence[int]) -> Iterator[SiteDay]:
    """Each day of these sensors and bands, in order. What a visit found is the ratio of the main sensitivities of two
    calibrations. Raises ValueError for a sum whose arrays are not whole."""
    n, b = len(sensors), len(bands)
    at, place = {i: k for k, i in enumerate(sensors)}, {band: k for k, band in enumerate(bands)}
    made: list[Made | None] = [None] * n
    main, u_main = np.full((n, 3), np.nan), np.full(n, np.nan)
    for one in sums:
        (own, to), (columns, to_bands) = _common(one.sensors, at), _common(one.bands, place)
        value, u, level = np.full((n, b, 6), np.nan), np.full((n, b, 6), np.inf), np.full((b, 3), np.nan)
        noise, mean = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        value[to[:, None], to_bands] = one.array("value")[own[:, None], columns]
        u[to[:, None], to_bands] = one.array("u")[own[:, None], columns]
        level[to_bands] = one.array("level")[columns]
        frequency = np.full((n, b, 3), np.nan)
        frequency[to[:, None], to_bands] = one.array("frequency")[own[:, None], columns]
        contrast, by_band = np.full((n, 3), np.nan), np.full((n, b, 3), np.nan)
        contrast[to] = one.array("contrast")[own]
        by_band[to[:, None], to_bands] = one.array("frequency_contrast")[own[:, None], columns]
        noise[to], mean[to] = one.array("log_noise")[own], one.array("mean")[own]
        lag_h = np.full(n, np.nan)
        lag_h[to] = one.array("lag_h")[own]
        visits = Visits.unknown(np.array([False] * n))
        new_main, new_u = one.array("main"), one.array("u_main")
        for k, i in zip(own.tolist(), to.tolist(), strict=True):
            if made[i] is not None and made[i] != one.made[k]:
                u_found = math.hypot(new_u[k], u_main[i])
                visits.there[i], visits.found[i] = True, new_main[k] / main[i] - 1.0
                visits.u[i] = u_found if math.isfinite(u_found) else math.inf
            made[i], main[i], u_main[i] = one.made[k], new_main[k], new_u[k]
        tests = [np.full((n, 3) if SHAPES[name] == "n3" else n, np.nan) for name in SELF_TEST]
        for name, array in zip(SELF_TEST, tests, strict=True):
            array[to] = one.array(name)[own]
        day = Day(one.number, value, u, level, noise, one.temperature_degc, mean, SelfTests(*tests), frequency,
                  np.nan_to_num(lag_h) if one.lag_h else None, contrast, by_band)  # fmt: skip
        yield SiteDay(day, visits, u_main.copy())


def _common(of_a_sum: Sequence[int], at: Mapping[int, int]) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Which sensors, or bands, of a sum are among those `at` a place, and the places of these."""
    own = [k for k, one in enumerate(of_a_sum) if one in at]
    return np.array(own, dtype=int), np.array([at[of_a_sum[k]] for k in own], dtype=int)


def _hz(bands: Sequence[int]) -> Array:
    return np.asarray(10.0 ** (np.array(bands) / 10.0))


def _matrix(told: list[float | None]) -> Array:
    """(B, 3) from all bands of the first, then the second, then the third."""
    return values(told).reshape(3, -1).T
