"""Mistakes that explain a contradiction: units by their factors, axes in other places, an offset that jumped."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.estimate.axes import axis_warnings
from calib.geometry import STANDARD_GRAVITY_MPS2 as G
from calib.model import Array

# What the reference's values must be multiplied by, and what was mistaken then.
FACTORS: Mapping[float, str] = {
    G: "it is in g",
    G / 1000.0: "it is in mg, or in cm/s2",
    0.01: "it is in cm/s2, or in mg",
    0.001: "it is in mm/s2, or mV were taken for V",
    1.0 / G: "values in m/s2 were taken for g",
    100.0: "it was divided by 100",
    1000.0: "it was divided by 1000, or V were taken for mV",
}
ABOUT = 1.3  # ratio: a sensor differs by less from its nominal sensitivity, and units by more
LEAST_JUMP_MPS2 = 0.5  # of an offset: self-tests cause 50 to 1200 mg (ICM-42688-P: kriswiner/ICM42688, issue 6)
ONE_OUTPUT = 0.9  # of the power of what is left: then only this output is wrong
OF_A_UNIT = {"1": ("%", 100.0), "rad": ("deg", 180.0 / np.pi)}


def with_unit(value: float, unit: str) -> str:
    """A value as people state it: an angle in deg, a relative one in %."""
    name, factor = OF_A_UNIT.get(unit, (unit, 1.0))
    return f"{factor * value:.3g} {name}"


def of_a_prior(S: Array, known: Array, *, of_offset: bool) -> str:
    """What explains that S (3, 3) is not as `known` (3, 3) says; "" if nothing does. `of_offset`: Q differs most."""
    if of_offset:
        return (
            "; an offset is so where a self-test was left on, after a shock, or in another range: set the sensor back"
        )
    main = np.diag(known)
    if not main.all() or not np.isfinite(S).all():
        return ""
    if not axis_warnings(known) and (found := axis_warnings(S)):
        return f"; {found[-1]}"
    ratio = np.diag(S) / main
    for factor, told in (
        (1.0 / G, "per g"),
        (G, "in g for m/s2"),
        (1000.0, "in other units"),
        (0.001, "in other units"),
    ):
        if np.all(ratio / factor < ABOUT) and np.all(ratio / factor > 1.0 / ABOUT):
            where = "the prior is" if factor == 1.0 / G else "the prior or the reference is"
            return (
                f"; all main sensitivities are about {factor:.3g} times what was expected: {where} {told}; convert it"
            )
    return ""


def of_means(left: Array) -> str:
    """What explains the residuals of means `left` (W, 3) in m/s2: one output whose offset jumps; "" if none does."""
    power = (left**2).sum(axis=0)
    k = int(np.argmax(power))
    if power[k] < ONE_OUTPUT * power.sum() or np.ptp(left[:, k]) < LEAST_JUMP_MPS2:
        return ""
    return (
        f"; the mean of output {'xyz'[k]} alone differs, by {np.ptp(left[:, k]):.3g} m/s2 between windows: its "
        "offset jumped, as a self-test that was left on makes it; leave these windows out of the poses"
    )
