"""Carries out `fieldcal fleet adjust`: all links of a site in one adjustment, and who contradicts the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.fleet.meeting import Meeting
from calib.distributions import coverage_factor
from calib.estimate.determined import determined
from calib.model import Array
from calib.site_adjustment.contradiction import DeviceVerdict, suspects, verdicts
from calib.site_adjustment.device import SiteDevice
from calib.site_adjustment.link import GRAVITY_NAME
from calib.site_adjustment.site import Site


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """The adjustment of a site, its meetings, the test of each device, and the one that contradicts the others.

    `suspects` are several devices if these cannot be told apart, and empty if no device contradicts the others.
    """

    site: Site
    meetings: Sequence[Meeting]
    tests: Sequence[DeviceVerdict]
    suspects: Sequence[DeviceVerdict]

    def coverage_factor(self, name: str) -> float:
        """For about 95 % coverage, by the fewest degrees of freedom among the links of a device."""
        own = [m.found for m in self.meetings if m.found is not None and name in (m.sensor, m.reference)]
        return coverage_factor(min((f.degrees_of_freedom for f in own), default=np.inf))

    def determined(self, name: str) -> Array:
        """(12,) flags of the parameters of a sensor that the data determine (calib.estimate.determined)."""
        device = self.site.devices[name]
        before = np.sqrt(np.sum(device.root**2, axis=1))
        unknown = np.any(device.root[:, device.wide] != 0.0, axis=1)
        u = self.site.standard_uncertainty(name)
        return np.asarray(
            determined(self.site.x[name], u, np.where(unknown, np.inf, before), np.ones(12, dtype=bool)), dtype=bool
        )

    @property
    def linked(self) -> list[str]:
        """The devices that are in a link, without gravity, in the order of the site."""
        own = {name for m in self.meetings if m.found is not None for name in (m.sensor, m.reference)}
        return [name for name in self.site.devices if name in own]


def adjusted(devices: Sequence[SiteDevice], meetings: Sequence[Meeting]) -> Adjusted:
    """Adjust all meetings that became a link. Raises ValueError if none did."""
    links = [m.found for m in meetings if m.found is not None]
    if not links:
        raise ValueError("no meeting of a sensor with a reference can be used")
    if any((GRAVITY_NAME, 0) in found.shared for found in links):
        devices = [*devices, SiteDevice.gravity(max(m.u_gravity_mps2 for m in meetings))]
    site = Site(devices, links)
    tests = verdicts(site)
    return Adjusted(site, meetings, tests, suspects(tests))
