"""Which device of a site contradicts the others: the largest normalised estimated bias, with a stated false-alarm rate.

For each device there are alternatives (Baarda 1968; Teunissen 2006, ch. 4: testing for one outlying group):

- a reference: what it indicates has a constant error beyond its certificate, in all its links; in all its axes, or in
  one axis alone. The statistic is b' V^-1 b of the estimated error b with its covariance V.
- a sensor: it is not the same in all its links, or not as stated. The statistic is by how much chi-squared of the site
  falls if this sensor is left out.

Each statistic is chi-squared if no device is bad. References and sensors share the false-alarm probability, the tests
of each by Bonferroni, so that a sound site names a device with that probability at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.model import PARAMETERS, Array
from calib.site_adjustment.device import SiteDevice
from calib.site_adjustment.site import EliminatedRows, Site

FALSE_ALARM = 0.05  # probability that a device of a sound site is named
OF_REFERENCES = 0.8  # part of it that the references get: the error of a reference is in all the sensors that it met
LEAST_SHOWN = 0.01  # a bias is tested only in directions in which an error of one stated u gives this non-centrality
DECISIVE_CHI2 = 4.0  # by which chi-squared of the worst device must exceed that of another one: odds of 7 to 1
LEAST_FREEDOM = 0.5  # of a sensor: with fewer degrees of freedom nothing can contradict it
AXES = "xyz"
FIXED = 1e-9  # relative singular value: below, an error in one axis does not show in the others


@dataclass(frozen=True, slots=True, eq=False)
class DeviceVerdict:
    """One device against all others.

    `axis` of a reference in which the error is supposed; "" for all axes, and for a sensor. `statistic` is chi-squared
    with `degrees_of_freedom` if the device is sound. `probability` is that of a site in which all devices are sound to
    show as much in any device of this kind. `bias` (n,) is the estimated error of the reference's parameters beyond its
    certificate; NaN for a sensor.
    """

    device: str
    is_reference: bool
    axis: str
    statistic: float
    degrees_of_freedom: float
    probability: float
    bias: Array


def verdicts(site: Site) -> list[DeviceVerdict]:
    """All devices that can be tested, each by the test that speaks most against it, the most contradictory first."""
    first: dict[str, DeviceVerdict] = {}
    for verdict in sorted(alternatives(site), key=lambda v: (v.probability, -v.statistic)):
        first.setdefault(verdict.device, verdict)
    return [replace(v, probability=min(v.probability, 1.0)) for v in first.values()]


def alternatives(site: Site) -> list[DeviceVerdict]:
    """All tests of all devices. A `probability` above 1 is that of a test that says nothing among so many."""
    of: dict[str, list[EliminatedRows]] = {name: [] for name in site.core}
    for message in site.messages():
        for name in site.core_of(message):
            of[name].append(message)
    references = [v for name in site.core for v in _reference(site, name, of[name])]
    sensors = [v for v in (_sensor(site, name) for name in site.leaves) if v is not None]
    part = OF_REFERENCES if sensors else 1.0
    rest = 1.0 - OF_REFERENCES if references else 1.0
    return [_among(v, len(references) / part) for v in references] + [_among(v, len(sensors) / rest) for v in sensors]


def suspects(found: list[DeviceVerdict], false_alarm: float = FALSE_ALARM) -> list[DeviceVerdict]:
    """The device that contradicts the others; `found` is from `verdicts`. Empty if none does.

    Several devices, the worst first, if the links cannot tell them apart: two references that disagree beside one
    sensor accuse each other.
    """
    if not found or found[0].probability > false_alarm:
        return []
    first = found[0]
    return [
        v
        for v in found
        if v.probability <= false_alarm
        and v.is_reference == first.is_reference
        and v.statistic > first.statistic - DECISIVE_CHI2
    ]


def _reference(site: Site, name: str, messages: Sequence[EliminatedRows]) -> list[DeviceVerdict]:
    """A constant error of what the device indicates as a reference: of all axes, and of each axis alone."""
    own = site.place(name)
    index = np.unique(np.concatenate([own, *(m.index for m in messages)]))
    by_error, pull = np.zeros((len(own), len(index))), np.zeros(len(own))
    for message in messages:
        mine = message.rows[:, np.isin(message.index, own) & message.by_reference]
        if mine.shape[1]:
            by_error[:, np.searchsorted(index, message.index)] += mine.T @ message.rows
            pull += mine.T @ (message.told - message.rows @ site.z_core[message.index])
    information = by_error[:, np.searchsorted(index, own)] - site.core_covariance(by_error, index, by_error, index)
    found = []
    for axis, within in _supposed(site.devices[name]).items():
        shown, ways = np.linalg.eigh(within.T @ information @ within)
        tested = shown > LEAST_SHOWN
        if tested.any():
            error = (ways.T @ within.T @ pull)[tested] / shown[tested]
            bias = site.devices[name].root @ within @ ways[:, tested] @ error
            chi2 = float(np.sum(error**2 * shown[tested]))
            found.append(DeviceVerdict(name, True, axis, chi2, float(tested.sum()), np.nan, bias))
    return found


def _supposed(device: SiteDevice) -> dict[str, Array]:
    """The directions (k, d) of z in which the error is supposed: "" all, and "x", "y", "z" those of one axis alone."""
    found = {"": np.eye(device.root.shape[1])}
    u = np.linalg.norm(device.root, axis=1, keepdims=True)
    relative = device.root / np.where(u > 0.0, u, 1.0)
    for i, axis in enumerate(AXES if len(u) == len(PARAMETERS) else ""):
        others = np.delete(relative, [3 * i, 3 * i + 1, 3 * i + 2, 9 + i], axis=0)
        _, size, ways = np.linalg.svd(others)
        alone = ways[np.count_nonzero(size > FIXED) :].T
        if 0 < alone.shape[1] < len(alone):
            found[axis] = alone
    return found


def _sensor(site: Site, name: str) -> DeviceVerdict | None:
    """The sensor left out: its rows against what all others say."""
    leaf = site.leaf(name)
    if leaf.observed < LEAST_FREEDOM:
        return None
    message = leaf.message
    left = message.told - message.rows @ site.z_core[message.index]
    given = message.rows, message.index
    free = np.eye(len(left)) - site.core_covariance(*given, *given)
    statistic = float(left @ np.linalg.solve(free, left)) + message.left
    return DeviceVerdict(
        name, False, "", statistic, leaf.observed, np.nan, np.full(len(site.devices[name].mean), np.nan)
    )


def _among(verdict: DeviceVerdict, number: float) -> DeviceVerdict:
    """With its probability among so many tests."""
    from scipy.special import gammaincc  # its import takes 0.2 s

    single = float(gammaincc(0.5 * verdict.degrees_of_freedom, 0.5 * verdict.statistic))
    return replace(verdict, probability=number * single)
