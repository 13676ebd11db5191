"""Dates and times of day as loggers write them, in s: since 1970 (UTC) with a date, since midnight without one.

Abbreviations of zones are those of RFC 5322, section 4.3, and of the file "europe" of the IANA time zone database.
Those with several meanings (IST, BST) are not known.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from datetime import date, datetime, timedelta
from functools import lru_cache
from zoneinfo import ZoneInfo

import numpy as np

from agent.reading.source import Array

ORDERS = ("dmy", "mdy", "ymd")
# A date as ISO 8601; a date without zone is taken as UTC.
_ISO = re.compile(
    r"(?P<date>(?:19|20)\d\d[-/]\d\d[-/]\d\d)[T ](?P<time>\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?)\s?"
    r"(?P<zone>Z|UTC|[+-]\d\d:?\d\d)?"
)
_DAY = r"\d{4}(?P<mark>[-/.])\d{1,2}(?P=mark)\d{1,2}|\d{1,2}(?P<sep>[-/.])\d{1,2}(?P=sep)(?:\d{4}|\d\d)"
_DAY += r"|\d{1,2}[-/ ][A-Za-z]{3,9}[-/ ]\d{4}"
_DAY += r"|[A-Za-z]{3,9} \d{1,2},? \d{4}|[12]\d{7}(?=T)"
_CLOCK = r"\d{1,3}:\d\d(?::\d\d)?(?:[.,]\d{1,9}|:\d{3})?(?: ?[AaPp]\.?[Mm]\.?)?"
_ZONE = r"Z|(?:UTC|GMT)?[+-]\d\d?(?::?\d\d)?|[A-Z]{2,4}|[A-Z][A-Za-z]+/[A-Za-z_/]+"
_MOMENT = re.compile(
    rf"(?:(?P<day>{_DAY})(?:[T_, ]{{1,3}}|$))?(?:(?P<clock>{_CLOCK})(?: ?(?P<zone>{_ZONE})(?: ?\[[\w/]+\])?)?)?"
)
_PARTS = re.compile(r"(\d+):(\d\d)(?::(\d\d))?(?:[.,:](\d+))?(?: ?([AaPp]).*)?")
_COMPACT = re.compile(r"(?P<day>[12]\d{7})T(\d\d)(\d\d)(\d\d)")
_HINT = re.compile(r"\b(d{1,2}|m{1,2}|y{2,4})[-/. ](d{1,2}|m{1,4}|y{2,4})[-/. ](d{1,2}|m{1,2}|y{2,4})\b", re.IGNORECASE)
_OFFSET = re.compile(r"(?:GMT|UTC) ?([+-]\d\d?(?::?\d\d)?)|[(\[]([+-]\d\d:?\d\d)[)\]]")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_HOURS = {"UT": 0, "UTC": 0, "GMT": 0, "Z": 0, "EST": -5, "EDT": -4, "CST": -6, "CDT": -5, "MST": -7, "MDT": -6,
          "PST": -8, "PDT": -7, "WET": 0, "WEST": 1, "CET": 1, "CEST": 2, "EET": 2, "EEST": 3}  # fmt: skip
_EPOCH = date(1970, 1, 1).toordinal()
DAY_S = 86400


class UnclearError(ValueError):
    """A date or a time of day that has several meanings, or none. The message names it and the remedy."""


def has_day(text: str) -> bool:
    """Whether `text` is a date, with or without a time of day."""
    found = _MOMENT.fullmatch(_spread(text))
    return found is not None and found["day"] is not None


def has_clock(text: str) -> bool:
    """Whether `text` has a time of day that is not midnight. Excel writes a date alone as one at midnight."""
    found = _MOMENT.fullmatch(_spread(text))
    return found is not None and bool((found["clock"] or "").strip("0:."))


def is_moment(text: str) -> bool:
    """Whether `text` is a date, a time of day, or both."""
    return bool(text) and _MOMENT.fullmatch(_spread(text)) is not None


def day_of(text: str) -> str:
    """The date in a text that has one."""
    found = _MOMENT.fullmatch(_spread(text))
    return found["day"] or "" if found else ""


def order_of(days: Iterable[str]) -> str:
    """Which of day, month and year is the first in these dates: "dmy", "mdy" or "ymd"; "" where that is not clear.

    A field above 12 decides, and so do the steps: time does not go back, and days follow each other.
    """
    distinct = list(dict.fromkeys(days))
    found: dict[tuple[int, ...], str] = {}
    for order in ORDERS:
        try:
            numbers = tuple(_day_number(day, order) for day in distinct)
        except UnclearError:
            continue
        if all(b >= a for a, b in itertools.pairwise(numbers)):
            found.setdefault(numbers, order)
    daily = [order for n, order in found.items() if len(n) > 1 and max(np.diff(n)) == 1]
    decided = daily if len(daily) == 1 else list(found.values())
    return decided[0] if len(decided) == 1 else ""


def order_in(text: str) -> str:
    """The order that a head states, as in "dd/mm/yyyy"; "" where it states none."""
    letters = ["".join(field[0].lower() for field in found) for found in _HINT.findall(text)]
    return next((order for order in letters if order in ORDERS), "")


def offset_in(name: str) -> int:
    """The offset from UTC in s that the name of a column states, as in "Date Time, GMT-05:00"; else 0."""
    found = _OFFSET.search(name)
    return _offset_s(found[1] or found[2]) if found else 0


def seconds_of(texts: Sequence[str], order: str = "", offset_s: int = 0) -> Array:
    """Dates and times of day in s. `order`: of day, month and year; `offset_s`: from UTC where the text has no zone.

    Raises ValueError for what is neither, and UnclearError for what has several meanings.
    """
    plain = [text.strip() for text in texts]
    iso = [_ISO.fullmatch(text) for text in plain]
    if not all(iso):
        return np.array([_moment_s(text, order, offset_s) for text in plain])
    dates = [f"{m['date'].replace('/', '-')}T{m['time'].replace(',', '.')}" for m in iso if m]
    ns = np.array(dates, dtype="datetime64[ns]").astype(np.int64)
    shift = np.array([_offset_s(m["zone"]) if m["zone"] else offset_s for m in iso if m])
    return np.asarray(ns // 10**9 - shift + (ns % 10**9) * 1e-9)


def _spread(text: str) -> str:
    """A compact time of ISO 8601, 20231114T221320, with its colons."""
    return _COMPACT.sub(r"\g<day>T\2:\3:\4", text)


def _moment_s(text: str, order: str, offset_s: int) -> float:
    found = _MOMENT.fullmatch(_spread(text))
    if not text or found is None:
        raise ValueError(text)
    day = None if found["day"] is None else _day_number(found["day"], order)
    ns = _clock_ns(found["clock"], day is not None) if found["clock"] else 0
    if day is None:
        return ns / 1e9
    whole_s = (day - _EPOCH) * DAY_S + ns // 10**9
    return whole_s - (_zone_s(found["zone"], whole_s) if found["zone"] else offset_s) + (ns % 10**9) * 1e-9


def _orders(text: str) -> tuple[list[str], list[str]]:
    """The three fields of a date, and the orders in which they may stand."""
    if text.isdigit():
        return [text[:4], text[4:6], text[6:]], ["ymd"]
    fields = re.findall(r"\d+|[A-Za-z]+", text)
    if fields[0].isalpha():
        return fields, ["mdy"]
    if fields[1].isalpha():
        return fields, ["dmy"]
    if len(fields[0]) > 2:
        return fields, ["ymd"]
    if len(fields[2]) == 4:
        return fields, ["dmy"] if "." in text else ["dmy", "mdy"]
    return fields, ["dmy", "mdy", "ymd"]


@lru_cache(maxsize=1024)
def _day_number(text: str, order: str) -> int:
    """The day's number in the proleptic Gregorian calendar. Raises UnclearError."""
    fields, orders = _orders(text)
    numbers = {o: n for o in orders if (n := _ordinal(dict(zip(o, fields, strict=True)))) is not None}
    if order in orders or len(orders) == 1:
        numbers = {o: n for o, n in numbers.items() if len(orders) == 1 or o == order}
    if len(set(numbers.values())) != 1:
        if not numbers:
            raise UnclearError(
                f"{text!r} is no date{f' in the order {order}, see --date-order' if order else ''}; correct it"
            )
        meant = " or ".join(f"{date.fromordinal(n)} ({o})" for o, n in numbers.items())
        raise UnclearError(f"{text!r} may be {meant}; state which with --date-order")
    return next(iter(numbers.values()))


