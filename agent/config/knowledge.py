"""What is known before any data: of the sensor, of its reference, and of all that moves the data besides S and Q."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from functools import cached_property, reduce
from operator import neg
from typing import Annotated

import msgspec
import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from agent.config.filters import Filters, ResponseTable, stated_by_driver
from agent.config.gate import DriftOptions, GateSettings
from agent.config.section import Section, Vector
from calib.estimate.nuisances import Priors
from calib.estimate.quantities import YEAR_DAYS, from_deg, from_percent
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Array, scale_of
from calib.signal.instrument import QUANTITIES, Instrument
from calib.signal.known_filters import Filter, filter_of
from calib.signal.known_response import KnownResponse

Percent = Annotated[float, Field(gt=0, le=100)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Nine = tuple[float, float, float, float, float, float, float, float, float]
NinePositive = tuple[Positive, Positive, Positive, Positive, Positive, Positive, Positive, Positive, Positive]
PositiveVector = tuple[Positive, Positive, Positive]
Sha256 = Annotated[str, Field(pattern="^([0-9a-f]{64})?$", description="of `file`; if stated, the file must have it")]


def iso_date(value: object) -> str:
    """A date in ISO form from the text, or from the date that TOML knows; "" is no date."""
    if isinstance(value, datetime):
        raise ValueError("must be a date without a time, as in 2026-03-01")
    try:
        return date.fromisoformat(str(value)).isoformat() if value != "" else ""
    except ValueError:
        raise ValueError("must be a date: year, month and day, as in 2026-03-01") from None


IsoDate = Annotated[str, BeforeValidator(iso_date)]


def midnight(stated: str) -> datetime | None:
    """Midnight UTC of a date in ISO form; None of ""."""
    return datetime.fromisoformat(stated).replace(tzinfo=UTC) if stated else None


class Prior(Section):
    """S and Q of the sensor before any data, from its certificate or data sheet; the agent does not start without.

    `sensitivity` is the main one in output unit per m/s2, or all nine, row by row (row = output axis); left out, it is
    the data sheet's, which the drivers of the chips know. `offset` is in m/s2, as are its uncertainties. `corner_hz`
    and `u_corner_hz` are of an AC-coupled sensor (first order), 0 where it responds to constants. `filters` are the
    known ones of the sensor; left out, they are the driver's. S holds at `reference_frequency_hz`; 0 takes the middle
    of the band of the first windows, or a lower one around which most of their motion is. `file` names an earlier
    result or a certificate of `fieldcal certificate` (JSON, or DCC XML) instead: the program reads it once, at the
    start, and fills in `sensitivity`, `u_sensitivity`, and the offset where the file knows it; of a certificate also
    `calibrated`, the date of this calibration. With a date it is in force at a sensor without a reference, and its U
    grows from then on.
    """

    file: Annotated[str, Field(description="result or certificate that states S and Q")] = ""
    file_sha256: Sha256 = ""
    sensitivity: Positive | Nine | None = None
    u_sensitivity: Annotated[
        NinePositive | None, Field(description="of all nine, in place of u_main_pct and u_transverse_pct")
    ] = None
    u_main_pct: Percent = 5.0
    u_transverse_pct: Percent = 3.0  # of the main one: data sheets of MEMS say 1 to 3 %
    offset_mps2: Vector = (0.0, 0.0, 0.0)
    u_offset_mps2: Positive | PositiveVector = 20.0  # two g: nothing is known
    corner_hz: NotNegative = 0.0
    u_corner_hz: NotNegative = 0.0
    filters: Filters = ()
    reference_frequency_hz: NotNegative = 0.0
    calibrated: IsoDate = ""

    @property
    def date(self) -> datetime | None:
        """The date `calibrated`, midnight UTC; None where it is not stated."""
        return midnight(self.calibrated)

    def with_filters(self, stated: tuple[str, ...]) -> Prior:
        """The prior with the filters and the corner that the sensor's driver states, where it states none itself."""
        has_corner = bool(self.corner_hz or self.u_corner_hz)
        return self.model_copy(update=stated_by_driver(stated, has_filters=bool(self.filters), has_corner=has_corner))

    def mean(self, nominal: float | None) -> Array:
        """(12,) S row by row and Q. Raises ValueError where neither configuration nor device tells a sensitivity."""
        if self.sensitivity is None:
            if nominal is None:
                raise ValueError("neither prior.sensitivity nor the device tells a sensitivity to begin with")
            S = nominal * np.eye(3)
        elif isinstance(self.sensitivity, tuple):
            S = np.reshape(self.sensitivity, (3, 3))
        else:
            S = self.sensitivity * np.eye(3)
        return np.append(S.ravel(), scale_of(S.ravel()) * np.array(self.offset_mps2))

    def standard_uncertainty(self, mean: Array) -> Array:
        """(12,) of what `mean` gave, in its units."""
        scale = scale_of(mean)
        share = np.where(np.eye(3).ravel() > 0, self.u_main_pct, self.u_transverse_pct) / 100.0
        u_S = scale * share if self.u_sensitivity is None else np.array(self.u_sensitivity)
        return np.append(u_S, scale * np.broadcast_to(self.u_offset_mps2, 3))


