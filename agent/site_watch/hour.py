"""One hourly `watch` result as a file or the bus brings it, checked."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from calib.model import Array
from calib.site_watch.day import HOURS

HOUR_NS = 3_600_000_000_000
LARGEST = 1e12  # (m/s²)²; beyond it no acceleration is believed
LARGEST_MEAN = 1e6  # m/s²
LONGEST_ID = 100  # characters
LEAST_COVERED_S = 1800.0  # of an hour that counts
MOST_WRONG = 0.01  # part of the samples of an hour that may be stuck or clipped
BANDS = range(-12, 31)  # third octaves n: 10^(n/10) Hz
GRID = 0.02  # relative distance from a nominal centre (IEC 61260-1, base 10)
FARTHEST = 1.1  # third octaves from the centre of its window, in which a peak frequency lies
YEARS_H = (262_968, 1_139_568)  # 2000 to 2100, in hours since 1970
TWICE = "an hour of a sensor twice; the one with the higher sequence is used"

Numbers = list[float | None]


class WatchHour(msgspec.Struct, kw_only=True):
    """A `watch` result as it is published. `key`, `site` and `gateway` say where it comes from."""

    sensor: str
    hour_utc_ns: int
    duration_s: float
    samples: int
    noise_psd: Numbers
    band_hz: list[float]
    band_power: Numbers
    cross_power: Numbers
    key: str = ""
    site: str = ""
    gateway: str = ""
    sequence: int = 0
    stuck: int = 0
    clipped: int = 0
    temperature_degc: float | None = None
    mean_mps2: Numbers = []
    calibration_run_id: str = ""
    calibration_sequence: int = 0
    u_main_pct: Numbers = []
    peak_frequency_hz: Numbers = []

    @property
    def hour(self) -> int:
        """Hours since 1970."""
        return self.hour_utc_ns // HOUR_NS

    @property
    def day(self) -> int:
        """Days since 1970."""
        return self.hour // HOURS

    @property
    def made(self) -> tuple[str, int]:
        """Which calibration was in force: CalibrationUpdate.made."""
        return self.calibration_run_id, self.calibration_sequence

    @property
    def u_main(self) -> float:
        """The largest relative standard uncertainty of a main sensitivity in force; NaN where none is stated."""
        return max((u / 100.0 for u in self.u_main_pct if u is not None and u > 0.0), default=math.nan)


class SelfTestLine(msgspec.Struct, kw_only=True):
    """What is used of a `self_test` result."""

    sensor: str
    t_utc_ns: int
    response_mps2: Numbers
    u_response_mps2: Numbers
    u_supply_pct: Numbers
    temperature_degc: float | None = None
    sequence: int = 0
    key: str = ""
    gateway: str = ""

    @property
    def day(self) -> int:
        """Days since 1970."""
        return self.t_utc_ns // (HOURS * HOUR_NS)

    @property
    def usable(self) -> bool:
        """Whether it tells a response of any axis, in numbers that can be believed."""
        told = self.response_mps2, self.u_response_mps2, self.u_supply_pct
        size = np.abs([values(each) if len(each) == 3 else np.full(3, np.nan) for each in told])
        degc = self.temperature_degc
        sound = (size <= LARGEST_MEAN).all(axis=0) & (size[0] > 0.0)
        return bool(sound.any()) and (degc is None or -100.0 <= degc <= 200.0)


class CalibrationLine(msgspec.Struct, kw_only=True):
    """What is used of a `calibration` result: S, and which one it is."""

    sensor: str
    sensitivity: list[list[float | None]]
    run_id: str = ""
    sequence: int = 0
    made_run_id: str = ""
    made_sequence: int = 0
    key: str = ""
    gateway: str = ""

    @property
    def made(self) -> tuple[str, int]:
        """As CalibrationUpdate.made."""
        return (self.made_run_id, self.made_sequence) if self.made_sequence else (self.run_id, self.sequence)

    @property
    def main(self) -> Array:
        """Main sensitivities (3,); NaN where S has none."""
        rows = self.sensitivity if len(self.sensitivity) == 3 and all(len(r) == 3 for r in self.sensitivity) else []
        return np.array([row[i] or math.nan for i, row in enumerate(rows)] or [math.nan] * 3, dtype=float)


def wrong(hour: WatchHour) -> str:
    """Why the content cannot be used; "" where it can."""
    b = len(hour.band_hz)
    number, odd = divmod(hour.hour_utc_ns, HOUR_NS)
    lengths = len(hour.band_power), len(hour.cross_power), len(hour.noise_psd)
    numbers = [*hour.band_power, *hour.cross_power, *hour.noise_psd]
    rules = (
        (odd or not YEARS_H[0] <= number < YEARS_H[1], "hour_utc_ns is not the begin of an hour between 2000 and 2100"),
        (not b or lengths != (3 * b, 3 * b, 3),
         "band_power and cross_power do not have three values for each of band_hz, or noise_psd not three"),
        (len(set(grid(hour.band_hz))) != b,
         "band_hz are not third octaves 10^(n/10) Hz between 0.06 and 1000 Hz, each once"),
        (any(value is not None and not abs(value) <= LARGEST for value in numbers),
         f"a power is beyond {LARGEST:g} (m/s2)2"),
        (hour.temperature_degc is not None and not -100.0 <= hour.temperature_degc <= 200.0,
         "temperature_degc is not between -100 and 200"),
        (len(hour.calibration_run_id) > LONGEST_ID, f"calibration_run_id has more than {LONGEST_ID} characters"),
        (len(hour.mean_mps2) not in (0, 3)
         or any(value is not None and not abs(value) <= LARGEST_MEAN for value in hour.mean_mps2),
         f"mean_mps2 is not three values within {LARGEST_MEAN:g} m/s2"),
        (len(hour.peak_frequency_hz) not in (0, 3 * b)
         or not all(math.isnan(place) or abs(place) <= FARTHEST for place in places(hour)),
         "peak_frequency_hz are not three values for each of band_hz, each within a third octave of it"),
        (not hour.duration_s >= LEAST_COVERED_S or hour.samples <= 0,
         f"less than {LEAST_COVERED_S:g} s of the hour are covered"),
        (hour.stuck + hour.clipped > MOST_WRONG * hour.samples,
         f"more than {100.0 * MOST_WRONG:g} % of the samples are stuck or clipped"),
    )  # fmt: skip
    return next((message for broken, message in rules if broken), "")


def grid(band_hz: list[float]) -> list[int]:
    """Numbers n of third octaves; of frequencies that are none, nothing."""
    numbers = []
    for f in band_hz:
        n = round(10.0 * math.log10(f)) if 1e-3 < f < 1e6 else BANDS.start - 1
        if n in BANDS and abs(f / 10.0 ** (n / 10.0) - 1.0) <= GRID:
            numbers.append(n)
    return numbers


def places(hour: WatchHour) -> list[float]:
    """Where each peak frequency lies from the nominal centre of its band, in third octaves; NaN where there is none."""
    centres = grid(hour.band_hz) * 3
    return [
        math.nan if hz is None else 10.0 * math.log10(hz) - n if hz > 0.0 else math.inf
        for hz, n in zip(hour.peak_frequency_hz, centres, strict=False)
    ]


def values(told: Numbers) -> Array:
    """The numbers; NaN for null."""
    return np.array([np.nan if value is None else value for value in told])
