"""The hourly `watch` of a sensor without a reference: mean, noise floor, and power in third octaves.

Segments of a minute are condensed as they come, in output units; at the end of the hour all of them are converted with
the calibration that is in force then. So an hour never mixes two calibrations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.core.stream import SATURATED, UNCOUNTED
from calib.estimate.correction import Law
from calib.model import Array
from calib.signal.spectra import Bands, Segment, bands_of, noise_floor, peak_frequency, robust_power, segment_of, turned
from hw.block import SampleBlock

HOUR_NS = 3_600_000_000_000
BACK_NS = HOUR_NS // 2  # UTC that steps back by less stays in the hour that is open
FILLED = 0.01  # of a segment: so many missing samples are bridged by straight lines; more begin another segment
COUNTS = ("samples", "stuck", "clipped", "missing")
PARTS = ("mean", "power", "floor", "peaks")  # of a segment


@dataclass(frozen=True, slots=True, eq=False)
class Hour:
    """What an hour tells, in m/s2 along the axes of the corrected acceleration; fields as in events.WatchReport."""

    hour_utc_ns: int
    duration_s: float
    counts: Mapping[str, int]
    temperature_degc: tuple[float, float]  # mean and standard deviation; NaN where the device tells none
    segments: int
    mean: Array
    mean_scatter: Array
    noise_psd: Array
    centre_hz: Array
    power: Array  # (6, B) as spectra.PAIRS
    frequency_hz: Array  # (3, B) peak frequency of each window
    u_frequency_hz: Array


class SensorWatch:
    """Takes the blocks of a sensor and gives an `Hour` after each hour of UTC that has samples."""

    def __init__(self) -> None:
        self._rate_hz = 0.0
        self._hour: int | None = None  # number since 1970; None before the first block, and after a silent end
        self._counts = dict.fromkeys(COUNTS, 0)
        self._warmth = np.zeros(3)  # samples whose temperature is told, sum of temperatures, sum of squares
        self._segments: list[tuple[float, Segment]] = []  # each with its temperature
        self._begin_segment(0)

    def _begin_segment(self, samples: int) -> None:
        """`_held` (3, samples): the samples from the first one of the segment on, as differences from it, `_zero`."""
        self._held, self._zero = np.zeros((3, samples), dtype=np.float32), np.zeros(3)
        self._length = self._filled = 0
        self._sound, self._next = True, -1
        self._degrees = np.zeros(2)  # samples whose temperature is told, sum of temperatures

    # --- changing

    def update(self, block: SampleBlock, suspect: NDArray[np.bool_], law: Law) -> Hour | None:
        """Take a block; the hour before, if the block begins another one.

        UTC of a block is that of its arrival less its length. `suspect` (3,): outputs of which samples are wrong.
        """
        x = np.asarray(block.indications, dtype=np.float64)
        if x.shape[1] != 3 or not len(x):
            return None
        if block.nominal_rate_hz != self._rate_hz:
            self._rate_hz = block.nominal_rate_hz
            self._begin_segment(bands_of(self._rate_hz).samples)
            self._segments = []  # of other bands
        done = self._turn_hour(block.t_utc_ns - round(len(x) / self._rate_hz * 1e9), law)
        flags = int(block.flags)
        self._counts["samples"] += len(x)
        self._counts["stuck"] += len(x) if suspect.any() else 0
        self._counts["clipped"] += len(x) if flags & SATURATED else 0
        degc = block.temperature_degc
        if degc is not None:
            self._warmth += len(x) * np.array([1.0, degc, degc**2])
        before, bands = self._next, bands_of(self._rate_hz)
        if flags & UNCOUNTED or before < 0:
            self._begin_segment(bands.samples)
        elif (lost := block.first_index - before) > 0:
            self._counts["missing"] += lost
            x = self._bridged(x, lost, bands)
        self._take(x, degc, not (suspect.any() or flags & SATURATED), bands, law)
        self._next = block.first_index + block.n
        return done

    def tick(self, t_utc_ns: int, late_s: float, law: Law) -> Hour | None:
        """Time has passed: the hour that is open ends without a block where samples would be later than `late_s`."""
        if self._hour is None or t_utc_ns < (self._hour + 1) * HOUR_NS + round(late_s * 1e9):
            return None
        return self._close(law)

    def _turn_hour(self, t_utc_ns: int, law: Law) -> Hour | None:
        hour, done = t_utc_ns // HOUR_NS, None
        if self._hour is not None and (hour > self._hour or t_utc_ns < self._hour * HOUR_NS - BACK_NS):
            done = self._close(law)
        if self._hour is None:
            self._hour = hour
        return done

    def _bridged(self, x: Array, lost: int, bands: Bands) -> Array:
        """The samples with those before them that are missing, where they are few; else the segment begins anew."""
        if not self._length or self._filled + lost > FILLED * bands.samples:
            self._begin_segment(bands.samples)
            return x
        self._filled += lost
        last = self._held[:, self._length - 1] + self._zero
        between = np.arange(1, lost + 1)[:, None] / (lost + 1.0)
        return np.vstack([last + between * (x[0] - last), x])

    def _take(self, x: Array, degc: float | None, sound: bool, bands: Bands, law: Law) -> None:
        """Fill segments with these samples."""
        while len(x):
            if not self._length:
                self._zero = x[0].copy()
            part, x = x[: bands.samples - self._length], x[bands.samples - self._length :]
            self._held[:, self._length : self._length + len(part)] = (part - self._zero).T
            self._length += len(part)
            self._sound &= sound and bool(np.isfinite(part).all())
            if degc is not None:
                self._degrees += len(part) * np.array([1.0, degc])
            if self._length == bands.samples:
                self._end_segment(bands, law)

    def _end_segment(self, bands: Bands, law: Law) -> None:
        if self._sound:
            told, total = self._degrees.tolist()
            degc = total / told if told else float("nan")
            try:
                made = segment_of(self._held, bands, _inverse(law.at(degc).sensitivity))
            except np.linalg.LinAlgError:
                made = segment_of(self._held, bands, np.full((3, 3), np.nan))
            self._segments.append((degc, replace(made, mean=made.mean + self._zero)))
        self._begin_segment(bands.samples)

    def _close(self, law: Law) -> Hour | None:
        """The hour that is open; None where S has no inverse. The segment that is open goes on into the next one."""
        assert self._hour is not None
        counts, segments, number = self._counts, self._segments, self._hour
        told, total, squares = self._warmth.tolist()
        mean_degc = total / told if told else float("nan")
        temperature = mean_degc, float(np.sqrt(max(squares / told - mean_degc**2, 0.0))) if told else float("nan")
        self._hour, self._counts, self._segments = None, dict.fromkeys(COUNTS, 0), []
        self._warmth = np.zeros(3)
        bands, n = bands_of(self._rate_hz), len(segments)
        try:
            at = [law.at(degc) for degc, _ in segments]
            back = [_inverse(one.sensitivity) for one in at]
        except np.linalg.LinAlgError:
            return None
        unknown = np.full(3, np.nan)
        mean, scatter, noise, power = unknown, unknown, unknown, np.full((6, len(bands.centre_hz)), np.nan)
        frequency = power[:3], power[:3]
        if n:
            own = [segment for _, segment in segments]
            means = np.array([by @ (s.mean - one.offset) for s, one, by in zip(own, at, back, strict=True)])
            mean = means.mean(axis=0)
            scatter = means.std(axis=0, ddof=1) / np.sqrt(n) if n > 1 else unknown
            power = robust_power(np.array([turned(s.power, by) for s, by in zip(own, back, strict=True)]), bands)
            noise = np.mean(np.square(back), axis=0) @ noise_floor(np.array([s.floor for s in own]), bands)
            frequency = peak_frequency(np.array([s.peaks for s in own]), noise, bands)
        duration_s = min(counts["samples"] / self._rate_hz, 3600.0)
        return Hour(number * HOUR_NS, duration_s, counts, temperature, n, mean, scatter, noise, bands.centre_hz, power,
                    *frequency)  # fmt: skip

    # --- state

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "rate_hz": self._rate_hz, "hour": self._hour, "counts": dict(self._counts), "warmth": self._warmth.copy(),
            "segments": [
                {"degc": degc, **{name: getattr(s, name) for name in PARTS}} for degc, s in self._segments
            ],
            "held": self._held[:, : self._length].copy(), "zero": self._zero.copy(), "filled": self._filled,
            "sound": self._sound, "next": self._next, "degrees": self._degrees.copy(),
        }  # fmt: skip

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._rate_hz, self._hour, self._counts = state["rate_hz"], state["hour"], dict(state["counts"])
        self._warmth = np.array(state["warmth"])
        self._segments = [
            (own["degc"], Segment(*(np.array(own[name]) for name in PARTS)))
            for own in state["segments"]
            if PARTS[-1] in own  # earlier states have no peaks: their minutes do not count
        ]
        self._begin_segment(bands_of(self._rate_hz).samples if self._rate_hz else 0)
        self._length = state["held"].shape[1]
        self._held[:, : self._length] = state["held"]
        self._zero, self._filled = np.array(state["zero"]), state["filled"]
        self._sound, self._next, self._degrees = state["sound"], state["next"], np.array(state["degrees"])


def _inverse(S: Array) -> Array:
    return np.asarray(np.linalg.inv(S), dtype=np.float64)
