"""The equations of one window, as weighed rows in the unknowns of a joint state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from calib.estimate.banded import Banded
from calib.estimate.condense import Condensed, condense
from calib.estimate.deviations import Deviations, LeftOpen
from calib.estimate.equations import Equations
from calib.estimate.equations import Rows as Linear
from calib.estimate.joint_state import JointState
from calib.estimate.nuisances import Applied, Nuisances, Priors
from calib.estimate.quantities import LAG, MAIN_TEMPERATURE, offset_temperature
from calib.estimate.slope_scatter import SlopeScatter
from calib.estimate.terms import Term
from calib.estimate.type_a import FEWEST_FREEDOM, LEAST_INFLATION, TypeA
from calib.excitation.bands import motion_band_hz
from calib.excitation.excited import excited
from calib.model import Array, Pose, Window
from calib.signal.response import FLAT, Response


@dataclass(frozen=True, slots=True)
class Noise:
    """Scatter of segments over that of white noise, and over what a filter makes of it, pooled over windows: variance
    ratios of slopes and means, and the degrees of freedom behind them."""

    slopes: float = 1.0
    means: float = 1.0
    degrees_of_freedom: float = 0.0

    def filtered(self, independent: float) -> Noise:
        """The noise of a window of which a filter left this share of independent points, over white noise."""
        return Noise(self.slopes / independent, self.means / independent, self.degrees_of_freedom)

    def pooled(self, own: Noise) -> Noise:
        """With another window's, by their degrees of freedom; the older ones forgotten beyond MOST_FREEDOM."""
        kept = min(self.degrees_of_freedom, MOST_FREEDOM - min(own.degrees_of_freedom, MOST_FREEDOM))
        total = kept + own.degrees_of_freedom
        if total <= 0.0:
            return own if self.degrees_of_freedom <= 0.0 else self
        share = kept / total
        slopes, means = share * self.slopes, share * self.means
        return Noise(slopes + (1.0 - share) * own.slopes, means + (1.0 - share) * own.means, total)


MOST_FREEDOM = 400.0  # degrees of freedom: beyond, the oldest windows' scatter is forgotten


