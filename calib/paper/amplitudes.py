"""The common part of Methods 1 and 2: for each cycle, amplitude of an output over that of the reference (Eqs. 1-4)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.estimate.nuisances import Applied, Priors
from calib.estimate.terms import Inputs, Nuisances
from calib.model import Array, Calibration, Pose
from calib.paper.propagation import Contribution, MethodUncertainty, Response, propagate
from calib.paper.sine_fit import (
    ComplexArray,
    SineFit,
    acceleration,
    coarse_frequency_hz,
    cycle_edges,
    four_parameter,
    three_parameter,
)
from calib.paper.statistics import Repeatability, repeatability

# Largest u of a determined parameter, relative to the largest main sensitivity (docs/vocabulary.md).
DETERMINED_U = 0.1
# If the residual of the reference is above this part of its amplitude, the reference is no sine, and Methods 1 and 2 do
# not apply. Vibrating tables keep distortion below 5 %; a second sine of equal amplitude gives 100 %.
NOT_A_SINE = 0.2
# Amplitudes of cycles that differ by more belong to different parts of a run: the table starts, stops or rests.
STEADY = 0.1
# If the phase between output and reference is closer than this to 90 deg, the sign of the sensitivity is not known.
NEAREST_QUADRATURE_RAD = np.deg2rad(30)
LEAST_CYCLES = 2  # each cycle gives one value, and an SD needs two


@dataclass(frozen=True, slots=True, eq=False)
class SineRun:
    """One run at one frequency in one position: n samples of reference and sensor at the same times `time_s` (n,).

    `reference` (n,) is in m/s2, or in m/s if `quantity` is "velocity"; `indications` (n, 3) are in output unit. `pose`
    is that of a uniaxial reference. Runs whose poses have the same position are repetitions.
    """

    time_s: Array
    reference: Array
    indications: Array
    pose: Pose
    quantity: Literal["acceleration", "velocity"] = "acceleration"


@dataclass(frozen=True, slots=True, eq=False)
class Ratios:
    """Output over reference acceleration of one run: `ratio` (K, 3) complex, one row per cycle, output unit per m/s2.

    `u_frequency_hz` is 0 if the reference measures acceleration, because Eq. (12) is then not needed.
    """

    pose: Pose
    frequency_hz: float
    u_frequency_hz: float
    acceleration_mps2: Array  # (K,) amplitude of the reference
    ratio: ComplexArray
    distortion: float  # residual SD of the reference over its amplitude


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """S_ij from one run: `values` (K,), one per cycle, with the sign of the phase; `magnitude` without sign (Eqs. 1-4).

    `i` is the output, `j` the direction, `run` the number of the run. `phase_rad` is the phase of output i relative to
    the reference along direction j: negative if the output is behind. A reversed sign (180 deg) is removed from it.
    """

    i: int
    j: int
    run: int
    values: Array
    magnitude: float
    phase_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class AmplitudeCalibration:
    """Result of Method 1 or 2. Q is NaN, because amplitudes do not depend on it.

    `magnitude`, `phase_rad` (3, 3) are NaN for elements that no run gives. `reasons` says why the result is refused;
    empty if it is accepted.
    """

    calibration: Calibration
    statement: MethodUncertainty
    coverage_factor: float
    frequency_hz: float
    readings: tuple[Reading, ...]
    ratios: tuple[Ratios, ...]
    magnitude: Array
    phase_rad: Array
    reasons: tuple[str, ...]

    @property
    def repeatability(self) -> dict[tuple[int, int], list[Repeatability]]:
        """Statistics of the values of S_ij by cycle (Table A1): {(i, j): one entry per run}."""
        found: dict[tuple[int, int], list[Repeatability]] = {}
        for reading in self.readings:
            found.setdefault((reading.i, reading.j), []).append(repeatability(reading.values))
        return found


def ratios(run: SineRun) -> Ratios:
    """The ratios of a run: frequency by a four-parameter fit of the reference, amplitudes by three-parameter fits of
    each cycle. Where the run holds more than the sine, it is the longest part with whole cycles of one amplitude.

    Raises ValueError, with the position, if the reference has no sine or fewer than two whole cycles.
    """
    try:
        run, whole = _sine(run)
        edges = cycle_edges(run.time_s, whole.frequency_hz)
    except ValueError as error:
        raise ValueError(f"position {run.pose.position}: {error}") from None
    if len(edges) <= LEAST_CYCLES:
        raise ValueError(
            f"position {run.pose.position}: {len(edges) - 1} whole cycle, {LEAST_CYCLES} are needed; record longer"
        )
    signals = np.column_stack([run.reference, run.indications])
    phasors = np.array(
        [
            three_parameter(run.time_s[a:b], signals[a:b], whole.frequency_hz).phasor
            for a, b in itertools.pairwise(edges)
        ]
    )
    reference = phasors[:, 0]
    if run.quantity == "velocity":
        reference = acceleration(reference, whole.frequency_hz)
    return Ratios(
        run.pose,
        whole.frequency_hz,
        whole.u_frequency_hz if run.quantity == "velocity" else 0.0,
        np.abs(reference),
        phasors[:, 1:] / reference[:, None],
        _distortion(whole),
    )


def _sine(run: SineRun) -> tuple[SineRun, SineFit]:
    """The run, or its steady part if it holds more than the sine, and the sine of its reference."""
    with suppress(ValueError):
        whole = four_parameter(run.time_s, run.reference)
        if _distortion(whole) <= NOT_A_SINE:
            return run, whole
    run = _steady(run, coarse_frequency_hz(run.time_s, run.reference))
    return run, four_parameter(run.time_s, run.reference)


def _distortion(reference: SineFit) -> float:
    return float(reference.residual_sd[0] / reference.amplitude[0])


def _steady(run: SineRun, frequency_hz: float) -> SineRun:
    """The longest part of a run in which the cycles of the reference have one amplitude; the run itself if no part has
    enough cycles."""
    edges = cycle_edges(run.time_s, frequency_hz)
    cycles = [slice(a, b) for a, b in itertools.pairwise(edges)]
    amplitude = np.array([
        float(three_parameter(run.time_s[c], run.reference[c], frequency_hz).amplitude[0]) for c in cycles
    ])  # fmt: skip
    moving = amplitude[amplitude > 0.5 * amplitude.max()]
    same = np.abs(amplitude / np.median(moving) - 1.0) <= STEADY
    ends = np.flatnonzero(np.diff(np.concatenate([[0], same, [0]])))
    first, stop = max(zip(ends[::2], ends[1::2], strict=True), key=lambda part: part[1] - part[0], default=(0, 0))
    # The first and the last cycle of the part may hold the end of a rest.
    first, stop = first + (first > 0), stop - (stop < len(cycles))
    if stop - first < LEAST_CYCLES:
        return run
    part = slice(edges[first], edges[stop])
    return replace(run, time_s=run.time_s[part], reference=run.reference[part], indications=run.indications[part])


def read(ratio: Ratios, run: int, i: int, j: int, phase_of: int) -> Reading:
    """S_ij of a run: V_i / (a_ref d_j) (Eqs. 2-4). Phases are relative to the main output `phase_of`."""
    values = ratio.ratio[:, i] / ratio.pose.direction[j, 0]
    main = (ratio.ratio[:, phase_of] / ratio.pose.direction[phase_of, 0]).mean()
    lag = np.angle(main * np.sign(main.real or 1.0))
    signed = (values * np.exp(-1j * lag)).real
    if i == phase_of:
        signed = np.abs(values) * np.sign(main.real)
    mean = values.mean()
    phase = float(np.angle(mean * np.sign(mean.real or 1.0)))
    return Reading(i, j, run, signed, float(np.abs(values).mean()), phase)


def combine(
    method: str,
    found: Sequence[Ratios],
    readings: Sequence[Reading],
    priors: Priors,
    unseen: Mapping[str, Contribution] | None = None,
) -> AmplitudeCalibration:
    """The result: means over cycles and repetitions, type A uncertainty from both, type B by propagation.

    `found` are the ratios of all runs, `readings` the values of S_ij; `unseen` adds contributions of type B.
    """
    S, u_a, freedom = (np.full((3, 3), np.nan) for _ in range(3))
    magnitude, phase = np.full((3, 3), np.nan), np.full((3, 3), np.nan)
    for i, j in sorted({(r.i, r.j) for r in readings}):
        same = [r for r in readings if (r.i, r.j) == (i, j)]
        S[i, j] = np.mean([r.values.mean() for r in same])
        u_a[i, j], freedom[i, j] = _type_a([(found[r.run].pose.position, r.values) for r in same])
        magnitude[i, j], phase[i, j] = np.mean([(r.magnitude, r.phase_rad) for r in same], axis=0)
    nuisances = Nuisances(_positions(found)[0], 1, priors, Applied())
    contributions = propagate(_response(_filled(S), found, readings), nuisances)
    u_frequency = float(np.max([r.u_frequency_hz / r.frequency_hz for r in found]))
    contributions[f"frequency, method {method}"] = Contribution("frequency", -u_frequency * _padded(S))  # Eq. (12)
    contributions |= unseen or {}
    statement = MethodUncertainty(contributions, _padded(u_a), _padded(freedom))
    determined = np.sqrt(np.diag(statement.covariance)) <= DETERMINED_U * np.nanmax(np.abs(np.diag(S)))
    values = np.where(determined, _padded(S), np.nan)
    calibration = Calibration(
        values[:9].reshape(3, 3),
        values[9:],
        np.where(np.outer(determined, determined), statement.covariance, np.nan),
        determined,
        float(np.nanmin(freedom)),
        method,
    )
    frequency = float(np.mean([r.frequency_hz for r in found]))
    return AmplitudeCalibration(
        calibration, statement, statement.coverage_factor, frequency, tuple(readings), tuple(found),
        magnitude, phase, tuple(_reasons(found, readings)),
    )  # fmt: skip


def _type_a(runs: Sequence[tuple[str, Array]]) -> tuple[float, float]:
    """u of the mean of all runs and its degrees of freedom: from cycles or from repetitions, whichever is larger.

    `runs`: position and values by cycle. Differences between positions are no repetitions; the budget contains them.
    """
    cycles = sum(len(values) for _, values in runs)
    within = sum(float(((v - v.mean()) ** 2).sum()) for _, v in runs) / (cycles - len(runs)) / cycles
    positions: dict[str, list[float]] = {}
    for position, values in runs:
        positions.setdefault(position, []).append(float(values.mean()))
    freedom = len(runs) - len(positions)
    if freedom:
        between = sum(len(m) * float(np.var(m)) for m in positions.values()) / freedom / len(runs)
        if between > within:
            return float(np.sqrt(between)), float(freedom)
    return float(np.sqrt(within)), float(cycles - len(runs))


def _response(S: Array, found: Sequence[Ratios], readings: Sequence[Reading]) -> Response:
    """The function that gives the readings of a sensor with sensitivity S for changed true inputs."""
    _, pose_of = _positions(found)
    omega = 2 * np.pi * float(np.mean([r.frequency_hz for r in found]))

    def response(inputs: Inputs) -> Array:
        passed = np.hypot(1.0, inputs.reference_corner / omega) / np.hypot(1.0, inputs.sensor_corner / omega)
        total, count = np.zeros((3, 3)), np.zeros((3, 3))
        for r in readings:
            felt = passed * S[r.i] @ inputs.direction[pose_of[r.run], :, 0]
            total[r.i, r.j] += felt / found[r.run].pose.direction[r.j, 0]
            count[r.i, r.j] += 1
        return _padded(np.divide(total, count, out=np.full((3, 3), np.nan), where=count > 0))

    return response


def _positions(found: Sequence[Ratios]) -> tuple[list[Pose], list[int]]:
    """The different poses by position, and the number of the pose of each run; repetitions share their angle errors."""
    names = list(dict.fromkeys(r.pose.position for r in found))
    first = {r.pose.position: r.pose for r in reversed(found)}
    return [first[name] for name in names], [names.index(r.pose.position) for r in found]


def _filled(S: Array) -> Array:
    """S with unknown elements replaced: transverse sensitivities by 0, main ones by the mean main sensitivity."""
    filled = np.where(np.isnan(S), 0.0, S)
    unknown = np.flatnonzero(np.isnan(np.diag(S)))
    filled[unknown, unknown] = np.nanmean(np.diag(S))
    return filled


def _padded(S: Array) -> Array:
    """(12,) S row by row, then NaN for Q."""
    return np.append(S.ravel(), np.full(3, np.nan))


def _reasons(found: Sequence[Ratios], readings: Sequence[Reading]) -> list[str]:
    reasons = [
        f"position {r.pose.position}: the reference is no sine, its residual is {100 * r.distortion:.3g} % of the "
        f"amplitude at {r.frequency_hz:.4g} Hz (limit {100 * NOT_A_SINE:g} %); use Method 3"
        for r in found
        if r.distortion > NOT_A_SINE
    ]
    for r in readings:
        if r.i == r.j and abs(r.phase_rad) > np.pi / 2 - NEAREST_QUADRATURE_RAD:
            axis, phase = "xyz"[r.i], np.rad2deg(r.phase_rad)
            reasons.append(
                f"position {found[r.run].pose.position}: the phase of output {axis} is {phase:.3g} deg from the "
                f"reference, its sign cannot be told (limit {np.rad2deg(np.pi / 2 - NEAREST_QUADRATURE_RAD):.0f} deg)"
            )
    return reasons
