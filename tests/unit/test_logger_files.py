"""Files from one truth, as loggers write them and with their faults: read right, or refused with line and remedy."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.calibrate.tables import SensorFile, read_sensor
from agent.reading import delimited, lines
from agent.reading.formats import Description
from agent.reading.source import TableError
from tests.unit.logger_heads import DATED, HEADS, Head

N = 100
_RANDOM = np.random.default_rng(7)
V = np.column_stack([_RANDOM.integers(-9999, 9999, (N, 2)), 9800 + _RANDOM.integers(0, 99, N)]) / 1000


@pytest.fixture(params=["pyarrow", "numpy"], autouse=True)
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files as a whole by pyarrow, and in pieces of 1000 bytes by numpy."""
    if request.param == "numpy":
        monkeypatch.setattr(delimited, "_arrow_parser", lambda: None)
        monkeypatch.setattr(lines, "CHUNK_BYTES", 1000)
    elif importlib.util.find_spec("pyarrow") is None:
        pytest.skip("pyarrow is not installed (extra files)")


def fields(k: int, step_s: float) -> dict[str, Any]:
    """What the rows of a head may name."""
    us = round(k * step_s * 1e6)
    d = datetime.fromtimestamp(DATED, UTC) + timedelta(microseconds=us)
    named: dict[str, Any] = dict(zip("xyz", (f"{value:.3f}" for value in V[k]), strict=True))
    named |= {f"{name}c": value.replace(".", ",") for name, value in named.items()}
    epoch_us = round(DATED) * 10**6 + us
    return named | {
        "k": k, "t": k * 0.01 if step_s < 1e-3 else k * step_s, "tc": f"{k * step_s:.3f}".replace(".", ","), "d": d,
        "ms": d.microsecond // 1000, "us": d.microsecond, "tick": us // 1000, "packet": (65500 + k) % 65536,
        "wrapping": (4_294_900_000 + us) % 2**32, "signed": (2_147_400_000 + us + 2**31) % 2**32 - 2**31,
        "epoch_s": epoch_us // 10**6, "epoch_ms": epoch_us // 1000, "epoch_us": epoch_us,
        "night": datetime(2023, 11, 14, 23, 59, 58, tzinfo=UTC) + timedelta(microseconds=us),
        "summer": datetime(2023, 10, 29, 2, 59, 58, tzinfo=UTC) + timedelta(microseconds=us, hours=-int(us >= 2e6)),
        "days": f"{25569 + (DATED + k * step_s) / 86400:.12f}",
    }  # fmt: skip


def rows(row: str, step_s: float = 0.01) -> list[str]:
    return [row.format(**fields(k, step_s)) for k in range(N)]


def read(tmp_path: Path, data: str | bytes, columns: str | None = None, order: str | None = None) -> SensorFile:
    path = tmp_path / "logger.csv"
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return read_sensor(path, None, columns, Description(date_order=order))


def agrees(found: SensorFile, times_s: np.ndarray, values: np.ndarray, resolution_s: float = 0.0) -> None:
    """The values exactly; times to 1e-9 s, or one unit in the last place of a date in s."""
    np.testing.assert_array_equal(found.v[:], values)
    atol = max(1e-9, resolution_s, float(np.spacing(np.abs(times_s).max())))
    np.testing.assert_allclose(found.time_s[:], times_s, rtol=0, atol=atol)


@pytest.mark.slow
@pytest.mark.parametrize("head", HEADS, ids=[head.source for head in HEADS])
def test_heads(head: Head, tmp_path: Path) -> None:
    text = head.head + "".join(f"{row}\r\n" for row in rows(head.row, head.step_s))
    if head.refused:
        with pytest.raises(TableError, match=head.refused) as told:
            read(tmp_path, text, head.columns, head.order)
        assert re.search("--columns|correct|write a line for each time", str(told.value))
        return
    found = read(tmp_path, text, head.columns, head.order)
    agrees(found, head.begins_s + np.arange(N) * head.step_s, V)
    assert head.said in " ".join(found.said)


def test_the_heads_have_sources() -> None:
    assert len({head.source for head in HEADS}) == len(HEADS) >= 50


@dataclass(frozen=True)
class Written:
    """How the truth is written: a head, a row, and the first time that is read, with the resolution of what is written.

    `anew`: what is said since the clock begins anew in the file."""

    head: str
    row: str
    delimiter: str = ","
    begins_s: float = 0.0
    resolution_s: float = 0.0
    anew: str = ""


