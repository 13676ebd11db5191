"""Faults that `benchmarks.hostile_files` found in what reads samples: each is one line, in bounded memory and time."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.calibrate.reference_certificate import read_reference_certificate
from agent.calibrate.tables import read_sensor
from agent.cli.main import run_cli
from agent.config.earlier import EarlierError, read_earlier
from agent.core.snapshot import pack, unpack
from agent.proto import fieldcal_pb2 as pb
from agent.reading.recording import HOLES_MAX
from agent.reading.seismic import open_miniseed
from agent.reading.source import TableError
from calib.model import Pose
from calib.recorded.poses import PoseInterval
from calib.recorded.table import SensorTable
from calib.recorded.tables import Tables
from calib.signal.instrument import Instrument
from calib.signal.stamps import clock_from_stamps
from tests.replay.forgery import Unpacked
from tests.replay.golden_files import FORMATS, RECORDING
from tests.unit.certificates import uneven

# Exit statuses. An earlier engine made the golden recording, so `replay` cannot say whether its results are right.
REFUSED = {"report": 2, "export": 2, "fleet replay": 3, "replay": 4}


def changed(path: Path, change: Callable[[str, Any], None]) -> Path:
    """The golden recording, in which `change` was done to each event and block. All CRCs are right."""
    found = Unpacked.of(FORMATS[-1] / RECORDING)
    for at, (topic, schema, *times, data) in enumerate(found.messages):
        if topic == "/events" or topic.endswith("/raw"):
            message = getattr(pb, schema.rpartition(".")[2]).FromString(data)
            change(topic, message)
            found.messages[at] = (topic, schema, *times, message.SerializeToString())  # type: ignore[assignment]
    found.write(path)
    return path


def configuration(text: str) -> Callable[[str, Any], None]:
    def change(topic: str, message: Any) -> None:
        if topic == "/events" and message.HasField("run_start"):
            message.run_start.config_json = text

    return change


def device(text: str) -> Callable[[str, Any], None]:
    def change(topic: str, message: Any) -> None:
        if topic == "/events" and message.HasField("device_change"):
            message.device_change.info_json = text

    return change


def times(topic: str, message: Any) -> None:
    if topic == "/events" and message.HasField("run_start"):
        message.run_start.t_utc_ns, message.run_start.t_monotonic_ns = 2**63 - 1, -(2**63)


def axes() -> Callable[[str, Any], None]:
    seen: list[int] = []

    def change(topic: str, message: Any) -> None:
        if topic == "/imu/raw":
            seen.append(1)
            if len(seen) == 3:
                message.axes = 1

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (configuration("[1"), "has no 'devices'"),
        (configuration("7"), "has no 'devices'"),
        (configuration("[" * 100_000), "has no 'devices'"),
        (device("{}"), "has no 'unit'"),
        (device('"x"'), "has no 'unit'"),
        (times, "ns after a boot"),
        (axes(), "a block of 'imu' has 1 axes, not 3"),
    ],
)
def test_a_recording_that_describes_itself_wrongly_is_told(
    tmp_path: Path, change: Callable[[str, Any], None], words: str
) -> None:
    path = changed(tmp_path / "f.mcap", change)
    with pytest.raises(TableError, match=re.escape(words)) as told:
        read_sensor(path, columns="group=imu")
    assert str(told.value).startswith(str(path))


def test_missing_samples_that_a_recording_claims_take_a_bounded_place(tmp_path: Path) -> None:
    """Each block claims that some millions are missing before it."""
    jump: list[int] = []

    def change(topic: str, message: Any) -> None:
        if topic == "/imu/raw":
            message.nominal_rate_hz = 1e6
            message.first_index += 800_000 * len(jump)
            jump.append(1)

    path = changed(tmp_path / "f.mcap", change)
    rows = len(read_sensor(path, columns="group=imu").time_s)
    assert len(jump) > 5
    assert 800_000 < rows < HOLES_MAX + 20_000


@pytest.mark.parametrize("last", [1e18, 1e15, -1e18])
def test_a_time_that_is_none_is_told(tmp_path: Path, last: float) -> None:
    path = tmp_path / "sensor.csv"
    stamps = [*(k / 100 for k in range(200)), last] if last > 0 else [last, *(k / 100 for k in range(200))]
    path.write_text("time_s,vx,vy,vz\n" + "".join(f"{t!r},0,0,9.8\n" for t in stamps))
    with pytest.raises(TableError, match="no time since 1970 in s; state its unit"):
        read_sensor(path)


def test_a_clock_has_no_more_pieces_than_stamps() -> None:
    """A thousand years between two samples are no reason for a parabola each half minute."""
    clock = clock_from_stamps(np.concatenate([np.arange(300) / 100.0, 3e10 + np.arange(3) / 100.0]))
    assert clock.knot_index is not None
    assert len(clock.knot_index) <= 305


def test_the_configuration_of_the_golden_recording_is_read(tmp_path: Path) -> None:
    """The changes above are what is refused, not the recording."""
    told: list[str] = []

    def change(topic: str, message: Any) -> None:
        if topic == "/events" and message.HasField("run_start"):
            told.append(message.run_start.config_json)

    path = changed(tmp_path / "f.mcap", change)
    assert [device["name"] for device in json.loads(told[0])["devices"]] == ["imu", "ref"]
    assert len(read_sensor(path, columns="group=imu").time_s) > 100


@pytest.mark.parametrize(
    "stated", ['{"result": RESULT, "stated": []}', '{"result": RESULT, "stated": {"instrument": 7}}']
)
def test_a_certificate_of_a_reference_without_a_serial_number_is_read(tmp_path: Path, stated: str) -> None:
    result = json.dumps(uneven())
    path = tmp_path / "certificate.json"
    path.write_text('{"certificate": ' + stated.replace("RESULT", result) + "}")
    assert read_reference_certificate(path).serial_number == ""


@pytest.mark.parametrize(("start_s", "stop_s"), [(0.0, 1e15), (-1e15, 4.0)])
def test_a_pose_that_lasts_for_ever_takes_no_time(start_s: float, stop_s: float) -> None:
    """There are no windows outside the recording, and none are looked for: there would be 10^13 of them."""
    time_s = np.arange(400) / 100
    still = 9.8 + np.random.default_rng(1).normal(0.0, 1e-3, (400, 3))
    pose = Pose("still", np.empty((3, 0)), np.array([0.0, 0.0, 9.81]))
    table = SensorTable("sensor", time_s, still, None)
    (window,) = Tables(table, None, [PoseInterval(start_s, stop_s, pose)], Instrument()).windows()
    assert window.used
    assert 300 < window.points <= 400


@pytest.mark.two_cases
@pytest.mark.parametrize(
    "text",
    [
        "5",
        pytest.param('{"gateway": {}}', marks=pytest.mark.thorough),
        pytest.param('{"channels": 5}', marks=pytest.mark.thorough),
        pytest.param('{"channels": [5]}', marks=pytest.mark.thorough),
        pytest.param('{"channels": [{"process": 5, "certificate": {}}]}', marks=pytest.mark.thorough),
        '{"channels": [{"process": {"reference_pct": "a"}, "certificate": {"calibrated": 5}}]}',
    ],
)
@pytest.mark.parametrize("command", REFUSED)
def test_a_recording_whose_configuration_is_none_is_refused_in_one_line(
    command: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(changed(tmp_path / "a.mcap", configuration(text)))
    out = {"report": "-o out", "export": "--to out.csv", "fleet replay": "--export csv -o out"}.get(command, "")
    status = run_cli([*command.split(), path, *out.replace("out", str(tmp_path / "out")).split()])
    assert status == REFUSED[command]
    told = capsys.readouterr()
    lines = [line for line in (told.out + told.err).splitlines() if "onfiguration" in line]
    assert len(lines) == 1
    assert re.search(r"its configuration (cannot be read|and snapshot): .*(no table|Field required)", lines[0])


def without_channels(snapshot: bytes) -> bytes:
    return pack(unpack(snapshot) | {"channels": {}})


def with_a_broken_clock(snapshot: bytes) -> bytes:
    state = unpack(snapshot)
    for channel in state["channels"].values():
        channel |= {"streams": {"imu": {"runs": [{"number": 0, "clock": {}, "blocks": []}]}}}
    return pack(state)


@pytest.mark.two_cases
@pytest.mark.parametrize("damage", [lambda held: held + b"\0", without_channels, with_a_broken_clock])
@pytest.mark.parametrize("command", REFUSED)
def test_a_recording_whose_snapshot_is_damaged_is_refused_in_one_line(
    command: str, damage: Callable[[bytes], bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def with_damage(topic: str, message: Any) -> None:
        if topic == "/events" and message.HasField("run_start"):
            message.run_start.snapshot = damage(message.run_start.snapshot)

    path = str(changed(tmp_path / "a.mcap", with_damage))
    out = {"report": "-o out", "export": "--to out.csv", "fleet replay": "--export csv -o out"}.get(command, "")
    status = run_cli([*command.split(), path, *out.replace("out", str(tmp_path / "out")).split()])
    told = capsys.readouterr()
    if out.endswith(("csv", "csv -o out")) and damage is without_channels:
        assert status == 0, "an export of the file's own samples needs nothing from before the file"
        return
    assert status == REFUSED[command]
    lines = [line for line in (told.out + told.err).splitlines() if "snapshot: " in line]
    assert len(lines) == 1
    assert re.search("snapshot: (KeyError|ValueError): ", lines[0])


@pytest.mark.parametrize("ending", ["csv", "uff", "mseed"])
def test_samples_whose_times_do_not_rise_are_not_exported(
    ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if ending == "mseed":
        pytest.importorskip("obspy", reason="the extra seismic is not installed")

    def backwards(topic: str, message: Any) -> None:
        if topic.endswith("/raw"):
            first_ns = began_ns.setdefault(message.device, message.burst_t_monotonic_ns[0])
            message.burst_t_monotonic_ns[:] = [2 * first_ns - ns for ns in message.burst_t_monotonic_ns]

    began_ns: dict[str, int] = {}
    path = changed(tmp_path / "backwards.mcap", backwards)
    assert run_cli(["export", str(path), "--to", str(tmp_path / f"out.{ending}")]) == 2
    assert capsys.readouterr().err.startswith(
        "fieldcal export: imu: the times of its samples do not rise (rate -100 Hz)"
    )
    assert not (tmp_path / f"out.{ending}").exists()


def test_a_number_too_large_for_a_result_is_told(tmp_path: Path) -> None:
    result = uneven()
    result["covariance"][0][0] = 10**400
    path = tmp_path / "result.json"
    path.write_text(json.dumps(result))
    with pytest.raises(EarlierError, match="int too large"):
        read_earlier(path)


@pytest.mark.parametrize(
    "damaged",
    [
        {"sensitivity": [[1.0, 0.0, 0.0]]},
        {"sensitivity": 1.0},
        {"offset": [0.0]},
        {"offset": [0.0] * 9, "sensitivity": [1.0, 1.0, 1.0]},
        {"covariance": [[1e-6] * 12] * 11},
        {"covariance": 1e-6},
    ],
)
def test_a_result_without_all_its_numbers_is_told(tmp_path: Path, damaged: dict[str, object]) -> None:
    path = tmp_path / "result.json"
    path.write_text(json.dumps(uneven() | damaged))
    with pytest.raises(TableError, match=r"result\.json.*3 x 3 numbers, offset 3 and covariance 12 x 12"):
        read_reference_certificate(path)


def with_an_early_record(path: Path, samples: int) -> Path:
    """Three components, one record of one of them 40 h early: 14 million samples each, 24 kB in the file. `samples`: of
    the other records of this component; the other two have 3000."""
    obspy = pytest.importorskip("obspy", reason="the extra seismic is not installed")
    traces = [
        obspy.Trace(np.arange(n, dtype=np.int32), {"sampling_rate": 100.0, "channel": f"HN{k}"})
        for k, n in zip("ENZ", (samples, 3000, 3000), strict=True)
    ]
    early = obspy.Trace(np.arange(600, dtype=np.int32), {"sampling_rate": 100.0, "channel": "HNE"})
    early.stats.starttime -= 40 * 3600
    obspy.Stream([*traces, early]).write(str(path), format="MSEED")
    return path


def test_a_damaged_time_in_miniseed_does_not_fill_the_memory_with_a_gap(tmp_path: Path) -> None:
    with pytest.raises(TableError, match=r"the file says that it holds .* bytes of values"):
        open_miniseed(with_an_early_record(tmp_path / "a.mseed", 2000))
    values = open_miniseed(with_an_early_record(tmp_path / "b.mseed", 3000)).values  # this component has the most
    (time_s,) = (held for column, held in values.items() if column.name == "time_s")
    expected_s = [*(np.arange(601) / 100 - 40 * 3600), *(np.arange(3000) / 100)]
    np.testing.assert_allclose(time_s[:], expected_s, rtol=0, atol=1e-9)
    (north,) = (held for column, held in values.items() if column.name == "y")
    np.testing.assert_array_equal(north[:], [*([np.nan] * 601), *range(3000)])


def test_a_header_of_miniseed_that_is_no_text_shows_no_traceback(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    obspy = pytest.importorskip("obspy", reason="the extra seismic is not installed")
    path = tmp_path / "a.mseed"
    header = {"network": "XX", "station": "A", "channel": "HNZ", "sampling_rate": 100.0}
    obspy.Stream([obspy.Trace(np.arange(400, dtype=np.int32), header)]).write(path, format="MSEED", encoding="STEIM2")
    data = bytearray(path.read_bytes())
    data[8], data[70:74] = 0xA0, b"\xff\xff\xff\xff"  # of the station's name; the codes of the samples
    path.write_bytes(data)
    with suppress(TableError):
        open_miniseed(path)
    assert "Traceback" not in capfd.readouterr().err
