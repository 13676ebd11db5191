"""What users of loggers and of programs for vibration ask for help with, in files of one world whose S is known.

Each file gives the right S, or one line that says what is wrong: OxWearables/biobankAccelerometerAnalysis 230 and
childmindresearch/wristpy 289 (zones), oliexdev/openScale 1475 (what Excel makes of times), collin80/SavvyCAN 571 (times
that fall), wadpac/GGIR 887 and obspy 2070 (units), realsenseai/realsense-ros 3028 (signs).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner

from agent.cli.main import fieldcal

S = np.array([[1.02, 0.01, -0.02], [0.015, 0.98, 0.005], [-0.01, 0.02, 1.01]])
G_MPS2, SECONDS = 9.80665, 40.0
BEGIN = datetime(2026, 3, 28, 23, 59, 40)  # 20 s before midnight


@cache
def world() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times in s and indications (n, 3) of a sensor of 100 Hz, and the same of a triad of 125 Hz in m/s2."""
    random = np.random.default_rng(3)
    t = np.arange(-1.0, SECONDS + 1.0, 1e-3)
    lines = np.fft.rfft(random.normal(size=(len(t), 3)), axis=0)
    at_hz = np.fft.rfftfreq(len(t), 1e-3)
    lines[(at_hz < 1.5) | (at_hz > 12.0)] = 0.0
    a = np.fft.irfft(lines, len(t), axis=0)
    a = a / a.std(axis=0) + [0.0, 0.0, G_MPS2]
    times = [np.arange(0.0, SECONDS, 1.0 / rate_hz) for rate_hz in (100.0, 125.0)]
    felt, measured = (np.column_stack([np.interp(at_s, t, x) for x in a.T]) for at_s in times)
    return times[0], felt @ S.T + 0.01 * random.normal(size=felt.shape), times[1], measured


def seconds(time_s: np.ndarray) -> list[str]:
    return [f"{x:.4f}" for x in time_s]


def dates(form: str, later_s: float = 0.0) -> Callable[[np.ndarray], list[str]]:
    return lambda time_s: [(BEGIN + timedelta(seconds=x + later_s)).strftime(form) for x in time_s.tolist()]


def table(head: str, times: Sequence[str], values: np.ndarray, mark: str = ",") -> str:
    rows = (mark.join([time, *(f"{x:.6f}" for x in row)]) for time, row in zip(times, values.tolist(), strict=True))
    return "\n".join([head, *rows, ""])


def run(tmp_path: Path, sensor: str = "", reference: str = "", *more: str) -> tuple[int, dict[str, Any], str]:
    """Exit status, result and what was said. Without a text the file is the plain one."""
    sensor_s, V, reference_s, a = world()
    (tmp_path / "sensor.csv").write_text(sensor or table("time_s,vx,vy,vz", seconds(sensor_s), V))
    (tmp_path / "reference.csv").write_text(reference or table("time_s,ax,ay,az", seconds(reference_s), a))
    names = [f"--{name}={tmp_path / name}.csv" for name in ("sensor", "reference")]
    more = more or ("--rotation=1,0,0,0,1,0,0,0,1",)
    result = CliRunner().invoke(
        fieldcal, ["calibrate", *names, *more, f"--json={tmp_path / 'found.json'}"], standalone_mode=False
    )
    found = json.loads((tmp_path / "found.json").read_text()) if result.return_value in (0, 3) else {}
    if isinstance(result.exception, click.ClickException):
        return 2, found, result.exception.format_message()
    return result.return_value, found, " ".join(result.output.split())


def right(status: int, found: dict[str, Any], said: str, expected: np.ndarray = S) -> None:
    """The result is S within U, and U of the main sensitivities is below 1 %."""
    assert status == 0, said
    U = np.array(found["expanded_uncertainty"]["sensitivity"])
    assert (np.abs(np.array(found["sensitivity"]) - expected) < U).all()
    assert (np.diag(U) < 0.01).all()


SERIAL = 46109.0 + 86380.0 / 86400.0  # BEGIN in days of Excel
TIMES = {
    "zones": (dates("%Y-%m-%dT%H:%M:%S.%f+01:00", 3600.0), dates("%Y-%m-%dT%H:%M:%S.%fZ")),
    "days of Excel": (lambda t: [f"{SERIAL + x / 86400:.9f}" for x in t],) * 2,
    "days of Excel with five decimals": (lambda t: [f"{SERIAL + x / 86400:.5f}" for x in t],) * 2,
    "AM and PM": (dates("%m/%d/%Y %I:%M:%S.%f %p"),) * 2,
    "minutes and seconds": (dates("%M:%S.%f"),) * 2,
    "us since 1970": (lambda t: [f"{1795857300e6 + 1e6 * x:.0f}" for x in t],) * 2,
    "below 0": (lambda t: [f"{x - SECONDS:.4f}" for x in t],) * 2,
}


@pytest.mark.one_case
@pytest.mark.parametrize("name", TIMES)
def test_times_as_programs_write_them(name: str, tmp_path: Path) -> None:
    of_sensor, of_reference = TIMES[name]
    sensor_s, V, reference_s, a = world()
    right(
        *run(tmp_path, table("time,x,y,z", of_sensor(sensor_s), V), table("time,x,y,z", of_reference(reference_s), a))
    )