STEP_S = 0.05
COMMA = "{xc};{yc};{zc}"
NAMES = "x,y,z\n"
DIALECTS = {
    "s": Written("time_s,vx,vy,vz\n", "{t:.2f},{x},{y},{z}"),
    "decimal commas": Written("time_s;vx;vy;vz\n", "{tc};" + COMMA, ";"),
    "blanks": Written("  time_s    vx    vy   vz\n", "  {t:.2f}   {x}   {y}  {z}", " "),
    "ms and tabs": Written("device\t17\nTime [ms]\tX\tY\tZ\n", "{tick}\t{x}\t{y}\t{z}", "\t"),
    "ISO 8601": Written("time," + NAMES, "{d:%Y-%m-%dT%H:%M:%S}.{ms:03d}Z,{x},{y},{z}", begins_s=DATED),
    "dd.mm.yyyy": Written("Zeit;x;y;z\n", "{d:%d.%m.%Y %H:%M:%S},{ms:03d};" + COMMA, ";", DATED),
    "mm/dd/yyyy AM/PM": Written("time," + NAMES, "{d:%m/%d/%Y %I:%M:%S}.{ms:03d} {d:%p},{x},{y},{z}", begins_s=DATED),
    "a zone name": Written("time," + NAMES, "{d:%Y/%m/%d %H:%M:%S}.{ms:03d} CET,{x},{y},{z}", begins_s=DATED - 3600),
    "two columns": Written("Date|Time|x|y|z\n", "{d:%d-%b-%Y}|{d:%H:%M:%S}.{ms:03d}|{x}|{y}|{z}", "|", DATED),
    "clock over midnight": Written("time," + NAMES, "{night:%H:%M:%S}.{ms:03d},{x},{y},{z}", begins_s=86398.0,
                                   anew="passes midnight"),
    "summer time ends": Written("time," + NAMES, "{summer:%Y-%m-%d %H:%M:%S}.{ms:03d},{x},{y},{z}",
                                begins_s=1_698_548_398.0, anew="at the end of summer time"),
    "days of Excel": Written("Date/Time," + NAMES, "{days},{x},{y},{z}", begins_s=DATED, resolution_s=7e-7),
    "counter that wraps": Written("time_us," + NAMES, "{wrapping},{x},{y},{z}", begins_s=4294.9, anew="of 32 bits"),
    "rate in the head": Written("Sampling interval (ms);50\nx;y;z\n", COMMA, ";"),
}  # fmt: skip


@dataclass
class Wrong:
    """A file with a fault, and what must come of it. `rows`: those that are read; `gaps`: those without values."""

    data: bytes
    rows: np.ndarray
    said: str = ""
    refused: str = ""
    gaps: tuple[int, ...] = ()


ALL = np.arange(N)


def written(way: Written, body: list[str]) -> bytes:
    return (way.head + "".join(f"{line}\n" for line in body)).encode()


def line_of(way: Written, row: int) -> int:
    return way.head.count("\n") + row + 1


def cells(way: Written, body: list[str], edit: Callable[[int, list[str]], list[str]]) -> list[str]:
    """The rows with some fields changed."""
    split = [line.split() if way.delimiter == " " else line.split(way.delimiter) for line in body]
    return [way.delimiter.join(edit(k, row)) for k, row in enumerate(split)]


def no_end(way: Written, body: list[str]) -> Wrong:
    return Wrong(
        written(way, body)[:-3], ALL[:-1], r"the last line, '.*', has no end and may be cut off; it is left out"
    )


def cut_line(way: Written, body: list[str]) -> Wrong:
    short = cells(way, body, lambda k, row: row[:-1] if k == N - 1 else row)
    return Wrong(written(way, short), ALL[:-1], "cut off or have bytes 0: 1; they are left out")


def zeros_behind(way: Written, body: list[str]) -> Wrong:
    return Wrong(written(way, body) + bytes(100_000), ALL, "bytes 0 stand behind the last line")


def zeros_within(way: Written, body: list[str]) -> Wrong:
    within = [*body[:50], body[50][:5] + "\0" * 512, *body[50:]]
    return Wrong(written(way, within), ALL, "bytes 0: 1; they are left out")


def no_time(way: Written, body: list[str]) -> Wrong | None:
    if way.delimiter == " " or "interval" in way.head:
        return None
    times = 2 if "Date|" in way.head else 1
    some = cells(way, body, lambda k, row: [""] * times + row[times:] if k in (30, 31) else row)
    return Wrong(written(way, some), np.delete(ALL, [30, 31]), rf"line {line_of(way, 30)}: rows without a time: 2")


