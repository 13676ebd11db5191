"""Method 3 without `plain`: the adjustment of all windows, and the norm fit if there are only rests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from calib.adjustment.across import Across
from calib.adjustment.adjustment import Adjustment, adjust
from calib.adjustment.norm_fit import norm_fit
from calib.adjustment.response_by_band import response_by_band
from calib.adjustment.verdict import MOST_BETWEEN_BANDS, response_reasons
from calib.estimate.nuisances import Applied, Priors
from calib.estimate.quantities import RESPONSE
from calib.estimate.response_told import LEFT_U, ResponseTold
from calib.excitation.lag_search import largest_omega, without_lag
from calib.excitation.windows import rests_anywhere
from calib.geometry import AXES, STANDARD_GRAVITY_MPS2
from calib.model import PARAMETERS, Array, Calibration, Window
from calib.recorded.certificate import ReferenceCertificate
from calib.recorded.halves import ChangeWithin, change_within
from calib.recorded.measurement_result import NuisanceValue
from calib.recorded.narrower import Band, band_below_gap, narrower_bands
from calib.recorded.options import Options
from calib.recorded.outcome import Outcome, nothing_used, parts_of
from calib.recorded.priors import priors_of, row_contradictions, u_gravity_mps2
from calib.recorded.table import SensorTable
from calib.recorded.tables import Tables
from calib.rounding import from_to
from calib.signal.known_response import known_response_of
from calib.signal.order_statistics import median
from calib.signal.response import FLAT, UNSETTLED, Response
from calib.signal.stamps import clock_from_stamps
from calib.windows.bands import lowest_hz, motion_band_hz
from calib.windows.condense import condense, mean_frequency_hz
from calib.windows.excited import excited_together

METHOD = "3 (adjustment)"
LAG_SD, LAG_PERIODS = 3.0, 3.0  # how far a lag is searched: stated standard uncertainties, periods of the motion
MOST_PHASE_RAD = 0.1  # SD between windows of one frequency: S is smaller by half of its square
LEAST_USED = 0.05  # of the points in motion
MAIN = [0, 4, 8]  # of PARAMETERS
CHANGE = "change within the recording"  # of the budget
HALF_OCTAVE = 2.0**0.5
RESPONSE_TURNS = 6
BETTER = 1.25  # times: largest u of the main sensitivities from rests alone over that from all windows
# Prior standard uncertainties from which on an attenuation at one frequency is not that of a filter with this lag.
UNLIKELY = 3.0
EIGHTH_RAD = np.pi / 4.0  # of the motion's phase: a correlation finds the lag at least so well
FOLLOWS = 0.9  # of the power of the output: the share that the reference explains where the lag is right, but for noise
HOPELESS = 2  # turns after which a refusal no longer comes from the response that is not yet taken out


class _AdjustedOutcome(NamedTuple):
    """An outcome and the adjustment that it tells; None where no window can be used. `narrower`: where it is refused
    because of the response over frequency, the bands that are tried next; empty elsewhere."""

    outcome: Outcome
    found: Adjustment | None
    narrower: tuple[Band, ...] = ()

    @property
    def fits(self) -> bool:
        """Whether it is not refused, and its motion tells a response and each main sensitivity that it excites."""
        if self.found is None or self.found.response is None or self.outcome.reasons:
            return False
        missed = self.found.grounds.solution.equations.seen & ~self.found.calibration.determined
        return not missed[MAIN].any()


def adjusted(
    tables: Tables, priors: Priors, certificate: ReferenceCertificate | None = None, band_hz: Band | None = None
) -> Outcome:
    """The outcome for these tables and priors. `certificate` is that of the reference, if it is given.

    Sensor and reference are limited to `band_hz`. Where it is not stated and the response over frequency leads to a
    refusal, as at a filter's edge, narrower bands are tried (calib.recorded.narrower), from wide to narrow. The first
    one that is not refused is used, if half an octave less tells the same. Its bands of frequency may deviate from one
    response by the limit over the number of bands that were tried.
    """
    if band_hz is None:
        told, band_hz = _in_the_widest(tables, priors)
    else:
        tables = tables.within(band_hz)
        told = _adjusted(tables, priors)
    outcome, found = _at_rest(told, priors)
    outcome = _with_remedy(outcome, tables, priors)
    offset_s = 0.0 if _is_lost(outcome.windows) else tables.offset_s
    outcome = replace(outcome, more={**outcome.more, "band_hz": band_hz, "clock_offset_s": offset_s})
    if offset_s:
        outcome = replace(outcome, warnings=(_offset_warning(offset_s),))
    if found is not None and found.across.motion:
        outcome = replace(outcome, warnings=(*outcome.warnings, _across_warning(found.across, priors.transverse)))
    if found is not None and outcome.calibration is not None and (change := change_within(found)) is not None:
        outcome = _with_change(outcome, outcome.calibration, change)
    if found is None or (share := found.share) is None:
        return outcome
    if certificate is not None:
        share = replace(share, sensitivity=certificate.sensitivity)
    identity = ("", "") if certificate is None else (certificate.serial_number, certificate.sha256)
    return replace(outcome, more={**outcome.more, "shared_errors": [share.as_object(*identity)]})


def _with_change(outcome: Outcome, calibration: Calibration, change: ChangeWithin) -> Outcome:
    """The outcome with a warning, and with half of the change of S in its uncertainty."""
    covariance, half = calibration.covariance.copy(), np.append(change.half, np.zeros(3))
    covariance += np.outer(half, half)
    sources = {**outcome.more["budget"], CHANGE: dict(zip(PARAMETERS, np.abs(half).tolist(), strict=True))}
    return replace(
        outcome, calibration=replace(calibration, covariance=covariance), warnings=(*outcome.warnings, change.words),
        more={**outcome.more, "budget": sources},
    )  # fmt: skip


def _offset_warning(offset_s: float) -> str:
    told = "ahead of" if offset_s > 0.0 else "behind"
    return (
        f"the clock of the sensor is {abs(offset_s):.2f} s {told} that of the reference, as the motion shows; this was "
        "taken out. Check that both files are of the same motion"
    )


def _across_warning(across: Across, stated: float) -> str:
    seen = across.motion
    if across.output is not None:
        return (
            f"the sensor shows motion across the uniaxial reference, some {100.0 * seen:.2g} % of what it measures; "
            f"what the other outputs show of it was taken out of output {AXES[across.output]}, and u of its S contains "
            f"{100.0 * across.u:.2g} % for what is left. Nothing tells S of the others: use a tri-axial reference"
        )
    return (
        f"the sensor shows motion across the uniaxial reference, some {100.0 * seen:.2g} % of what it measures, or "
        f"one axis has much more noise than another; u_transverse_motion_pct is {100.0 * stated:.2g}, and "
        f"{100.0 * seen:.2g} counts: S across the motion is uncertain by as much. Move it along one line, or use a "
        "tri-axial reference"
    )


def _in_the_widest(tables: Tables, priors: Priors) -> tuple[_AdjustedOutcome, Band | None]:
    """What is told in the widest band that is not refused, and this band; None where nothing was limited."""
    whole = _adjusted(tables, priors)
    for tried, band_hz in enumerate(whole.narrower, 2):
        found = _adjusted(tables.within(band_hz), priors, MOST_BETWEEN_BANDS / tried)
        if found.fits and _repeated(found.outcome, tables, priors, band_hz):
            return found, band_hz
    if not whole.narrower:
        return whole, None
    tried_hz = ", ".join(f"{from_to(*band_hz)} Hz" for band_hz in whole.narrower)
    *others, last = whole.outcome.reasons
    reasons = (*others, f"{last}; limited to narrower bands ({tried_hz}) they are refused as well")
    return whole._replace(outcome=replace(whole.outcome, reasons=reasons)), None


def _with_remedy(outcome: Outcome, tables: Tables, priors: Priors) -> Outcome:
    """The outcome; where it is refused, and would not be if no response were left to the data, the last reason
    says how to state that. Noise of a reference may look like a response that nobody can believe."""
    if not outcome.reasons or priors.known.is_stated or len(outcome.more.get("response") or ()) < 2:
        return outcome
    if _adjusted(tables, priors.beside_known(known_response_of(["flat"], ["flat"]))).outcome.reasons:
        return outcome
    *others, last = outcome.reasons
    remedy = "if no filter of sensor and reference matters in the motion's band, state `sensor_filter` flat"
    return replace(outcome, reasons=(*others, f"{last}; {remedy} `reference_filter` flat: then the data are accepted"))


def _repeated(outcome: Outcome, tables: Tables, priors: Priors, band_hz: Band) -> bool:
    """Whether a band that is half an octave narrower tells the same S within U. What lies beyond the end of a band, as
    a resonance or a notch, may bend a smooth response that shows no deviation; it bends that of both bands differently.
    """
    at_hz = {"reference_frequency_hz": outcome.reference_frequency_hz or 0.0}
    other = _adjusted(tables.within((band_hz[0] * HALF_OCTAVE, band_hz[1] / HALF_OCTAVE)), priors.with_values(at_hz))
    away = np.abs(other.outcome.sensitivity - outcome.sensitivity).ravel()
    largest = np.fmax(outcome.expanded_uncertainty, other.outcome.expanded_uncertainty)[:9]
    return other.fits and not bool(np.any(away > largest))


def _phase_scatter(found: Adjustment) -> float:
    """SD in rad of the phase by which windows differ, at the frequency at which S holds."""
    return 0.0 if found.response is None else 2.0 * np.pi * found.response.reference_frequency_hz * found.lag_scatter_s


def _not_alike(found: Adjustment) -> str:
    """Why windows of one frequency have no S and no lag in common; "" where they have, and of other motion."""
    phase, size = _phase_scatter(found), found.slope_scatter
    if not found.grounds.priors.response_model.one_frequency:
        return ""
    if phase <= MOST_PHASE_RAD and size <= MOST_BETWEEN_BANDS:
        return ""
    return (
        f"windows of one frequency have no S and no lag in common: as SD they differ by {size:.2g} of S, limit "
        f"{MOST_BETWEEN_BANDS:g}, and {phase:.2g} rad of phase, limit {MOST_PHASE_RAD:g}; calibrate with motion at "
        "other frequencies too, below the corner of any filter; look for a mount that slips or a clock that jumps"
    )


def _adjusted(tables: Tables, priors: Priors, most_between: float = MOST_BETWEEN_BANDS) -> _AdjustedOutcome:
    """Make windows with the lag and the response over frequency taken out, and adjust them. Bands may deviate from one
    response by `most_between`."""
    search = _Search(tables, priors, most_between)
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
        narrower = search.of_any_response(applied.lag_s)
        return _AdjustedOutcome(nothing_used(refused, tables.rate_hz, METHOD), None, narrower)
    more = {} if first is None else _response(search.by_band(*first))
    return _AdjustedOutcome(
        Outcome(None, (UNSETTLED,), search.windows, tables.rate_hz, METHOD, more=more), None, search.narrower
    )


def _turned(search: _Search, priors: Priors, applied: Applied, turn: int, rate_hz: float) -> _AdjustedOutcome | Applied:
    """The outcome, or what must still be taken out of the windows."""
    windows, found = search.windows, search.at(search.windows, applied)
    if not search.stated.response:
        found = _attenuated(found, windows, priors, applied)
        return _AdjustedOutcome(_outcome(found, windows, rate_hz), found)
    told = found.response
    left_u = LEFT_U if turn <= HOPELESS else 2.0 * LEFT_U  # noisy windows change a little with the response, to and fro
    if not (told is None or told.is_taken_out(applied.response, left_u) or (turn >= HOPELESS and found.reasons)):
        return replace(applied, response=_next_response(told.terms, applied.response))
    deviates = response_reasons(found.grounds.shares, search.most_between)
    outcome = _outcome(found, windows, rate_hz, deviates)
    if outcome.calibration is None:
        outcome = replace(outcome, more={**outcome.more, **_response(search.by_band(found, applied.lag_s))})
    narrower: tuple[Band, ...] = ()
    if outcome.calibration is None:
        narrower = band_below_gap(_used(windows), priors.reference_frequency_hz)
    if deviates and outcome.reasons == tuple(deviates):
        narrower += search.narrower
    return _AdjustedOutcome(outcome, found, narrower)


class _Search:
    """Adjustments of the windows of tables from which a lag and a response are taken out.

    `windows`: those made last; of a day they need so much memory that they go before others are made. `stated` are the
    priors, later with those of the response, whose scale is that of the motion. `narrower`: bands in which the motion
    may be used instead. `most_between`: how far bands may deviate from one response.
    """

    def __init__(self, tables: Tables, priors: Priors, most_between: float) -> None:
        self.most_between, self.narrower = most_between, tuple[Band, ...]()
        self._tables, self._priors = tables, tables.beside(priors)
        self.stated = self._priors
        self.windows: list[Window] = []
        self._latest: tuple[Sequence[Window], Applied, Adjustment] | None = None

    def begin(self) -> Applied:
        """Make the first windows; returns what the search goes on with.

        If none can be used the sensor may be far too late, or a response may look like a mean that changes. If the lags
        that they show are still large, the two clocks run apart. The lag that they lead to may also be another one.
        Where hardly any can be used even so, the two clocks may be seconds apart.
        """
        flat = Applied(self._priors.lag_at_s, self._priors.reference_corner_at_hz, self._priors.sensor_corner_at_hz)
        applied = self.make(flat)
        lost = not _used(self.windows) or self._tables.far
        if lost or self._may_be_another_lag(applied):
            rate, lag_s = self._tables.rate, _likely_lag_s(self._tables, self._priors, self.windows)
            elsewhere = abs(lag_s - applied.lag_s) * largest_omega(self.windows) > EIGHTH_RAD
            if lost or elsewhere or self._tables.rate != rate:
                applied = self.make(replace(flat, lag_s=lag_s))
        if _is_lost(self.windows) and self._join_clocks():
            return self.begin()
        if _used(self.windows):
            return applied
        refused = self.windows
        taken = self.make(applied, steady=False)
        response = self.at(self.windows, taken).response if _used(self.windows) else None
        self.windows = refused
        return applied if response is None else replace(taken, response=_next_response(response.terms))

    def _join_clocks(self) -> bool:
        """Take out by how much the two clocks are apart; whether that was not done before."""
        omega = largest_omega(self.windows)
        if not omega or not self._tables.join_clocks(max(EIGHTH_RAD / omega, 2.0 / self._tables.rate_hz)):
            return False
        self.stated, self.narrower, self._latest = self._priors, (), None
        return True

    def _may_be_another_lag(self, taken: Applied) -> bool:
        """Whether the outputs may follow the reference better at another lag: half a period away from the right one, a
        sensor seems to be inverted."""
        inverted = float(self.at(self.windows, taken).mean[MAIN].sum()) < 0.0
        return inverted or _coherence(self.windows) < FOLLOWS

    def at(self, windows: Sequence[Window], taken: Applied) -> Adjustment:
        """The adjustment of windows from which this was taken out; the latest one is kept."""
        if not self.stated.response and (told := with_response(self._priors, windows)).response:
            self.stated, self._latest = told, None
            self.narrower = narrower_bands(_used(windows), self._priors.reference_frequency_hz)
        if self._latest is None or self._latest[0] is not windows or self._latest[1] != taken:
            self._latest = windows, taken, self._adjustment(windows, taken)
        return self._latest[2]

    def _adjustment(self, windows: Sequence[Window], taken: Applied) -> Adjustment:
        """The adjustment; where it shows a corner below the motion that is nearer than the priors of its terms allow
        for, once more with wider ones, which are stated from then on."""
        while True:
            found, model = adjust(_used(windows), self.stated, taken), self.stated.response_model
            nearer = None if found.response is None else model.nearer(found.response.terms)
            if nearer is None:
                return found
            self.stated = replace(self.stated, response_model=nearer)

    def by_band(self, found: Adjustment, lag_s: float) -> ResponseTold | None:
        """The response as each band tells it by itself, where no smooth one is right; `found` is of windows from which
        this lag was taken out."""
        return response_by_band(found, self._tables.of_any_response(lag_s))

    def of_any_response(self, lag_s: float) -> tuple[Band, ...]:
        """`narrower` where no window can be used: perhaps because of what the response makes of the motion."""
        windows = _used(self._tables.of_any_response(lag_s))
        return narrower_bands(windows, self._priors.reference_frequency_hz)

    def make(self, taken: Applied, *, steady: bool = True) -> Applied:
        """Make windows from which this response is taken out and whatever lag they show; returns both."""

        def anew(lag_s: float) -> list[Window]:
            self.windows, self._latest = [], None
            return self._tables.windows(lag_s, taken.response, steady=steady)

        def lag_of(made: Sequence[Window], lag_s: float) -> float:
            return self.at(made, replace(taken, lag_s=lag_s)).common_lag_s or 0.0

        self.windows, lag_s = without_lag(taken.lag_s, anew, _used, lag_of)
        return replace(taken, lag_s=lag_s)


def _next_response(found: Response, taken: Response = FLAT) -> Response:
    """What to take out after a turn that found this response. Terms below the motion that were taken out stay: without
    their filter the windows would be longer ones again, and the search could go to and fro between both."""
    return (found if taken.from_hz else found.without_slight_below).modest


def _is_lost(windows: Sequence[Window]) -> bool:
    """Whether no window can be used, or almost none of the motion."""
    return not _used(windows) or bool(_hardly_used(windows))


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


def _coherence(windows: Sequence[Window]) -> float:
    """The share of the sensor's power that the reference explains, of half of the windows in motion."""
    shares = [w.numbers["coherence"] for w in _used(windows) if w.kind == "motion" and "coherence" in w.numbers]
    return float(median(np.array(shares))) if shares else 1.0


