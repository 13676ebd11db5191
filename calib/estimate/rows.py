"""The rows of windows: what each one says of the unknowns, in units of its own standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate

import numpy as np

from calib.estimate import physics
from calib.estimate.physics import Stack, Windows
from calib.estimate.quantities import (
    REFERENCE_DRIFT,
    SENSITIVITY_PER_K,
    TEMPERATURE,
    WALK,
    YEAR_DAYS,
    offset_temperature,
)
from calib.estimate.statements import FLAT, Statements
from calib.estimate.unknowns import Unknowns
from calib.model import Array, own_channels
from calib.windows.condense import regressed
from calib.windows.record import TERMS, TOLD, Record
from calib.windows.type_a import LEAST_INFLATION, LEVELS, SUMS, Scattered, scattered

# Of a pool of noise: a window tells half as much of the noise of another one with so many windows between them. Noise
# changes with traffic, weather and the season; 100 windows of ten segments know a variance to 5 %.
HALF_WINDOWS = 100.0


@dataclass(frozen=True, eq=False)
class NoiseScores:
    """How much slopes and means of a window scatter, by it and those near it: `scores` (2, LEVELS, SUMS) of
    calib.windows.type_a, summed.

    Where segments are few, the rest is what a filter makes of white noise.
    """

    scores: Array = field(default_factory=lambda: np.zeros((2, LEVELS, SUMS)))

    @classmethod
    def around(cls, records: Sequence[Record]) -> list[NoiseScores]:
        """That of each of the records, which are in the order of their days."""
        before, after = cls._one_way(records), cls._one_way(records[::-1])[::-1]
        return [cls(a.scores + b.scores - r.scores) for a, b, r in zip(before, after, records, strict=True)]

    @classmethod
    def _one_way(cls, records: Sequence[Record]) -> list[NoiseScores]:
        return list(accumulate(records, cls.pooled, initial=cls()))[1:]

    def pooled(self, record: Record) -> NoiseScores:
        """That of the next record."""
        return NoiseScores(self.scores * 0.5 ** (record.windows / HALF_WINDOWS) + record.scores)

    @cached_property
    def _scattered(self) -> tuple[Scattered | None, Scattered | None]:
        return scattered(self.scores[0]), scattered(self.scores[1])

    @property
    def slopes(self) -> float:
        """Variance of slopes over that of white noise."""
        return _beside_white(self._scattered[0])

    @property
    def means(self) -> float:
        """Variance of means over that of white noise."""
        return _beside_white(self._scattered[1])

    @property
    def degrees_of_freedom(self) -> float:
        """Of the one that is known from less; 0 where none is known."""
        return min((found.degrees_of_freedom for found in self._scattered if found is not None), default=0.0)


def _beside_white(found: Scattered | None) -> float:
    if found is None:
        return 1.0
    return found.share_known * found.variance + 1.0 - found.share_known


@dataclass(frozen=True, slots=True)
class TemperatureSpread:
    """What the temperature of a window that tells none may have been, and does: the lowest and highest one that any
    window had, over that to which S and Q refer, the coefficients (2, 3) of Q, by power, and those (3, 3) of S."""

    ends_k: tuple[float, float]
    coefficients: Array
    of_sensitivity: Array = field(default_factory=lambda: np.zeros((3, 3)))

    @classmethod
    def of(cls, unknowns: Unknowns, seen_degc: tuple[float, float], x: Array) -> TemperatureSpread:
        """For values x (N,) of the unknowns; temperatures `seen_degc`, NaN if no window had one."""
        found, zero = np.zeros((2, 3)), unknowns.statements.temperature.reference_degc
        for power in (1, 2):
            for i, name in enumerate(offset_temperature(power)):
                if (k := unknowns.at.get(name)) is not None:
                    found[power - 1, i] = x[k]
        of_S = np.array([x[unknowns.at[name]] if name in unknowns.at else 0.0 for name in SENSITIVITY_PER_K])
        low, high = (end - zero if np.isfinite(end) else 0.0 for end in seen_degc)
        return cls((low, high), found, of_S.reshape(3, 3))

    def moved(self, told_degc: Array, by_S: Array) -> Array:
        """(W, 6M, n) what the slopes of windows scatter, of which `by_S` (W, 2M, 3, 3) are the derivatives of each axis
        by its row of S; n is 1 where a window had no temperature and S depends on it, else 0."""
        w, m = by_S.shape[:2]
        if told_degc.all() or not self.of_sensitivity.any():
            return np.zeros((w, 3 * m, 0))
        size = float(np.sqrt(np.mean(np.square(self.ends_k))))
        moved = size * np.einsum("wmij,ij->wmi", by_S, self.of_sensitivity)
        return np.asarray(np.where(told_degc[:, None, None], 0.0, moved).reshape(w, 3 * m, 1))

    @property
    def covariance(self) -> Array:
        """(3, 3) of the mean output: one end of the range or the other."""
        found = np.zeros((3, 3))
        for above in self.ends_k:
            moved = np.array([above, above**2]) @ self.coefficients
            found += 0.5 * np.outer(moved, moved)
        return found


TYPE_A, OFFSETS, LAGS = "type A", "offset between windows", "lag between windows"
BESIDE = "transverse motion between windows"
CORRECTION, UNSEEN = "correction for the reference's noise", "directions without motion"


class Rows:
    """The rows of W records as functions of the unknowns. `epoch_day` (W,) is the day of the epoch of each, `noise`
    (W) its noise."""

    def __init__(
        self,
        unknowns: Unknowns,
        records: Sequence[Record],
        epoch_day: Array,
        noise: Sequence[NoiseScores],
        spread: TemperatureSpread,
    ) -> None:
        s, by = unknowns.statements, dict[tuple[int, int, float, float, float, bool], list[int]]()
        for w, r in enumerate(records):
            p = s.of(r.reference)
            key = r.channels, len(r.means), p.reference_frequency_hz, p.reference_share, p.known_size, p.response > 0.0
            by.setdefault(key, []).append(w)
        self._count, self._groups = len(records), list[_Group]()
        for (_, _, hz, share, size, told), at in by.items():
            own = [records[w] for w in at]
            stack = Stack.of(own, fixed=s.held_mps2 is not None)
            degc, nominal, held = s.temperature.reference_degc, s.nominal, s.held_mps2
            windows = Windows(stack, degc, nominal, held, at_hz=hz, share=share, known_size=size)
            pairs = [unknowns.effect(records[w], float(epoch_day[w])) for w in at]
            effect, taken_out = np.array([e for e, _ in pairs]), np.array([a for _, a in pairs])
            near = [noise[w] for w in at]
            slopes = _Slopes(own, windows, unknowns, near, spread)
            means = _Means(own, windows, unknowns, near, spread)
            by_bands = _response_information(own) if told else None
            self._groups.append(_Group(at, windows, effect, taken_out, slopes, means, by_bands))

    def at(self, x: Array, around: Array) -> list[Array]:
        """Rows (r, N + 1) [derivatives | observed less predicted] of each record at the values x (W, N); the
        derivatives are those at the values `around` (W, N).

        They must not follow a random walk. S_k / (1 + r) with derivatives at each S_k of its own tells r falsely: a
        smaller r makes all steps of the walk smaller. (The largest posterior density is biased: main S by -4.3 to -7.5
        u in ten years of simulated windows.)
        """
        found = [np.zeros((0, 0))] * self._count
        for group in self._groups:
            for w, rows in zip(group.at, group.rows(x[group.at], around[group.at]), strict=True):
                found[w] = rows
        return found

    def shares(self, gains: Sequence[Array]) -> dict[str, Array]:
        """By source, what it adds to the variances of m quantities that move by `gains` (r, m) with the rows of each
        record. Their sum over the sources is the sum of the squares of all gains."""
        found: dict[str, Array] = {}
        for group in self._groups:
            for source, variance in group.shares(np.array([gains[w] for w in group.at])).items():
                found[source] = found.get(source, 0.0) + variance
        return found


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    at: list[int]
    windows: Windows
    effect: Array
    taken_out: Array
    slopes: _Slopes
    means: _Means
    told: Array | None

    def rows(self, x: Array, around: Array) -> Array:
        p, near = ((self.effect @ (values - self.taken_out)[..., None])[..., 0] for values in (x, around))
        live = np.flatnonzero(self.effect.any(axis=(0, 2)))
        slope, mean, d_slope, d_mean = self.windows.linear(p, near, live)
        on = self.effect[:, live]
        parts = [
            self.slopes.weights @ np.concatenate([d_slope @ on, slope[..., None]], axis=2),
            self.means.weights @ np.concatenate([d_mean @ on, mean[..., None]], axis=2),
        ]
        if self.told is not None:
            moves, left = self.told[..., :-1], self.told[..., -1:]
            left = left - moves @ p[:, physics.RESPONSE, None]
            parts.append(np.concatenate([moves @ self.effect[:, physics.RESPONSE], left], axis=2))
        return np.concatenate(parts, axis=1)

    def shares(self, gains: Array) -> dict[str, Array]:
        slopes, means = self.slopes.weights.shape[1], self.means.weights.shape[1]
        of_slopes, of_means, of_told = np.split(gains, [slopes, slopes + means], axis=1)
        found = self.slopes.shares(of_slopes)
        for source, variance in self.means.shares(of_means).items():
            found[source] = found.get(source, 0.0) + variance
        found[TYPE_A] = found[TYPE_A] + (of_told**2).sum(axis=(0, 1))
        return found


def _response_information(records: Sequence[Record]) -> Array:
    """(W, TOLD, TERMS + 1) what the bands of each record tell of the response."""
    found = np.zeros((len(records), TOLD, TERMS + 1))
    for own, record in zip(found, records, strict=True):
        own[: len(record.told)] = record.told
    return found


class _Slopes:
    """By what the slopes of W windows are multiplied, so that their covariance is one: `weights` (W, 6M, 6M).

    The covariance of the slopes of a window, in units of the noise of a point, is the sum of these; `_inverse` adds
    them up, and `shares` gives each its source in the budget. Of n merged windows, T days from the first to the last:

        attribute   source in the budget                  covariance
        _white      type A                                w I: variance over that of white noise, by near windows
        _loaded 0   lag between windows                   l l' u(lag)^2 / n: l = derivatives by a lag
        _bent       lag between windows                   b b' / n: b = what is open of the lag within a window
        _loaded 1   correction for the reference's noise  s s' a^2 / n: s = the slopes; a = u of the correction
        _missed     directions without motion             diag(d^2 u(S)^2): d = what moved a little along them
        _spread     temperature                           c c' (range of temperature)^2, of a window that tells none
        _beside     transverse motion between windows     b b' u(transverse)^2 / n, beside one axis at a fixed mount
        _walked     walks and steps of S and Q            m m' (walk of S a day)^2 T / 12, each output by itself
        _drifted    reference drift                       r r' (drift in a year)^2 T / (12 YEAR_DAYS), by channel
    """

    def __init__(
        self,
        records: Sequence[Record],
        windows: Windows,
        unknowns: Unknowns,
        noise: Sequence[NoiseScores],
        spread: TemperatureSpread,
    ) -> None:
        s, n, own = unknowns.statements, 6 * windows.channels, windows.stack
        merged, self._stretch = _merged(records)
        priors = [s.of(r.reference) for r in records]
        u_lag_s = [max(p.lag_window_s, r.u_lag_s) * (p.lag_s > 0.0) for p, r in zip(priors, records, strict=True)]
        u = np.array([u_lag_s, [r.attenuation for r in records]]).T / np.sqrt(merged)[:, None]
        self._loaded = np.array([r.loadings for r in records]).mT * u[:, None]
        self._bent = _alike([r.by_bend for r in records]).mT / np.sqrt(merged)[:, None, None]
        self._white = _white([own.slopes for own in noise], records)
        # What nobody knows of S along directions that were not excited, by the little that moved there.
        unknown = np.minimum(s.u[:9], FLAT * s.scale).reshape(3, 3)
        silent = windows.moved @ (np.eye(3) - own.excited)
        self._missed = (np.sqrt(silent**2 @ unknown.T**2) / own.noise[:, None]).reshape(len(records), n)
        walks = np.sqrt(unknowns.a_day[[0, 4, 8]])
        by_S = windows.moved[:, :, None, :] / own.noise[:, None, :, None]
        self._spread = spread.moved(windows.told_degc, by_S)
        self._walked = windows.moved[:, :, None, :] * walks[:, None] / own.noise[:, None, :, None]
        drifted = np.sqrt(self._stretch / YEAR_DAYS) * [p.of(REFERENCE_DRIFT.prior) for p in priors]
        self._beside = _beside_one_axis(windows, s, np.array([p.transverse for p in priors]) / np.sqrt(merged))
        by_channel = _by_channel(windows).reshape(len(records), n, own_channels(windows.channels))
        self._drifted = by_channel * drifted[:, None, None]
        self._noise = np.tile(own.noise, n // 3)
        self.weights = self._inverse() / self._noise[:, None] if n else np.zeros((len(records), 0, 0))

    def _inverse(self) -> Array:
        """(W, 6M, 6M) that of the root of the covariance, in units of the noise of a point."""
        one = np.eye(self._missed.shape[1])
        covariance = self._white[:, None, None] * one + self._missed[..., None] ** 2 * one
        for scatter in (self._loaded, self._bent, self._spread, self._beside):
            covariance = covariance + scatter @ scatter.mT
        if self._stretch.any():
            for i in range(3):
                each = self._walked[:, :, i]
                covariance[:, i::3, i::3] += self._stretch[:, None, None] * (each @ each.mT)
            covariance = covariance + self._drifted @ self._drifted.mT
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))

    def shares(self, gains: Array) -> dict[str, Array]:
        """By source, of the variances of m quantities that move by `gains` (W, 6M, m) with the weighted slopes."""
        moved = (self.weights.mT @ gains) * self._noise[..., None]
        by_load, by_bend = (self._loaded.mT @ moved) ** 2, ((self._bent.mT @ moved) ** 2).sum(axis=(0, 1))
        by_walk = sum(((self._walked[:, :, i].mT @ moved[:, i::3]) ** 2).sum(axis=1) for i in range(3))
        shares = {
            TYPE_A: np.einsum("w,wrm->m", self._white, moved**2), LAGS: by_load[:, 0].sum(axis=0) + by_bend,
            CORRECTION: by_load[:, 1].sum(axis=0), UNSEEN: ((self._missed[..., None] * moved) ** 2).sum(axis=(0, 1)),
            WALK: self._stretch @ by_walk, REFERENCE_DRIFT.source: ((self._drifted.mT @ moved) ** 2).sum(axis=(0, 1)),
        }  # fmt: skip
        if self._beside.size:
            shares[BESIDE] = ((self._beside.mT @ moved) ** 2).sum(axis=(0, 1))
        by_spread = ((self._spread.mT @ moved) ** 2).sum(axis=(0, 1))
        return shares | ({TEMPERATURE: by_spread} if self._spread.size else {})


def _alike(rows: Sequence[Array]) -> Array:
    """(W, k, n) rows (at most k, n) of each of W windows, with rows of zeros behind."""
    found = np.zeros((len(rows), max(map(len, rows), default=0), rows[0].shape[1] if rows else 0))
    for own, told in zip(found, rows, strict=True):
        own[: len(told)] = told
    return found


def _beside_one_axis(windows: Windows, s: Statements, u: Array) -> Array:
    """(W, 6M, n) what the slopes of windows scatter by motion across that of a uniaxial reference, over it `u` (W,).

    At a fixed mount it is the structure that moves, by wind and traffic: another way in each window, in phase with what
    the reference measures and 90 deg ahead. n is 0 for a mount that turns: what moves it there is one thing, and so is
    its motion across (calib.estimate.terms). S across the motion is as nobody knows it.
    """
    own, w, m = windows.stack, len(u), windows.channels
    if windows.away is None or own_channels(m) != 1:
        return np.zeros((w, 6 * m, 0))
    in_phase = np.concatenate([own.along[:, 0], own.along_rate_s[:, 0]], axis=1)
    ahead = np.eye(1, 2 * m, m) * windows.per_omega[:, None]
    across = np.linalg.svd(own.direction[:, :, :1])[0][:, :, 1:]
    unknown = np.minimum(s.u[:9], FLAT * s.scale).reshape(3, 3)
    alike = s.nominal @ across
    each = np.sqrt(unknown**2 @ across**2)[:, :, None] * np.eye(3)[:, :, None]
    by_output = np.concatenate([alike, each.reshape(w, 3, 6)], axis=2) / own.noise[..., None]
    found = []
    for motion in (in_phase, ahead):
        moved = (own.root @ motion[..., None]) * u[:, None, None]
        found.append((moved[:, :, None] * by_output[:, None]).reshape(w, 6 * m, 8))
    return np.concatenate(found, axis=2)


def _by_channel(windows: Windows) -> Array:
    """(W, 2M, 3, C) derivatives of the slopes, whitened by the noise, by the size of each channel of the reference."""
    own, m = windows.stack, windows.channels
    b = regressed(own.root, own.slopes)[:, :m] / own.noise[:, None]
    channels = np.resize(np.eye(own_channels(m)), (m, own_channels(m)))  # integrals have the size of their own channel
    return np.asarray(np.einsum("wrm,mc,wmi->wric", own.root[..., :m], channels, b))


class _Means:
    """By what the means of W windows are multiplied, so that their covariance is one: `weights` (W, 3k, 3k); 0 where
    nobody stated gravity.

    The covariance of a row of means is the sum of these, in output units; attribute, source in the budget, covariance
    of n merged windows in T days:

        _white      type A                                noise^2 w n / points, diagonal
        _between    offset between windows                (u(offset between windows) scale)^2, diagonal
        _walked     walks and steps of S and Q            (walk of Q a day + that of S times gravity) n T / 12, diagonal
        _spread     temperature                           of Q at the ends of the range, where none is told
    """

    def __init__(
        self,
        records: Sequence[Record],
        windows: Windows,
        unknowns: Unknowns,
        noise: Sequence[NoiseScores],
        spread: TemperatureSpread,
    ) -> None:
        s, k = unknowns.statements, windows.stack.means.shape[1]
        merged, stretch = _merged(records)
        self._white = _white([own.means for own in noise], records)[:, None] * windows.stack.noise**2
        self._white *= (merged / np.array([r.count for r in records]))[:, None]
        between = np.array([(s.of(r.reference).offset_mps2 * s.scale) ** 2 for r in records])
        self._between = between[:, None] + np.zeros(3)
        walked = unknowns.a_day[9:] + np.outer(np.linalg.norm(windows.gravity, axis=1) ** 2, unknowns.a_day[[0, 4, 8]])
        self._walked = (stretch * merged)[:, None] * walked
        self._spread = np.where(windows.told_degc[:, None, None], 0.0, spread.covariance)
        covariance = (self._white + (self._between + self._walked))[..., None] * np.eye(3)
        covariance = covariance + self._spread
        inverse = np.linalg.inv(np.linalg.cholesky(covariance))
        inverse = np.where(windows.known[:, None, None], inverse, 0.0)
        self.weights = np.einsum("ab,wij->waibj", np.eye(k), inverse).reshape(len(records), 3 * k, 3 * k)

    def shares(self, gains: Array) -> dict[str, Array]:
        """By source, of the variances of m quantities that move by `gains` (W, 3k, m) with the weighted means."""
        moved = (self.weights.mT @ gains).reshape(len(gains), -1, 3, gains.shape[2])
        square = (moved**2).sum(axis=1)
        found = {TYPE_A: self._white, OFFSETS: self._between, WALK: self._walked}
        shares = {source: np.einsum("wi,wim->m", variance, square) for source, variance in found.items()}
        return shares | {TEMPERATURE: np.einsum("wkim,wij,wkjm->m", moved, self._spread, moved)}


def _white(ratios: Sequence[float], records: Sequence[Record]) -> Array:
    """(W,) variance over that of white noise of the points that filters leave independent."""
    return np.asarray(np.maximum(np.array(ratios) / [r.independent for r in records], LEAST_INFLATION))


def _merged(records: Sequence[Record]) -> tuple[Array, Array]:
    """(W,) how many windows each record holds, and for how many days a random walk gains the variance by which its mean
    over their stretch differs from its middle: a twelfth of the stretch."""
    merged = np.array([float(r.windows) for r in records])
    return merged, np.array([r.days[1] - r.days[0] for r in records]) / 12.0