def _quantity(name: str) -> str:
    if name not in QUANTITIES:
        raise ValueError(f"must be one of {', '.join(QUANTITIES)}")
    return name


class Certificate(Section):
    """The reference's certificate. Where it states a `serial_number`, a reference that tells another one is not used.

    `u_sensitivity_pct` holds on the date `calibrated`. Since then the reference may have drifted: by a random walk
    whose standard uncertainty after one year is `stability_pct`. `interval_years` is the time after which the reference
    must be calibrated again; `fieldcal check` tells when it is over. `filters` and the table `response` are divided out
    of the data; left out, the filters are the driver's. `file` names a certificate of `fieldcal certificate` (JSON, or
    DCC XML) instead: the program reads it once, at the start, and fills in `sensitivity` (the mean of the three main
    ones), its u, which covers their spread, `u_transverse_pct`, which covers the transverse ones, the serial number and
    the date.
    """

    file: Annotated[str, Field(description="certificate of the reference")] = ""
    file_sha256: Sha256 = ""
    quantity: Annotated[str, AfterValidator(_quantity)] = "acceleration"
    sensitivity: Annotated[float, Field(gt=0, description="indication per SI unit of the quantity")] = 1.0
    u_sensitivity_pct: Annotated[float, Field(gt=0, le=50)] = 0.1
    u_transverse_pct: Annotated[
        float, Field(ge=0, le=20, description="of the transverse sensitivities of a tri-axial reference; 0: none")
    ] = 0.0
    lag_s: Annotated[float, Field(ge=-0.1, le=0.1, description="by which its indications come late")] = 0.0
    u_lag_s: Annotated[float, Field(ge=0, le=0.1, description="0: the lag is found from the data alone")] = 0.0
    noise_mps2: Annotated[float, Field(ge=0, description="rms, in SI units of the quantity; 0: as the data show")] = 0.0
    corner_hz: Annotated[float, Field(ge=0, description="of an AC-coupled reference, first order; 0: none")] = 0.0
    u_corner_hz: NotNegative = 0.0
    filters: Filters = ()
    response: ResponseTable | None = None
    serial_number: str = ""
    calibrated: IsoDate = ""
    interval_years: Annotated[float | None, Field(gt=0, le=100)] = None
    stability_pct: Annotated[float, Field(ge=0, le=50, description="standard uncertainty that a year adds")] = 0.35
    u_sensitivity_pct_per_k: Annotated[
        float, Field(ge=0, le=5, description="by which it may change with temperature; 0: it does not")
    ] = 0.02

    @model_validator(mode="after")
    def _interval(self) -> Certificate:
        if self.interval_years is not None and not self.calibrated:
            raise ValueError("interval_years: needs the date of the certificate; add calibrated, as in 2026-03-01")
        return self

    @property
    def known_filters(self) -> tuple[Filter, ...]:
        """The filters that it states, and its table over frequency; empty where it states none."""
        table = () if self.response is None else (self.response.filter(),)
        return (*map(filter_of, self.filters), *table)

    def with_filters(self, stated: tuple[str, ...]) -> Certificate:
        """The certificate with the filters and the corner that the driver of the reference states, where it states none
        itself."""
        has_corner = bool(self.corner_hz or self.u_corner_hz)
        update = stated_by_driver(stated, has_filters=bool(self.known_filters), has_corner=has_corner)
        return self.model_copy(update=update)

    @property
    def date(self) -> datetime | None:
        """The date `calibrated`, midnight UTC; None where it is not stated."""
        return midnight(self.calibrated)

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of what is stated: the JSON of all fields that have not their default, by name, without blanks."""
        stated = self.model_dump(mode="json", exclude_defaults=True)
        return hashlib.sha256(msgspec.json.encode(stated, order="deterministic")).hexdigest()

    def overdue(self, now: datetime) -> str:
        """Why the certificate does not hold at `now`, with the remedy; "" if it holds or states no date."""
        if self.date is None:
            return ""
        if self.date > now:
            return f"calibrated: {self.calibrated} is in the future; correct it, or the clock of this computer"
        if self.interval_years is None or now <= self.date + timedelta(days=self.interval_years * YEAR_DAYS):
            return ""
        age = (now - self.date).days / YEAR_DAYS
        return (
            f"calibrated: {self.calibrated} is {age:.1f} years ago, more than interval_years {self.interval_years:g}; "
            "have the reference calibrated, and state the new certificate"
        )


class Uncertainty(Section):
    """Standard uncertainties of the nuisances, which change the data besides S and Q; 0: the stated value is exact."""

    angle_deg: NotNegative = 0.2  # how the sensor stands: alpha, or a stated direction, by position
    theta_deg: NotNegative = 0.2
    theta_position_deg: NotNegative = 0.0
    alpha_common_deg: NotNegative = 0.1
    rotation_deg: NotNegative = 0.2
    tilt_deg: NotNegative = 0.2  # how a fixed mount, with the sensor and its reference, leans against gravity
    transverse_motion_pct: NotNegative = 1.0
    offset_mps2: Positive = 0.05  # between windows
    offset_position_mps2: NotNegative = 0.0
    gravity_mps2: NotNegative = 0.03  # standard gravity is up to 0.3 % off
    lag_s: NotNegative = 0.02
    lag_window_s: NotNegative = 5e-4  # between windows, besides what the clocks themselves say


class Process(Section):
    """How fast things may wander: standard deviation of a random walk after a day, growing with the square root of
    time, and the first uncertainty of a steady drift. Defaults: MEMS data sheets' stability over life, divided down."""

    sensitivity_pct: NotNegative = 0.018  # 0.34 % in a year, as the default of the reference (docs/drift.md)
    offset_mps2: NotNegative = 0.002  # 40 mm/s2 a year; ADXL355: 35 mm/s2 over the same
    offset_rate_mps2: NotNegative = 0.001  # a day: first uncertainty of the steady part
    offset_rate_walk_mps2: NotNegative = 2e-5  # a day, per square-root day
    tilt_deg: NotNegative = 0.002  # of a mount; 0.04 deg a year


