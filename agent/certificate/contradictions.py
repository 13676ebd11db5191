"""What a person stated for a certificate, and the data tell otherwise: the dates, and the serial numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

from agent.certificate.statements import CertificateStatements
from agent.report.material import Material
from calib.recorded.table import FIRST_DATE_S, LAST_S

# A stated day is one of the place, data are in UTC: somewhere a day begins so much earlier, and ends so much later.
BEGINS_EARLIER, ENDS_LATER = timedelta(hours=14), timedelta(hours=12)


def contradictions(stated: CertificateStatements, material: Material) -> tuple[str, ...]:
    """A sentence for each statement that the data contradict."""
    return *_of_dates(stated, material), *_of_serial_numbers(stated, material)


def _of_dates(stated: CertificateStatements, material: Material) -> Iterator[str]:
    times = _times(material)
    if not times:
        return
    first, last = min(times), max(times)
    begun, ended = (datetime.fromisoformat(day).replace(tzinfo=UTC) for day in (stated.dates.begun, stated.dates.ended))
    if last >= ended + timedelta(days=1) + ENDS_LATER:
        yield f"dates.ended is stated as {stated.dates.ended}, but the data go on until {last:%Y-%m-%d %H:%M} UTC"
    if first < begun - BEGINS_EARLIER:
        yield f"dates.begun is stated as {stated.dates.begun}, but the data are from {first:%Y-%m-%d %H:%M} UTC"


def _times(material: Material) -> list[datetime]:
    """Begin and end of the used windows of files with dates; of an agent the date of the calibration."""
    result = material.results[0]
    dates = [u.date_utc_ns * 1e-9 for u in material.history if u.made == (result.fields.get("run_id"),
                                                                          result.fields.get("sequence"))]  # fmt: skip
    if not material.history:
        dates = [s for w in result.windows if w.used for s in (w.start_s, w.stop_s) if FIRST_DATE_S <= s < LAST_S]
    return [datetime.fromtimestamp(s, UTC) for s in dates]


def _of_serial_numbers(stated: CertificateStatements, material: Material) -> Iterator[str]:
    for role, number in (
        ("instrument", stated.instrument.serial_number),
        ("reference", stated.reference.serial_number),
    ):
        told = material.serial_numbers.get(role, "")
        if told and _plain(told) != _plain(number):
            yield f"{role}.serial_number is stated as {number}, but the recording names {told}"


def _plain(serial_number: str) -> str:
    """Without what people write in different ways: blanks, hyphens, capital letters."""
    return re.sub(r"[\W_]", "", serial_number).casefold()
