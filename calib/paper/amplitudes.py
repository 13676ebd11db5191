"""What Methods 1 and 2 share: amplitudes of outputs over amplitude of the reference, cycle by cycle (section 2.7)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.estimate.nuisances import Applied, Inputs, Nuisances, Priors
from calib.model import Array, Calibration, Pose
from calib.paper.propagation import Contribution, Response, Statement, propagate
from calib.paper.sine_fit import ComplexArray, acceleration, cycle_edges, four_parameter, three_parameter
from calib.paper.statistics import Repeatability, repeatability

# Without a prior a parameter counts as determined up to this u, as a part of the largest main sensitivity (contract).
DETERMINED_U = 0.1
# A reference whose residual is above this part of its amplitude is no sine: Methods 1 and 2 do not apply. Tables of
# this kind keep distortion below 5 %; a second line of equal size leaves 100 %.
NOT_A_SINE = 0.2
# Closer than this to a quarter turn, output and reference do not tell the sign of a sensitivity.
NEAREST_QUADRATURE_RAD = np.deg2rad(30)
LEAST_CYCLES = 2  # one value a cycle: no SD from fewer


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One run at one frequency in one position: n samples of reference and sensor at the same instants.

    `reference` (n,) in m/s2, or in m/s where `quantity` is velocity; `indications` (n, 3) in output unit. `pose` is
    uniaxial. Runs whose poses have the same position are repetitions.
    """

    time_s: Array
    reference: Array
    indications: Array
    pose: Pose
    quantity: Literal["acceleration", "velocity"] = "acceleration"


@dataclass(frozen=True, slots=True, eq=False)
class Ratios:
    """Output over reference acceleration of one run: `ratio` (K, 3) complex, one row a cycle, output unit per m/s2.

    `u_frequency_hz` is 0 where the reference measures acceleration: its amplitude then does not depend on frequency.
    """

    pose: Pose
    frequency_hz: float
    u_frequency_hz: float
    acceleration_mps2: Array  # (K,) amplitude of the reference
    ratio: ComplexArray
    distortion: float  # residual SD of the reference over its amplitude


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """S_ij as one run gives it: a value a cycle (K,), signed by its phase; `magnitude` without the sign (Eqs. 1-4).

    `phase_rad` of output i behind (negative) or ahead of the reference along direction j, the sign taken out.
    """

    i: int
    j: int
    run: int
    values: Array
    magnitude: float
    phase_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class AmplitudeCalibration:
    """Result of Method 1 or 2. Q is not seen by amplitudes: NaN.

    `magnitude`, `phase_rad` (3, 3) NaN where not had. `reasons`: why it is refused, empty if it is not.
    """

    calibration: Calibration
    statement: Statement
    coverage_factor: float
    frequency_hz: float
    readings: tuple[Reading, ...]
    ratios: tuple[Ratios, ...]
    magnitude: Array
    phase_rad: Array
    reasons: tuple[str, ...]

    @property
    def repeatability(self) -> dict[tuple[int, int], list[Repeatability]]:
        """Appendix A: {(i, j): one entry a run} of S_ij's values by cycle."""
        found: dict[tuple[int, int], list[Repeatability]] = {}
        for reading in self.readings:
            found.setdefault((reading.i, reading.j), []).append(repeatability(reading.values))
        return found


def ratios(run: Run) -> Ratios:
    """Ratios of a run, its frequency found from the reference (four parameters), amplitudes by cycle (three).

    Raises ValueError where the reference carries no sine or fewer than two whole cycles, naming the position.
    """
    try:
        whole = four_parameter(run.time_s, run.reference)
        edges = cycle_edges(run.time_s, whole.frequency_hz)
    except ValueError as error:
        raise ValueError(f"position {run.pose.position}: {error}") from None
    if len(edges) <= LEAST_CYCLES:
        raise ValueError(f"position {run.pose.position}: {len(edges) - 1} whole cycle, {LEAST_CYCLES} are needed")
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
        float(whole.residual_sd[0] / whole.amplitude[0]),
    )


def read(ratio: Ratios, run: int, i: int, j: int, phase_of: int) -> Reading:
    """S_ij of a run: V_i over a_ref d_j. `phase_of` is the output whose phase counts as none (the main one)."""
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
    """Mean over cycles and repetitions, type A from both, type B by propagation; `unseen` adds contributions."""
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
    statement = Statement(contributions, _padded(u_a), _padded(freedom))
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
    """u of the mean of all runs and its degrees of freedom: by scatter of cycles or of repetitions, the larger.

    `runs`: position and values by cycle. What differs between positions is no repetition; the budget has it.
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
    """What the readings would say of a sensor with sensitivity S where the true inputs are moved."""
    _, pose_of = _positions(found)
    omega = 2 * np.pi * float(np.mean([r.frequency_hz for r in found]))

    def response(inputs: Inputs, _: Array) -> Array:
        passed = np.hypot(1.0, inputs.reference_corner / omega) / np.hypot(1.0, inputs.sensor_corner / omega)
        total, count = np.zeros((3, 3)), np.zeros((3, 3))
        for r in readings:
            felt = passed * S[r.i] @ inputs.direction[pose_of[r.run], :, 0]
            total[r.i, r.j] += felt / found[r.run].pose.direction[r.j, 0]
            count[r.i, r.j] += 1
        return _padded(np.divide(total, count, out=np.full((3, 3), np.nan), where=count > 0))

    return response


def _positions(found: Sequence[Ratios]) -> tuple[list[Pose], list[int]]:
    """Distinct poses by position, and which of them each run has: repetitions share their angle errors."""
    names = list(dict.fromkeys(r.pose.position for r in found))
    first = {r.pose.position: r.pose for r in reversed(found)}
    return [first[name] for name in names], [names.index(r.pose.position) for r in found]


def _filled(S: Array) -> Array:
    """S with what is not known replaced: no transverse sensitivity, the mean main one."""
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
        f"amplitude at {r.frequency_hz:.4g} Hz (limit {100 * NOT_A_SINE:g} %)"
        for r in found
        if r.distortion > NOT_A_SINE
    ]
    for r in readings:
        if r.i == r.j and abs(r.phase_rad) > np.pi / 2 - NEAREST_QUADRATURE_RAD:
            axis, phase = "xyz"[r.i], np.rad2deg(r.phase_rad)
            reasons.append(
                f"position {found[r.run].pose.position}: output {axis} is {phase:.3g} deg from the reference, its sign "
                "cannot be told"
            )
    return reasons