def _likely_lag_s(tables: Tables, priors: Priors, windows: Sequence[Window]) -> float:
    """Where the search for the lag begins if windows do not lead to it: a sensor that is late seems not to follow its
    reference. Steep filters with their corner above the motion delay by up to LAG_PERIODS periods of it."""
    omega = largest_omega(windows)
    if not (priors.lag_s and omega):
        return priors.lag_at_s
    furthest_s = max(LAG_SD * priors.lag_s, LAG_PERIODS * 2.0 * np.pi / omega)
    return tables.likely_lag_s(furthest_s, omega)


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


def _at_rest(told: _AdjustedOutcome, priors: Priors) -> tuple[Outcome, Adjustment | None]:
    """The outcome and its adjustment: those of the rests alone, with S at 0 Hz, where they tell S about as well as all
    windows do at the frequency of the motion, or contradict the motion, and nobody stated a frequency.

    Motion takes no part: how far S changes from its frequency down to 0 Hz is known only where rests tell S themselves.
    Where they do not, motion that does not agree with itself is refused.
    """
    outcome, found = told.outcome, told.found
    if outcome.reasons or found is None or found.response is None:
        return outcome, found
    rests = [w for w in _used(outcome.windows) if w.kind == "rest"]
    if rests and not priors.reference_frequency_hz and (steady := _rests_alone(rests, found, priors)) is not None:
        return replace(_outcome(steady, outcome.windows, outcome.rate_hz), lag_s=outcome.lag_s), steady
    if reason := _not_alike(found):
        return replace(outcome, calibration=None, reasons=(reason,)), found
    return outcome, found


