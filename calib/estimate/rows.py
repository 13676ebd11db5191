"""The rows of windows: what each one says of the unknowns, in units of its own standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.estimate import physics
from calib.estimate.physics import Windows
from calib.estimate.quantities import offset_temperature
from calib.estimate.record import TOLD, Record
from calib.estimate.statements import FLAT
from calib.estimate.type_a import LEAST_INFLATION
from calib.estimate.unknowns import Unknowns
from calib.model import Array

TYPE_A, OFFSETS, LAGS = "type A", "offset between windows", "lag between windows"
CORRECTION, UNSEEN = "correction for the reference's noise", "directions without motion"


@dataclass(frozen=True, slots=True)
class Noise:
    """Variance of slopes and of means over that of white noise, pooled over windows by their degrees of freedom."""

    slopes: float = 1.0
    means: float = 1.0
    degrees_of_freedom: float = 0.0

    @classmethod
    def of(cls, records: Sequence[Record]) -> Noise:
        """That of all records: their order does not matter."""
        found = cls()
        for record in records:
            found = found.pooled(record)
        return found

    def pooled(self, record: Record) -> Noise:
        """With one more record."""
        total = self.degrees_of_freedom + record.freedom
        if total <= 0.0:
            return self
        share = record.freedom / total
        slopes, means = (
            (1.0 - share) * mine + share * its
            for mine, its in zip((self.slopes, self.means), record.ratio.tolist(), strict=True)
        )
        return Noise(slopes, means, total)


@dataclass(frozen=True, slots=True)
class Degrees:
    """What a window without a temperature may have had: the lowest and highest temperature that any had, over the one
    to which S and Q refer, and the coefficients (2, 3) of Q, by power."""

    ends_k: tuple[float, float]
    coefficients: Array

    @classmethod
    def of(cls, unknowns: Unknowns, seen_degc: tuple[float, float], x: Array) -> Degrees:
        """For values x (N,) of the unknowns; temperatures `seen_degc`, NaN if no window had one."""
        found, zero = np.zeros((2, 3)), unknowns.statements.temperature.reference_degc
        for power in (1, 2):
            for i, name in enumerate(offset_temperature(power)):
                if (k := unknowns.at.get(name)) is not None:
                    found[power - 1, i] = x[k]
        low, high = (end - zero if np.isfinite(end) else 0.0 for end in seen_degc)
        return cls((low, high), found)

    @property
    def covariance(self) -> Array:
        """(3, 3) of the mean output: one end of the range or the other."""
        found = np.zeros((3, 3))
        for above in self.ends_k:
            moved = np.array([above, above**2]) @ self.coefficients
            found += 0.5 * np.outer(moved, moved)
        return found


class Rows:
    """The rows of records as functions of the unknowns. `epoch_day` (W,) is the day of the epoch of each."""

    def __init__(
        self, unknowns: Unknowns, records: Sequence[Record], epoch_day: Array, noise: Noise, degrees: Degrees
    ) -> None:
        s, by = unknowns.statements, dict[tuple[int, int, float, float, float, bool], list[int]]()
        for w, r in enumerate(records):
            p = s.of(r.reference)
            key = r.channels, len(r.means), p.reference_frequency_hz, p.reference_share, p.known_size, p.response > 0.0
            by.setdefault(key, []).append(w)
        self._count, self._groups = len(records), list[_Group]()
        for (_, _, hz, share, size, told), at in by.items():
            own = [records[w] for w in at]
            windows = Windows(own, s.temperature.reference_degc, s.mount, hz, share, size)
            pairs = [unknowns.effect(records[w], float(epoch_day[w])) for w in at]
            effect, taken_out = np.array([e for e, _ in pairs]), np.array([a for _, a in pairs])
            weights = Weights(windows, unknowns, noise, degrees)
            self._groups.append(_Group(at, windows, effect, taken_out, weights, told))

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

    def sources(self) -> list[dict[str, Array]]:
        """For each record, by source, factors (r, c) of what the source has in the unit covariance of the rows."""
        found: list[dict[str, Array]] = [{}] * self._count
        for group in self._groups:
            for k, w in enumerate(group.at):
                found[w] = group.sources(k)
        return found

    def slopes(self, rows: Sequence[Array]) -> list[Array]:
        """Of the rows of each record, those of its slopes."""
        size = {w: group.windows.slopes.shape[1] * 3 for group in self._groups for w in group.at}
        return [own[: size[w]] for w, own in enumerate(rows)]


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    at: list[int]
    windows: Windows
    effect: Array
    taken_out: Array
    weights: Weights
    told: bool

    def rows(self, x: Array, around: Array) -> Array:
        p, near = ((self.effect @ (values - self.taken_out)[..., None])[..., 0] for values in (x, around))
        live = np.flatnonzero(self.effect.any(axis=(0, 2)))
        slope, mean, d_slope, d_mean = self.windows.linear(p, near, live)
        on = self.effect[:, live]
        parts = [
            self.weights.slope @ np.concatenate([d_slope @ on, slope[..., None]], axis=2),
            self.weights.mean @ np.concatenate([d_mean @ on, mean[..., None]], axis=2),
        ]
        if self.told:
            moves, left = self.windows.told[..., :-1], self.windows.told[..., -1:]
            left = left - moves @ p[:, physics.RESPONSE, None]
            parts.append(np.concatenate([moves @ self.effect[:, physics.RESPONSE], left], axis=2))
        return np.concatenate(parts, axis=1)

    def sources(self, k: int) -> dict[str, Array]:
        own, told = self.weights, TOLD if self.told else 0
        above, below = own.slope.shape[1], own.mean.shape[1]
        total = above + below + told

        def wide(slopes: Array, means: Array, rest: Array) -> Array:
            parts = np.zeros((total, slopes.shape[1] + means.shape[1] + rest.shape[1]))
            at, stop = 0, 0
            for first, part in ((0, slopes), (above, means), (above + below, rest)):
                stop = at + part.shape[1]
                parts[first : first + len(part), at:stop] = part
                at = stop
            return parts

        none = np.zeros((0, 0))
        return {
            TYPE_A: wide(own.white[k], own.white_mean[k], np.eye(told)),
            OFFSETS: wide(none, own.between_mean[k], none),
            LAGS: wide(own.loaded[k][:, :1], none, none),
            CORRECTION: wide(own.loaded[k][:, 1:], none, none),
            UNSEEN: wide(own.missed[k], none, none),
        }


class Weights:
    """By what the rows of W windows are multiplied, so that their covariance is one: `slope` (W, 6M, 6M), `mean`
    (W, 3k, 3k). Of this unit covariance, factors of the parts: `white`, `loaded` (lag and correction) and `missed` of
    the slopes, `white_mean` and `between_mean` of the means."""

    def __init__(self, windows: Windows, unknowns: Unknowns, noise: Noise, degrees: Degrees) -> None:
        s, records, n = unknowns.statements, windows.records, 3 * windows.slopes.shape[1]
        priors = [s.of(r.reference) for r in records]
        self._a_day = np.array([unknown.a_day for unknown in unknowns.all[:12]])
        independent = np.array([r.independent for r in records])
        merged = np.array([float(r.windows) for r in records])
        # The mean of a random walk over a merged stretch differs from its middle by a twelfth of its variance.
        stretch = np.array([r.days[1] - r.days[0] for r in records]) / 12.0
        self._slopes(windows, unknowns, noise, independent, merged, stretch, n)
        white = np.maximum(noise.means / independent, LEAST_INFLATION)[:, None] * windows.noise**2
        white *= (merged / np.array([r.count for r in records]))[:, None]
        between = np.array([(p.offset_mps2 * s.scale) ** 2 for p in priors])[:, None] + np.zeros(3)
        walked = self._a_day[9:] + np.outer(windows.magnitude**2, self._a_day[[0, 4, 8]])
        between = between + (stretch * merged)[:, None] * walked
        covariance = (white + between)[..., None] * np.eye(3)
        covariance = covariance + np.where(windows.told_degc[:, None, None], 0.0, degrees.covariance)
        inverse = np.linalg.inv(np.linalg.cholesky(covariance))
        inverse = np.where(windows.known[:, None, None], inverse, 0.0)
        k = windows.means.shape[1]
        self.mean, self.white_mean, self.between_mean = (
            np.einsum("ab,wij->waibj", np.eye(k), inverse @ part).reshape(len(records), 3 * k, -1)
            for part in (
                np.tile(np.eye(3), (len(records), 1, 1)), np.sqrt(white)[..., None] * np.eye(3),
                _root(covariance - white[..., None] * np.eye(3)),
            )
        )  # fmt: skip

    def _slopes(
        self, windows: Windows, unknowns: Unknowns, noise: Noise, independent: Array, merged: Array, stretch: Array,
        n: int,
    ) -> None:  # fmt: skip
        s, records = unknowns.statements, windows.records
        if not n:
            empty = np.zeros((len(records), 0, 0))
            self.slope = self.white = self.missed = empty
            self.loaded = np.zeros((len(records), 0, 2))
            return
        priors = [s.of(r.reference) for r in records]
        u_lag_s = [max(p.lag_window_s, r.u_lag_s) * (p.lag_s > 0.0) for p, r in zip(priors, records, strict=True)]
        u = np.array([u_lag_s, [r.attenuation for r in records]]).T / np.sqrt(merged)[:, None]
        loaded = np.array([r.loadings for r in records]).mT * u[:, None]
        white = np.maximum(noise.slopes / independent, LEAST_INFLATION)
        # What nobody knows of S along directions that were not excited, by the little that moved there.
        unknown = np.minimum(s.u[:9], FLAT * s.scale).reshape(3, 3)
        silent = windows.moved @ (np.eye(3) - windows.excited)
        missed = np.sqrt(silent**2 @ unknown.T**2) / windows.noise[:, None]
        missed = missed.reshape(len(records), n)
        covariance = white[:, None, None] * np.eye(n) + missed[..., None] ** 2 * np.eye(n) + loaded @ loaded.mT
        if stretch.any():
            walks = np.sqrt(self._a_day[[0, 4, 8]])
            each = windows.moved[:, :, None, :] * walks[:, None] / windows.noise[:, None, :, None]
            for i in range(3):
                covariance[:, i::3, i::3] += stretch[:, None, None] * (each[:, :, i] @ each[:, :, i].mT)
        inverse = np.linalg.inv(np.linalg.cholesky(covariance))
        self.white, self.loaded = inverse * np.sqrt(white)[:, None, None], inverse @ loaded
        self.missed = _root(inverse @ (covariance - white[:, None, None] * np.eye(n) - loaded @ loaded.mT) @ inverse.mT)
        self.slope = inverse / np.tile(windows.noise, n // 3)[:, None]


def _root(covariance: Array) -> Array:
    """Factors (W, n, n) of positive semidefinite matrices (W, n, n)."""
    values, ways = np.linalg.eigh(covariance)
    return np.asarray(ways * np.sqrt(np.maximum(values, 0.0))[:, None])
