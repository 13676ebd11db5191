"""Corrected acceleration a = S^-1 (V - Q) (Eq. 8 solved for a) with its uncertainty; S and Q may depend on temperature.

The covariance due to the calibration is S^-1 J Sigma J' S^-T, with J = [a' (x) I, I] and the full covariance Sigma of
[S, Q]. The correlations matter: at rest the diagonal of Sigma alone would give 63 mm/s2 where 1 mm/s2 is right. The
noise of single samples is stated separately.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from calib.estimate.determined import Flags
from calib.model import Array, Calibration


@dataclass(frozen=True, slots=True, eq=False)
class Law:
    """S and Q as functions of the temperature T, with their joint covariance.

    Q(T) = Q + sum_k c_k (T - T0)^k; S(T) = S + C (T - T0); T0 = `reference_degc`. `mean` is [S row by row, Q, c_1 (3),
    .. c_K (3), C (9) if `varies`], `covariance` its covariance, K = `order`. The data cover the range from `low_degc`
    to `high_degc` (NaN if there are none). Outside it, `u_beyond` (output unit per K2) times the squared distance
    from it is combined with u(Q), for a power that the data cannot show. `determined` (12,) as in
    calib.model.Calibration.
    """

    mean: Array
    covariance: Array
    order: int = 0
    varies: bool = False
    reference_degc: float = 20.0
    low_degc: float = np.nan
    high_degc: float = np.nan
    u_beyond: float = 0.0
    determined: Flags = field(default_factory=lambda: np.ones(12, dtype=bool))

    def aged(self, variance: Array) -> Law:
        """The law where S and Q may have changed since, independently, by so much (12,)."""
        covariance = self.covariance.copy()
        covariance[range(12), range(12)] += variance
        return replace(self, covariance=covariance)

    def difference(self, degc: float, other_degc: float) -> Array:
        """Derivative (12, n) of what S and Q are more at one temperature than at another, with respect to `mean`."""
        return self._map(degc)[0] - self._map(other_degc)[0]

    def at(self, degc: float) -> Calibration:
        """S and Q at a temperature in deg C. If it is NaN (not known), S and Q at the reference temperature, with an
        uncertainty that covers the range of the data."""
        if np.isnan(degc):
            return self._anywhere()
        map_, base = self._map(degc)
        covariance = map_ @ self.covariance @ map_.T
        beyond = max(self.low_degc - degc, degc - self.high_degc, 0.0)
        if np.isfinite(beyond):
            covariance[range(9, 12), range(9, 12)] += (self.u_beyond * beyond**2) ** 2
        return self._calibration(base, covariance)

    def _anywhere(self) -> Calibration:
        """S and Q at the reference temperature; the temperature is either end of the range with equal probability."""
        map_, base = self._map(self.reference_degc)
        covariance = map_ @ self.covariance @ map_.T
        if np.isfinite(self.low_degc):
            ends = [self._map(degc) for degc in (self.low_degc, self.high_degc)]
            parts = [m @ self.covariance @ m.T + np.outer(value - base, value - base) for m, value in ends]
            covariance = np.mean(parts, axis=0)
        return self._calibration(base, covariance)

    def _calibration(self, base: Array, covariance: Array) -> Calibration:
        return Calibration(base[:9].reshape(3, 3), base[9:], covariance, self.determined, np.inf, "corrected")

    def _map(self, degc: float) -> tuple[Array, Array]:
        """Derivative (12, n) of S and Q at this temperature with respect to `mean` (n,), and their values (12,)."""
        above = degc - self.reference_degc
        map_ = np.zeros((12, len(self.mean)))
        map_[range(12), range(12)] = 1.0
        value = self.mean[:12].copy()
        for k in range(self.order):
            at = 12 + 3 * k + np.arange(3)
            map_[range(9, 12), at] = above ** (k + 1)
            value[9:] += self.mean[at] * above ** (k + 1)
        if self.varies:
            at = 12 + 3 * self.order + np.arange(9)
            map_[range(9), at] = above
            value[:9] += self.mean[at] * above
        return map_, value


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """Corrected accelerations (N, 3) in m/s2.

    `covariance` (3, 3) in m2/s4 is the part of the calibration, at the mean acceleration; `noise` (3,) in m/s2 is the
    SD of a single sample.
    """

    acceleration: Array
    covariance: Array
    noise: Array


def corrected(indications: Array, calibration: Calibration, residual_sd: Array) -> Corrected:
    """Corrected accelerations from indications (N, 3) in output unit: a = S^-1 (V - Q).

    `residual_sd` (3,) is the SD of the noise of a single sample, in output unit. Raises numpy.linalg.LinAlgError if S
    has no inverse.
    """
    inverse = np.linalg.inv(calibration.sensitivity)
    acceleration = (indications - calibration.offset) @ inverse.T
    covariance = calibration_part(np.nanmean(acceleration, axis=0), calibration)
    noise = np.sqrt((inverse**2) @ residual_sd**2)
    return Corrected(acceleration, covariance, noise)


def between(law: Law, degc: float, other_degc: float, acceleration: Array) -> Array:
    """Covariance (3, 3) in m2/s4 of the difference of a corrected acceleration (3,) at two temperatures, due to the
    uncertainty of the dependence on temperature; 0 where one of them is not known."""
    if not np.isfinite(degc) or not np.isfinite(other_degc):
        return np.zeros((3, 3))
    through = _through(acceleration, law.at(degc)) @ law.difference(degc, other_degc)
    return np.asarray(through @ law.covariance @ through.T)


def calibration_part(acceleration: Array, calibration: Calibration) -> Array:
    """Covariance (3, 3) in m2/s4 of one corrected acceleration (3,) due to the uncertainty of S and Q."""
    through = _through(acceleration, calibration)
    return np.asarray(through @ calibration.covariance @ through.T)


def _through(acceleration: Array, calibration: Calibration) -> Array:
    """(3, 12) by how much a corrected acceleration is larger, for what S and Q are larger, but for the sign."""
    J = np.zeros((3, 12))
    for i in range(3):
        J[i, 3 * i : 3 * i + 3] = acceleration
        J[i, 9 + i] = 1.0
    return np.asarray(np.linalg.inv(calibration.sensitivity) @ J)
