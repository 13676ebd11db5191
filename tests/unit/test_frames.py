"""A DataFrame is read as its CSV is: the same columns, units and times, and the same faults."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.calibrate.tables import read_reference, read_sensor
from agent.reading.source import TableError
from calib import InputError, calibrate
from calib.recorded.arrays import reference_table, sensor_table
from tests.unit.test_notebook import OPTIONS, POSES, REFERENCE, SENSOR
from tests.unit.test_output_unit import calibrated, files
from tests.unit.test_reading_csv import DATED, SENSORS, VALUES, written

pandas = pytest.importorskip("pandas", reason="the test of DataFrames needs pandas")
TEXTS = ("ISO 8601", "ISO 8601 with Z")
PLAIN = ("plain", "units in the names", "suffixes", "many other columns", "names without a meaning", "an index before",
         "s since 1970", "ms since 1970", "us since 1970", "ns since 1970")  # fmt: skip


@pytest.mark.parametrize("kind", PLAIN)
def test_the_samples_are_those_of_the_csv(tmp_path: Path, kind: str) -> None:
    text = {**SENSORS, **DATED}[kind]
    assert isinstance(text, str)
    of_file, found = read_sensor(written(tmp_path, text)), sensor_table(pandas.read_csv(io.StringIO(text)))
    np.testing.assert_array_equal(found.time_s[:], of_file.time_s[:])
    np.testing.assert_array_equal(found.v[:], of_file.v[:])
    assert found.unit == of_file.unit
    assert bool(found.said) == bool(of_file.said)


@pytest.mark.parametrize(
    ("head", "quantity", "si"),
    [("Time (ms),Acc [g]", "acceleration", 9.80665), ("t,Vel [mm/s]", "velocity", 1e-3), ("Date,d_um", "", 1e-6),
     ("time_s,a", "acceleration", 1.0), ("time,ax_mg,ay_mg,az_mg", "acceleration", 9.80665e-3)],
)  # fmt: skip
def test_a_reference_comes_into_si_units(tmp_path: Path, head: str, quantity: str, si: float) -> None:
    width = head.count(",") + 1
    text = "".join(f"{line}\n" for line in (head, *(",".join(map(repr, row[:width])) for row in VALUES.tolist())))
    of_file = read_reference(written(tmp_path, text))
    found = reference_table(pandas.read_csv(io.StringIO(text)), None)
    assert found.quantity == of_file.quantity == (quantity or "displacement")
    np.testing.assert_array_equal(found.x[:], of_file.x[:])
    np.testing.assert_allclose(found.x[:], si * VALUES[:, 1:width], rtol=1e-15)
    np.testing.assert_array_equal(found.time_s[:], of_file.time_s[:])


@pytest.mark.parametrize(
    ("head", "told"),
    [
        ("Time,X [mV],X (V),Z [mV]", "several columns could be x: 'X [mV]', 'X (V)' in the header"),
        ("Time,X [mV],Y [mV],temp", "column vz is missing in the header 'Time,X [mV],Y [mV],temp'"),
        ("X [mm/s],X,Y,Z", "column time_s is missing in the header"),
    ],
)
def test_a_fault_is_told_in_the_same_words_with_the_remedy_of_a_notebook(tmp_path: Path, head: str, told: str) -> None:
    text = f"{head}\n" + "".join(",".join(map(repr, row)) + "\n" for row in VALUES.tolist())
    with pytest.raises(TableError, match=r"say which columns to use: --columns time=NAME"):
        read_sensor(written(tmp_path, text))
    with pytest.raises(InputError) as error:
        sensor_table(pandas.read_csv(io.StringIO(text)))
    assert told.split(" in the header")[0] in str(error.value) or "several columns" in str(error.value)
    assert str(error.value).startswith("sensor: ")
    assert str(error.value).endswith("; rename the columns; a unit may stand in a name: 'x [mg]'")


@pytest.mark.slow
def test_a_result_from_frames_is_that_of_the_files(tmp_path: Path) -> None:
    heads = ("Acc X [mg]", "Acc Y [mg]", "Acc Z [mg]")
    t, a = (np.asarray(REFERENCE[name]) for name in ("time_s", "a"))
    velocity_mps = np.concatenate([[0.0], np.cumsum(0.5 * (a[1:] + a[:-1]) * np.diff(t))])
    reference = {"Time [ms]": 1e3 * t, "Vel [mm/s]": 1e3 * velocity_mps}
    _, of_files = calibrated(tmp_path, *files(tmp_path, heads, 1e3 / 9.80665, reference))
    frames: list[Any] = [pandas.read_csv(tmp_path / f"{name}.csv") for name in ("sensor", "reference", "poses")]
    with pytest.warns(UserWarning, match="columns guessed: ") as told:
        found = calibrate(*frames, **OPTIONS)
    assert [str(each.message).partition(":")[0] for each in told] == ["sensor", "reference"]
    kept = {name: value for name, value in of_files.items() if name not in ("options", "files")}
    assert json.loads(found.to_json()) == kept
    assert (found.unit, kept["reference_quantity"]) == ("mg", "velocity")


def test_dates_with_a_zone_are_times() -> None:
    stamps = pandas.to_datetime(1e9 + np.asarray(SENSOR["time_s"]), unit="s")
    values = {"X": SENSOR["vx"], "Y": SENSOR["vy"], "Z": SENSOR["vz"]}
    naive, zoned = (
        sensor_table(pandas.DataFrame({"when": time, **values}).rename(columns={"when": "Timestamp"})).time_s
        for time in (stamps, stamps.tz_localize("UTC").tz_convert("Europe/Rome"))
    )
    np.testing.assert_array_equal(zoned, naive)
    np.testing.assert_allclose(np.asarray(naive) - 1e9, SENSOR["time_s"], atol=3e-7)


@pytest.mark.parametrize("kind", TEXTS)
def test_dates_as_text_and_as_dates_are_those_of_the_csv(tmp_path: Path, kind: str) -> None:
    text = DATED[kind].replace("vx,vy,vz", "X,Y,Z")
    of_file = read_sensor(written(tmp_path, text)).time_s[:]
    as_text = pandas.read_csv(io.StringIO(text))
    as_dates = as_text.assign(**{as_text.columns[0]: pandas.to_datetime(as_text.iloc[:, 0])})
    for frame in (as_text, as_dates):
        np.testing.assert_array_equal(sensor_table(frame).time_s[:], of_file)


def test_our_own_names_need_no_guess() -> None:
    assert sensor_table(pandas.DataFrame(SENSOR)).said == ()
    assert len(POSES) == 6
