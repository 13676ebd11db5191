"""What is kept of a window: sufficient statistics of its samples, and what the front end did with them.

Nothing in a record depends on an estimate, a prior or a version of the estimator, but for what the front end took out
of the samples (a lag, a response, noise), which is stated. So a changed statement is solved anew from the records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from calib.model import Array, BandSums, Pose, Window, WindowSums, own_channels
from calib.signal.response import ALL_POWERS
from calib.windows.bands import ABOVE, HIGHEST, centre_hz, motion_band_hz, parts, share_above
from calib.windows.condense import Condensed, condense, mean_frequency_hz, regressed
from calib.windows.deviations import Deviations, LeftOpen
from calib.windows.excited import MotionSums, excited, excited_together, excited_ways, motion_of
from calib.windows.never_turned import mean_input

TERMS = len(ALL_POWERS)  # of the response over frequency, at most
# The mean frequency by power, over that by the logarithm, from which on a motion has frequencies far apart.
FAR_APART = 2.0
WIDER = 1.1  # later windows may move so much faster than the first one whose motion is in a band
TOLD = 6  # rows of the terms of the response that are kept: five terms and a residual


@dataclass(frozen=True, eq=False)
class Record:
    """One window, or several that were merged (calib.state.thinning), of a reference with M channels.

    `pose` as stated; `reference` is the identity of the reference. `day`: the mean of the windows' days, `days` the
    first and the last of them, `windows` how many they are.

    What the front end took out: `lag_s`, and `response`, the terms of the response. `u_lag_s`: what the two clocks
    leave of the lag of a window, `attenuation`: the relative standard uncertainty of the slopes by the noise of the
    reference that was subtracted, `independent`: the share of points that a filter leaves independent.

    Motion: `excited` (3, 3) projects on the directions that moved; `along`, `along_rate_s` (M, M): the motion that
    silent channels share (calib.windows.excited). `root` R (2M, 2M), `slopes` R b (2M, 3): the regression of V on
    [u, du/dt], as calib.windows.condense gives it; `passed` R P (TERMS, 2M, M): what each term of the response adds.
    `omega2`, `each_omega2`: power of du/dt over that of u in rad2/s2. `noise` (3,): SD of the residuals of a point.
    `scores` (2, LEVELS, SUMS): what tells how much slopes and means scatter (calib.windows.type_a.score_sums).

    Means: of the reference `mean_x` (2M,), of V `means` (k, 3), each a sum over (1, T, T^2) with the weights `over_t`
    (k, 3), T in K above 0 degC; one row for one window. `temperature_degc`: NaN where nothing told it; `behind_k`: by
    how much its mean over the last hour is above it, as that of a body that follows it late. `held_mps2` (3,): mean
    input acceleration by the pose as stated, NaN where nobody stated gravity. `count`: samples.

    Response: `told` (r, TERMS + 1): rows of its terms alone; `deviations` and `left_open`: what the bands say beside.
    `motion_hz`: the band of the motion that lasts, also where less of it was used; None where it tells no response.
    `mean_hz`: the mean frequency of what was used, 0 at rest.
    `motion`: that
    of a window whose directions the noise of the reference turns (see `together`), None of any other.

    `to_hz`: no motion above it is in the sums. `bands`: the sums of the newest windows by band, from which `within`
    makes the record of a narrower band, with the noise `reference_noise` (2, M) of the reference, as rms in their
    points.
    """

    pose: Pose
    reference: str
    day: float
    days: tuple[float, float]
    windows: int
    lag_s: float
    response: tuple[float, ...]
    u_lag_s: float
    attenuation: float
    independent: float
    excited: Array
    along: Array
    along_rate_s: Array
    root: Array
    slopes: Array
    passed: Array
    omega2: float
    noise: Array
    scores: Array
    mean_x: Array
    means: Array
    over_t: Array
    temperature_degc: float
    held_mps2: Array
    count: float
    told: Array
    deviations: Deviations
    left_open: LeftOpen
    motion_hz: tuple[float, float] | None
    mean_hz: float
    motion: MotionSums | None = None
    to_hz: float = np.inf
    behind_k: float = 0.0
    bands: BandSums | None = None
    reference_noise: Array | None = None
    lag_bend: Array | None = None

    @classmethod
    def of(
        cls,
        window: Window,
        day: float,
        lag_s: float = 0.0,
        temperature_degc: float = np.nan,
        reference: str = "",
        to_hz: float = np.inf,
    ) -> Record:
        """The record of a window that is used, of its motion up to `to_hz`; where no window before settled that, up to
        the end of its own motion that lasts."""
        found = excited(window)
        turned = found.turned and bool(found.noise.any())
        if turned:
            found = excited_together([window])[0][0]
        motion_hz = motion_band_hz([window])
        lasts_hz = window.motion_hz or motion_band_hz([window], lasting=True) or motion_hz
        if motion_hz is None:
            lasts_hz = None
        elif to_hz == np.inf and lasts_hz is not None:
            to_hz = WIDER * lasts_hz[1]
        data = condense([found], response_hz=to_hz, one_frequency=motion_hz is None)
        channels = data.channels
        passed, told, deviations, left_open = _over_frequency(data)
        t = temperature_degc if np.isfinite(temperature_degc) else 0.0
        directions = found.directions
        mean_hz = mean_frequency_hz(data)
        ends_hz = WIDER * (mean_hz if motion_hz is None else motion_hz[1])
        noise, kept = _kept_bands(window, ends_hz)
        made = cls(
            window.pose, reference, day, (day, day), 1, lag_s, window.response, window.u_lag_s, found.attenuation,
            window.independent, np.round(directions @ directions.T, 6) + 0.0,
            np.eye(channels) if found.pose.along is None else found.pose.along,
            np.zeros((channels, channels)) if found.pose.along_rate_s is None else found.pose.along_rate_s,
            data.root[0], data.slopes[0], passed, float(data.omega2[0]), data.type_a.noise[0], data.type_a.scores,
            data.mean_x[0], data.mean_v[0][None], np.array([[1.0, t, t * t]]), temperature_degc,
            mean_input(window), float(data.count[0]), told, deviations, left_open,
            lasts_hz, mean_hz,
            to_hz=ends_hz, bands=kept, reference_noise=noise, motion=motion_of(window) if turned else None,
            lag_bend=window.lag_bend,
        )  # fmt: skip
        return made.within(to_hz) or made

    def within(self, to_hz: float) -> Record | None:
        """The record of the same motion up to `to_hz`, exactly that of the sums by band; None where there is motion
        above, and these sums are not kept."""
        if self.to_hz <= HIGHEST * to_hz:
            return self
        if self.bands is None:
            return None
        if share_above(self.bands, HIGHEST * to_hz) <= ABOVE:
            return replace(self, to_hz=to_hz)
        if (bands := _up_to(self.bands, to_hz)) is None:
            return None
        count = float(bands.points.sum())
        mean = np.append(self.mean_x, self.means[0])
        sums = WindowSums(self.channels, np.array([count]), mean[None], bands.products.sum(axis=0)[None])
        window = Window(
            0.0, 0.0, self.pose, sums, True, "", round(count), 0, u_lag_s=self.u_lag_s, independent=bands.independent,
            reference_noise=self._noise_within(bands), bands=bands, response=self.response, motion_hz=self.motion_hz,
            lag_bend=self.lag_bend,
        )  # fmt: skip
        made = Record.of(window, self.day, self.lag_s, self.temperature_degc, self.reference, to_hz)
        return replace(made, mean_x=self.mean_x, to_hz=to_hz, scores=self.scores, behind_k=self.behind_k)

    def _noise_within(self, bands: BandSums) -> Array | None:
        """(2, m) rms of the reference's noise in a point of these bands, the first ones of all."""
        if self.reference_noise is None:
            return None
        own = self.reference_noise.shape[1]
        powers = bands.noise[:, : 2 * self.channels].reshape(-1, 2, self.channels)[:, :, :own].sum(axis=0)
        return np.asarray(np.sqrt(powers / bands.points.sum()))

    @property
    def channels(self) -> int:
        """M."""
        return len(self.along)

    @property
    def centre_hz(self) -> float:
        """The frequency around which most of its motion is; 0 where nothing moves. Of a few tones that lie far apart,
        as of waves and an engine, the mean frequency by power is one at which nothing moves."""
        if self.bands is None:
            return self.mean_hz
        if self.motion_hz is not None:
            return centre_hz(self.bands, self.motion_hz)
        found_hz = centre_hz(self.bands, (0.0, np.inf))
        return found_hz if FAR_APART * found_hz < self.mean_hz else self.mean_hz

    @property
    def planar(self) -> bool:
        """Whether S counts only along the directions that all windows excite together."""
        return self.motion is not None

    @property
    def rows(self) -> int:
        """How many numbers of V it holds: slopes along directions that moved, and means."""
        means = 3 * len(self.means) if np.isfinite(self.held_mps2).all() else 0
        return 3 * int(np.count_nonzero(np.diag(self.root))) + means

    @property
    def tells_temperature(self) -> bool:
        """Whether its temperature is known."""
        return bool(np.isfinite(self.temperature_degc))

    @cached_property
    def setting(self) -> tuple[object, ...]:
        """Records with the same setting have the same unknowns, with the same effects."""
        return (*self.pose.setting, self.reference, self.channels, self.tells_temperature)

    @cached_property
    def loadings(self) -> Array:
        """(2, 6M) derivatives of the slopes, whitened by the noise, by a lag of this window alone and by their size."""
        m = self.channels
        b = regressed(self.root, self.slopes)
        size = np.zeros_like(self.slopes)
        size[:m] = self.slopes[:m]
        return np.array([(-self.root[:, m:] @ b[:m] / self.noise).ravel(), (size / self.noise).ravel()])

    @property
    def by_bend(self) -> Array:
        """(k, 6M) what the slopes, whitened by the noise, are more for one standard uncertainty of each of k
        independent parts of what is open of the lag within the window."""
        if self.lag_bend is None:
            return np.zeros((0, 6 * self.channels))
        return np.asarray((self.root @ self.lag_bend / self.noise).reshape(len(self.lag_bend), -1))

    @property
    def lag_left_s(self) -> tuple[float, float]:
        """The lag that is left in the window by its own slopes, and its standard uncertainty by its noise, in s; (0,
        inf) where nothing moves."""
        m, own = self.channels, own_channels(self.channels)
        b = regressed(self.root, self.slopes)
        by_lag = (self.root[:, m : m + own] @ b[:own] / self.noise).ravel()
        told = (self.root[:, m : m + own] @ b[m : m + own] / self.noise).ravel()
        information = float(by_lag @ by_lag)
        return (-float(by_lag @ told) / information, information**-0.5) if information > 0.0 else (0.0, np.inf)

    def with_gravity(self, ratio: float) -> Record:
        """The same with the stated gravity multiplied by `ratio`."""
        gravity = self.pose.gravity_mps2 * ratio
        held = self.held_mps2 + gravity - self.pose.gravity_mps2
        return replace(self, pose=replace(self.pose, gravity_mps2=gravity), held_mps2=held)

    def with_reference_times(self, factor: float) -> Record:
        """The same with all indications of the reference multiplied by `factor`, by another certificate of it."""
        moved = self.held_mps2 - self.pose.gravity_mps2
        bands, by = self.bands, np.append(np.full(2 * self.channels, factor), np.ones(3))
        if bands is not None:
            bands = replace(bands, products=bands.products * np.outer(by, by), noise=bands.noise * by**2)
        return replace(
            self, root=self.root * factor, passed=self.passed * factor, mean_x=self.mean_x * factor,
            held_mps2=self.pose.gravity_mps2 + moved * factor, bands=bands,
            reference_noise=None if self.reference_noise is None else self.reference_noise * factor,
        )  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        """Plain values and arrays, for `load`."""
        parts = {name: getattr(self, name) for name in ("pose", "bands", "motion", "deviations", "left_open")}
        return _plain(self) | {name: None if part is None else _plain(part) for name, part in parts.items()}

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> Record:
        """The record whose snapshot this is."""
        pairs = {name: tuple(state[name]) for name in ("days", "response")}
        band, bands, motion = state["motion_hz"], state["bands"], state["motion"]
        own = {
            "pose": Pose(**state["pose"]), "deviations": Deviations(**state["deviations"]),
            "left_open": LeftOpen.load(state["left_open"]), "motion_hz": None if band is None else (band[0], band[1]),
            "motion": None if motion is None else MotionSums(**motion),
            "bands": None if bands is None else BandSums(**bands),
        }  # fmt: skip
        return cls(**{**state, **pairs, **own})


