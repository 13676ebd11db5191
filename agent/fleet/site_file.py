"""The file that describes a site: its devices with what is known of them, and which sensor met which reference."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from agent.config.reading import load_model
from agent.config.section import Section

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
OF_DEVICE = ("u-reference-pct", "nominal", "u-nominal-pct", "prior")
OF_SITE = ("gravity", "u-gravity-mps2")
NOT_HERE = ("sensor", "reference", "method", "plain", "json", "help")  # the files are keys of the link itself
OPTION = re.compile(r"[a-z0-9]+(?:-[a-z0-9]+)*")
MOST = 100_000  # devices, or links


class DeviceSection(Section):
    """A device. Of a reference in SI units: `u_sensitivity_pct`. Of a device whose file holds its own indications:
    `certificate` (a result or certificate with all parameters and their covariance), or `nominal`, output unit per
    m/s2, with `u_nominal_pct`. A sensor of which nothing is known states none of them."""

    u_sensitivity_pct: Annotated[float, Field(gt=0, le=50)] | None = None
    certificate: Path | None = None
    nominal: Positive | None = None
    u_nominal_pct: Annotated[float, Field(gt=0, le=100)] | None = None

    @model_validator(mode="after")
    def _check_statement(self) -> DeviceSection:
        if (self.nominal is None) != (self.u_nominal_pct is None):
            raise ValueError("nominal and u_nominal_pct must be given together")
        if sum(v is not None for v in (self.u_sensitivity_pct, self.certificate, self.nominal)) > 1:
            raise ValueError("give only one of u_sensitivity_pct, certificate and nominal")
        return self


class LinkSection(Section):
    """One meeting of a sensor with a reference: their files, and options of `fieldcal calibrate` in `options`.

    Without `reference` the sensor rested under gravity, as its poses say.
    """

    sensor: str
    sensor_file: Path
    reference: str = ""
    reference_file: Path | None = None
    options: Mapping[str, str | int | float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _belongs_here(self) -> LinkSection:
        if bool(self.reference) != (self.reference_file is not None):
            raise ValueError("reference and reference_file must be given together")
        if self.reference == self.sensor:
            raise ValueError(f"reference: {self.sensor} cannot be its own reference; name another device")
        for name in self.options:
            if name in OF_DEVICE:
                raise ValueError(f"options.{name}: is a statement on a device; move it to the section of the device")
            if name in OF_SITE:
                raise ValueError(f"options.{name}: is the same in the whole site; state it once, at the top")
            if name in NOT_HERE or not OPTION.fullmatch(name):
                raise ValueError(f"options.{name}: is no option of a link; remove it")
        return self


class SiteSection(Section):
    """A site: gravity, devices by name, and links."""

    gravity_mps2: Annotated[float, Field(gt=9.7, lt=9.9)] | None = None
    u_gravity_mps2: NotNegative | None = None
    devices: Annotated[dict[str, DeviceSection], Field(min_length=1, max_length=MOST)]
    links: Annotated[list[LinkSection], Field(min_length=1, max_length=MOST)]

    @model_validator(mode="after")
    def _named(self) -> SiteSection:
        for k, link in enumerate(self.links):
            for role, name in (("sensor", link.sensor), ("reference", link.reference)):
                if name and name not in self.devices:
                    raise ValueError(f"links.{k}.{role}: there is no device {name!r}; add a section for it to devices")
            if self.devices[link.sensor].u_sensitivity_pct is not None:
                raise ValueError(
                    f"links.{k}.sensor: {link.sensor!r} states u_sensitivity_pct, which is for references in SI units; "
                    "state nominal or certificate of a sensor, or nothing"
                )
            stated = self.devices.get(link.reference)
            if stated is not None and not any((stated.u_sensitivity_pct, stated.certificate, stated.nominal)):
                raise ValueError(
                    f"links.{k}.reference: nothing is stated of {link.reference!r}; state u_sensitivity_pct, "
                    "certificate or nominal in the section of the device"
                )
        return self


def load_site(path: Path) -> SiteSection:
    """Read and check the file of a site. Raises agent.config.reading.ConfigError with all faults."""
    return load_model(path, SiteSection)


def arguments_of(site: SiteSection, link: LinkSection, directory: Path) -> list[str]:
    """A link as arguments of `fieldcal calibrate`; files are named relative to `directory`."""
    sensor, reference = site.devices[link.sensor], site.devices.get(link.reference)
    told: dict[str, Any] = {"sensor": directory / link.sensor_file}
    if link.reference_file is not None and reference is not None:
        told |= {"reference": directory / link.reference_file, "u-reference-pct": reference.u_sensitivity_pct or 0.0}
    if sensor.nominal is not None:
        told |= {"nominal": sensor.nominal, "u-nominal-pct": sensor.u_nominal_pct}
    if sensor.certificate is not None:
        told["prior"] = directory / sensor.certificate
    if site.gravity_mps2 is not None:
        told["gravity"] = site.gravity_mps2
    if site.u_gravity_mps2 is not None:
        told["u-gravity-mps2"] = site.u_gravity_mps2
    told |= {name: directory / str(v) if name == "poses" else v for name, v in link.options.items()}
    return [part for name, value in told.items() for part in (f"--{name}", str(value))]
