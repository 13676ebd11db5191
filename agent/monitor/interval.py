"""When to look again: the interval of recalibration from the history of a sensor or reference, by a control chart.

ILAC-G24 / OIML D 10:2022, method 2 (control chart): the results of successive calibrations are plotted over time, and
from their drift and their spread follows the time in which the instrument stays within the limit. Here

    y_i = a + b (t_i - t_n) + e_i,  u(e_i) = u_i,

is fitted by weighted least squares. If the residuals are greater than the u_i say (Birge ratio R > 1), the instrument
also changes at random between two calibrations: s^2 = (R^2 - 1) mean(u_i^2), and u(b) is multiplied by R. The interval
T is the longest one for which

    |b| T + K sqrt((u(b) T)^2 + s^2) <= limit.

Peers are instruments of the same kind. What their squared drifts have beyond their u(b) tells tau^2, the variance of
the drift of an instrument of this kind (method of moments, mean 0; here its upper limit of 95 %). N(0, tau^2) is the
prior of b, so that a short history neither promises much nor alarms. An instrument whose drift contradicts this prior
is unlike its peers: then its own history alone counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

K = 1.645  # one-sided 95 %: the change exceeds the limit with a probability of 5 % at most
POINTS_MIN = 4  # a line has two unknowns, and their spread wants at least two more points
PEERS_MIN = 3
UNLIKE = 2.0  # a drift of so many of its standard uncertainties, that of the peers included, contradicts the peers
# The interval is at most this many times the time that was observed: beyond, a straight line is a mere hope.
LONGEST_IN_HISTORY = 2.0
LARGEST = 1e100  # of a number in its unit, and of its inverse: squares of greater ones are not finite
DAY_NS = 86_400_000_000_000

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trend:
    """The line through a history. `rate`, `u_rate` in units a day; `random`: SD of random changes; `span_days`."""

    rate: float
    u_rate: float
    random: float
    points: int
    span_days: float


@dataclass(frozen=True, slots=True)
class Advice:
    """`interval_days`: None where the history does not tell; 0 where random changes alone exceed the limit."""

    interval_days: float | None
    reason: str


def daily(t_utc_ns: Sequence[int]) -> list[int]:
    """Positions of the last calibration of each day (UTC): those of one day share their data, and count once."""
    last = {t // DAY_NS: k for k, t in enumerate(t_utc_ns)}
    return [last[day] for day in sorted(last)]


def trend(t_days: Array, values: Array, u: Array) -> Trend | None:
    """The weighted line through values (n,) with standard uncertainties u (n,) > 0 at the times t_days (n,).

    None where there are fewer than POINTS_MIN points, or all at one time, or the numbers are beyond any instrument.
    """
    n = len(t_days)
    if n < POINTS_MIN or not np.ptp(t_days) > 0:
        return None
    with np.errstate(all="ignore"):
        weights = 1.0 / u**2
        total = np.sum(weights)
        centre, mean = np.sum(weights * t_days) / total, np.sum(weights * values) / total
        leverage = np.sum(weights * (t_days - centre) ** 2)
        rate = np.sum(weights * (t_days - centre) * (values - mean)) / leverage
        residuals = values - mean - rate * (t_days - centre)
        birge = np.sqrt(np.sum(weights * residuals**2) / (n - 2))
        birge = np.where(birge < 1.0, 1.0, birge)  # which keeps NaN
        found = np.array([rate, birge / np.sqrt(leverage), np.sqrt((birge**2 - 1.0) * np.mean(u**2))])
    if not (np.all(np.abs(found) < LARGEST) and found[1] > 1.0 / LARGEST):
        return None
    rate_found, u_rate, random = found.tolist()
    return Trend(rate_found, u_rate, random, n, float(np.ptp(t_days)))


def spread_of_rates(peers: Sequence[Trend]) -> float | None:
    """SD of the drift of instruments of this kind, per day, upper limit; None with fewer than PEERS_MIN of them."""
    if len(peers) < PEERS_MIN:
        return None
    weights = np.array([1.0 / peer.u_rate**2 for peer in peers])
    excess = sum(peer.rate**2 / peer.u_rate**2 for peer in peers) - len(peers)
    # If tau is 0, the sum of the normalised squares is chi-squared with as many degrees of freedom as there are peers.
    upper = max(0.0, excess) + K * math.sqrt(2.0 * len(peers))
    return math.sqrt(upper / float(weights.sum()))


def advise(own: Trend | None, limit: float, spread: float | None, unit: str) -> Advice:
    """The interval of an instrument. `limit`: greatest change that is tolerated, in `unit`; `spread`: of its peers."""
    if own is None:
        return Advice(None, f"needs calibrations of {POINTS_MIN} days")
    if not limit < LARGEST:
        return Advice(None, f"its U, {limit:.3g} {unit}, is beyond any instrument")
    rate, u_rate = own.rate, own.u_rate
    unlike = spread is not None and abs(rate) > UNLIKE * math.hypot(spread, u_rate)
    if spread is not None and not unlike:
        kept = spread**2 / (spread**2 + u_rate**2)
        rate, u_rate = kept * rate, math.sqrt(kept) * u_rate
    seen = (
        f"{own.points} calibrations in {own.span_days:.3g} days, drift {365.25 * own.rate:.3g} ± "
        f"{2 * 365.25 * own.u_rate:.2g} {unit} a year"
    )
    if spread is not None:
        seen += f"; drifts of its peers have an SD of at most {365.25 * spread:.2g}, " + (
            "which it contradicts, so its own history counts alone"
            if unlike
            else f"with which it is {365.25 * rate:.3g} ± {2 * 365.25 * u_rate:.2g}"
        )
    if own.random:
        seen += f", random changes of {own.random:.2g} beyond the stated u"
    seen += f"; limit {limit:.3g} {unit}"
    if K * own.random >= limit:
        return Advice(0.0, f"{seen}: random changes alone exceed the limit, so no interval keeps it")
    reached = _reached(abs(rate), u_rate, own.random, limit)
    longest = LONGEST_IN_HISTORY * own.span_days
    if reached > longest:
        return Advice(
            longest, f"{seen}: reached after more than {LONGEST_IN_HISTORY:g} times the history, which bounds it"
        )
    return Advice(reached, f"{seen}: reached after {reached:.3g} days with 95 %")


def _reached(rate: float, u_rate: float, random: float, limit: float) -> float:
    """The T > 0 of rate T + K sqrt((u_rate T)^2 + random^2) = limit; infinite where nothing changes."""
    # (limit - rate T)^2 = K^2 (u_rate^2 T^2 + random^2), of whose roots the smaller positive one has rate T < limit.
    a = rate**2 - (K * u_rate) ** 2
    c = limit**2 - (K * random) ** 2
    root = math.sqrt(max(0.0, (rate * limit) ** 2 - a * c))
    below = rate * limit + root  # c / below is the root that is stable where a is near 0
    return c / below if below > 0 else math.inf
