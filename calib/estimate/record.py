"""What is kept of a window: sufficient statistics of its samples, and what the front end did with them.

Nothing in a record depends on an estimate, a prior or a version of the estimator, but for what the front end took out
of the samples (a lag, a response, noise), which is stated. So a changed statement is solved anew from the records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from calib.estimate.condense import condense, mean_frequency_hz
from calib.estimate.deviations import Deviations, LeftOpen
from calib.estimate.never_turned import mean_input
from calib.excitation.bands import motion_band_hz
from calib.excitation.excited import Motion, excited, excited_together, excited_ways, motion_of
from calib.model import Array, Pose, Window
from calib.signal.response import ALL_POWERS

TERMS = len(ALL_POWERS)  # of the response over frequency, at most
WIDER = 1.1  # later windows may move so much faster than the first one whose motion is in a band
TOLD = 6  # rows of the terms of the response that are kept: five terms and a residual


@dataclass(frozen=True, eq=False)
class Record:
    """One window, or several that were merged (calib.estimate.thinning), of a reference with M channels.

    `pose` as stated; `reference` is the identity of the reference. `day`: the mean of the windows' days, `days` the
    first and the last of them, `windows` how many they are.

    What the front end took out: `lag_s`, and `response`, the terms of the response. `u_lag_s`: what the two clocks
    leave of the lag of a window, `attenuation`: the relative standard uncertainty of the slopes by the noise of the
    reference that was subtracted, `independent`: the share of points that a filter leaves independent.

    Motion: `excited` (3, 3) projects on the directions that moved; `along`, `along_rate_s` (M, M): the motion that
    silent channels share (calib.excitation.excited). `root` R (2M, 2M), `slopes` R b (2M, 3): the regression of V on
    [u, du/dt], as calib.estimate.condense gives it; `passed` R P (TERMS, 2M, M): what each term of the response adds.
    `omega2`, `each_omega2`: power of du/dt over that of u in rad2/s2. `noise` (3,): SD of the residuals of a point.
    `scores` (2, LEVELS, SUMS): what tells how much slopes and means scatter (calib.estimate.type_a.score_sums).

    Means: of the reference `mean_x` (2M,), of V `means` (k, 3), each a sum over (1, T, T^2) with the weights `over_t`
    (k, 3), T in K above 0 degC; one row for one window. `temperature_degc`: NaN where nothing told it. `held_mps2`
    (3,): mean input acceleration by the pose as stated, NaN where nobody stated gravity. `count`: samples.

    Response: `told` (r, TERMS + 1): rows of its terms alone; `deviations` and `left_open`: what the bands say beside.
    `motion_hz`: the band of the motion, None where it tells no response; `mean_hz` its mean frequency, 0 at rest.
    `misfit` (2,): chi-squared by which the slopes of merged windows differ, and its degrees of freedom. `motion`: that
    of a window whose directions the noise of the reference turns (see `together`), None of any other.
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
    misfit: tuple[float, float] = (0.0, 0.0)
    motion: Motion | None = None

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
        """The record of a window that is used. Its bands up to `to_hz` tell the response over frequency; where no
        window before settled that, those of its own motion."""
        found = excited(window)
        if found.turned:
            found = excited_together([window])[0][0]
        motion_hz = motion_band_hz([window])
        if motion_hz is not None and to_hz == np.inf:
            to_hz = WIDER * motion_hz[1]
        data = condense([found], response_hz=to_hz, one_frequency=motion_hz is None)
        channels = data.channels
        passed, told = np.zeros((TERMS, 2 * channels, channels)), np.zeros((0, TERMS + 1))
        deviations, left_open = Deviations(), LeftOpen()
        if (bands := data.bands) is not None:
            k = bands.projected.shape[1]
            passed[:k] = data.root[0] @ bands.projected[0]
            told = np.zeros((min(k + 1, len(bands.residual)), TERMS + 1))
            rows = np.column_stack([bands.moves, bands.residual])
            triangle = np.asarray(np.linalg.qr(rows, mode="r"))[: len(told)]
            told[:, :k], told[:, -1] = triangle[:, :-1], triangle[:, -1]
            deviations, left_open = bands.deviations, bands.left_open
        t = temperature_degc if np.isfinite(temperature_degc) else 0.0
        directions = found.directions
        return cls(
            window.pose, reference, day, (day, day), 1, lag_s, window.response, window.u_lag_s, found.attenuation,
            window.independent, np.round(directions @ directions.T, 6) + 0.0,
            np.eye(channels) if found.pose.along is None else found.pose.along,
            np.zeros((channels, channels)) if found.pose.along_rate_s is None else found.pose.along_rate_s,
            data.root[0], data.slopes[0], passed, float(data.omega2[0]), data.type_a.noise[0], data.type_a.scores,
            data.mean_x[0], data.mean_v[0][None], np.array([[1.0, t, t * t]]), temperature_degc,
            mean_input(window), float(data.count[0]), told, deviations, left_open,
            motion_hz, mean_frequency_hz(data), motion=motion_of(window) if found.turned else None,
        )  # fmt: skip

    @property
    def channels(self) -> int:
        """M."""
        return len(self.along)

    @property
    def planar(self) -> bool:
        """Whether S counts only along the directions that all windows excite together."""
        return self.motion is not None

    @property
    def rows(self) -> int:
        """How many numbers of V it holds: slopes along directions that moved, and means."""
        means = 3 * len(self.means) if np.isfinite(self.held_mps2).all() else 0
        return 3 * int(np.count_nonzero(np.diag(self.root))) + means

    @cached_property
    def setting(self) -> tuple[object, ...]:
        """Records with the same setting have the same unknowns, with the same effects."""
        return (*self.pose.setting, self.reference, self.channels)

    @cached_property
    def loadings(self) -> Array:
        """(2, 6M) derivatives of the slopes, whitened by the noise, by a lag of this window alone and by their size."""
        m = self.channels
        b = np.linalg.pinv(self.root, rcond=1e-9) @ self.slopes
        size = np.zeros_like(self.slopes)
        size[:m] = self.slopes[:m]
        return np.array([(-self.root[:, m:] @ b[:m] / self.noise).ravel(), (size / self.noise).ravel()])

    def slopes_at_lag(self, lag_s: float) -> Array:
        """(2M, 3) the slopes as if `lag_s` had been taken out: of first order, for microseconds."""
        return np.asarray(self.slopes - (lag_s - self.lag_s) * self.loadings[0].reshape(-1, 3) * self.noise)

    def with_gravity(self, ratio: float) -> Record:
        """The same with the stated gravity multiplied by `ratio`."""
        gravity = self.pose.gravity_mps2 * ratio
        held = self.held_mps2 + gravity - self.pose.gravity_mps2
        return replace(self, pose=replace(self.pose, gravity_mps2=gravity), held_mps2=held)

    def with_reference_times(self, factor: float) -> Record:
        """The same with all indications of the reference multiplied by `factor`, by another certificate of it."""
        moved = self.held_mps2 - self.pose.gravity_mps2
        return replace(
            self, root=self.root * factor, passed=self.passed * factor, mean_x=self.mean_x * factor,
            held_mps2=self.pose.gravity_mps2 + moved * factor,
        )  # fmt: skip

    def snapshot(self) -> dict[str, Any]:
        """Plain values and arrays, for `load`."""
        held = {f.name: getattr(self, f.name) for f in fields(self)}
        pose = {f.name: getattr(self.pose, f.name) for f in fields(self.pose)}
        motion = None if self.motion is None else asdict(self.motion)
        told = {"deviations": asdict(self.deviations), "left_open": asdict(self.left_open)}
        return held | {"pose": pose, "motion": motion} | told

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> Record:
        """The record whose snapshot this is."""
        pairs = {name: tuple(state[name]) for name in ("days", "response", "misfit")}
        band, motion = state["motion_hz"], state.get("motion")
        own = {
            "pose": Pose(**state["pose"]), "deviations": Deviations(**state["deviations"]),
            "left_open": LeftOpen.load(state["left_open"]), "motion_hz": None if band is None else (band[0], band[1]),
            "motion": None if motion is None else Motion(**motion),
        }  # fmt: skip
        return cls(**{**state, **pairs, **own})


def together(records: Sequence[Record], *, fixed: bool) -> list[Record]:
    """The records; of those whose directions noise turns, each with the directions that all of them excite together.

    Noise turns the directions of each window another way: from these small differences least squares would tell S in
    the direction that nothing excited (calib.excitation.excited). Where all directions are excited together, each
    window counts in all of them, or in its own at a mount that is `fixed`.
    """
    moved = [r.motion for r in records if r.motion is not None]
    whole = any(np.trace(r.excited) > 2.5 for r in records if r.motion is None)
    ways = excited_ways(moved) if moved and not whole else np.eye(3)
    if ways.shape[1] == 3 and (fixed or not moved):
        return list(records)
    excited_by_all = np.round(ways @ ways.T, 6) + 0.0
    return [r if r.motion is None else replace(r, excited=excited_by_all) for r in records]
