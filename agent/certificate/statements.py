"""What only people know of a calibration: the file `certificate.toml`."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from agent.config.knowledge import iso_date
from agent.config.section import Section
from agent.terminal.text import one_line

LONGEST_LINE = 160  # characters: two lines of the PDF
FIELD_TITLE = "Calibration certificate (field calibration)"
NOT_IN_XML = re.compile("[\ufffe\uffff]")


def _line(text: str) -> str:
    if text != text.strip() or one_line(text) != text or NOT_IN_XML.search(text):
        raise ValueError("must be one line of visible characters, without spaces at its ends")
    return text


def _country(text: str) -> str:
    if not re.fullmatch("[A-Z]{2}", text):
        raise ValueError("must be the two capital letters of ISO 3166-1, as in IT")
    return text


def _day(value: object) -> str:
    day = iso_date(value)
    if not day:
        raise ValueError("must be a date: year, month and day, as in 2026-03-01")
    return day


Optional = Annotated[str, Field(max_length=LONGEST_LINE), AfterValidator(_line)]
Line = Annotated[str, Field(min_length=1, max_length=LONGEST_LINE), AfterValidator(_line)]
Country = Annotated[str, AfterValidator(_country)]
Day = Annotated[str, BeforeValidator(_day)]
Degrees = Annotated[float, Field(ge=-100, le=300)]


class Contact(Section):
    """An organisation or a person with an address."""

    name: Line
    street: Optional = ""
    post_code: Optional = ""
    city: Line
    country: Country
    email: Optional = ""

    @property
    def address(self) -> str:
        """In one line."""
        parts = (self.street, f"{self.post_code} {self.city}".strip(), self.country, self.email)
        return ", ".join(part for part in parts if part)


class Operator(Section):
    """Who answers for the calibration (7.8.2.1 o)."""

    name: Line
    role: Optional = ""


class Item(Section):
    """The sensor that was calibrated. `output_unit`: if the result does not state it, for example mV or count."""

    name: Line = "tri-axial accelerometer"
    manufacturer: Line
    model: Line
    serial_number: Line
    output_unit: Optional = ""


class Reference(Section):
    """The reference with its own certificate. `certificate_file` is found beside certificate.toml, and is hashed.

    `name`: left out, it is called by what it gives: reference accelerometer, or vibrometer where it gives a velocity.
    """

    name: Optional = ""
    manufacturer: Line
    model: Line
    serial_number: Line
    certificate_number: Line
    certificate_issuer: Line
    calibrated: Day
    certificate_file: Optional = ""


class Place(Section):
    """Where the sensor was calibrated. `kind` is in the words of the DCC."""

    description: Line
    kind: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] = "other"


class Dates(Section):
    """`begun` and `ended`: first and last day of the measurement. `issued`: date of the certificate."""

    received: Annotated[str, BeforeValidator(iso_date)] = ""
    begun: Day
    ended: Day
    issued: Day

    @model_validator(mode="after")
    def _order(self) -> Dates:
        if self.ended < self.begun:
            raise ValueError(f"ended: {self.ended} is before begun, {self.begun}; correct one of them")
        if self.issued < self.ended:
            raise ValueError(f"issued: {self.issued} is before ended, {self.ended}; correct one of them")
        return self


class Conditions(Section):
    """The environment. Left out, the temperatures are those that the sensor recorded."""

    temperature_low_degc: Degrees | None = None
    temperature_high_degc: Degrees | None = None
    other: Optional = ""

    @model_validator(mode="after")
    def _check_temperatures(self) -> Conditions:
        low, high = self.temperature_low_degc, self.temperature_high_degc
        if (low is None) != (high is None):
            raise ValueError("temperature_low_degc and temperature_high_degc must be given together; add the other")
        if low is not None and high is not None and low > high:
            raise ValueError(f"temperature_low_degc: {low} is above temperature_high_degc, {high}; exchange them")
        return self


class DecisionRule(Section):
    """A limit for the main sensitivities, in % of `nominal` (output unit per m/s2), and how U is taken into account.

    `simple acceptance`: the deviation is at most the limit. `guard band`: deviation and U together are at most the
    limit (ILAC-G8:09/2019, w = U).
    """

    nominal: Annotated[float, Field(gt=0)]
    limit_pct: Annotated[float, Field(gt=0, le=100)]
    rule: Literal["simple acceptance", "guard band"]


class Accreditation(Section):
    """Only for a laboratory whose accreditation covers this calibration where it was made."""

    body: Line
    number: Line


class CertificateStatements(Section):
    """The whole file. `number` is left out: the certificate is numbered by its content."""

    title: Line = FIELD_TITLE
    number: Optional = ""
    organisation: Contact
    operator: Operator
    customer: Contact
    instrument: Item
    reference: Reference
    place: Place
    dates: Dates
    conditions: Conditions = Conditions()
    decision: DecisionRule | None = None
    accreditation: Accreditation | None = None
    remarks: Annotated[tuple[Line, ...], Field(max_length=5)] = ()