class Temperature(Section):
    """Dependence on temperature as a polynomial about `reference_degc`; order 0 is a constant.

    Where no temperature of the sensor is told, S is a constant. `sensitivity_order` left out is 0 where `offset_order`
    is, else 1. `reference_degc` left out is the temperature of the first window that tells one, in whole degrees.
    First uncertainties of the coefficients: data sheets say 0.01 %/K (ADXL313, ADXL350) to 0.026 %/K and 0.8 mg/K
    (ICM-20948, DS-000189).
    """

    offset_order: Annotated[int, Field(ge=0, le=2)] = 1
    sensitivity_order: Annotated[int | None, Field(ge=0, le=1)] = None
    reference_degc: Annotated[float | None, Field(ge=-60, le=150)] = None
    u_offset_mps2_per_k: Positive = 0.01
    u_offset_mps2_per_k2: Positive = 2e-4
    u_sensitivity_pct_per_k: Positive = 0.02  # of each element of S, over the main sensitivity

    @model_validator(mode="after")
    def _orders(self) -> Temperature:
        if self.sensitivity_order and not self.offset_order:
            raise ValueError(
                "sensitivity_order 1 needs offset_order 1 or 2, because under gravity a sensitivity that changes moves "
                "the mean; state that, or sensitivity_order = 0"
            )
        return self

    @property
    def model(self) -> TemperatureModel:
        """The same, with what is left out filled in."""
        order = min(self.offset_order, 1) if self.sensitivity_order is None else self.sensitivity_order
        degc = 20.0 if self.reference_degc is None else self.reference_degc
        u_offset = self.u_offset_mps2_per_k, self.u_offset_mps2_per_k2
        return TemperatureModel(
            self.offset_order, order, degc, u_offset, self.u_sensitivity_pct_per_k / 100.0, self.reference_degc is None
        )


@dataclass(frozen=True, slots=True)
class StatedFields:
    """The fields of a channel that state one number, as "section.field"; the root of the sum of their squares counts.
    `convert` converts their unit to that of the estimators."""

    fields: tuple[str, ...]
    convert: Callable[[float], float] = float

    def of(self, channel: object) -> float:
        """What the channel states, in the unit of the fields."""
        places = [field.split(".") for field in self.fields]
        return float(reduce(np.hypot, [getattr(getattr(channel, section), field) for section, field in places]))


def _percent_a_year(walked_pct: float) -> float:
    return float(from_percent(walked_pct) / np.sqrt(YEAR_DAYS))