def test_times_of_two_zones_are_told_as_dates(tmp_path: Path) -> None:
    sensor_s, V, reference_s, a = world()
    local, utc = dates("%Y-%m-%d %H:%M:%S.%f", 3600.0)(sensor_s), dates("%Y-%m-%d %H:%M:%S.%f")(reference_s)
    status, _, said = run(tmp_path, table("time,x,y,z", local, V), table("time,x,y,z", utc, a))
    assert status == 2
    assert "sensor.csv from 2026-03-29 00:59:40.000 to 2026-03-29 01:00:19.990" in said
    assert "a date without a zone is taken as UTC: where it is local time, write its offset" in said
    assert said.endswith("as 'Time UTC+02:00'")
    named = table("time UTC+01:00,x,y,z", local, V)
    right(*run(tmp_path, named, table("time,x,y,z", utc, a)))


def test_times_that_fall_are_refused(tmp_path: Path) -> None:
    sensor_s, V, *_ = world()
    status, _, said = run(tmp_path, table("time_s,vx,vy,vz", seconds(sensor_s[::-1]), V[::-1]))
    assert status == 2
    assert "line 3, column time_s: 39.98 after 39.99; time must not decrease" in said


def test_a_decimal_comma_between_commas_is_told(tmp_path: Path) -> None:
    sensor_s, V, *_ = world()
    points = table("time_s,vx,vy,vz", seconds(sensor_s), V).split("\n", 1)
    status, _, said = run(tmp_path, points[0] + "\n" + points[1].replace(".", ","))
    assert status == 2
    assert "line 2: 8 fields, but the header has 4; correct the line; where commas are decimal marks too" in said


@pytest.mark.slow
def test_a_number_for_missing_values_is_named(tmp_path: Path) -> None:
    sensor_s, V, *_ = world()
    V = V.copy()
    V[::40] = -9999.0
    status, found, _ = run(tmp_path, table("time_s,vx,vy,vz", seconds(sensor_s), V))
    assert status == 3
    assert found["reasons"][0].startswith("output x of ")
    assert "sensor.csv is -9999 in 2.5 % of the recording: if this stands for a missing value" in found["reasons"][0]


COLUMNS = {
    "north, east, up": ("time,N [m/s2],E [m/s2],Z [m/s2]", [1, 0, 2], 1.0),
    "up, north, east": ("time,Up (Gal),North (Gal),East (Gal)", [2, 1, 0], 100.0),
    "codes of SEED": ("time,HNZ [um/s2],HNN [um/s2],HNE [um/s2]", [2, 1, 0], 1e6),
}


@pytest.mark.one_case
@pytest.mark.parametrize("name", COLUMNS)
def test_east_north_and_up_are_x_y_and_z(name: str, tmp_path: Path) -> None:
    """In the order of the file they would be a left-handed frame."""
    head, order, factor = COLUMNS[name]
    _, _, reference_s, a = world()
    right(*run(tmp_path, "", table(head, seconds(reference_s), factor * a[:, order])))


def test_two_of_east_north_and_up_are_not_taken_for_axes(tmp_path: Path) -> None:
    _, _, reference_s, a = world()
    status, _, said = run(tmp_path, "", table("time,N,Q,Z", seconds(reference_s), a))
    assert status == 2
    assert "neither name nor unit tells what 'Z' is" in said


@pytest.mark.slow
@pytest.mark.parametrize("sign", [[1, 1, -1], [-1, -1, -1]])
def test_a_reference_with_another_sense_is_warned_of(sign: list[int], tmp_path: Path) -> None:
    _, _, reference_s, a = world()
    status, found, _ = run(tmp_path, "", table("time_s,ax,ay,az", seconds(reference_s), a * sign))
    assert status == 0
    assert found["warnings"][0].startswith("det S is negative")


@pytest.mark.slow
def test_a_unit_that_neither_gravity_nor_anybody_tells_is_warned_of(tmp_path: Path) -> None:
    _, _, reference_s, a = world()
    moved = (a - [0.0, 0.0, G_MPS2]) * 1000.0 / G_MPS2  # in mg
    status, found, _ = run(tmp_path, "", table("time_s,ax,ay,az", seconds(reference_s), moved))
    assert status == 0
    assert found["warnings"][0].startswith("the reference feels no gravity, and nobody stated its unit")
    assert found["offset"] == [None, None, None]
    status, found, said = run(tmp_path, "", table("time,ax [mg],ay [mg],az [mg]", seconds(reference_s), moved))
    right(status, found, said)
    assert found["warnings"] == []


def test_a_missing_rotation_is_told_with_an_example(tmp_path: Path) -> None:
    status, _, said = run(tmp_path, "", "", "--u-reference-pct=1")
    assert status == 2
    assert "a tri-axial reference needs --rotation, its orientation against the sensor; where the axes" in said


def test_a_sensitivity_with_a_comma_and_none_at_all(tmp_path: Path) -> None:
    _, _, reference_s, a = world()
    volts = table("time,AI0 (mV)", seconds(reference_s), a[:, :1])
    status, _, said = run(tmp_path, "", volts, "--sensitivity=101,3 mV/g")
    assert status == 2
    assert "with a point as the decimal mark" in said
    status, _, said = run(tmp_path, "", volts, "--u-reference-pct=1")
    assert status == 2
    assert said.endswith("and its sensitivity is not stated; state it as its certificate does: "
                         "--sensitivity '100 mV/g'")  # fmt: skip