def together(records: Sequence[Record], *, fixed: bool) -> list[Record]:
    """The records; of those whose directions noise turns, each with the directions that all of them excite together.

    Noise turns the directions of each window another way: from these small differences least squares would tell S in
    the direction that nothing excited (calib.windows.excited). Where all directions are excited together, each
    window counts in all of them, or in its own at a mount that is `fixed`.
    """
    moved = [r.motion for r in records if r.motion is not None]
    whole = any(np.trace(r.excited) > 2.5 for r in records if r.motion is None)
    ways = excited_ways(moved) if moved and not whole else np.eye(3)
    if ways.shape[1] == 3 and (fixed or not moved):
        return list(records)
    excited_by_all = np.round(ways @ ways.T, 6) + 0.0
    return [r if r.motion is None else replace(r, excited=excited_by_all) for r in records]


def _over_frequency(data: Condensed) -> tuple[Array, Array, Deviations, LeftOpen]:
    """(TERMS, 2M, M) what each term of the response adds, what the bands tell of the terms as a triangle, and what the
    terms do not explain."""
    channels, bands = data.channels, data.bands
    passed = np.zeros((TERMS, 2 * channels, channels))
    if bands is None:
        return passed, np.zeros((0, TERMS + 1)), Deviations(), LeftOpen()
    k = bands.projected.shape[1]
    passed[:k] = data.root[0] @ bands.projected[0]
    told = np.zeros((min(k + 1, len(bands.residual)), TERMS + 1))
    rows = np.column_stack([bands.moves, bands.residual])
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))[: len(told)]
    told[:, :k], told[:, -1] = triangle[:, :-1], triangle[:, -1]
    return passed, told, bands.deviations, bands.left_open


def _kept_bands(window: Window, ends_hz: float) -> tuple[Array | None, BandSums | None]:
    """The noise of the reference in the bands up to `ends_hz`, and these bands."""
    noise, kept = window.reference_noise, _up_to(window.bands, ends_hz)
    if window.bands is not None and kept is not None and noise is not None:
        noise = noise * np.sqrt(window.bands.points.sum() / kept.points.sum())
    return noise, kept


def _up_to(bands: BandSums | None, to_hz: float) -> BandSums | None:
    """The bands up to a frequency; None where there is none."""
    if bands is None or not (kept := bands.high_hz <= HIGHEST * to_hz).any():
        return None
    return parts(bands, kept)


def _plain(found: Any) -> dict[str, Any]:
    """The fields of a dataclass by name; what they hold is not copied, as `asdict` does at ten times the cost."""
    return {f.name: getattr(found, f.name) for f in fields(found)}
