"""Workbooks of Excel: which sheets and columns are read, how cells become numbers, and what a hostile one may cost."""

from __future__ import annotations

import datetime
import re
import resource
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not installed")
from agent.calibrate.tables import read_reference, read_sensor  # noqa: E402
from agent.reading.dialect import dialect_of_cells  # noqa: E402
from agent.reading.formats import open_source  # noqa: E402
from agent.reading.source import TableError  # noqa: E402

HEAD = ["time_s", "vx", "vy", "vz"]
ROWS = [[k / 128, k + 0.5, 2 * k, -k] for k in range(40)]


def book(path: Path, **sheets: Sequence[Sequence[Any]]) -> Path:
    made = openpyxl.Workbook()
    made.remove(made.active)
    for title, rows in sheets.items():
        sheet = made.create_sheet(title)
        for row in rows:
            sheet.append(list(row))
    made.save(path)
    return path


@pytest.mark.slow
def test_each_sheet_with_a_table_is_a_group(tmp_path: Path) -> None:
    one: list[list[Any]] = [["t (s)", "a (mg)"], *[[row[0], 1000 * row[1]] for row in ROWS]]
    path = book(tmp_path / "a.xlsx", notes=[["bridge", 7]], imu=[HEAD, *ROWS], shaker=one)
    sensor, reference = read_sensor(path), read_reference(path)
    np.testing.assert_array_equal(np.column_stack([sensor.time_s[:], sensor.v[:]]), ROWS)
    np.testing.assert_allclose(reference.x[:][:, 0], 9.80665 * np.array(ROWS)[:, 1], rtol=1e-14)
    with open_source(path) as source:
        assert {column.group for column in source.columns} == {"imu", "shaker"}


@pytest.mark.slow
def test_dates_times_of_day_durations_and_missing_cells(tmp_path: Path) -> None:
    begin = datetime.datetime(2023, 11, 14, 22, 13, 20)  # naive, as Excel has it: UTC
    rows = [
        [begin + datetime.timedelta(seconds=k), datetime.timedelta(seconds=k), datetime.time(1, 0, k), 1.0, None, "n/a"]
        for k in range(9)
    ]
    path = book(tmp_path / "a.xlsx", only=[["when", "since", "day", "x", "y", "z"], *rows])
    found = read_sensor(path, columns="time=when,x=since,y=day,z=x")
    np.testing.assert_array_equal(found.time_s[:], 1_700_000_000 + np.arange(9.0))
    np.testing.assert_array_equal(found.v[:], [[k, 3600.0 + k, 1.0] for k in range(9)])
    with pytest.raises(TableError, match=r"a\.xlsx: there are 0 rows of data"):  # y and z have none
        read_sensor(path, columns="time=when,x=x,y=y,z=z")


@pytest.mark.thorough
def test_the_place_of_a_fault_is_that_of_the_sheet(tmp_path: Path) -> None:
    """Empty rows and comments count, as a person sees them."""
    rows: list[list[Any]] = [["drill 4"], [], HEAD, *ROWS[:5], [], ["# a pause"], *ROWS[5:]]
    late = [*rows[:20], [0.0, 1, 2, 3], *rows[20:]]
    with pytest.raises(TableError, match=r"a\.xlsx, row 21, column time_s: 0 after .*sort or cut"):
        read_sensor(book(tmp_path / "a.xlsx", only=late))
    word = [*rows[:20], [0.1, "two", 2, 3], *rows[20:]]
    told = r"b\.xlsx, sheet 'only', row 21, column vx: 'two' is not a finite number below 1e\+19; correct it"
    with pytest.raises(TableError, match=told):
        read_sensor(book(tmp_path / "b.xlsx", only=word))
    read_sensor(tmp_path / "b.xlsx", columns="time=time_s,x=vy,y=vy,z=vz")  # the word is in another column


