"""Times of loggers that have several meanings: decided by what is in the file, told, or asked."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from agent.calibrate.tables import SensorFile, read_reference, read_sensor
from agent.cli.main import run_cli
from agent.reading.formats import Description
from agent.reading.source import TableError

N = 300
HEADER = "time,x,y,z\n"
APRIL_3, MARCH_4 = 1_775_174_400.0, 1_772_582_400.0  # 2026-04-03 and 2026-03-04, 00:00 UTC


def clock(s: float) -> str:
    return f"{int(s // 3600) % 24:02d}:{int(s // 60) % 60:02d}:{s % 60:05.2f}"


def table(time: Callable[[int], str], head: str = HEADER, count: int = N) -> str:
    return head + "".join(f"{time(k)},{k % 7 - 3},{k % 5 - 2},9.81\n" for k in range(count))


def read(tmp_path: Path, text: str, columns: str | None = None, order: str | None = None) -> SensorFile:
    path = tmp_path / "logger.csv"
    path.write_text(text)
    return read_sensor(path, None, columns, Description(date_order=order))


def dates(first: str, later: str = "") -> str:
    """Dates with a time of day; `later` is the date from midnight on."""
    if not later:
        return table(lambda k: f"{first} {clock(43200 + k / 100)}")
    return table(lambda k: f"{first if k < 100 else later} {clock((86399 + k / 100) % 86400)}")


@pytest.mark.parametrize(
    ("text", "order", "begins_s"),
    [
        (dates("03/04/2026"), "dmy", APRIL_3 + 43200),
        (dates("03/04/2026"), "mdy", MARCH_4 + 43200),
        (dates("03/04/2026", "04/04/2026"), None, APRIL_3 + 86399),  # the day is the field that grows at midnight
        (dates("03/04/2026", "03/05/2026"), None, MARCH_4 + 86399),
        (dates("12/04/2026", "13/04/2026"), None, APRIL_3 + 9 * 86400 + 86399),  # a field above 12
        (dates("03.04.2026"), None, APRIL_3 + 43200),
        (dates("26/04/03"), "ymd", APRIL_3 + 43200),
        (dates("3-Apr-2026"), None, APRIL_3 + 43200),
        (table(lambda k: f'"Apr 3, 2026 {clock(43200 + k / 100)}"'), None, APRIL_3 + 43200),
        (table(lambda k: f"03/04/2026 {clock(k / 100)}", "Date (dd/mm/yyyy),x,y,z\n"), None, APRIL_3),
    ],
)
def test_the_order_of_dates(text: str, order: str | None, begins_s: float, tmp_path: Path) -> None:
    found = read(tmp_path, text, None, order)
    np.testing.assert_allclose(found.time_s[:], begins_s + np.arange(N) / 100, rtol=0, atol=3e-7)
    assert "is taken as 2026-0" in found.said[0]


def test_an_ambiguous_date_is_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.csv"
    path.write_text(dates("03/04/2026"))
    for command in (["convert", str(path), "-o", str(tmp_path / "b.csv")], ["calibrate", "--sensor", str(path)]):
        assert run_cli(command) == 2
        told = capsys.readouterr().err
        assert "a.csv, line 2, column time: '03/04/2026' may be 2026-04-03 (dmy) or 2026-03-04 (mdy)" in told
        assert "--date-order" in told
        assert told.count("\n") == 1
    assert run_cli(["convert", str(path), "-o", str(tmp_path / "b.csv"), "--date-order", "mdy"]) == 0
    assert read_sensor(tmp_path / "b.csv").time_s[:1][0] == MARCH_4 + 43200
    assert run_cli(["calibrate", "--sensor", str(path), "--date-order", "mdy"]) == 3  # understood; no rests in it


@pytest.mark.parametrize(
    ("text", "columns", "said"),
    [
        (table(lambda k: f"{10 * k}"), None, "'time' are 10 s apart; state their unit where it is not s, as "
         "time=time:ms"),
        (table(lambda k: f"{10000 * k}", "time_s,vx,vy,vz\n"), None, "'time_s' are 1e+04 s apart; state their unit"),
        ("rate: 100 Hz\n" + table(lambda k: f"{k}"), None, "1 s apart, and the head states 100 Hz; state their unit"),
        (table(lambda k: f"{k / 100}", "time [ticks],x,y,z\n"), None,
         "the unit 'ticks' of column 'time [ticks]' is not known"),
        (table(lambda k: f"{k / 6000:.9f}", "time_min,x,y,z\n"), None, "'time_min' are taken in min"),
    ],
)  # fmt: skip
def test_a_unit_that_is_not_meant_is_told(text: str, columns: str | None, said: str, tmp_path: Path) -> None:
    assert said in "\n".join(read(tmp_path, text, columns).said)


def test_units_of_time(tmp_path: Path) -> None:
    for unit, second in (("h", 3600.0), ("min", 60.0), ("days", 86400.0), ("ms", 1e-3)):
        found = read(
            tmp_path,
            table(lambda k, second=second: f"{k / 100 / second:.15g}", f"Elapsed time ({unit}),x,y,z\n"),  # type: ignore[misc]
        )
        np.testing.assert_allclose(found.time_s[:], np.arange(N) / 100, rtol=0, atol=1e-9)
        assert len(found.said) == 1  # the columns
    found = read(tmp_path, table(lambda k: f"{739205.5 + k / 8640000:.10f}"))
    np.testing.assert_allclose(found.time_s[:], 1_700_049_600 + np.arange(N) / 100, rtol=0, atol=1e-5)
    assert "is taken as days of MATLAB; state its unit" in found.said[0]
    with pytest.raises(TableError, match=r"line 2, column time: 20231114221320 is a date without marks.*write it as"):
        read(tmp_path, table(lambda k: f"20231114221320.{k:03d}"))
    with pytest.raises(
        TableError, match=r"line 2, column time: '12:00' may be hours and minutes, or .*; write HH:MM:SS"
    ):
        read(tmp_path, table(lambda k: f"12:{k // 10:02d}"))
    with pytest.raises(
        TableError, match=r"line 2, column time: the zone 'IST' is not known, or has .*write its offset"
    ):
        read(tmp_path, table(lambda k: f"2026-04-03 {clock(k / 100)} IST"))


@pytest.mark.parametrize(
    "head", ["Sample period: 0.01 s", "Sampling time,10,ms", "Sampling interval (ms);10", "Sample rate: 100 Hz"]
)
def test_the_head_states_the_rate(head: str, tmp_path: Path) -> None:
    found = read(tmp_path, head + "\nx,y,z\n" + "".join(f"{k % 7 - 3},{k % 5 - 2},9.81\n" for k in range(N)))
    np.testing.assert_allclose(found.time_s[:], np.arange(N) / 100, rtol=0, atol=1e-9)
    assert "over the 100 Hz that the head states" in found.said[0]


@pytest.mark.parametrize(
    ("zone", "east_h"), [("+0530", 5.5), ("+05:30", 5.5), ("+530", 5.5), ("-02", -2.0), ("UTC+1", 1.0), ("Z", 0.0)]
)
def test_offsets_from_utc(zone: str, east_h: float, tmp_path: Path) -> None:
    found = read(tmp_path, table(lambda k: f"2026-04-03 {clock(43200 + k / 100)}{zone}"))
    np.testing.assert_allclose(found.time_s[:1][0], APRIL_3 + 43200 - 3600 * east_h, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("head", ["", HEADER, "Logger 7\nstarted 2023-11-14 10:05:00\n" + HEADER])
def test_a_restart_makes_pieces(head: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = "Logger 7\nstarted 2023-11-14 10:00:00\n" + table(lambda k: f"{k / 100:.2f}")
    text += table(lambda k: f"{0.5 + k / 100:.2f}", head)
    found = read(tmp_path, text)
    line = 304 + head.count("\n")
    expected = np.append(np.arange(N) / 100, 12.99 + np.arange(N) / 100)
    np.testing.assert_allclose(found.time_s[:], expected, rtol=0, atol=1e-9)
    assert f"line {line}, column time: 0.5 after 2.99: the time begins anew" in found.said[0]
    (tmp_path / "poses.csv").write_text("start_s,stop_s,gx,gy,gz\n0,2,0,0,9.81\n")
    sensor = str(tmp_path / "logger.csv")
    for beside in (
        ["--poses", str(tmp_path / "poses.csv")],
        ["--reference", sensor, "--rotation", "1,0,0,0,1,0,0,0,1"],
    ):
        assert run_cli(["calibrate", "--sensor", sensor, *beside]) == 2
        assert re.search(rf"line {line}, column time: the time begins anew at 0.5 after 2.99; .*cut the file there",
                         capsys.readouterr().err)  # fmt: skip
    with pytest.raises(TableError, match=rf"line {line}, .* a reference needs one clock: cut the file there"):
        read_reference(Path(sensor))


@pytest.mark.parametrize(
    "time",
    [
        lambda k: f"{(k * 37) % N / 100:.2f}",  # rows in disorder
        lambda k: f"{(k % 150) / 100 + 5:.2f}",  # the same rows twice
        lambda k: f"2023-11-14 {clock(43200 + (k % 150) / 100)}",
        lambda k: f"2023-11-14 {clock(43200 + k / 100 - (4294 if k > 150 else 0))}",  # VSCaptureMP issue 5: 2^32 us
        lambda k: f"{(k % 60) / 100:.2f}",  # the same 0.6 s five times
    ],
)
def test_what_is_out_of_order_is_refused(time: Callable[[int], str], tmp_path: Path) -> None:
    with pytest.raises(TableError, match=r"line \d+, column time: .* after .*; time must not decrease, sort or cut"):
        read(tmp_path, table(time))


def with_fields(*fields: str, delimiter: str = ",") -> str:
    """A table whose rows end with these fields, in which "#" is the number of the row."""
    names = ["time", "x", "y", "z"][: len(fields)]
    return "".join(
        delimiter.join(f.replace("#", str(k)) for f in row) + "\n"
        for k, row in enumerate([names, *(N * [list(fields)])])
    )


COMMA_OR_THOUSANDS = (
    "line 2: in '402,118' the comma may be a decimal mark, or separate thousands; write 402.118 or 402118"
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (with_fields("0.01", '"402,118"', '"1,118"', '"2,118"'),
         "line 2, column time: '0.01' has a point, and '402,118' a comma; write the numbers without separators"),
        (with_fields("0,01", "402.118", "0,5", "0,5", delimiter=";"),
         "line 2, column x: '402.118' has a point, and '0,01'"),
        (with_fields("#", '"402,118"', '"1,118"', '"2,118"'), COMMA_OR_THOUSANDS),
        (with_fields("2023-11-14 22:13:20.#", "402,118", "1,118", "2,118", delimiter=";"), COMMA_OR_THOUSANDS),
        (table(lambda k: f"{k / 100:.2f}") + '9,1,2,"1,402"\n',
         "line 302, column z: '1,402' has a comma, and other numbers"),
        (with_fields("#", "1", "2", "3", delimiter=";") + "400;1,5;2;3\n",
         "line 302, column x: '1,5' has a comma, and other"),
    ],
)  # fmt: skip
def test_separators_of_thousands(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(TableError, match=message):
        read(tmp_path, text)


def test_a_decimal_comma_is_told(tmp_path: Path) -> None:
    """Numbers below one, or with another number of decimals than three, say that the comma is a decimal mark."""
    for x in ("0,118", "402,11", "1402,118"):
        found = read(tmp_path, with_fields("#", x, "1,118", "2,118", delimiter=";"))
        assert found.v[:1].tolist() == [[float(x.replace(",", ".")), 1.118, 2.118]]
        assert f"the comma is taken as the decimal mark, as in '{x}'" in found.said[0]
    beside = read(tmp_path, with_fields("#", "1.5", "2.5", "3.5", delimiter=";").replace("3.5", '3.5;"402,118"', N)
                  .replace("z\n", "z;memory\n"))  # fmt: skip
    assert beside.v[:1].tolist() == [[1.5, 2.5, 3.5]]  # a column that is not read decides nothing


def test_a_value_that_was_cut_off_is_left_out(tmp_path: Path) -> None:
    found = read(tmp_path, table(lambda k: f"{k / 100:.2f}") + "3.00,0,0,-12")
    assert len(found.v) == N
    assert "the last line, '3.00,0,0,-12', has no end and may be cut off; it is left out" in found.said[0]


def test_names_of_rows_are_no_times(tmp_path: Path) -> None:
    """R's write.table names the rows, but not their column: all columns would be moved by one."""
    text = '"time" "x" "y" "z"\n' + "".join(f'"{k + 1}" {k / 100} 1 2 3\n' for k in range(N))
    with pytest.raises(TableError, match="line 2: 5 fields, but the header has 4; correct the line"):
        read(tmp_path, text)


def test_a_second_hour_of_the_day_and_gaps_of_hours(tmp_path: Path) -> None:
    """An hour that is repeated is told; an hour that is left out is a gap; the times of two zones are those of UTC."""
    spring = table(lambda k: f"2023-03-26 {clock(7199 + k / 100 + (3600 if k >= 100 else 0))}")
    assert np.diff(read(tmp_path, spring).time_s[:])[99] == pytest.approx(3600.01, abs=1e-6)
    zones = table(
        lambda k: f"2023-10-29 {clock(10799 + k / 100 - (3600 if k >= 100 else 0))}{'+02:00' if k < 100 else '+01:00'}"
    )
    found = read(tmp_path, zones)
    np.testing.assert_allclose(np.diff(found.time_s[:]), 0.01, rtol=0, atol=1e-6)
    assert len(found.said) == 1  # the columns
