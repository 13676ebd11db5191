"""The watch of a site: takes one day after another, and keeps what is needed to ask which sensor changed, and when.

`update(day)` changes the state, `calib.site_watch.verdicts.result(watch)` reads it. Nothing depends on a clock; the
same days give the same state, and a watch that is loaded from a snapshot goes on as the original.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.site_watch.day import Day, SelfTests, Visits
from calib.site_watch.scatter import LAGS_DAYS, Blocks
from calib.site_watch.steps import HUBER, PRIOR_DEGREES, TERMS, Steps
from calib.site_watch.together import DIRECTIONS, biweight, design, median, scores
from calib.site_watch.witnesses import supply_basis

ORIGIN_DEGC, SCALE_K = 10.0, 10.0  # of the temperature in the norm
FEWEST_LEFT = 5  # degrees of freedom for a channel to state its own variance, or its residual to count
# By which a band of a sensor differs from its norm in a day, beside what its noise does; only ratios of weights depend
# on it. Without it days of little noise would count nine times as much as others that scatter by 1.3 times as much: the
# simulated bridge has 0.0066 to 0.010. docs/site-watch.md says what half and twice of it do.
U_BAND = 0.0075
LEAST_SCATTER = 1e-4  # variance of a channel over U_BAND², however little its days differ
MEMORY_DAYS = 60.0  # of the scatter of days: frost, traffic and wind make it another one in each season
PRIOR_BLOCKS = 30.0  # by which a sensor's own scatter of days is drawn to that of all: its test has no wide tails
FEWEST_SENSORS = 2  # with a band, for its common level to be taken out; of two it is their mean
CHANNELS = 6
LEVELS = slice(3, TERMS)  # of the regressors: the levels of the band and of the site
WEEK_DAYS = 7  # over which the days of a channel depend on each other
U_SELF_TEST = 0.001  # of the log of a response, however little it scatters; only ratios of weights depend on it
U_FREQUENCY = 0.001  # of the peak frequency of a day; only ratios of weights, and the prior, depend on it
U_MEAN_MPS2 = 0.001  # of the mean of a day; only ratios of weights depend on it
# The prior of the coefficients of the mean, in m/s² where steps.PRIOR has log amplitudes, is ten times as wide.
MEAN_PRIOR_SCALE = 0.01
# Of a visit: which sensor, when; whether its sensitivity was suspected; the change that the watch told (0 where it told
# none) and what was found, as logarithms, each with its standard uncertainty.
VISIT = "sensor", "day", "suspected", "size", "u", "found", "u_found"
PRIOR_VISITS = 10.0  # suspicions that are worth what the scatter says of itself


class SiteWatch:
    """Sensors 0 to n - 1 in bands `band_hz`; `gateway` (n,): a number of the gateway of each sensor."""

    def __init__(self, gateway: Array, band_hz: Array) -> None:
        self.gateway, self.band_hz = np.asarray(gateway, dtype=np.int64), np.asarray(band_hz, dtype=float)
        self.shape = len(self.gateway), len(self.band_hz), CHANNELS
        self.day = -1
        self.steps = Steps(int(np.prod(self.shape)))
        self.noise = Steps(self.shape[0] * 3)
        self.means = Steps(self.shape[0] * 3, MEAN_PRIOR_SCALE)
        self.self_tests = Steps(self.shape[0] * 3)
        self.contrasts = Steps(self.shape[0] * 3)
        self.frequencies = Steps(self.shape[0] * self.shape[1] * 3)
        self.frequency_contrasts = Steps(self.shape[0] * self.shape[1] * 3)
        self.u_supply = np.full((self.shape[0], 3), np.nan)  # of the newest self-test
        self.days_scatter = Blocks((self.shape[0], len(DIRECTIONS)), LAGS_DAYS, MEMORY_DAYS, PRIOR_BLOCKS)
        self.band_scatter = Blocks(self.shape, (WEEK_DAYS,), prior_blocks=PRIOR_DEGREES)
        self.noise_scatter = Blocks((self.shape[0], 3))
        self.mean_scatter = Blocks((self.shape[0], 3))
        self.self_test_scatter = Blocks((self.shape[0], 3))
        self.contrast_scatter = Blocks((self.shape[0], 3))
        self.frequency_scatter = Blocks((self.shape[1] * 3, 1))  # of all sensors together
        self.visits = np.zeros((0, len(VISIT)))  # of each visit that taught something
        self.origin = np.full((self.shape[1], 3), np.nan)  # levels of the first day
        self.seen_degc = np.tile([np.inf, -np.inf], (self.shape[0], 1))
        self.degc = np.nan  # of the last day
        self.lag_h = np.zeros(self.shape[0])  # of each clock, on the last day that tells it

    def update(self, day: Day, visits: Visits | None = None) -> None:
        """Take a day. `visits`: sensors whose calibration changed in it; their norm begins anew after it.

        Raises ValueError if the day is not later than the one before.
        """
        if day.number <= self.day:
            raise ValueError(f"day {day.number} comes after day {self.day}")
        visited = np.zeros(self.shape[0], dtype=bool) if visits is None else visits.there
        if visited.any():
            self._restart(visited)
        self.day, self.degc = day.number, day.temperature_degc
        lag_h = np.zeros(self.shape[0]) if day.lag_h is None else day.lag_h
        told = np.isfinite(day.value).any(axis=(1, 2)) | (lag_h != 0.0)
        self.lag_h = np.where(told, lag_h, self.lag_h)
        there = np.isfinite(day.value) & ~visited[:, None, None]
        x = self._regressors(day)
        value = np.where(there, day.value, 0.0)
        weight = np.where(there, 1.0 / (U_BAND**2 + np.square(day.u)), 0.0)
        expected, u2 = self.steps.expected(x)
        residual = value - expected.reshape(self.shape)
        left = self.steps.days.reshape(self.shape) - TERMS
        known = there & (left >= FEWEST_LEFT)
        independent = self.variance() * (1.0 / np.where(there, weight, 1.0) + u2.reshape(self.shape))
        variance = independent * self.band_scatter.today()
        information = np.where(known, 1.0 / variance, 0.0)
        common = _common(residual[..., :3], information[..., :3])
        residual[..., :3] -= common
        value[..., :3] -= common
        z = residual * np.sqrt(information)
        G = design(np.where(left > -TERMS, expected.reshape(self.shape), np.nan), np.nan_to_num(day.level))
        self._scatter(residual / np.sqrt(independent), z, information, G)
        weight *= np.minimum(1.0, HUBER / np.maximum(np.abs(z), 1e-9))
        self.steps.update(day.number, x, value.ravel(), weight.ravel())
        self.days_scatter.remember(self.steps.begins)
        self.band_scatter.remember(self.steps.begins)
        degc = np.full(self.shape[0], day.temperature_degc)
        self._follow(self.noise, self.noise_scatter, day.log_noise, np.ones((self.shape[0], 3)), degc)
        untold = visited[:, None] if day.mean_mps2 is not None else True
        mean = np.where(untold, np.nan, 0.0 if day.mean_mps2 is None else day.mean_mps2)
        u_mean = np.full((self.shape[0], 3), U_MEAN_MPS2)
        self._follow(self.means, self.mean_scatter, np.broadcast_to(mean, u_mean.shape), u_mean, degc)
        contrast = np.full(u_mean.shape, np.nan) if day.contrast is None else day.contrast
        contrast = np.where(visited[:, None], np.nan, contrast)
        levels = x.reshape(TERMS, *self.shape)[LEVELS, ..., :3].mean(axis=2)
        u_contrast = np.full(u_mean.shape, U_BAND)
        self._follow(self.contrasts, self.contrast_scatter, contrast, u_contrast, degc, squared=True, levels=levels)
        self._take_self_tests(day, visited)
        self._take_frequencies(day, x)
        self._seen(there.sum(axis=(1, 2)) > 0)

    def norm_since(self, which: list[int], size: Array) -> tuple[Array, Array]:
        """What the norm without steps of `size` (k, n, B, 6) expects of the days since begins `which`: the channels
        (k, n, B, 6), NaN where no day counts, and the log amplitude of the level (k, n, B, 3)."""
        x, value = self.steps.norm_since(which, size.reshape(len(which), -1))
        away = (x[:, 3] + x[:, 4]).reshape(size.shape)[..., :3]
        return value.reshape(size.shape), np.nan_to_num(self.origin) + away

    def variance(self) -> Array:
        """Variance of the channels (n, B, 6) over what their noise gives.

        A channel's own, drawn to the median of all sensors in its band as by PRIOR_DEGREES days.
        """
        return np.maximum(pooled(*self.steps.rest(), self.shape), LEAST_SCATTER)

    def taught(self) -> float:
        """Factor of the variance of each test, at least 1, from the visits that looked at a suspicion."""
        suspected = self.visits[self.visits[:, VISIT.index("suspected")] > 0.0]
        _, _, _, size, u, found, u_found = suspected.T
        squares = float(np.sum((size - found) ** 2 / (u**2 + u_found**2)))
        return max((PRIOR_VISITS + squares) / (PRIOR_VISITS + len(suspected)), 1.0)

    def snapshot(self) -> dict[str, Any]:
        """All state as plain arrays, in dictionaries."""
        parts = {name: getattr(self, name).snapshot() for name in _PARTS}
        own = {name: np.copy(getattr(self, name)) for name in ("gateway", "band_hz", "day", *_OWN)}
        return {**own, **parts}

    @classmethod
    def loaded(cls, told: dict[str, Any]) -> SiteWatch:
        """The watch of a snapshot."""
        watch = cls(told["gateway"], told["band_hz"])
        watch.day, watch.degc = int(told["day"]), float(told["degc"])
        for name in ("origin", "seen_degc", "visits", "u_supply", "lag_h"):
            setattr(watch, name, told[name].copy())
        for name in _PARTS:
            getattr(watch, name).load(told[name])
        return watch

    def _restart(self, visited: NDArray[np.bool_]) -> None:
        channels = np.broadcast_to(visited[:, None, None], self.shape).ravel()
        self.steps.restart(channels)
        self.means.restart(np.repeat(visited, 3))
        self.self_tests.restart(np.repeat(visited, 3))
        self.contrasts.restart(np.repeat(visited, 3))
        self.seen_degc[visited] = np.inf, -np.inf

    def _regressors(self, day: Day) -> Array:
        """(TERMS, channels): 1, temperature, its square, the level of the band against the site's, the site's level.

        For a cross power the third is the level of its first axis against that of its second.
        """
        fresh = np.isnan(self.origin) & np.isfinite(day.level)
        self.origin[fresh] = day.level[fresh]
        away = day.level - self.origin
        whole = float(np.mean(away[np.isfinite(away)])) if np.isfinite(away).any() else 0.0
        away = np.nan_to_num(away)
        degrees = np.nan_to_num((day.temperature_degc - ORIGIN_DEGC) / SCALE_K)
        x = np.empty((TERMS, *self.shape[1:]))
        x[0], x[1], x[2], x[4] = 1.0, degrees, degrees**2, whole
        x[3] = np.column_stack([away - whole, away[:, [0, 0, 1]] - away[:, [1, 2, 2]]])
        return np.repeat(x[:, None], self.shape[0], axis=1).reshape(TERMS, -1)

    def _scatter(self, alone: Array, z: Array, information: Array, G: Array) -> None:
        """What this day says of the scatter: by channel, `alone` as if days were independent, and by direction."""
        there = information > 0.0
        self.band_scatter.update(alone, there)
        clipped = np.where(there, np.clip(z, -HUBER, HUBER), 0.0) / np.sqrt(np.where(there, information, 1.0))
        score, squares = scores(clipped, information, G)
        known = squares > 0.0
        self.days_scatter.update(score / np.sqrt(np.where(known, squares, 1.0)), known)

    def _take_self_tests(self, day: Day, visited: NDArray[np.bool_]) -> None:
        """Responses are followed along and across what the supply does to them, at the temperature of their night, or
        at that of the site where the device tells none. A night counts where all three axes are told."""
        none = np.full((self.shape[0], 3), np.nan)
        tests = day.self_tests or SelfTests(none, none, none, none[:, 0])
        there = (
            np.isfinite(tests.log_response + tests.u + tests.u_supply).all(axis=1, keepdims=True) & ~visited[:, None]
        )
        self.u_supply = np.where(there, tests.u_supply, self.u_supply)
        basis = supply_basis(self.u_supply)
        response = np.where(there, np.einsum("nij,nj->ni", basis, tests.log_response), np.nan)
        u = np.sqrt(U_SELF_TEST**2 + np.einsum("nij,nj->ni", basis**2, tests.u**2))
        own = tests.temperature_degc
        degc = np.where(np.isfinite(own), own, day.temperature_degc)
        self._follow(self.self_tests, self.self_test_scatter, response, u, degc, squared=True)

    def _take_frequencies(self, day: Day, x: Array) -> None:
        """Peak frequencies are followed as the channels are. A visit does not touch them. `x`: as for the channels."""
        shape = (*self.shape[:2], 3)
        told = np.full(shape, np.nan) if day.frequency is None else day.frequency
        there, steps = np.isfinite(told), self.frequencies
        x = x.reshape(TERMS, *self.shape)[..., :3].reshape(TERMS, -1)
        expected, u2 = steps.expected(x)
        variance = pooled(*steps.rest(), shape) * (U_FREQUENCY**2 + u2.reshape(shape))
        known = there & (steps.days.reshape(shape) - TERMS >= FEWEST_LEFT)
        z = np.where(known, told - expected.reshape(shape), 0.0) / np.sqrt(np.maximum(variance, 1e-18))
        information = np.where(known, 1.0 / np.maximum(variance, 1e-18), 0.0)
        total = information.sum(axis=0)
        score = np.sum(np.sqrt(information) * np.clip(z, -HUBER, HUBER), axis=0) / np.sqrt(
            np.where(total > 0.0, total, 1.0)
        )
        self.frequency_scatter.update(score.reshape(-1, 1), total.reshape(-1, 1) > 0.0)
        weight = there / U_FREQUENCY**2 * np.minimum(1.0, HUBER / np.maximum(np.abs(z), 1e-9))
        steps.update(self.day, x, np.nan_to_num(told).ravel(), weight.ravel())
        self.frequency_scatter.remember(steps.begins)
        none = np.full(shape, np.nan)
        contrast = none if day.frequency_contrast is None else day.frequency_contrast
        degc = np.full(self.shape[0], day.temperature_degc)
        self._follow(self.frequency_contrasts, None, contrast, np.full(shape, U_FREQUENCY), degc, squared=True)

    def _follow(
        self,
        steps: Steps,
        scatter: Blocks | None,
        told: Array,
        u: Array,
        degc: Array,
        *,
        squared: bool = False,
        levels: Array | None = None,
    ) -> None:
        """Noise floors, means, responses and contrasts `told` (n, ...) are followed as the channels are; `u` (n, ...):
        of one of them; `degc` (n,). `squared`: the norm has the square of the temperature too. `levels` (2, n, ...):
        the last two regressors, where the norm has them."""
        value = told.ravel()
        there = np.isfinite(value)
        x = np.zeros((TERMS, len(value)))
        x[0] = 1.0
        x[1] = np.repeat(np.nan_to_num((degc - ORIGIN_DEGC) / SCALE_K), len(value) // len(degc))
        x[2] = x[1] ** 2 if squared else 0.0
        if levels is not None:
            x[LEVELS] = levels.reshape(2, -1)
        u2_told = np.where(there, np.square(u.ravel()), 1.0)
        expected, u2 = steps.expected(x)
        s2 = pooled(*steps.rest(), told.shape).ravel()
        z = (np.nan_to_num(value) - expected) / np.sqrt(np.maximum(s2, 1e-12) * (u2_told + u2))
        known = there & (steps.days - TERMS >= FEWEST_LEFT)
        weight = there / u2_told * np.where(known, np.minimum(1.0, HUBER / np.maximum(np.abs(z), 1e-9)), 1.0)
        steps.update(self.day, x, np.nan_to_num(value), weight)
        if scatter is not None:
            scatter.update(z.reshape(told.shape), known.reshape(told.shape))
            scatter.remember(steps.begins)

    def _seen(self, told: NDArray[np.bool_]) -> None:
        if np.isfinite(self.degc):
            self.seen_degc[told, 0] = np.minimum(self.seen_degc[told, 0], self.degc)
            self.seen_degc[told, 1] = np.maximum(self.seen_degc[told, 1], self.degc)


_OWN = ("origin", "seen_degc", "degc", "visits", "u_supply", "lag_h")
_PARTS = (
    *("steps", "noise", "means", "self_tests", "contrasts", "frequencies", "frequency_contrasts"),
    *("days_scatter", "band_scatter", "noise_scatter", "mean_scatter", "self_test_scatter", "contrast_scatter"),
    "frequency_scatter",
)


def pooled(left: Array, freedom: Array, shape: tuple[int, ...]) -> Array:
    """Variance of each channel from its own days, drawn to the median of all sensors as by PRIOR_DEGREES days."""
    left, freedom = left.reshape(shape), freedom.reshape(shape)
    own = np.where(freedom >= FEWEST_LEFT, left / np.maximum(freedom, 1.0), np.nan)
    middle = np.where(np.isfinite(own).any(axis=0), median(own, axis=0), 1.0)
    return np.asarray((left + PRIOR_DEGREES * middle) / (freedom + PRIOR_DEGREES))


def _common(residual: Array, information: Array) -> Array:
    """What all sensors share in a band and axis on this day (B, 3): a median, then Tukey's biweight."""
    there = information > 0.0
    enough = there.sum(axis=0) >= FEWEST_SENSORS
    common = np.where(enough, median(np.where(there, residual, np.nan), axis=0), 0.0)
    for _ in range(2):
        weight = information * biweight((residual - common) * np.sqrt(information))
        total = weight.sum(axis=0)
        mean = np.sum(weight * residual, axis=0) / np.where(total > 0.0, total, 1.0)
        common = np.where(enough & (total > 0.0), mean, common)
    return common