@pytest.mark.one_case
@pytest.mark.parametrize("cell", [1e20, True, "=2+3", "#DIV/0!", "inf"])
def test_what_is_no_number(cell: Any, tmp_path: Path) -> None:
    """A formula has no value before a program has computed it; True is no 1."""
    path = book(tmp_path / "a.xlsx", only=[HEAD, *ROWS[:9], [ROWS[9][0], cell, 2, 3], *ROWS[10:]])
    if cell == "=2+3":
        assert np.isnan(read_sensor(path).v[9:10]).all()
        return
    with pytest.raises(TableError, match="row 11, column vx"):
        read_sensor(path)


def changed(path: Path, name: str, edit: Any) -> Path:
    """The workbook with one part rewritten, or added."""
    with zipfile.ZipFile(path) as archive:
        parts = {part.filename: archive.read(part) for part in archive.infolist()}
    parts[name] = edit(parts.get(name, b""))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for part, data in parts.items():
            archive.writestr(part, data)
    return path


SHEET = "xl/worksheets/sheet1.xml"
ENTITY = b'<?xml version="1.0"?>\n<!DOCTYPE s [<!ENTITY e SYSTEM "file:///etc/passwd">]>\n'


def with_rows(rows: bytes) -> Any:
    """A sheet with these rows instead of its own."""
    return lambda sheet: re.sub(b"<sheetData>.*</sheetData>", b"<sheetData>" + rows + b"</sheetData>", sheet)


HOSTILE = {
    "an entity": ("xl/sharedStrings.xml", lambda _: ENTITY + b"<sst>&e;</sst>", "document type"),
    "an entity after a long comment": (
        SHEET, lambda sheet: b"<!--" + b"x" * (1 << 20) + b"-->" + b"<!DOCTYPE a>" + sheet, "document type"),
    "another encoding": (SHEET, lambda sheet: sheet.decode().encode("utf-16"), "UTF-8"),
    "values of another file": ("xl/externalLinks/externalLink1.xml", lambda _: b"<externalLink/>", "other files"),
    "a bomb": ("xl/media/image1.png", lambda _: bytes(1 << 25), "unpacked"),
    "a row of millions of cells": (SHEET, with_rows(b"<row>" + b"<c/>" * 3_500_000 + b"</row>"), "announces more"),
    "rows without end": (SHEET, with_rows(b'<row r="999999999999"><c r="A1"/></row>'), "no sheet"),
    "a sheet that ends early": (SHEET, lambda sheet: sheet[: len(sheet) // 2], "a.xlsx: the file cannot be read"),
    "no sheets": ("xl/workbook.xml", lambda _: b"<workbook/>", "no sheet|cannot be read"),
}  # fmt: skip


@pytest.mark.two_cases
@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_workbook_ends_in_one_line(kind: str, tmp_path: Path) -> None:
    name, edit, told = HOSTILE[kind]
    path = changed(book(tmp_path / "a.xlsx", only=[HEAD, *ROWS]), name, edit)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with pytest.raises(TableError, match=told) as raised:
        read_sensor(path)
    assert "\n" not in str(raised.value)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert used.ru_utime - before.ru_utime < 10.0  # s of CPU


@pytest.mark.slow
def test_a_cut_file_and_another_archive(tmp_path: Path) -> None:
    data = book(tmp_path / "a.xlsx", only=[HEAD, *ROWS]).read_bytes()
    (tmp_path / "b.xlsx").write_bytes(data[: len(data) // 2])
    with pytest.raises(TableError, match=r"b\.xlsx: the file cannot be read: .*write the sheet as CSV"):
        read_sensor(tmp_path / "b.xlsx")
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as archive:
        archive.writestr("sensor.csv", "time_s,vx,vy,vz\n")
    with pytest.raises(TableError, match="it is a compressed file, which is not read; unpack it"):
        read_sensor(tmp_path / "c.zip")


def test_lines_above_the_names_of_the_columns_may_hold_values() -> None:
    head = [["Serial", "12345", "100", ""], ["Range", "16", "2", ""], ["time", "x", "y", "z"]]
    rows = [*head, *([f"{k / 100:.2f}", "1.5", "2.0", "3.0"] for k in range(6))]
    dialect = dialect_of_cells(list(enumerate(rows, start=1)))
    assert dialect is not None
    assert (dialect.header, dialect.header_line, dialect.first_line) == (("time", "x", "y", "z"), 3, 4)
