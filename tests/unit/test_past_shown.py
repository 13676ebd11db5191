"""`fieldcal show --past` and `fieldcal export --corrected`: the same past in all forms, and what has none."""

from __future__ import annotations

import csv
import json
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.core.memory import Memory
from agent.core.past import KnownPast
from agent.core.snapshot import pack, unpack
from agent.delivery.history import FILE_NAME, History
from agent.delivery.schema import write_memory
from agent.delivery.store import Store
from agent.export.smoothing import Smoothed, date_of
from agent.report.material import gather
from calib.estimate.correction import Law
from calib.model import PARAMETERS
from calib.rounding import rounded
from calib.state.past import Past
from tests.unit.recorded_bench import EPOCH_NS, record

RECORDING = "fieldcal-000001.mcap"


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bench for 55 s: four windows."""
    directory = tmp_path_factory.mktemp("past")
    record(directory, 55.0)
    return directory


@pytest.fixture
def copied(kept: Path, tmp_path: Path) -> Path:
    return shutil.copytree(kept, tmp_path / "data")


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    status = run_cli([*map(str, arguments)])
    told = capsys.readouterr()
    return status, told.out, told.err


def shown(capsys: pytest.CaptureFixture[str], directory: Path) -> dict[str, Any]:
    status, out, err = run(capsys, "show", "--past", "--data-dir", directory, "--json", "-")
    assert (status, err) == (0, "")
    (past,) = json.loads(out)["past"]
    return dict(past)


def change_memory(directory: Path, change: Any) -> None:
    """Replace the kept state by what `change` makes of its bytes."""
    with History(directory / FILE_NAME) as history:
        (memory,) = history.memories()
    with sqlite3.connect(directory / FILE_NAME) as connection:
        state = change(memory.state)
        write_memory(connection, Memory(memory.sensor, memory.identity, memory.sequence, state))


@pytest.mark.slow
def test_table_csv_and_json_say_the_same(kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    past, to = shown(capsys, kept), tmp_path / "past.csv"
    assert run(capsys, "show", "--past", "--data-dir", kept, "--csv", to)[0] == 0
    head, *rows = csv.reader(line for line in to.read_text().splitlines() if not line.startswith("#"))
    assert past["smoothing"] in to.read_text()
    table = run(capsys, "show", "--past", "--data-dir", kept)[1].splitlines()
    assert len(rows) == len(past["epochs"]) == past["windows"] == 4
    for row, epoch, line in zip(rows, past["epochs"], table[3:], strict=True):
        told = dict(zip(head, row, strict=True))
        values = [*np.ravel(epoch["sensitivity"]), *epoch["offset"]]
        assert [float(told[name]) for name in PARAMETERS] == values
        assert [float(told[f"u_{name}"]) for name in PARAMETERS] == epoch["standard_uncertainty"]
        np.testing.assert_allclose(np.diag(epoch["covariance"]), np.square(epoch["standard_uncertainty"]), rtol=1e-12)
        assert line.startswith(told["time"])
        U = past["coverage_factor"] * epoch["standard_uncertainty"][0]
        assert U > 100.0
        assert f"{float(f'{values[0]:.4g}'):.0f} ± {float(f'{U:.2g}'):.0f}" in line  # both to tens
    # An epoch is the end of a window. Its own calibration comes into force 1.5 s later, when the window closes.
    results = json.loads(run(capsys, "show", "--data-dir", kept, "--json", "-")[1])["sensors"]["mems"]
    newest, third = results["history"]
    assert newest["t_utc_ns"] - past["epochs"][3]["t_utc_ns"] == pytest.approx(1.5e9, abs=1e7)
    numbers = [epoch["calibration"] and epoch["calibration"]["sequence"] for epoch in past["epochs"]]
    assert numbers == [None, None, None, third["sequence"]]
    stops = [EPOCH_NS + 1e9 * window["stop_s"] for window in reversed(results["windows"])]
    np.testing.assert_allclose([epoch["t_utc_ns"] for epoch in past["epochs"]], stops, rtol=0, atol=1e6)


@pytest.mark.slow
def test_recordings_tell_the_same_past_as_the_data_directory(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run(capsys, "show", "--past", kept / RECORDING, "--json", "-")
    assert (status, err) == (0, "")
    told = json.loads(out)
    assert told["recordings"] == [str(kept / RECORDING)]
    assert told["past"] == [shown(capsys, kept)]
    (tmp_path / "no.mcap").write_bytes(b"x" * 100)
    refused: tuple[tuple[list[str | Path], str], ...] = (
        ([kept / RECORDING], "recordings tell the past; add --past"),
        (["--past", kept / RECORDING, "--data-dir", kept], "--data-dir belongs to a data directory; remove it"),
        (["--past", tmp_path / "no.mcap"], "damaged at byte 0"),
        (["--past", tmp_path / "none.mcap"], "No such file"),
    )
    for arguments, words in refused:
        status, out, err = run(capsys, "show", *arguments)
        assert (status, out) == (2, "")
        assert words in err


@pytest.mark.slow
def test_the_date_of_a_change_is_the_same_in_table_csv_and_json(
    copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A step is stated between the second and the third window, whose ends are 12 s apart."""

    def stepped(state: bytes) -> bytes:
        held = unpack(state)
        own = held["estimation"]["state"]
        day = float(np.nextafter(own["records"][2]["day"], -np.inf))
        own["steps"].append({"day": day, "u": {"Sxx": 2000.0}})
        return pack(held)

    change_memory(copied, stepped)
    past, to = shown(capsys, copied), tmp_path / "past.csv"
    (change,) = past["changes"]
    date = change["date"]
    first, last = date["interval_utc_ns"]
    assert past["epochs"][0]["t_utc_ns"] <= first < date["t_utc_ns"] < last <= past["epochs"][-1]["t_utc_ns"]
    assert (date["probability"], date["told_by"]) == (0.95, "windows")
    assert run(capsys, "show", "--past", "--data-dir", copied, "--csv", to)[0] == 0
    head, *rows = csv.reader(line for line in to.read_text().splitlines() if not line.startswith("#"))
    dated = [dict(zip(head, row, strict=True)) for row in rows if row[head.index("change")]]
    (row,) = dated
    times = [date_of(t) for t in (date["t_utc_ns"], first, last)]
    assert [row[name] for name in ("change", "change_after", "change_before")] == times
    assert float(row["u_change_days"]) == date["standard_uncertainty_days"]
    assert row["time"] == date_of(change["t_utc_ns"])
    line = run(capsys, "show", "--past", "--data-dir", copied)[1].splitlines()[-1]
    u = rounded(date["standard_uncertainty_days"])
    assert line.endswith(f"; it came {times[0]} with u = {u} d, from {times[1]} to {times[2]} (95 %)")