def missing_cells(way: Written, body: list[str]) -> Wrong:
    words = (
        "---",
        "OVER",
        "#N/A",
        "NaN",
        "NAN",
        "null",
        "-OVER",
        "OL",
        "+++++++",
        *([] if way.delimiter == " " else [""]),
    )
    last = 3 if "interval" in way.head else 2
    some = cells(
        way, body, lambda k, row: [*row[:-last], words[k], *row[len(row) - last + 1 :]] if k < len(words) else row
    )
    return Wrong(written(way, some), ALL, gaps=tuple(range(len(words))))


def comments(way: Written, body: list[str]) -> Wrong:
    marks = ["# knock", "% knock", "  // knock", *([] if way.delimiter == ";" else ["; knock"])]
    return Wrong(written(way, [*body[:40], *marks, *body[40:]]), ALL)


def head_again(way: Written, body: list[str]) -> Wrong:
    return Wrong(written(way, [*body[:60], *way.head.splitlines(), *body[60:]]), ALL)


def carriage_returns(way: Written, body: list[str]) -> Wrong:
    return Wrong(written(way, body).replace(b"\n", b"\r"), ALL)


def utf16(way: Written, body: list[str]) -> Wrong:
    return Wrong(written(way, body).decode().encode("utf-16"), ALL)


def byte_order_mark(way: Written, body: list[str]) -> Wrong:
    return Wrong(b"\xef\xbb\xbf" + written(way, body).replace(b"\n", b"\r\n"), ALL)


def fortran(way: Written, body: list[str]) -> Wrong:
    some = cells(way, body, lambda _, row: [*row[:-3], *(f"{value}D+00" for value in row[-3:])])
    return Wrong(written(way, some), ALL)


def delimiters_at_the_end(way: Written, body: list[str]) -> Wrong:
    return Wrong(written(way, [line + way.delimiter for line in body]), ALL)


def thousands(way: Written, body: list[str]) -> Wrong:
    grouped = "1.402,118" if "," in body[0].replace(way.delimiter, "") else "1,402.118"
    some = cells(
        way, body, lambda k, row: [*row[:-1], grouped if way.delimiter == " " else f'"{grouped}"'] if k == 70 else row
    )
    return Wrong(written(way, some), ALL, refused=rf"line {line_of(way, 70)}, column .*: '{grouped}' has a .*; write ")


def a_word(way: Written, body: list[str]) -> Wrong:
    some = cells(way, body, lambda k, row: [*row[:-1], "abc"] if k == 20 else row)
    return Wrong(written(way, some), ALL, refused=rf"line {line_of(way, 20)}, column .*: 'abc' is not a .*; correct it")


def a_field_less(way: Written, body: list[str]) -> Wrong:
    short = cells(way, body, lambda k, row: row[:-1] if k == 20 else row)
    return Wrong(
        written(way, short), ALL, refused=rf"line {line_of(way, 20)}: \d fields, but the header has \d; correct"
    )


FAULTS = (no_end, cut_line, zeros_behind, zeros_within, no_time, missing_cells, comments, head_again, carriage_returns,
          utf16, byte_order_mark, fortran, delimiters_at_the_end, thousands, a_word, a_field_less)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
@pytest.mark.parametrize(
    "dialect", [pytest.param(d, marks=[pytest.mark.thorough] * (k % 3 > 0)) for k, d in enumerate(DIALECTS)]
)
def test_faults(dialect: str, fault: Callable[[Written, list[str]], Wrong | None], tmp_path: Path) -> None:
    way = DIALECTS[dialect]
    wrong = fault(way, rows(way.row, STEP_S))
    if wrong is None:
        return
    if wrong.refused:
        with pytest.raises(TableError, match=wrong.refused) as told:
            read(tmp_path, wrong.data)
        assert "\n" not in str(told.value)
        return
    found = read(tmp_path, wrong.data)
    expected = V[wrong.rows].copy()
    expected[list(wrong.gaps)] = np.nan
    agrees(found, way.begins_s + STEP_S * wrong.rows, expected, way.resolution_s)
    said = "\n".join(found.said)
    assert re.search(wrong.said, said)
    assert way.anew in said
    assert ("the comma is taken as the decimal mark" in said) == ("{xc}" in way.row)
