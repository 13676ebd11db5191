"""What is known of the response over frequency, beside its terms, which are unknowns of the estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from typing import Any, Self

import numpy as np

from calib.estimate.estimate import Now
from calib.estimate.nuisances import Priors
from calib.estimate.quantities import RESPONSE, Quantity
from calib.estimate.response_told import LEFT_U, KnownResponses, ResponseTold, response_at_one_frequency, response_of
from calib.model import Array
from calib.signal.response import FLAT, NEAR, POWERS, Complex, Response, attenuating, by_term, in_units
from calib.windows.deviations import Deviations, LeftOpen
from calib.windows.record import WIDER, Record

KNOWN = 0.03  # standard uncertainty of ln h
SURELY = 4.0  # standard uncertainties
SEVERAL = 8  # windows that settle the band
ANOTHER_OCTAVES = np.array([1.0, 1.0 / 3.0])  # two windows of one motion differ by less in their lower and upper ends
MOVED = 1e-2  # change of ln h from which the windows must be linearised again
# (2, 5) derivatives of ln h by the unknowns of the response, in the middle and at the upper end of the motion.
_ENDS: Complex = by_term(np.array([0.5, 1.0]) / WIDER) * in_units(1.0 / (2.0 * np.pi))


@dataclass(frozen=True, slots=True)
class OverFrequency:
    """`motion_hz` is the band of the motion that is used, up to `to_hz`; None before a window tells a response. It is
    that of the first such window until several windows agree on another one, at most until `windows` of them are
    SEVERAL; or the one that is stated (`fixed`), always. S holds at `settled_hz`, 0 before the second window with
    motion; it then stays, whatever the band is. `left_out`: so many windows have motion above the band, and their sums
    by band were not kept. `deviations` of all windows from one response, and what they leave open."""

    motion_hz: tuple[float, float] | None = None
    deviations: Deviations = field(default_factory=Deviations)
    left_open: LeftOpen = field(default_factory=LeftOpen)
    first_hz: float = 0.0  # mean frequency of the first window with motion; 0 before
    late_s: float | None = None  # the lag at this frequency, where it was the only one; None where a band told more
    settled_hz: float = 0.0
    windows: int = 0
    fixed: bool = False
    left_out: int = 0

    @property
    def to_hz(self) -> float:
        """Upper end of the motion that is used; inf before a window told it."""
        return np.inf if self.motion_hz is None else WIDER * self.motion_hz[1]

    def stated(self, priors: Priors) -> Priors:
        """The priors with those of the response, once it is an unknown."""
        if self.motion_hz is not None and priors.response_model.to_hz == self.to_hz:
            return priors  # they have them already
        if self.at_hz and not priors.reference_frequency_hz:
            priors = priors.with_values({"reference_frequency_hz": self.at_hz})
        if self.late_s is not None:
            priors = priors.at_one_frequency(self.first_hz, self.late_s)
        return priors if self.motion_hz is None else priors.with_response(self.motion_hz, self.to_hz)

    def begun(self, record: Record, before: Sequence[Record]) -> Self:
        """The same when a window comes after those of `before`: its motion is in a band, or has one frequency."""
        over = self
        if record.motion_hz is not None:
            over = self._settled([*before, record])
            over = replace(over, first_hz=self.first_hz or record.mean_hz)
        elif self.motion_hz is None and self.late_s is None and record.mean_hz:
            over = replace(self, first_hz=record.mean_hz, late_s=record.lag_s)
        moving = [one.centre_hz for one in (*before, record) if one.mean_hz]
        if over.settled_hz or not record.mean_hz or len(moving) < 2:
            return over
        return replace(over, settled_hz=over._among(min(moving)))

    def _settled(self, records: Sequence[Record]) -> Self:
        """With the band of these windows, until they are SEVERAL."""
        if self.fixed or self.windows >= SEVERAL:
            return self
        low_hz, high_hz, windows = common_band(records)
        if self.motion_hz is not None:
            away = np.abs(np.log2([low_hz / self.motion_hz[0], high_hz / self.motion_hz[1]]))
            if (away <= ANOTHER_OCTAVES).all():
                return replace(self, windows=windows)
        return replace(self, motion_hz=(low_hz, high_hz), windows=windows)

    @property
    def at_hz(self) -> float:
        """The frequency at which S holds where none is stated; 0 before any motion."""
        return self.settled_hz or self._among(self.first_hz)

    def _among(self, centre_hz: float) -> float:
        """The frequency at which S holds: the first one that moved if nothing else did or if it is in the band, else
        the middle of the band, or that around which the motion of a window is, `centre_hz`, where that is lower. Motion
        that comes and goes, such as that of a lorry, reaches higher than what several windows have in common."""
        if self.motion_hz is None:
            return min(centre_hz, self.first_hz)
        low_hz, high_hz = self.motion_hz
        if self.late_s is not None and low_hz <= self.first_hz <= self.to_hz:
            return self.first_hz
        middle_hz = float(np.sqrt(low_hz * high_hz))
        return centre_hz if low_hz < centre_hz < middle_hz else middle_hz

    def stating(self, band_hz: tuple[float, float] | None) -> Self:
        """The same where the band is stated; None: it is settled by windows."""
        if band_hz is None:
            return replace(self, fixed=False)
        return replace(self, motion_hz=band_hz, fixed=True)

    def keeping(self, records: Sequence[Record]) -> tuple[Self, list[Record]]:
        """After another band: the records of the motion in it, and the same beside these."""
        found = [(record, record.within(self.to_hz)) for record in records]
        kept = [one for _, one in found if one is not None]
        left_out = sum(record.windows for record, one in found if one is None)
        over = replace(self, deviations=Deviations(), left_open=LeftOpen(), left_out=self.left_out + left_out)
        for record in kept:
            over = over.taken(record)
        return over, kept

    def taken(self, record: Record) -> Self:
        """After a window."""
        deviations, left_open = self.deviations.plus(record.deviations), self.left_open.plus(record.left_open)
        return replace(self, deviations=deviations, left_open=left_open)

    def news(self, before: OverFrequency, priors: Priors) -> str:
        """For the operator: the band that was settled since; "" if nothing was."""
        several = self.windows >= SEVERAL > before.windows and not self.fixed
        another = self.motion_hz != before.motion_hz and before.motion_hz is not None
        if self.motion_hz is None or not (several or another or self.left_out > before.left_out):
            return ""
        low_hz, high_hz = self.motion_hz
        found = f"{self.windows} windows have this band in common{'' if several else ', and may still change it'}"
        if self.fixed:
            found = "this band is stated"
        left_out = self.left_out - before.left_out
        lost = f"; {left_out} older windows with motion above it are left out" if left_out else ""
        remedy = "" if self.fixed else ". Set band_hz if another band is to be used"
        return (
            f"S holds at {self.reference_hz(priors):.3g} Hz and is estimated from motion of {low_hz:.3g} to "
            f"{high_hz:.3g} Hz: {found}{lost}{remedy}"
        )

    def reference_hz(self, priors: Priors) -> float:
        """The frequency at which S holds; 0 if nothing moved yet."""
        return self.stated(priors).reference_frequency_hz or self.first_hz

    def response(self, state: Now, reference: str, taken: tuple[float, ...] = ()) -> Response:
        """The response of the sensor over that of a reference: what the front end is to take out.

        `taken`: the terms that were taken out of the window before. They stay while they are right but for a part of
        their uncertainty, so that a response nobody can tell from a flat one is not taken out: files do the same.
        """
        own = terms_of(state, reference)
        if self.motion_hz is None or not own:
            return FLAT
        before = Response(taken, self.to_hz) if taken else FLAT
        if self.is_taken_out(before, state, reference):
            return before
        found = Response(tuple((state.mean[own] * in_units(self.to_hz)).tolist()), self.to_hz).rounded
        return FLAT if found.is_flat else found

    def is_known(self, state: Now, reference: str) -> bool:
        """Whether windows have told the response beside a reference: one more cannot change it much."""
        own = terms_of(state, reference)
        return bool(own) and float(np.linalg.norm(_ENDS @ state.factor[own], axis=1).max()) < KNOWN

    def is_taken_out(self, taken: Response, state: Now, reference: str) -> bool:
        """Whether `taken` is the response beside a reference, but for a part of its uncertainty."""
        own = terms_of(state, reference)
        if not own:
            return True
        left = np.abs(_ENDS @ (state.mean[own] - np.array(taken.terms) / in_units(self.to_hz)))
        return bool(np.all(left < np.maximum(NEAR, LEFT_U * np.linalg.norm(_ENDS @ state.factor[own], axis=1))))

    def differs(self, state: Now, earlier: Now, reference: str) -> bool:
        """Whether the response beside a reference is surely another in `state` than in an earlier state."""
        own, was = terms_of(state, reference), terms_of(earlier, reference)
        if not own or len(own) != len(was):
            return False
        moved = np.abs(_ENDS @ (state.mean[own] - earlier.mean[was]))
        u, u_was = (np.linalg.norm(_ENDS @ one.factor[k], axis=1) for one, k in ((state, own), (earlier, was)))
        return bool(np.any(moved > np.maximum(MOVED, SURELY * np.hypot(u, u_was))))

    def factor(self, state: Now, reference: str, priors: Priors) -> Array:
        """A factor (N, N + 4) of the covariance of a state beside a reference, with what known filters, the bands'
        deviations and what they leave open add to that of S. (N, N) before any band.
        """
        parts, by_axis = self._relative(state, reference, priors)
        if not any(parts.values()) and not by_axis:
            return state.factor
        more = np.zeros((len(state), 4))
        more[:9, 0] = float(np.linalg.norm(list(parts.values()))) * state.mean[:9]
        for row in range(3):
            own = slice(3 * row, 3 * row + 3)
            more[own, 1 + row] = by_axis * state.mean[own]
        return np.hstack([state.factor, more])

    def _relative(self, state: Now, reference: str, priors: Priors) -> tuple[dict[str, float], float]:
        """Relative standard uncertainties that they add to S: those common to all elements, by source, and that of each
        axis by itself."""
        stated = self.stated(priors)
        hz = stated.reference_frequency_hz or self.first_hz
        by_axis = self.left_open.by_axis(self._terms(state, reference), _at_reference(stated))
        between = self.deviations.between.beyond(by_axis.explains)
        common = {"known filters": stated.known_u, "response between bands": between}
        return {**common, "whose noise it is": self.left_open.u_lost(hz)}, by_axis.u

    def budget(self, state: Now, reference: str, priors: Priors, by: Array) -> dict[str, Array]:
        """By source, what `factor` adds to the variances (m,) of quantities with the derivatives `by` (m, N)."""
        parts, by_axis = self._relative(state, reference, priors)
        rows = (by[:, :9] * state.mean[:9]).reshape(len(by), 3, 3).sum(axis=2)
        found = {source: (u * rows.sum(axis=1)) ** 2 for source, u in parts.items()}
        return found | {"response by axis": (by_axis**2 * rows**2).sum(axis=1)}

    def _terms(self, state: Now, reference: str) -> Array:
        """The terms (K,) of the response beside a reference."""
        own, unit = self._unknowns(state, reference)
        terms = np.zeros(len(POWERS))
        terms[: len(own)] = unit[: len(own)] * state.mean[own]
        return terms

    def response_over_frequency(
        self, state: Now, reference: str, priors: Priors, coverage_factor: float
    ) -> ResponseTold | None:
        """The response beside a reference; None where it is no unknown."""
        own = terms_of(state, reference)
        if self.motion_hz is None:
            return self._at_one_frequency(state, reference, priors, coverage_factor)
        if not own:
            return None
        chosen, effects = [*range(9), *own], np.diag(in_units(self.to_hz))
        factor, hz = self.factor(state, reference, priors)[chosen], self.stated(priors).reference_frequency_hz
        return response_of(
            state.mean[chosen], factor @ factor.T, effects, hz, self.motion_hz, coverage_factor, per_octave=1.0,
            known=KnownResponses.of(self.stated(priors)),
        )  # fmt: skip

    def log_h(self, state: Now, reference: str, frequency_hz: float) -> float:
        """ln |h| beside a reference at a frequency, 0 at 0 Hz."""
        own, effects = self._effects(state, reference, frequency_hz)
        return float(effects @ state.mean[own])

    def prior_of(self, state: Now, reference: str, frequency_hz: float, u_terms: float) -> float:
        """Standard uncertainty of ln |h| beside a reference at a frequency, if each term had this one."""
        return u_terms * float(np.linalg.norm(self._effects(state, reference, frequency_hz)[1]))

    def _effects(self, state: Now, reference: str, frequency_hz: float) -> tuple[list[int], Array]:
        """Where the terms of the response beside a reference are in a state, and their effects on ln |h|."""
        own, unit = self._unknowns(state, reference)
        moved = by_term(np.array(2.0 * np.pi * frequency_hz)).real * unit
        return own, np.asarray(moved[: len(own)])

    def _unknowns(self, state: Now, reference: str) -> tuple[list[int], Array]:
        """Where the first terms of the response beside a reference are in a state, and the units (5,) of all terms."""
        if self.motion_hz is not None:
            return terms_of(state, reference), in_units(self.to_hz)
        own = attenuation_of(state, reference)
        return own, attenuating(self.first_hz) if own else np.zeros(len(POWERS))

    def _at_one_frequency(
        self, state: Now, reference: str, priors: Priors, coverage_factor: float
    ) -> ResponseTold | None:
        own = attenuation_of(state, reference)
        if not own:
            return None
        chosen, effects = [*range(9), *own], attenuating(self.first_hz)[None]
        factor, hz = self.factor(state, reference, priors)[chosen], self.stated(priors).reference_frequency_hz
        band_hz = (self.first_hz, self.first_hz)
        return response_at_one_frequency(
            state.mean[chosen],
            factor @ factor.T,
            effects,
            hz,
            band_hz,
            coverage_factor,
            KnownResponses.of(self.stated(priors)),
        )

    def snapshot(self) -> dict[str, Any]:
        """Plain values, for `load`."""
        return asdict(self)

    @classmethod
    def load(cls, state: Mapping[str, Any]) -> OverFrequency:
        """The object whose snapshot this is."""
        band = state["motion_hz"]
        motion_hz = None if band is None else (band[0], band[1])
        sums = {"deviations": Deviations(**state["deviations"]), "left_open": LeftOpen.load(state["left_open"])}
        return cls(**{**state, "motion_hz": motion_hz, **sums})


def common_band(records: Sequence[Record]) -> tuple[float, float, int]:
    """The ends in Hz that the bands of all but a quarter of the windows reach, of four windows all, and how many
    windows they are. Windows without a band do not count. Where less than an octave is left, it begins at the lowest
    frequency of all."""
    bands = [(record.motion_hz, record.windows) for record in records if record.motion_hz is not None]
    low_hz, high_hz = np.array([band for band, _ in bands]).T
    windows = np.array([count for _, count in bands])
    total = int(windows.sum())
    but = (total - 1) // 4
    ends_hz = _at_rank(high_hz, windows, but)
    begins_hz = _at_rank(low_hz, windows, total - 1 - but)
    return (begins_hz if 2.0 * begins_hz < ends_hz else float(low_hz.min())), ends_hz, total


def _at_rank(values: Array, counts: Array, rank: int) -> float:
    """The value with this rank, from 0 on, where each value (n,) counts `counts` (n,) times."""
    order = np.argsort(values, kind="stable")
    return float(values[order[np.searchsorted(np.cumsum(counts[order]), rank, side="right")]])


def _at_reference(stated: Priors) -> Array:
    """(K,) effects of the terms on ln |h| at the reference frequency, as far as they are the sensor's."""
    return np.asarray((1.0 - stated.reference_share) * _at(stated.reference_frequency_hz))


