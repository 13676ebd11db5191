"""Method 3 without `plain`: the adjustment of all windows, and the norm fit if there are only rests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.estimate.adjustment import Adjustment, adjust
from calib.estimate.condense import condense, mean_frequency_hz
from calib.estimate.lag_search import correlated_lag_s, largest_omega, without_lag
from calib.estimate.norm_fit import norm_fit
from calib.estimate.nuisances import Applied, Priors
from calib.estimate.reference_share import ReferenceShare
from calib.estimate.response_by_band import told_by_band
from calib.estimate.response_told import LEFT_U, ResponseTold
from calib.excitation.bands import lowest_hz, motion_band_hz
from calib.excitation.excited import excited_together
from calib.excitation.windows import rests_anywhere
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import PARAMETERS, Array, Window
from calib.recorded.certificate import ReferenceCertificate
from calib.recorded.options import Options
from calib.recorded.outcome import NuisanceValue, Outcome, nothing_used
from calib.recorded.priors import priors_of, row_contradictions, u_gravity_mps2
from calib.recorded.table import SensorTable
from calib.recorded.tables import Tables
from calib.signal.response import FLAT, UNSETTLED, Response
from calib.signal.stamps import clock_from_stamps

METHOD = "3 (adjustment)"
LAG_SD, LAG_PERIODS = 3.0, 3.0  # how far a lag is searched: stated standard uncertainties, periods of the motion
LEAST_USED = 0.05  # of the points in motion
RESPONSE_TURNS = 6
HOPELESS = 2  # turns after which a refusal no longer comes from the response that is not yet taken out

_Told = tuple[Outcome, ReferenceShare | None]


def adjusted(tables: Tables, priors: Priors, certificate: ReferenceCertificate | None = None) -> Outcome:
    """The outcome for these tables and priors. `certificate` is that of the reference, if it is given."""
    outcome, share = _adjusted(tables, priors)
    if share is None:
        return outcome
    if certificate is not None:
        share = replace(share, sensitivity=certificate.sensitivity)
    told = ("", "") if certificate is None else (certificate.serial_number, certificate.sha256)
    return replace(outcome, more={**outcome.more, "shared_errors": [share.told(*told)]})


def _adjusted(tables: Tables, priors: Priors) -> _Told:
    """Make windows with the lag and the response over frequency taken out, and adjust them."""
    search = _Search(tables, priors)
    applied = search.begin()
    refused = None if _used(search.windows) else search.windows
    first: tuple[Adjustment, float] | None = None
    for turn in range(RESPONSE_TURNS):
        if turn or refused is not None:
            applied = search.make(applied)
        if not _used(search.windows):
            break
        first = first or (search.at(search.windows, applied), applied.lag_s)
        told = _turned(search, priors, applied, turn, tables.rate_hz)
        if not isinstance(told, Applied):
            return told
        applied = told
    if refused is not None and not _used(search.windows):
        return nothing_used(refused, tables.rate_hz, METHOD), None
    more = {} if first is None else _response(search.by_band(*first))
    return Outcome(None, (UNSETTLED,), search.windows, tables.rate_hz, METHOD, more=more), None


def _turned(search: _Search, priors: Priors, applied: Applied, turn: int, rate_hz: float) -> _Told | Applied:
    """The outcome, or what must still be taken out of the windows."""
    windows, found = search.windows, search.at(search.windows, applied)
    if not search.stated.response:
        found = _attenuated(found, windows, priors, applied)
        return _outcome(found, windows, rate_hz), found.share
    told = found.response
    left_u = LEFT_U if turn <= HOPELESS else 2.0 * LEFT_U  # noisy windows change a little with the response, to and fro
    if not (told is None or told.is_taken_out(applied.response, left_u) or (turn >= HOPELESS and found.reasons)):
        return replace(applied, response=_next_response(told.terms, applied.response))
    outcome = _outcome(found, windows, rate_hz)
    if outcome.calibration is None:
        outcome = replace(outcome, more={**outcome.more, **_response(search.by_band(found, applied.lag_s))})
    return outcome, found.share


class _Search:
    """Adjustments of the windows of tables from which a lag and a response are taken out.

    `windows`: those made last; of a day they need so much memory that they go before others are made. `stated` are the
    priors, later with those of the response, whose scale is that of the motion.
    """

    def __init__(self, tables: Tables, priors: Priors) -> None:
        self._tables, self._priors = tables, priors.beside_unknown_corner if tables.corner_unknown else priors
        self.stated = self._priors
        self.windows: list[Window] = []
        self._latest: tuple[Sequence[Window], Applied, Adjustment] | None = None

    def begin(self) -> Applied:
        """Make the first windows; returns what the search goes on with.

        If none can be used the sensor may be far too late, or a response may look like a mean that changes.
        """
        flat = Applied(self._priors.lag_at_s, self._priors.reference_corner_at_hz, self._priors.sensor_corner_at_hz)
        applied = self.make(flat)
        if not _used(self.windows):
            applied = self.make(replace(flat, lag_s=_likely_lag_s(self._tables, self._priors, self.windows)))
        if _used(self.windows):
            return applied
        refused = self.windows
        taken = self.make(applied, steady=False)
        response = self.at(self.windows, taken).response if _used(self.windows) else None
        self.windows = refused
        return applied if response is None else replace(taken, response=_next_response(response.terms))

    def at(self, windows: Sequence[Window], taken: Applied) -> Adjustment:
        """The adjustment of windows from which this was taken out; the latest one is kept."""
        if not self.stated.response and (told := with_response(self._priors, windows)).response:
            self.stated, self._latest = told, None
        if self._latest is None or self._latest[0] is not windows or self._latest[1] != taken:
            self._latest = windows, taken, adjust(_used(windows), self.stated, taken)
        return self._latest[2]

    def by_band(self, found: Adjustment, lag_s: float) -> ResponseTold | None:
        """The response as each band tells it by itself, where no smooth one is right; `found` is of windows from which
        this lag was taken out."""
        return told_by_band(found, self._tables.of_any_response(lag_s))

    def make(self, taken: Applied, *, steady: bool = True) -> Applied:
        """Make windows from which this response is taken out and whatever lag they show; returns both."""

        def anew(lag_s: float) -> list[Window]:
            self.windows, self._latest = [], None
            return self._tables.windows(lag_s, taken.response, steady=steady)

        def lag_of(made: Sequence[Window], lag_s: float) -> float:
            return self.at(made, replace(taken, lag_s=lag_s)).lag_s or 0.0

        self.windows, lag_s = without_lag(taken.lag_s, anew, _used, lag_of)
        return replace(taken, lag_s=lag_s)


def _next_response(found: Response, taken: Response = FLAT) -> Response:
    """What to take out after a turn that found this response. Terms below the motion that were taken out stay: without
    their filter the windows would be longer ones again, and the search could go to and fro between both."""
    return (found if taken.from_hz else found.without_slight_below).modest


def _hardly_used(windows: Sequence[Window]) -> tuple[str, ...]:
    """The reason for a refusal where almost none of the motion can be used: a few points by chance tell nothing."""
    moved = [w for w in windows if w.kind == "motion"]
    used, points = (sum(w.points for w in some) for some in (_used(moved), moved))
    if not used or used >= LEAST_USED * points:
        return ()
    refused = next(w for w in moved if not w.used)
    return (
        f"only {used} of {points} points in motion can be used, at least {LEAST_USED:.0%} are needed; the first window "
        f"that cannot be used ({refused.pose.position}): {refused.reason}",
    )


def _likely_lag_s(tables: Tables, priors: Priors, windows: Sequence[Window]) -> float:
    """Where the search for the lag begins if no window can be used: a sensor that is late seems not to follow its
    reference. Steep filters with their corner above the motion delay by up to LAG_PERIODS periods of it."""
    omega = largest_omega(windows)
    if not (priors.lag_s and omega):
        return 0.0
    furthest_s = max(LAG_SD * priors.lag_s, LAG_PERIODS * 2.0 * np.pi / omega)
    return correlated_lag_s(tables.stretches(), tables.rate_hz, furthest_s) or 0.0


def with_response(priors: Priors, windows: Sequence[Window]) -> Priors:
    """The priors with those of the response, where the motion covers a band that is wide enough to tell it."""
    band_hz = motion_band_hz(_used(windows))
    return priors if band_hz is None else priors.with_response(band_hz, from_hz=lowest_hz(_used(windows)))


def over_frequency(priors: Priors, windows: Sequence[Window], lag_s: float) -> Priors:
    """The priors with those of the response: of a band, or of the attenuation at the only frequency of the motion.

    The sensor comes late by `lag_s`. Unchanged where nothing moved.
    """
    told, moved = with_response(priors, windows), [w for w in _used(windows) if w.kind == "motion"]
    if told.response or not moved:
        return told
    found, _ = excited_together(moved)
    used = [w if e.live.all() else e for w, e in zip(moved, found, strict=True)]  # noise has a frequency of its own
    motion_hz = mean_frequency_hz(condense(used, response_hz=np.inf, one_frequency=True))
    return priors.at_one_frequency(motion_hz, lag_s) if motion_hz else priors


def _attenuated(found: Adjustment, windows: Sequence[Window], priors: Priors, applied: Applied) -> Adjustment:
    """The adjustment with the attenuation at one frequency as an unknown; unchanged where nothing moved."""
    known = over_frequency(priors, windows, applied.lag_s if found.lag_s is None else found.lag_s)
    return adjust(_used(windows), known, applied) if known.response else found


def _used(windows: Sequence[Window]) -> list[Window]:
    return [w for w in windows if w.used]


def norm_fitted(sensor: SensorTable, options: Options) -> Outcome:
    """Fit to rests that are found in the sensor's table. Only the magnitude of gravity is known, so the frame is free
    and S is upper triangular.
    """
    priors = priors_of(options)
    clock = clock_from_stamps(sensor.time_s)
    gravity = options.gravity or STANDARD_GRAVITY_MPS2
    V = sensor.v[:]
    there = np.flatnonzero(np.isfinite(V).all(axis=1))
    windows = rests_anywhere(clock.time_of(there), V[there], gravity)
    try:
        found = norm_fit(windows, gravity, u_gravity_mps2(options))
    except ValueError as error:
        return Outcome(None, (str(error),), windows, clock.rate_hz, "norm fit", more={"frame": "free"})
    reasons = (*found.reasons, *row_contradictions(found.calibration, priors))
    return Outcome(
        None if reasons else found.calibration, reasons, windows, clock.rate_hz, "norm fit",
        coverage_factor=found.coverage_factor,
        uncertainty_kind="scatter of the rests and u of gravity",
        more={
            "frame": "free", "residual_mps2": found.residual_mps2, "offset_drift_mps2": found.drift_mps2,
            "reference_frequency_hz": 0.0,
        },
    )  # fmt: skip


def _outcome(found: Adjustment, windows: Sequence[Window], rate_hz: float) -> Outcome:
    reasons, joint = _hardly_used(windows) or found.reasons, found.joint
    nuisances = [NuisanceValue(n.name, n.value, n.standard_uncertainty, n.unit) for n in found.nuisances]
    return Outcome(
        None if reasons else found.calibration, reasons, windows, rate_hz, found.calibration.method,
        coverage_factor=found.coverage_factor,
        uncertainty_kind="combined",
        nuisances=nuisances,
        lag_s=found.lag_s,
        rank=found.rank,
        more={
            "frame": "stated",
            "budget": {
                source: dict(zip(PARAMETERS, u, strict=True)) for source, u in found.contributions.items() if u.any()
            },
            "chi2": found.chi2,
            "chi2_degrees_of_freedom": found.chi2_degrees_of_freedom,
            "offset_scatter_mps2": found.offset_scatter_mps2,
            "slope_scatter": found.slope_scatter,
            "lag_scatter_s": found.lag_scatter_s,
            "misfit": found.misfit,
            "nuisance_pull": found.nuisance_pull,
            **_response(found.response),
            "invariant": None if reasons else found.invariant,
            "unexcited_directions": found.grounds.solution.equations.unexcited,
            "joint": None if joint is None else _joint(*joint),
        },
    )  # fmt: skip


def _joint(values: Array, covariance: Array) -> dict[str, Any]:
    return {"sensitivity": values[:9].reshape(3, 3), "offset": values[9:], "covariance": covariance}


def _response(told: ResponseTold | None) -> dict[str, Any]:
    """The members of the JSON object that tell the response over frequency."""
    if told is None:
        nothing = dict.fromkeys(("valid_band_hz", "sensitivity_at_0hz", "response"))
        return {"reference_frequency_hz": 0.0, **nothing}  # only rests
    return {
        "reference_frequency_hz": told.reference_frequency_hz,
        "valid_band_hz": list(told.valid_band_hz),
        "sensitivity_at_0hz": {"sensitivity": told.at_0hz, "standard_uncertainty": told.u_at_0hz},
        "response": [
            {
                "low_hz": band.low_hz,
                "high_hz": band.high_hz,
                "sensitivity_re": band.sensitivity.real,
                "sensitivity_im": band.sensitivity.imag,
                "standard_uncertainty": band.standard_uncertainty,
            }
            for band in told.bands
        ],
    }