@dataclass(frozen=True, slots=True, eq=False)
class Summary:
    """All that is kept of a window: its slopes and means, the directions (3, k) that were excited and what the
    correction for noise leaves, its time in days, the lag that the front end took out, what the clocks leave of it, its
    temperature, the identity of its reference, and the terms of the response that the front end took out.

    `pose` as stated, `moved` as `excited` leaves it. `held_mps2` (3,) is the mean input acceleration by the pose
    as stated, NaN where nobody stated gravity. `motion_hz` is the band of the motion, None where that tells no response
    over frequency.
    """

    pose: Pose
    moved: Pose
    held_mps2: Array
    data: Condensed
    directions: Array
    attenuation: float
    day: float
    lag_s: float = 0.0
    temperature_degc: float = np.nan
    u_lag_s: float = 0.0
    independent: float = 1.0
    reference: str = ""
    response: tuple[float, ...] = ()
    motion_hz: tuple[float, float] | None = None

    @classmethod
    def of(
        cls,
        window: Window,
        day: float,
        lag_s: float = 0.0,
        temperature_degc: float = np.nan,
        reference: str = "",
        to_hz: float = np.inf,
    ) -> Summary:
        """The summary of a window that is used. Its bands up to `to_hz` tell the response over frequency."""
        found, sums, m = excited(window), window.sums, window.pose.direction.shape[1]
        mean = sums.count @ sums.mean[:, :m] / sums.count.sum()
        held = window.pose.gravity_mps2 + window.pose.direction @ mean
        motion_hz = motion_band_hz([window])
        data = condense([found], response_hz=to_hz, one_frequency=motion_hz is None)
        return cls(
            window.pose, found.pose, held, data, found.directions, found.attenuation, day, lag_s, temperature_degc,
            window.u_lag_s, window.independent, reference, window.response, motion_hz,
        )  # fmt: skip

    def with_gravity(self, ratio: float) -> Summary:
        """The summary with the stated gravity multiplied by `ratio`."""
        pose, moved = (replace(p, gravity_mps2=p.gravity_mps2 * ratio) for p in (self.pose, self.moved))
        held_mps2 = self.held_mps2 + pose.gravity_mps2 - self.pose.gravity_mps2
        return replace(self, pose=pose, moved=moved, held_mps2=held_mps2)

    def snapshot(self) -> dict[str, Any]:
        """Plain values and arrays."""
        held = {f.name: getattr(self, f.name) for f in fields(self)}
        data = {f.name: getattr(self.data, f.name) for f in fields(self.data)}
        data["type_a"] = {f.name: getattr(self.data.type_a, f.name) for f in fields(self.data.type_a)}
        if (bands := self.data.bands) is not None:
            of_bands = {f.name: getattr(bands, f.name) for f in fields(bands)}
            data["bands"] = of_bands | {name: asdict(of_bands[name]) for name in ("deviations", "left_open")}
        poses = {
            name: {f.name: getattr(pose, f.name) for f in fields(pose)}
            for name, pose in (("pose", self.pose), ("moved", self.moved))
        }
        return held | poses | {"data": data}

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> Summary:
        """The summary whose snapshot this is."""
        data = {**state["data"], "type_a": TypeA(**state["data"]["type_a"])}
        if (bands := data["bands"]) is not None:
            sums = {"deviations": Deviations(**bands["deviations"]), "left_open": LeftOpen.load(bands["left_open"])}
            data["bands"] = Banded(**{**bands, **sums})
        poses = {name: Pose(**state[name]) for name in ("pose", "moved")}
        band = state["motion_hz"]
        told = {"response": tuple(state["response"]), "motion_hz": None if band is None else (band[0], band[1])}
        return cls(**{**state, **poses, **told, "data": Condensed(**data)})


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Observed less predicted (R,) and Jacobian (R, N), in units in which their covariance is one.

    The slopes come first, the bands last. The noise of all windows' segments together scales that covariance, as in
    calib.estimate.adjustment.
    """

    residual: Array
    jacobian: Array
    slopes: int


class WindowRows:
    """One window's equations on the names of a joint state.

    `scale` is the sensor's output unit per m/s2. `held_mps2` (3,) makes it the window of a fixed mount: the quantities
    Q are then the mean output under that constant input acceleration (see recursion.py), and columns of S in
    directions that were not excited get no part in the slopes. None: the mount turns. `seen_degc` is the range of
    temperatures of windows before: one without a temperature may have had any of them.
    """

    def __init__(
        self,
        summary: Summary,
        priors: Priors,
        scale: float,
        reference_degc: float,
        held_mps2: Array | None,
        seen_degc: tuple[float, float],
        like: Nuisances | None = None,
    ) -> None:
        """`like`: the nuisances of another window, which are not built again if this window has the same."""
        self.summary, self.data = summary, summary.data
        applied = Applied.of(priors, summary.lag_s, Response(summary.response) if summary.response else FLAT)
        if like is not None and like.are_of(summary.moved, self.data.channels, priors, summary.reference):
            self.nuisances = like.with_applied(applied)
        else:
            self.nuisances = Nuisances([summary.moved], self.data.channels, priors, applied, summary.reference)
        u_lag_s = max(priors.lag_window_s, summary.u_lag_s)
        self._scatter = SlopeScatter.of(self.data, u_lag_s, summary.attenuation)
        # The scatter between windows is in the covariance of the rows, not before it.
        own = replace(self._scatter, lag_s=np.zeros(1), attenuation=np.zeros(1))
        self.equations = Equations(self.data, self.nuisances, [0], priors.offset_mps2, own, scale)
        self._priors, self._held_mps2, self._seen_degc = priors, held_mps2, seen_degc
        above = summary.temperature_degc - reference_degc
        self._temperature_k = above if np.isfinite(above) else 0.0
        told = np.isfinite(above) or not np.isfinite(seen_degc).all()
        self._perhaps_k = () if told else tuple(degc - reference_degc for degc in seen_degc)
        self._live = np.repeat(np.diag(self.data.root[0]) > 0.0, 3)
        self._kept: tuple[Array, Linear] | None = None

    def made_of(
        self, summary: Summary, priors: Priors, held_mps2: Array | None, seen_degc: tuple[float, float]
    ) -> bool:
        """Whether these rows are those of this window under these statements; see `__init__`."""
        same = self.summary is summary and self._priors is priors and self._held_mps2 is held_mps2
        return same and (bool(np.isfinite(summary.temperature_degc)) or self._seen_degc == seen_degc)

    @property
    def terms(self) -> list[Term]:
        """Its nuisances."""
        return self.nuisances.terms

    @property
    def noise(self) -> Noise:
        """What this window's own segments say; where they are few, the rest is what a filter makes of white noise."""
        type_a, live = self.data.type_a, self._live
        freedom = type_a.degrees_of_freedom if np.isfinite(type_a.degrees_of_freedom) else 0.0
        own = min(freedom / FEWEST_FREEDOM, 1.0)
        slopes = type_a.slope_ratio(live) if live.any() else 1.0
        means = float(np.diag(type_a.means).mean())
        return Noise(own * slopes + 1.0 - own, own * means + 1.0 - own, freedom)

    def at(self, state: JointState, at: Array, noise: Noise) -> Rows:
        """Rows at the values `at` (N,) of the state's quantities; `noise` is the pooled one, to which this window's is
        added: the first window of all has no other."""
        noise = noise.pooled(self.noise).filtered(self.summary.independent)
        x, chain = self._own(state, at)
        rows = self._linear_at(x)
        slope, d_slope = rows.slope.reshape(-1), rows.d_slope.reshape(-1, len(x))
        mean, d_mean = rows.mean.reshape(-1), rows.d_mean.reshape(-1, len(x))
        slope, d_slope = slope[self._live], d_slope[self._live]
        covariance = self._slope_covariance(noise)
        if self._held_mps2 is not None:
            mean, d_mean = self._fixed_means(x, self._held_mps2)
            d_slope, missed = self._without_silent(d_slope, state)
            covariance = covariance + np.diag(missed)
        parts = []
        if slope.size:
            parts.append(_weighed(slope, d_slope, covariance))
        if self.equations.known[0]:
            parts.append(_weighed(mean, d_mean, self._mean_covariance(noise) + self._perhaps(state, at)))
        if rows.band.size and self._priors.response:
            parts.append((rows.band, rows.d_band))
        if not parts:
            return Rows(np.zeros(0), np.zeros((0, len(state))), 0)
        residual, jacobian = zip(*parts, strict=True)
        return Rows(np.concatenate(residual), np.vstack(jacobian) @ chain, slope.size)

    def _linear_at(self, x: Array) -> Linear:
        """The equations at x, kept: a window becomes part of the base at the point at which it was taken."""
        if self._kept is None or not np.array_equal(self._kept[0], x):
            self._kept = x, self.equations.at(x)
        return self._kept[1]

    def with_its_lag(self, state: JointState, values: Array) -> Array:
        """The values (N,) of the state's quantities with the lag that was taken out of the window."""
        own = np.array([q.kind is LAG and q.owner == self.summary.reference and not q.first for q in state.quantities])
        return np.where(own, self.summary.lag_s, values)

    def _own(self, state: JointState, at: Array) -> tuple[Array, Array]:
        """The equations' own unknowns [S, Q, nuisances] at this temperature, and their derivatives (n, N)."""
        n, t = 12 + len(self.nuisances), self._temperature_k
        x, chain = np.zeros(n), np.zeros((n, len(state)))
        stretch = np.ones(3)
        for i, name in enumerate(MAIN_TEMPERATURE):
            if name in state:
                k = state.index(name)
                stretch[i] += at[k] * t
                chain[3 * i : 3 * i + 3, k] = at[3 * i : 3 * i + 3] * t
        x[:9] = at[:9] * np.repeat(stretch, 3)
        x[9:12] = at[9:12]
        chain[range(9), range(9)] = np.repeat(stretch, 3)
        chain[range(9, 12), range(9, 12)] = 1.0
        for power in (1, 2):
            for i, name in enumerate(offset_temperature(power)):
                if name in state:
                    k = state.index(name)
                    x[9 + i] += at[k] * t**power
                    chain[9 + i, k] = t**power
        for j, term in enumerate(self.nuisances.terms):
            k = state.index(term.key)
            x[12 + j], chain[12 + j, k] = at[k] - term.applied, 1.0
        return x, chain

    def _perhaps(self, state: JointState, at: Array) -> Array:
        """(3, 3) covariance of the weighed means for a temperature nobody told: one end of the range or the other."""
        found = np.zeros((3, 3))
        for above in self._perhaps_k:
            moved = np.zeros(3)
            for power in (1, 2):
                for i, name in enumerate(offset_temperature(power)):
                    if name in state:
                        moved[i] += at[state.index(name)] * above**power * self.equations.mean_weight[0, i]
            found += np.outer(moved, moved) / len(self._perhaps_k)
        return found

    def _slope_covariance(self, noise: Noise) -> Array:
        """Of the live slopes in units of the noise within the window.

        In it are what two clocks differ by from window to window, and what the correction for noise leaves.
        """
        live = np.ix_(self._live, self._live)
        white = max(noise.slopes, LEAST_INFLATION) * np.eye(int(self._live.sum()))
        return np.asarray(white + self._scatter.covariance()[0][live])

    def _mean_covariance(self, noise: Noise) -> Array:
        """Of the weighted means: the noise in their share, the offset between windows in the rest."""
        share = self.equations.white_share[0]
        return np.diag(max(noise.means, LEAST_INFLATION) * share + 1.0 - share)

    def _fixed_means(self, x: Array, held_mps2: Array) -> tuple[Array, Array]:
        """Weighted residuals (3,) and Jacobian (3, n) of the means at a fixed mount: the mean output alone."""
        weight = self.equations.mean_weight[0]
        away = x[:9].reshape(3, 3) @ np.nan_to_num(self.summary.held_mps2 - held_mps2)
        jacobian = np.zeros((3, len(x)))
        jacobian[range(3), range(9, 12)] = weight
        return (self.data.mean_v[0] - x[9:12] - away) * weight, jacobian

    def _without_silent(self, d_slope: Array, state: JointState) -> tuple[Array, Array]:
        """The slopes' Jacobian without the columns of S along directions that were not excited, and the variance that
        these columns' uncertainty puts into the rows: second order, since nothing moved there but by a nuisance."""
        silent = np.eye(3) - self.summary.directions @ self.summary.directions.T
        missed, kept = np.zeros(len(d_slope)), d_slope.copy()
        for i in range(3):
            own = d_slope[:, 3 * i : 3 * i + 3] @ silent
            kept[:, 3 * i : 3 * i + 3] -= own
            missed += np.sum((own @ state.factor[3 * i : 3 * i + 3]) ** 2, axis=1)
        return kept, missed


def _weighed(residual: Array, jacobian: Array, covariance: Array) -> tuple[Array, Array]:
    """Rows in units in which `covariance` is the identity."""
    both = np.linalg.solve(np.linalg.cholesky(covariance), np.column_stack([residual, jacobian]))
    return both[:, 0], both[:, 1:]
