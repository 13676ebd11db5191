"""What is stated before any data of a sensor, its reference and its mount; and what a changed statement changes.

A changed prior replaces the prior with which a quantity came into the state. It is never new data: else S, which owes
its value to a reference, would count the error of that reference again at each change of the configuration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.estimate.fixed_mount import Held
from calib.estimate.joint_state import JointState
from calib.estimate.linearised import Linearised
from calib.estimate.nuisances import Priors
from calib.estimate.quantities import (
    KINDS,
    OFFSET,
    OFFSET_RATE,
    PRIORS,
    RATES,
    S_AND_Q,
    SENSITIVITY,
    SENSITIVITY_RATE,
    Quantity,
)
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array, scale_of

OF_REFERENCES = [s.name for kind in KINDS.values() if kind.of_reference for s in kind.statements if s.name in PRIORS]
OF_DATA = (SENSITIVITY, OFFSET, SENSITIVITY_RATE)  # stated elsewhere, or not at all
SAME = 1e-9  # relative: standard uncertainties that differ by less are the same


@dataclass(frozen=True, slots=True, eq=False)
class Beforehand:
    """The statements: `mean` and `standard_uncertainty` (12,) of S and Q in output units, the priors of the nuisances,
    random walks, and the dependence on temperature."""

    mean: Array
    standard_uncertainty: Array
    priors: Priors
    wander: Wander
    temperature: TemperatureModel

    @property
    def scale(self) -> float:
        """Output unit per m/s2: root mean square of the main sensitivities."""
        return scale_of(self.mean)

    def state(self) -> JointState:
        """The joint state before any window: S, Q, the rates of Q, the coefficients of temperature."""
        state = JointState(S_AND_Q, self.mean, self.standard_uncertainty)
        for quantity, u in self._of_time_and_temperature():
            state.append(quantity, 0.0, u)
        return state

    def _of_time_and_temperature(self) -> list[tuple[Quantity, float]]:
        u_rate = self.wander.of(OFFSET_RATE.prior) * self.scale
        return [(Quantity(name, OFFSET_RATE), u_rate) for name in RATES] + self.temperature.terms(self.scale)

    def restate(self, joint: Linearised, before: Before, held: Held | None, reference: str) -> bool:
        """Put these statements into the base of a joint state in the place of those of `before`.

        `reference` is the identity of the present reference: what is stated of other references stays as it was.
        Returns whether anything changed; all recent windows must then be taken again. Where the base does not have the
        effect of a quantity that is uncertain now, the base is lost, and the estimation begins with the recent windows.
        """
        now = self._priors_of(joint.base, before.priors, reference)
        for state in (joint.state, joint.base):
            self._fill(state, now)
        base, known = joint.base, {key: k for k, key in enumerate(joint.base.keys)}
        same = before.equals(self) and all(
            prior == (base.stated_mean[known[key]], base.stated_u[known[key]]) for key, prior in now.items()
        )
        own = {quantity.key for quantity, _ in self._of_time_and_temperature()}
        gone = [q.kind.prior is None and q.kind not in OF_DATA and q.key not in own for q in base.quantities]
        if same and not any(gone) and own <= known.keys():
            return False
        appeared = any(base.stated_u[known[key]] == 0.0 < u for key, (_, u) in now.items())
        if appeared or own - known.keys() or self._appeared(base, before.priors, reference):
            self._begin_again(joint, now, held)
            return True
        for key, prior in now.items():
            if prior != (base.stated_mean[known[key]], base.stated_u[known[key]]):
                first = replace(base.quantities[known[key]], first=True).key
                base.exchange(known.get(first, known[key]), *prior)
                base.stated_mean[known[key]], base.stated_u[known[key]] = prior
        for k in range(len(S_AND_Q) if held is None else len(S_AND_Q) - 3):
            if (before.mean[k], before.u[k]) != (self.mean[k], self.standard_uncertainty[k]):
                base.exchange(k, float(self.mean[k]), float(self.standard_uncertainty[k]))
        for k, lost in enumerate(gone):
            if lost:
                base.exchange(k, 0.0, 0.0)
        joint.keep_in_base([not lost for lost in gone])
        return True

    def _fill(self, state: JointState, now: Mapping[str, tuple[float, float]]) -> None:
        """The means of the priors that a state of version 2 did not keep."""
        for k in np.flatnonzero(np.isnan(state.stated_mean)).tolist():
            key = replace(state.quantities[k], first=False).key
            if k < len(S_AND_Q):
                state.stated_mean[k] = self.mean[k]
            elif key in now:
                state.stated_mean[k] = now[key][0]

    def _priors_of(self, state: JointState, before: Priors, reference: str) -> dict[str, tuple[float, float]]:
        """The prior (mean, standard uncertainty) of each quantity of a state but S and Q, by key.

        A position that was found by gravity may have a larger standard uncertainty of its own, which stays.
        """
        found = {q.key: (0.0, u) for q, u in self._of_time_and_temperature() if q.key in state}
        for k, quantity in enumerate(state.quantities):
            kind = quantity.kind
            if not kind.of_nuisance or quantity.owner not in ("", reference):
                continue
            if quantity.first:  # it goes with the quantity itself
                continue
            was, now, stated_u = before.of(kind.prior), self.priors.of(kind.prior), float(state.stated_u[k])
            if kind.since_certificate:  # the time since the certificate stays
                found[quantity.key] = 0.0, stated_u * (now / was if was not in (0.0, now) else 1.0)
                continue
            own = quantity.position and stated_u > was * (1.0 + SAME)
            found[quantity.key] = self.priors.of(kind.mean), max(now, stated_u) if own else now
        return found

    def _begin_again(self, joint: Linearised, now: Mapping[str, tuple[float, float]], held: Held | None) -> None:
        """The base is the state before any window, with the nuisances that the joint state has."""
        fresh, old = self.state(), joint.base
        for k, quantity in enumerate(old.quantities):
            if quantity.kind.prior is not None and quantity.key not in fresh and not quantity.first:
                fresh.append(quantity, *now.get(quantity.key, (float(old.stated_mean[k]), float(old.stated_u[k]))))
        if held is not None:
            u = held.mean_output_u(fresh, {key: float(fresh.stated_u[fresh.index(key)]) for key in held.by})
            fresh.replace(slice(9, 12), fresh.mean[9:12] + fresh.mean[:9].reshape(3, 3) @ held.mps2, u)
        joint.begin_with(fresh)

    def _appeared(self, state: JointState, before: Priors, reference: str) -> bool:
        """Whether a kind had no uncertainty before and has one now: the windows in the base do not have its effect."""
        there = {(quantity.kind.name, quantity.owner) for quantity in state.quantities}
        owners = {owner for _, owner in there}
        for kind in KINDS.values():
            owner = reference if kind.of_reference else ""
            if not kind.of_nuisance or (kind.of_reference and not reference):
                continue
            missing = owner in owners and (kind.name, owner) not in there
            if missing and before.of(kind.prior) == 0.0 < self.priors.of(kind.prior):
                return True
        return False


@dataclass(frozen=True, slots=True, eq=False)
class Before:
    """The statements on values that a joint state was made with: of S and Q (12,), and the priors of the nuisances."""

    mean: Array
    u: Array
    priors: Priors

    @classmethod
    def of(cls, beforehand: Beforehand) -> Before:
        """The values in these statements."""
        return cls(beforehand.mean.copy(), beforehand.standard_uncertainty.copy(), beforehand.priors)

    def now(self, stated: Beforehand, *, of_reference: bool) -> Before:
        """These statements of today in the place of those before; without `of_reference`, those on references stay."""
        if of_reference:
            return Before.of(stated)
        values = dict(stated.priors.values) | {name: self.priors.values[name] for name in OF_REFERENCES}
        return Before(stated.mean.copy(), stated.standard_uncertainty.copy(), Priors(values, known=stated.priors.known))

    def of_references_differ(self, now: Beforehand) -> bool:
        """Whether other values are stated of the reference now."""
        return any(self.priors.values[name] != now.priors.values[name] for name in OF_REFERENCES)

    def equals(self, now: Beforehand) -> bool:
        """Whether the same values are stated now."""
        same = np.array_equal(self.mean, now.mean) and np.array_equal(self.u, now.standard_uncertainty)
        return bool(same) and dict(self.priors.values) == dict(now.priors.values)

    def snapshot(self) -> dict[str, Any]:
        """Plain values, for `load`."""
        return {"mean": self.mean.copy(), "u": self.u.copy(), "priors": dict(self.priors.values)}

    @classmethod
    def load(cls, state: Mapping[str, Any], now: Beforehand) -> Before:
        """The statements whose snapshot this is. What it does not have (in a state of version 2) counts as now."""
        values = {name: value for name, value in (state["priors"] or {}).items() if name in PRIORS}
        mean = now.mean if state["mean"] is None else np.array(state["mean"])
        return cls(mean, np.array(state["u"]), Priors(dict(now.priors.values) | values, known=now.priors.known))