def _rests_alone(rests: Sequence[Window], found: Adjustment, priors: Priors) -> Adjustment | None:
    """The adjustment of rests, where they tell S instead of the motion (see `_at_rest`)."""
    steady = adjust(rests, priors, found.grounds.applied)
    u, u_at_rest = (np.nan_to_num(a.calibration.standard_uncertainty[MAIN], nan=np.inf) for a in (found, steady))
    lost = found.calibration.determined & ~steady.calibration.determined
    alone = BETTER * np.max(u) > np.max(u_at_rest) or _contradicts_rests(found) or _not_alike(found)
    return steady if alone and not lost.any() and not steady.reasons else None


def _contradicts_rests(found: Adjustment) -> bool:
    """Whether S at the only frequency of the motion and at 0 Hz differ by more than a filter with this lag can make it:
    of a tone on an ellipse another lag and another S fit as well."""
    priors = found.grounds.priors
    if not priors.response_model.one_frequency:
        return False
    (attenuation,) = (n.value for n in found.nuisances if n.kind is RESPONSE)
    return abs(attenuation - priors.response_at) > UNLIKELY * priors.response


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


def _outcome(found: Adjustment, windows: Sequence[Window], rate_hz: float, deviates: Sequence[str] = ()) -> Outcome:
    """`deviates`: why no one response explains the bands, where a limit is narrower than that of all adjustments."""
    reasons, joint = _hardly_used(windows) or found.reasons or tuple(deviates), found.joint
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
            "effective_degrees_of_freedom": parts_of(found.grounds.shares.degrees_of_freedom),
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
