"""What is stated of a sensor: priors, certificates, walks, steps, and calibrations that an operator put in force.

With the records of windows it is all that an estimate depends on. A changed statement is solved anew: nothing is ever
taken out of a posterior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.estimate.nuisances import Priors
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array, scale_of

FLAT = 1e4  # standard uncertainty, relative to the scale, of what nobody knows
FLAT_OFFSET_MPS2 = 1e5  # the same, of Q
DOUBT = 1.0  # times its variance that an unknown is less certain where its correlation with S and Q was lost


@dataclass(frozen=True, slots=True)
class Step:
    """Between the windows before `day` and those from it on, unknowns may have changed at once: standard uncertainties
    of the changes, by key. A jump, a remount, a plugged line, a found drift are all such statements."""

    day: float
    u: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Widening:
    """Between two days unknowns may have walked by more than the walks say: standard uncertainties of what they may
    have walked besides in all of this time, by key (calib.drift.net_changes)."""

    since: float
    until: float
    u: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Dated:
    """S and Q were `mean` (12,) with this `covariance` (12, 12) on a day, whatever was known of them before."""

    day: float
    mean: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Statements:
    """`mean`, `u` (12,): of S and Q before any data, in output units. `priors`: of the nuisances, by the identity of
    the reference; that of "" holds beside any other one. `places`: at which place a reference is mounted. `certified`:
    the days of their certificates. `held_mps2` (3,): the mean input acceleration of a mount that never turns against
    gravity; Q is then the mean output (calib.estimate.physics.Windows). None: the mount turns.
    """

    mean: Array
    u: Array
    priors: Mapping[str, Priors]
    wander: Wander
    temperature: TemperatureModel
    places: Mapping[str, int] = field(default_factory=dict)
    certified: Mapping[str, float] = field(default_factory=dict)
    steps: Sequence[Step] = ()
    widened: Sequence[Widening] = ()
    dated: Sequence[Dated] = ()
    held_mps2: Array | None = None

    @property
    def scale(self) -> float:
        """Output unit per m/s2: root mean square of the main sensitivities."""
        return scale_of(self.mean)

    @property
    def nominal(self) -> Array:
        """(3, 3) S before any data."""
        return self.mean[:9].reshape(3, 3)

    def of(self, reference: str) -> Priors:
        """What is stated beside a reference."""
        return self.priors.get(reference, self.priors[""])

    @property
    def u_parameters(self) -> Array:
        """(12,) standard uncertainties with which S and Q begin."""
        most = np.append(np.full(9, FLAT), np.full(3, FLAT_OFFSET_MPS2)) * self.scale
        u = np.minimum(self.u, most)
        return u if self.held_mps2 is None else np.append(u[:9], most[9:])
