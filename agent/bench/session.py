"""A session at the bench: the stops taken so far, what is known after them, and which stop to take next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.bench.stops import BenchStop, angles_of, like
from calib.adjustment.adjustment import Adjustment, adjust
from calib.distributions import chi2_quantile
from calib.estimate.nuisances import Priors
from calib.estimate.quantities import S_AND_Q
from calib.model import Window
from calib.visit.next_stop import Expected, JointCovariance, Plan, StopIndications, Suggestion, WantedUncertainty
from calib.visit.stop_order import stops_ahead
from calib.windows.sums import factor

# Probability that a right stop is called wrong, though every stated standard uncertainty were twice as large.
FALSE_ALARM = 1e-5
STATED_TIMES = 2.0
# Another stop fits decisively better if it is e^12.5 = 3e5 times as likely (as in calib.adjustment.verdict). This shows
# a wrong turn before S is known well enough for the test above.
DECISIVE_CHI2 = 25.0
DOUBTED = 2.5  # standard uncertainties by which a stated value may be off before it is doubted
SCATTERED = 1.3  # times the stated scatter of the offset from which a person is told
FEWEST_WITNESSES = 3  # stops from which on one of them can be found to be wrong, and not the newest
MOST_SESSIONS = 0.95  # share of sessions in which the larger number of stops is enough
MOST_AHEAD = 100  # stops that are planned ahead
# Before the first window: 5 m/s2 of motion and 2 mg of noise, in so many points that the noise does not matter, since
# a stay lasts until it does not.
START = Expected(5.0, 0.02, 1e5)


@dataclass(frozen=True, slots=True)
class StopFit:
    """Whether a window fits the stop that was told: chi2, its limit, and the stop that fits instead, if any does.

    `earlier`: an earlier window, without which this one fits, while the earlier one then fits another stop only: when
    that window began, and this stop.
    """

    fits: bool
    chi2: float
    limit: float
    instead: int | None
    earlier: tuple[float, int] | None = None


@dataclass(frozen=True, slots=True)
class Outlook:
    """How many stops are still needed, None if MOST_AHEAD do not reach what is wanted.

    `mostly`, before the first stop: how many are enough in MOST_SESSIONS, since few rests may show more scatter of the
    offsets than there is.
    `best` is the uncertainty (main, transverse) after the stops that were planned. `floor` (main, transverse) is left
    after any number of stops, and `because` names the quantity behind it; "" if what is wanted can be reached.
    """

    stops: int | None
    mostly: int | None
    best: tuple[float, float]
    floor: tuple[float, float]
    because: str


class BenchSession:
    """`take` changes it; everything else reads."""

    def __init__(
        self,
        stops: Sequence[BenchStop],
        priors: Priors,
        wanted: WantedUncertainty,
        scale: float = 1.0,
        expected: Expected = START,
    ) -> None:
        """`scale`: the nominal sensitivity in output unit per m/s2. `expected`: of the first window."""
        self.stops = tuple(stops)
        self.wanted = wanted
        self.priors = priors
        self.plan = _plan(stops, priors)
        self._scale, self._priors_now = scale, priors
        self.joint = JointCovariance.before(priors, scale)
        self.expected = expected if stops[0].pose.direction.shape[1] == 1 else replace(expected, rms_mps2=0.0)
        self.windows: list[Window] = []
        self.found: Adjustment | None = None

    @property
    def reached(self) -> bool:
        """Whether all uncertainties are as wanted."""
        return self.wanted.reached(self.joint.expanded)

    def index_of(self, stop: BenchStop) -> int:
        """The number of a stop among `stops`."""
        return next(k for k, each in enumerate(self.stops) if each.name == stop.name)

    def stop_named(self, text: str) -> BenchStop | None:
        """The stop that a person typed; a position of the clamp that was not among `stops` is from now on.

        None where the text is no position.
        """
        name = " ".join(text.replace(",", " ").split())
        found = next((stop for stop in self.stops if stop.name == name), None)
        if found is None and (angles := angles_of(name)) is not None and self.stops[0].pose.theta_rad is not None:
            found = next((stop for stop in self.stops if stop.name == f"{angles[0]:g} {angles[1]:g}"), None)
            if found is None:
                found = like(self.stops[0], *angles)
                self.stops = (*self.stops, found)
                self.plan = _plan(self.stops, self.priors)
        return found

    def suggestion(self) -> Suggestion:
        """The stop to take next: the first of as few as reach what is wanted, or the one that gains most."""
        ahead = stops_ahead(self.plan, self.joint, self.expected, self.wanted, MOST_AHEAD)
        return ahead[0] if ahead else self.plan.suggestions(self.joint, self.expected, self.wanted)[0]

    def outlook(self) -> Outlook:
        """How far it is to what is wanted, with the best stop each time."""
        ahead = stops_ahead(self.plan, self.joint, self.expected, self.wanted, MOST_AHEAD)
        last = Suggestion(0, ahead[-1].expanded if ahead else self.joint.expanded)
        stops = len(ahead) if self.wanted.reached(last.expanded) else None
        left, without = self.plan.floor(self.joint, self.expected)
        floor, because = Suggestion(0, left), ""
        if not self.wanted.reached(left):
            over = {name: float(np.max(each / self.wanted.by_parameter)) for name, each in without.items()}
            because = min(over, key=lambda name: over[name]) if over else ""
        mostly = self._mostly(stops) if stops is not None and not self.windows else stops
        return Outlook(stops, mostly, (last.main, last.transverse), (floor.main, floor.transverse), because)

    def _mostly(self, stops: int) -> int:
        """So many stops that MOST_SESSIONS need no more.

        The adjustment takes the larger of the stated scatter of the offsets and of the one that it sees, which has
        three degrees of freedom for each rest, less the twelve of S and Q. Motion tells more, so that it needs no more.
        """
        for count in range(stops, MOST_AHEAD if self.expected.rms_mps2 == 0.0 else stops):
            if (freedom := 3 * count - len(S_AND_Q)) <= 0:
                continue  # the scatter is not seen yet, and the next rest may show a large one
            seen = np.sqrt(chi2_quantile(MOST_SESSIONS, freedom) / freedom)
            wanted = WantedUncertainty(self.wanted.main / seen, self.wanted.transverse / seen)
            if len(stops_ahead(self.plan, self.joint, self.expected, wanted, MOST_AHEAD)) <= count:
                return count
        return stops

    def fit(self, stop: int, window: Window) -> StopFit:
        """Whether a window fits this stop, by all that is known before it."""
        found = self._fit(self.joint, stop, window)
        return found if found.fits else replace(found, earlier=self._earlier(stop, window))

    def _fit(self, known: JointCovariance, stop: int, window: Window) -> StopFit:
        chi2 = self.plan.surprise(known, StopIndications.of(window), expected_of(window, known.scale))
        limit = STATED_TIMES**2 * chi2_quantile(1.0 - FALSE_ALARM, 3.0 if window.kind == "rest" else 6.0)
        best = int(np.argmin(chi2))
        fits = bool(chi2[stop] <= min(limit, chi2[best] + DECISIVE_CHI2))
        return StopFit(fits, float(chi2[stop]), limit, None if fits or chi2[best] > limit else best)

    def _earlier(self, stop: int, window: Window) -> tuple[float, int] | None:
        """The earlier window that is wrong rather than this one, by leaving out each in turn."""
        suspects = []
        for k, each in enumerate(self.windows if len(self.windows) >= FEWEST_WITNESSES else ()):
            own = next((n for n, s in enumerate(self.stops) if s.pose.position == each.pose.position), None)
            known = JointCovariance.after(adjust([*self.windows[:k], *self.windows[k + 1 :]], self._priors_now))
            if own is None or not self._fit(known, stop, window).fits:
                continue
            found = self._fit(known, own, each)
            if not found.fits and found.instead is not None:
                suspects.append((found.chi2, each.start_s, found.instead))
        return max(suspects)[1:] if suspects else None

    def restart(self) -> None:
        """Forget all stops."""
        self.windows, self.found, self.joint = [], None, JointCovariance.before(self.priors, self._scale)

    def doubts(self) -> list[str]:
        """Stated values that the stops contradict, one line each, for a person."""
        if self.found is None:
            return []
        lines, scatter, stated = [], self.found.offset_scatter_mps2, self.priors.offset_mps2
        if scatter > SCATTERED * stated:
            lines.append(
                f"the offset scatters by {1e3 * scatter:.2g} mm/s2 between stops, "
                f"{1e3 * stated:.2g} mm/s2 were stated: U grows with it"
            )
        for n in self.found.nuisances:
            if n.kind.stated and n.prior_uncertainty and abs(n.value) > DOUBTED * n.prior_uncertainty:
                by = f"{np.degrees(n.value):+.2g} deg" if n.unit == "rad" else f"{n.value:+.2g} {n.unit}"
                u = f"{np.degrees(n.prior_uncertainty):.2g} deg" if n.unit == "rad" else f"{n.prior_uncertainty:.2g}"
                lines.append(f"{n.name} seems off by {by}, and u {u} was stated: check it")
        return lines

    def take(self, windows: Sequence[Window], priors: Priors | None = None) -> None:
        """Adjust all windows of the session, the newest included. `priors`: with what the motion has shown."""
        self.windows = list(windows)
        self._priors_now = priors or self.priors
        self.found = adjust(self.windows, self._priors_now)
        self.joint = JointCovariance.after(self.found)
        self.expected = expected_of(self.windows[-1], self.joint.scale)


def _plan(stops: Sequence[BenchStop], priors: Priors) -> Plan:
    return Plan([s.pose for s in stops], priors, np.array([s.reference_mps2 for s in stops]))


def expected_of(window: Window, scale: float) -> Expected:
    """What a further window will hold that is like this one. `scale`: output unit per m/s2."""
    m, whole = window.sums.reference_channels, factor(window.sums, derivative=window.kind != "rest")
    power = np.diag(window.sums.scatter.sum(axis=0))[:m] / whole.count
    moved = float(np.sqrt(power.max(initial=0.0))) if window.kind != "rest" else 0.0
    noise = float(np.sqrt(np.trace(whole.residual) / 3.0 / whole.count)) / scale
    return Expected(moved, noise, max(whole.count * window.independent, 1.0))