_ANGLE, _TILT = StatedFields(("uncertainty.angle_deg",), from_deg), StatedFields(("uncertainty.tilt_deg",), from_deg)
# By the names of calib.estimate.nuisances.Priors.
PRIORS: Mapping[str, StatedFields] = {
    "sensor_corner_hz": StatedFields(("prior.u_corner_hz",)), "sensor_corner_at_hz": StatedFields(("prior.corner_hz",)),
    "lag_s": StatedFields(("uncertainty.lag_s", "certificate.u_lag_s")),
    "lag_at_s": StatedFields(("certificate.lag_s",), neg),
    "theta_rad": StatedFields(("uncertainty.theta_deg",), from_deg),
    "theta_position_rad": StatedFields(("uncertainty.theta_position_deg",), from_deg),
    "alpha_common_rad": StatedFields(("uncertainty.alpha_common_deg",), from_deg),
    "angle_rad": _ANGLE, "gravity_direction_rad": _ANGLE,
    "offset_position_mps2": StatedFields(("uncertainty.offset_position_mps2",)),
    "gravity_mps2": StatedFields(("uncertainty.gravity_mps2",)),
    "reference": StatedFields(("certificate.u_sensitivity_pct",), from_percent),
    "reference_transverse": StatedFields(("certificate.u_transverse_pct",), from_percent),
    "reference_drift": StatedFields(("certificate.stability_pct",), from_percent),
    "reference_per_k": StatedFields(("certificate.u_sensitivity_pct_per_k",), from_percent),
    "reference_corner_hz": StatedFields(("certificate.u_corner_hz",)),
    "reference_corner_at_hz": StatedFields(("certificate.corner_hz",)),
    "rotation_rad": StatedFields(("uncertainty.rotation_deg",), from_deg),
    "transverse": StatedFields(("uncertainty.transverse_motion_pct",), from_percent),
    "offset_mps2": StatedFields(("uncertainty.offset_mps2",)),
    "lag_window_s": StatedFields(("uncertainty.lag_window_s",)),
    "reference_frequency_hz": StatedFields(("prior.reference_frequency_hz",)),
}  # fmt: skip
AT_FIXED_MOUNT: Mapping[str, StatedFields] = {**PRIORS, "gravity_direction_rad": _TILT, "lean_rad": _TILT}
# By the names of calib.estimate.wander.Wander.
WALKS: Mapping[str, StatedFields] = {
    "sensitivity": StatedFields(("process.sensitivity_pct",), from_percent),
    "tilt_rad": StatedFields(("process.tilt_deg",), from_deg),
    "offset_mps2": StatedFields(("process.offset_mps2",)),
    "offset_rate_mps2": StatedFields(("process.offset_rate_mps2",)),
    "offset_rate_walk_mps2": StatedFields(("process.offset_rate_walk_mps2",)),
    "reference_drift": StatedFields(("certificate.stability_pct",), _percent_a_year),
}


class Knowledge(Section):
    """Base of a channel: all its sections of what is known beforehand."""

    prior: Prior
    certificate: Certificate = Certificate()
    uncertainty: Uncertainty = Uncertainty()
    process: Process = Process()
    temperature: Temperature = Temperature()
    gate: GateSettings = GateSettings()
    drift: DriftOptions = DriftOptions()

    @model_validator(mode="after")
    def _agree(self) -> Knowledge:
        if fault := self.certificate_fault:
            raise ValueError(fault)
        return self

    @property
    def certificate_fault(self) -> str:
        """What is wrong with the statements on the reference; "" if nothing is."""
        if self.certificate.lag_s and not self.certificate.u_lag_s:
            return "certificate.lag_s needs certificate.u_lag_s"
        return ""

    @property
    def instrument(self) -> Instrument:
        """What the front end must know of the reference, and of the sensor beside it."""
        c, s = self.certificate, self.prior
        return Instrument(
            c.quantity, c.sensitivity, c.noise_mps2, c.corner_hz, c.u_corner_hz, s.corner_hz, s.u_corner_hz,
            known=self.known_filters,
        )  # fmt: skip

    @property
    def known_filters(self) -> KnownResponse:
        """What is stated of the filters of both instruments."""
        sensor, reference = tuple(map(filter_of, self.prior.filters)), self.certificate.known_filters
        return KnownResponse(sensor or None, reference or None)

    def priors(self, *, fixed_mount: bool) -> Priors:
        """The nuisances' priors."""
        return Priors(self._stated(AT_FIXED_MOUNT if fixed_mount else PRIORS)).beside_known(self.known_filters)

    def wander(self) -> Wander:
        """How fast things may change."""
        return Wander(self._stated(WALKS))

    def _stated(self, settings: Mapping[str, StatedFields]) -> dict[str, float]:
        return {name: setting.convert(setting.of(self)) for name, setting in settings.items()}

    def temperature_model(self) -> TemperatureModel:
        """Dependence on temperature."""
        return self.temperature.model