@lru_cache(maxsize=16)
def _at(frequency_hz: float) -> Array:
    """(K,) effects of the terms on ln |h| at a frequency. Read-only."""
    found = by_term(np.array(2.0 * np.pi * frequency_hz)).real
    found.flags.writeable = False
    return found


def terms_of(state: Now, reference: str) -> list[int]:
    """Where the terms of the response beside a reference are in a state, in the order of POWERS."""
    return _named(state, reference, tuple(f"response_{power}" for power in POWERS))


def attenuation_of(state: Now, reference: str) -> list[int]:
    """Where the attenuation at the one frequency beside a reference is in a state; empty where it is no unknown."""
    return _named(state, reference, ("attenuation",))


def _named(state: Now, reference: str, names: tuple[str, ...]) -> list[int]:
    return [state.index(key) for key in _keys(reference, names) if key in state]


@lru_cache(maxsize=64)
def _keys(reference: str, names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(Quantity(name, RESPONSE, owner=reference).key for name in names)


def changed(state: Now, point: Array) -> bool:
    """Whether a response in the state differs so much from the `point` (N,) that windows must be linearised again."""
    for owner in dict.fromkeys(q.owner for q in state.quantities if q.kind is RESPONSE):
        own = terms_of(state, owner)
        if own and np.abs(_ENDS @ (state.mean - point)[own]).max() > MOVED:
            return True
    return False
