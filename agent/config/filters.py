"""Filters of instruments that are known beforehand, as a configuration or a certificate states them."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from agent.config.section import Section
from calib.signal.known_filters import MOST_NUMBERS, Filter, Highpass, Table, corner_apart, filter_of

MOST_FILTERS = 8
Numbers = Annotated[tuple[float, ...], Field(max_length=MOST_NUMBERS)]


def _filter(text: str) -> str:
    if isinstance(filter_of(text), Highpass):
        raise ValueError(
            "highpass is what a driver states; of an AC-coupled instrument state corner_hz, u_corner_hz here"
        )
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
        corner_apart(stated)
    except ValueError as error:
        raise FiltersError(str(error)) from None
    return tuple(stated)


def stated_by_driver(lines: tuple[str, ...], *, has_filters: bool, has_corner: bool) -> dict[str, object]:
    """What the `lines` of a driver change in the section of its device: `filters` and the corner of an AC-coupled
    instrument, each unless the section states it itself."""
    filters, (corner_hz, u_corner_hz) = corner_apart(lines)
    of_filters: dict[str, object] = {} if has_filters else {"filters": filters}
    return of_filters if has_corner else of_filters | {"corner_hz": corner_hz, "u_corner_hz": u_corner_hz}


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