@pytest.mark.one_case
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_samples_are_corrected_by_the_past_and_name_their_calibration(
    ending: str, kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if ending == "parquet":
        pytest.importorskip("pyarrow", reason="the extra files is not installed")
    past, to, again = shown(capsys, kept), tmp_path / f"a.{ending}", tmp_path / f"b.{ending}"
    for path in (to, again):
        assert run(capsys, "export", "--corrected", kept / RECORDING, "-o", path)[::2] == (0, "")
    assert to.read_bytes() == again.read_bytes()
    if ending == "csv":
        head, *lines = [line for line in to.read_text().splitlines() if not line.startswith("#")]
        columns = dict(zip(head.split(","), np.loadtxt(lines, delimiter=",").T, strict=True))
        about = to.read_text()
    else:
        from pyarrow import parquet

        table = parquet.read_table(to)
        columns = {name: table[name].to_numpy() for name in table.column_names}
        columns["time_s"] = columns["time"].astype(np.int64) * 1e-9
        about = str(table.schema.metadata)
    assert past["smoothing"].split(", state ")[0] in about
    V, a = (np.column_stack([columns[f"{kind}{axis}"] for axis in "xyz"]) for kind in "va")
    ends = [epoch["t_utc_ns"] * 1e-9 for epoch in past["epochs"]]
    values = np.array([[*np.ravel(epoch["sensitivity"]), *epoch["offset"]] for epoch in past["epochs"]])
    at = np.column_stack([np.interp(columns["time_s"], ends, column) for column in values.T])
    ideal = np.einsum("nij,nj->ni", at[:, :9].reshape(-1, 3, 3), a) + at[:, 9:]
    np.testing.assert_allclose(ideal, V, rtol=0, atol=1e-3)  # counts; S by 1e-6 u of itself
    results = json.loads(run(capsys, "show", "--data-dir", kept, "--json", "-")[1])["sensors"]["mems"]
    found = {(update["t_utc_ns"] - EPOCH_NS) * 1e-9: update["sequence"] for update in results["history"]}
    begins = columns["time_s"][columns["calibration"] > 0][0] - EPOCH_NS * 1e-9
    assert begins == pytest.approx(min(found), abs=1.0)  # from the next block on
    assert set(columns["calibration"].tolist()) == {0, *found.values()}


@pytest.mark.thorough
def test_stationxml_has_the_channels_of_the_miniseed_of_the_same_recording(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """ObsPy takes the sensitivity of each trace from the StationXML; the same numbers as in the past."""
    obspy = pytest.importorskip("obspy", reason="ObsPy is not installed (extra seismic)")
    from obspy.io.stationxml.core import validate_stationxml

    place = ["--place", "47.5", "-8.25", "412"]

    def export(name: str, *more: str | Path) -> tuple[int, str, str]:
        return run(capsys, "export", kept / RECORDING, "-o", tmp_path / name, *more)

    assert export("a.mseed")[0] == 0
    beside: dict[str, list[str | Path]] = {"a.xml": [], "b.xml": [], "c.xml": ["--data-dir", kept]}
    for name, more in beside.items():
        assert export(name, "--corrected", *place, *more)[::2] == (0, "")
    first, again, by_store = ((tmp_path / f"{name}.xml").read_bytes() for name in "abc")
    assert first == again == by_store
    assert validate_stationxml(str(tmp_path / "a.xml")) == (True, ())
    past, inventory = shown(capsys, kept), obspy.read_inventory(tmp_path / "a.xml")
    traces = obspy.read(tmp_path / "a.mseed").select(location="00")
    traces.trim(obspy.UTCDateTime(ns=past["epochs"][-1]["t_utc_ns"]))
    assert len(traces) == 3
    for trace in traces:
        told = inventory.get_response(trace.id, trace.stats.starttime).instrument_sensitivity
        k = int(trace.stats.channel[-1]) - 1
        assert told.value == past["epochs"][-1]["sensitivity"][k][k]
        assert told.frequency == past["reference_frequency_hz"]
    for name, arguments, words in (
        ("no.xml", ["--corrected"], "StationXML wants the place of the sensor; add --place"),
        ("no.xml", place, "StationXML has the epochs of the past; add --corrected"),
        ("no.xml", ["--corrected", "--place", "91", "0", "0"], "91.0 is not in the range"),
        ("no.xml", ["--corrected", "--place", "nan", "0", "0"], "is not a finite number"),
        ("no.csv", place, "--place belongs to StationXML"),
    ):
        status, _, err = export(name, *arguments)
        assert status == 2
        assert words in err
        assert not (tmp_path / name).exists()


def test_samples_between_two_epochs_are_corrected_by_what_is_between_their_values() -> None:
    """S grows by 2 % and Q by 1 m/s2 in a day; S and Q depend on the temperature as well."""
    sides = ((1.0, 0.0), (1.02, 1.0))
    laws = [Law(np.append(size * np.eye(3).ravel(), [Q] * 3 + [0.1] * 3), np.eye(15), 1) for size, Q in sides]
    past = Past(np.array([5.0, 6.0]), laws, (1, 1), (), 5.0, 2.0)
    known = KnownPast("mems", "mems A", "A", "m/s2", past, "", 0.0, 6.0, EPOCH_NS)
    smoothed, hour_ns = Smoothed({"A": known}, {"B": "B has none"}), 3600 * 10**9
    V = np.array([[2.02, 1.01, 0.0]])
    a, why = smoothed.acceleration("A", V, EPOCH_NS - 12 * hour_ns, 22.0)
    assert why == ""
    assert a is not None
    np.testing.assert_allclose(a, (V - 0.5 - 0.2) / 1.01, rtol=1e-12)
    for hours, (size, Q) in ((-24.5, sides[0]), (0.9, sides[1])):
        a, _ = smoothed.acceleration("A", V, EPOCH_NS + round(hours * hour_ns), None)
        assert a is not None
        np.testing.assert_allclose(a, (V - Q) / size, rtol=1e-12)
    a, why = smoothed.acceleration("A", V, EPOCH_NS + 61 * hour_ns // 60, None)
    assert a is None
    assert "more than an hour before the first window (2026-09-20T14:13:20Z) or after the last one" in why
    assert smoothed.acceleration("B", V, EPOCH_NS, None) == (None, "B has none")
    assert smoothed.acceleration("C", V, EPOCH_NS, None) == (None, "no state is kept of the device C")


@pytest.mark.slow
def test_the_kept_state_tells_the_past_beside_a_running_agent(
    kept: Path, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = Store(copied, 0)
    try:
        assert shown(capsys, copied) == shown(capsys, kept)
        to = tmp_path / "a.csv"
        asked = "export", "--corrected", kept / RECORDING, "-o", to, "--data-dir", copied
        assert run(capsys, *asked)[::2] == (0, "")
        assert shown(capsys, kept)["state_sha256"] in to.read_text()
    finally:
        store.close()


@pytest.mark.slow
def test_a_store_without_a_state_and_a_state_of_an_earlier_version_are_told(
    copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Store(tmp_path / "new", 0).close()
    assert run(capsys, "show", "--past", "--data-dir", tmp_path / "new") == (
        0, f"{tmp_path / 'new'}: no state is kept yet\n", ""
    )  # fmt: skip
    to = tmp_path / "a.csv"
    asked = "export", "--corrected", copied / RECORDING, "-o", to, "--data-dir"
    status, _, err = run(capsys, *asked, tmp_path / "new")
    assert status == 2
    assert "no sample can be corrected: no state is kept of the device virtual mems-1" in err

    def older(state: bytes) -> bytes:
        held = unpack(state)
        del held["channel"]
        return pack(held)

    change_memory(copied, older)
    status, out, _ = run(capsys, "show", "--past", "--data-dir", copied)
    assert status == 0
    assert "no past of virtual mems-1" in out
    assert "its state is of an earlier version" in out
    status, _, err = run(capsys, *asked, copied)
    assert status == 2
    assert "its state is of an earlier version" in err
    assert not to.exists()


@pytest.mark.parametrize("u", [np.nan, -1.0, 1e300])
def test_a_step_of_no_size_is_one_line(u: float, copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def stepped(state: bytes) -> bytes:
        held = unpack(state)
        own = held["estimation"]["state"]
        own["steps"].append({"day": float(np.nextafter(own["records"][2]["day"], -np.inf)), "u": {"Sxx": u}})
        return pack(held)

    change_memory(copied, stepped)
    status, out, err = run(capsys, "show", "--past", "--data-dir", copied)
    assert (status, err) == (0, "")
    assert "its state cannot be read" in out or "; it came " in out.splitlines()[-1]


@pytest.mark.parametrize("damage", ["bytes", "content", "page"])
def test_a_damaged_state_is_one_line(damage: str, copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if damage == "bytes":
        with sqlite3.connect(copied / FILE_NAME) as connection:
            connection.execute("UPDATE memory SET state = zeroblob(100)")
    elif damage == "content":
        change_memory(copied, lambda _: pack({"estimation": {"state": {"records": 5}}, "channel": "{}", "filters": {}}))
    else:
        data = bytearray((copied / FILE_NAME).read_bytes())
        data[len(data) // 2 :] = b"\xa5" * (len(data) - len(data) // 2)
        (copied / FILE_NAME).write_bytes(data)
    status, out, err = run(capsys, "show", "--past", "--data-dir", copied)
    if damage == "content":
        assert (status, err) == (0, "")
        assert "its state cannot be read" in out
    else:
        assert (status, out) == (2, "")
        assert err.startswith("fieldcal show: ")
    assert (out + err).count("\n") == 1


@pytest.mark.slow
def test_a_recording_that_a_power_cut_tore_is_exported_up_to_there(
    copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = (copied / RECORDING).read_bytes()
    (copied / RECORDING).write_bytes(data[: int(0.9 * len(data))])
    to = tmp_path / "a.csv"
    status, _, err = run(capsys, "export", "--corrected", copied / RECORDING, "-o", to)
    assert status == 0
    assert "ends early" in err
    assert "nan" not in to.read_text().splitlines()[-1]


def test_what_cannot_be_corrected_is_refused_with_a_remedy(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    to = tmp_path / "a.csv"
    refused: tuple[tuple[list[str | Path], str], ...] = (
        (["-o", tmp_path / "a.uff"], "--corrected writes one file with the ending .csv or .parquet"),
        (["-o", to, "--device", "reference"], "reference has 1 axis; S and Q are those of three axes"),
        (["-o", to, "--device", "other"], "has no samples of 'other'"),
    )
    for arguments, words in refused:
        status, _, err = run(capsys, "export", "--corrected", kept / RECORDING, *arguments)
        assert (status, to.exists()) == (2, False)
        assert words in err
    status, _, err = run(capsys, "export", kept / RECORDING, "-o", to, "--data-dir", kept)
    assert status == 2
    assert "--data-dir names the windows for --corrected" in err


@pytest.mark.slow
def test_what_makes_u_of_any_calibration_is_told_by_store_and_recording(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of an earlier one, the numbers are those of the run that ended with it."""

    def budget(number: int, *of: str | Path) -> dict[str, Any]:
        status, out, err = run(capsys, "show", "--budget", str(number), *of, "--json", "-")
        assert (status, err) == (0, "")
        told = dict(json.loads(out))
        assert told["sequence"] == number
        np.testing.assert_allclose(told["u_over_u_in_force"], 1.0, rtol=0, atol=0.01)
        return dict(told["budget"])

    def newest(directory: Path) -> dict[str, Any]:
        return dict(json.loads(run(capsys, "show", "--data-dir", directory, "--json", "-")[1])["sensors"]["mems"])

    record(tmp_path / "shorter", 45.0)
    for ended in (kept, tmp_path / "shorter"):
        told = newest(ended)
        for of in (["--data-dir", kept], [kept / RECORDING]):
            assert budget(told["calibration"]["sequence"], *of) == told["budget"]
    third = told["calibration"]["sequence"]
    assert third < newest(kept)["calibration"]["sequence"]
    lines = run(capsys, "show", "--budget", str(third), kept / RECORDING)[1].splitlines()
    assert lines[0].startswith(f"mems: calibration {third} of run run-1, in force since 2026-09-21")
    assert len(lines) == 3 + len(told["budget"]["standard_uncertainty"])
    gone = shutil.copytree(kept, tmp_path / "gone")
    (gone / RECORDING).unlink()
    for arguments, status, words in (
        (["1", kept / RECORDING], 2, "has no calibration with the number 1"),
        (["1", "--data-dir", kept], 2, "no calibration with the number 1 is kept"),
        ([str(third), "--data-dir", gone], 3, "the recording fieldcal-000001.mcap does not exist any more"),
        ([str(third), "--past"], 2, "--past and --budget show different things"),
    ):
        found, out, err = run(capsys, "show", "--budget", *arguments)
        assert (found, out) == (status, "")
        assert words in err


def test_show_and_report_say_what_makes_u(kept: Path, copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sensor = json.loads(run(capsys, "show", "--data-dir", kept, "--json", "-")[1])["sensors"]["mems"]
    budget, update = sensor["budget"], sensor["calibration"]
    squares = np.sum(np.square(list(budget["standard_uncertainty"].values())), axis=0)
    np.testing.assert_allclose(np.sqrt(squares), update["standard_uncertainty"], rtol=0.01)
    assert budget["coverage_factor"] == update["coverage_factor"]
    line = next(line for line in run(capsys, "show", "--data-dir", kept)[1].splitlines() if "type A" in line[:9])
    U = [2.0 * u for u in budget["standard_uncertainty"]["type A"]]
    np.testing.assert_allclose([float(cell) for cell in line.split()[2:]], np.array(U)[[0, 4, 8, 9, 10, 11]], rtol=0.08)
    material = gather([kept], None)
    assert dict(material.results[0].budget).keys() == budget["standard_uncertainty"].keys()
    assert material.facts["uncertainty budget"].startswith("of all kept windows, solved anew; its u is 1.000")

    def rolled_back(state: bytes) -> bytes:
        held = unpack(state)
        held["in_force"]["made_sequence"] = held["in_force"]["sequence"] = 1
        return pack(held)

    change_memory(copied, rolled_back)
    assert (
        "what makes U is not known: S and Q in force are not those of the newest windows"
        in run(capsys, "show", "--data-dir", copied)[1]
    )
    assert not gather([copied], None).results[0].budget