def _ordinal(fields: dict[str, str]) -> int | None:
    """The number of the day with these fields, None where there is no such day. Two digits of a year as in POSIX."""
    month = fields["m"] if fields["m"].isdigit() else str(_MONTHS.index(m) + 1 if (m := fields["m"][:3].lower()) in
                                                          _MONTHS else 0)  # fmt: skip
    year = int(fields["y"])
    if len(fields["y"]) == 2:
        year += 2000 if year < 69 else 1900
    try:
        return date(year, int(month), int(fields["d"])).toordinal()
    except ValueError:
        return None


def _hour(text: str, half: str | None) -> int:
    """The hour of the day; `half`: A or P where the day has two halves. 99 for an hour that these do not have."""
    hour = int(text)
    if not half:
        return hour
    return hour % 12 + (12 if half in "Pp" else 0) if 1 <= hour <= 12 else 99


def _clock_ns(text: str, with_day: bool) -> int:
    """A time of day in ns. Raises UnclearError."""
    found = _PARTS.fullmatch(text)
    assert found is not None  # _CLOCK is the same without its parts
    first, second, third, fraction, half = found.groups()
    if third is None and fraction is None and not with_day:
        raise UnclearError(f"{text!r} may be hours and minutes, or minutes and seconds; write HH:MM:SS")
    if third is None and fraction is not None:
        first, second, third = "0", first, second
    hour, minute, s = _hour(first, half), int(second), int(third or 0)
    if minute > 59 or s > 60 or hour > (23 if with_day or half else 999):
        raise UnclearError(f"{text!r} is no time of day; correct it")
    return ((60 * hour + minute) * 60 + s) * 10**9 + int((fraction or "").ljust(9, "0"))


def _zone_s(zone: str, local_s: int) -> int:
    """The offset from UTC in s of a zone at a local time. Raises UnclearError."""
    if zone in _HOURS:
        return 3600 * _HOURS[zone]
    if zone[-1].isdigit():
        return _offset_s(zone)
    try:
        local = datetime(1970, 1, 1, tzinfo=ZoneInfo(zone)) + timedelta(seconds=local_s)
        return int((local.utcoffset() or timedelta()).total_seconds())
    except (KeyError, ValueError, OSError):
        raise UnclearError(
            f"the zone {zone!r} is not known, or has several meanings; write its offset, as +01:00"
        ) from None


def _offset_s(zone: str) -> int:
    if zone in ("Z", "UTC"):
        return 0
    plain = zone.removeprefix("UTC").removeprefix("GMT").strip().replace(":", "")
    hours, minutes = (plain[1:-2], plain[-2:]) if len(plain) > 3 else (plain[1:], "0")
    return (-60 if plain[0] == "-" else 60) * (60 * int(hours) + int(minutes))
