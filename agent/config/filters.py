"""Filters of instruments that are known beforehand, as a configuration or a certificate states them."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from agent.config.section import Section
from calib.signal.known_filters import MOST_NUMBERS, Filter, Table, filter_of

MOST_FILTERS = 8
Numbers = Annotated[tuple[float, ...], Field(max_length=MOST_NUMBERS)]


def _filter(text: str) -> str:
    filter_of(text)
    return text


class FiltersError(ValueError):
    """What a driver states of its filters cannot be used; the text says why."""


def filters_of(stated: object) -> tuple[str, ...]:
    """The lines that a driver states, if each is a filter. Raises FiltersError."""
    if not isinstance(stated, list | tuple) or not all(isinstance(line, str) for line in stated):
        raise FiltersError("a list of texts is needed, one for each filter")
    if len(stated) > MOST_FILTERS:
        raise FiltersError(f"there are {len(stated)} filters, at most {MOST_FILTERS} are allowed")
    try:
        return tuple(map(_filter, stated))
    except ValueError as error:
        raise FiltersError(str(error)) from None


Filters = Annotated[
    tuple[Annotated[str, AfterValidator(_filter)], ...],
    Field(max_length=MOST_FILTERS, description="known filters, one after the other, as 'lowpass order=2 corner_hz=31'"),
]


class ResponseTable(Section):
    """A calibration over frequency as laboratories print it: sensitivity relative to that of the certificate, phase in
    degrees (negative where the indication comes late), expanded uncertainty (k = 2) of the sensitivity in %."""

    frequency_hz: Numbers
    relative_sensitivity: Numbers
    phase_deg: Numbers = ()
    expanded_u_pct: Numbers = ()

    @model_validator(mode="after")
    def _table(self) -> ResponseTable:
        self.filter()
        return self

    def filter(self) -> Filter:
        """The filter that it is. Raises ValueError."""
        return Table(self.frequency_hz, self.relative_sensitivity, self.phase_deg, self.expanded_u_pct)
