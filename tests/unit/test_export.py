"""`fieldcal export`: what it writes is read again, by the readers of this program and by their formats' definitions."""

from __future__ import annotations

import csv
import json
import re
import struct
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from agent.calibrate.tables import read_sensor
from agent.cli.main import run_cli
from agent.export import uff
from agent.export.plots import write_plots
from agent.export.samples import ExportedSamples, ExportError, RecordedContent, content_of, samples
from agent.export.tables import cell, write_csv
from agent.export.uff import write_uff
from agent.reading.ros2 import RosBag
from hw.virtual.bench import Bench
from hw.virtual.presets import plain
from tests.unit.recorded_bench import BLOCK, EPOCH_NS, record

SECONDS = 41.0
VIEWERS = Path(__file__).parents[2] / "deploy" / "viewers"
TYPES = {"int32": "i", "uint32": "I", "float64": "d"}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("export")
    record(directory, SECONDS)
    return next(directory.glob("*.mcap"))


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str]:
    status = run_cli(["export", *map(str, arguments)])
    return status, capsys.readouterr().err


@pytest.fixture(scope="module")
def truth() -> tuple[np.ndarray, np.ndarray]:
    """When the samples were taken, in s since 1970, and the indications, as the bench made them."""
    made = Bench(plain(7), 7).recording(SECONDS)
    count = len(made.v) // BLOCK * BLOCK
    return made.sensor_time_s[:count] + EPOCH_NS * 1e-9, np.asarray(made.v[:count], dtype=float)


@pytest.mark.one_case
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_table_has_times_indications_and_accelerations(
    ending: str, recorded: Path, truth: tuple[np.ndarray, np.ndarray], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    if ending == "parquet":
        pytest.importorskip("pyarrow", reason="the extra files is not installed")
    path = tmp_path / f"out.{ending}"
    assert run(capsys, recorded, "--to", path) == (0, "")
    time = "time_s" if ending == "csv" else "time"
    found = read_sensor(path, columns=f"time={time},x=vx,y=vy,z=vz")
    np.testing.assert_array_equal(found.v[:], truth[1])
    # The clock model is within a tenth of a sample of the truth, and has no steps of bursts of 25 ms.
    np.testing.assert_allclose(found.time_s[:], truth[0], atol=1e-4)
    assert np.diff(found.time_s[:]).min() > 0.0
    a = read_sensor(path, columns=f"time={time},x=ax,y=ay,z=az").v[:]
    newest = content_of([recorded], None).calibrations[-1]
    np.testing.assert_allclose(a @ np.transpose(newest.sensitivity) + newest.offset, truth[1], rtol=1e-9, atol=1e-6)


def uff_sets(path: Path) -> list[tuple[list[str], list[float]]]:
    """The sets 58 of a file by the places of the format, without pyuff: (the 11 lines of the head, the numbers)."""
    sets = path.read_text("ascii").split("    -1\n")[1::2]
    assert all(lines.startswith((f"{164:6d}", f"{58:6d}")) for lines in sets)
    found = []
    for lines in (one.split("\n") for one in sets if one.startswith(f"{58:6d}")):
        numbers = [float(line[at : at + 20]) for line in lines[12:] for at in range(0, len(line), 20)]
        found.append((lines[1:12], numbers))
    return found


@pytest.mark.thorough
def test_uff_has_each_signal_with_unit_direction_and_times(
    recorded: Path, truth: tuple[np.ndarray, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pyuff = pytest.importorskip("pyuff", reason="pyuff is not installed (extra uff)")
    path = tmp_path / "out.uff"
    assert run(capsys, recorded, "--to", path) == (0, "")
    times, indications = truth
    newest = content_of([recorded], None).calibrations[-1]
    a = np.linalg.solve(np.array(newest.sensitivity), (indications - newest.offset).T).T
    wanted = np.hstack([indications, a])
    sets = uff_sets(path)
    assert len(sets) == 6
    for k, (head, numbers) in enumerate(sets):
        np.testing.assert_allclose(numbers, wanted[:, k], rtol=1e-11, atol=1e-11)
        assert head[0].rstrip() == f"mems {('vx', 'vy', 'vz', 'ax', 'ay', 'az')[k]}"
        assert head[2].rstrip() == f"{datetime.fromtimestamp(times[0], UTC):%d-%b-%y %H:%M:%S}".upper()
        # Record 6, Format(2(I5,I10),2(1X,10A1,I10,I4)): function type, response entity, node and direction
        assert (int(head[5][:5]), head[5][31:41].strip(), int(head[5][41:51])) == (1, "mems", 1)
        assert int(head[5][51:55]) == k % 3 + 1
        # Record 7, Format(3I10,3E13.5): real numbers of 64 bits, how many, equally spaced, begin, step
        assert [int(head[6][at : at + 10]) for at in (0, 10, 20)] == [4, len(times), 1]
        step_s = (times[-1] - times[0]) / (len(times) - 1)
        assert float(head[6][30:43]) == 0.0
        assert float(head[6][43:56]) == pytest.approx(step_s, rel=6e-6)
        # Records 8 and 9, Format(I10,3I5,2(1X,20A1)): type, label, unit of abscissa and ordinate
        assert (int(head[7][:10]), head[7][26:46].strip(), head[7][47:67].strip()) == (17, "Time", "s")
        told = (12, "Acceleration", "m/s2") if k > 2 else (0, "Indication", "count")
        assert (int(head[8][:10]), head[8][26:46].strip(), head[8][47:67].strip()) == told
        rate_hz = float(head[3].split("rate ")[1].split()[0])
        assert rate_hz == pytest.approx(1.0 / step_s, rel=1e-6)
    made = f"a = inv(S) (V - Q), calibration {newest.made[1]} of {newest.made[0]}"
    assert [head[1].rstrip() for head, _ in sets] == ["indication"] * 3 + [made] * 3

    units, *read = pyuff.UFF(str(path)).read_sets()
    assert (units["type"], units["units_code"], units["length"]) == (164, 1, 1.0)
    for k, one in enumerate(read):
        np.testing.assert_allclose(one["data"], wanted[:, k], rtol=1e-11, atol=1e-11)
        assert (one["rsp_dir"], one["ordinate_axis_units_lab"]) == (k % 3 + 1, "m/s2" if k > 2 else "count")
        np.testing.assert_allclose(one["x"], times - times[0], atol=2e-4)  # the step has six digits


def uff_blocks(*parts: tuple[int, int]) -> Iterator[ExportedSamples]:
    """Blocks (number of the first sample, how many) of a steady device at 100 Hz, with a = its own number."""
    for first, count in parts:
        numbers = np.arange(first, first + count, dtype=float)
        yield ExportedSamples(
            (1_700_000_000 * 10**9 + numbers * 1e7).astype(np.int64), numbers[:, None], None, first, 100.0, None
        )


def test_a_set_of_uff_spans_no_hole_and_no_name_breaks_its_lines(tmp_path: Path) -> None:
    pytest.importorskip("pyuff", reason="pyuff is not installed (extra uff)")
    path = tmp_path / "holes.uff"
    content = RecordedContent("a" * 63, "m/s²\n    -1\n", 1)
    assert write_uff(path, content, uff_blocks((5, 3), (8, 2), (20, 1), (30, 4))) == 10
    assert [(numbers, float(head[6][30:43]), head[4].rstrip()) for head, numbers in uff_sets(path)] == [
        ([5.0, 6.0, 7.0, 8.0, 9.0], 0.0, "NONE"),
        ([20.0], 0.15, "10 samples are missing before"),
        ([30.0, 31.0, 32.0, 33.0], 0.25, "9 samples are missing before"),
    ]
    (head, _), *_ = uff_sets(path)
    assert (head[5][31:41], int(head[5][51:55])) == ("a" * 10, 0)
    assert all(len(line) <= 80 for line in head)
    assert [one.name for one in tmp_path.iterdir()] == ["holes.uff"]


@pytest.mark.parametrize("limit", ["MOST_SAMPLES", "MOST_PARTS"])
def test_what_uff_cannot_hold_is_refused(limit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyuff", reason="pyuff is not installed (extra uff)")
    monkeypatch.setattr(uff, limit, 3)
    blocks = uff_blocks((0, 4)) if limit == "MOST_SAMPLES" else uff_blocks(*((10 * k, 1) for k in range(4)))
    with pytest.raises(ExportError, match="export fewer recordings at once, or to"):
        write_uff(tmp_path / "a.uff", RecordedContent("a", "m/s2", 1), blocks)
    assert list(tmp_path.iterdir()) == []


def test_without_pyuff_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyuff", None)
    with pytest.raises(ExportError, match="fieldcal extras --install uff"):
        write_uff(tmp_path / "a.uff", RecordedContent("a", "m/s2", 1), [])


@pytest.mark.slow
def test_miniseed_has_each_block_at_its_own_time(
    recorded: Path, truth: tuple[np.ndarray, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("obspy", reason="ObsPy is not installed (extra seismic)")
    path = tmp_path / "out.mseed"
    assert run(capsys, recorded, "--to", path) == (0, "")
    found = read_sensor(path, columns="group=XX.MEMS.00.FN,time=time_s,x=1,y=2,z=3")
    np.testing.assert_array_equal(found.v[:], truth[1])
    # One grid for the whole file, as MiniSEED has it: the clock of the bench is steady, the rate has 24 bits.
    np.testing.assert_allclose(found.time_s[:], truth[0], atol=1e-3)
    a = read_sensor(path, columns="group=XX.MEMS.10.FN,time=time_s,x=1,y=2,z=3").v[:]
    newest = content_of([recorded], None).calibrations[-1]
    np.testing.assert_allclose(a @ np.transpose(newest.sensitivity) + newest.offset, truth[1], rtol=1e-9, atol=1e-6)


@pytest.mark.slow
def test_a_reference_is_one_column(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "out.csv"
    assert run(capsys, recorded, "--to", path, "--device", "reference") == (0, "")
    with path.open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["time_s", "a"]
    assert len(rows) - 1 == len(Bench(plain(7), 7).recording(SECONDS).reference) // BLOCK * BLOCK


def decode(kind: str, definitions: dict[str, list[str]], data: bytes, at: int = 4) -> tuple[Any, int]:
    """A CDR message by the definition that the file itself holds; numbers are aligned from byte 4 on."""
    if kind == "string":
        length, at = decode("uint32", definitions, data, at)
        return data[at : at + length - 1].decode(), at + length
    if kind in TYPES:
        size = struct.calcsize(TYPES[kind])
        at += -(at - 4) % size
        return struct.unpack_from(f"<{TYPES[kind]}", data, at)[0], at + size
    if repeated := re.fullmatch(r"(.+)\[(\d*)\]", kind):
        count = int(repeated[2] or 0)
        if not repeated[2]:
            count, at = decode("uint32", definitions, data, at)
        values = []
        for _ in range(count):
            value, at = decode(repeated[1], definitions, data, at)
            values.append(value)
        return values, at
    found: dict[str, Any] = {}
    for line in definitions[kind]:
        inner, name = line.split()
        found[name], at = decode(inner, definitions, data, at)
    return found, at


def messages(path: Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Topic, publish time and content of each message of an MCAP file of ROS 2."""
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            parts = re.split(r"=+\nMSG: (.*)\n", schema.data.decode())
            texts = dict(zip([schema.name.replace("/msg", ""), *parts[1::2]], parts[0::2], strict=True))
            definitions = {name: text.strip().splitlines() for name, text in texts.items()}
            found, end = decode(schema.name.replace("/msg", ""), definitions, message.data)
            assert end == len(message.data)
            assert message.publish_time == message.log_time
            yield channel.topic, message.publish_time, found


@pytest.fixture(scope="module")
def plots(recorded: Path) -> Path:
    path = recorded.with_name("plots.mcap")
    assert run_cli(["export", str(recorded), "--mcap", str(path), "--rate-hz", "50"]) == 0
    return path


@pytest.mark.slow
def test_plots_are_means_at_the_stated_rate(plots: Path, truth: tuple[np.ndarray, np.ndarray], recorded: Path) -> None:
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for topic, t_utc_ns, content in messages(plots):
        assert t_utc_ns == content["header"]["stamp"]["sec"] * 10**9 + content["header"]["stamp"]["nanosec"]
        assert content["header"]["frame_id"] == "mems"
        found.setdefault(topic, []).append((t_utc_ns, content))
    assert set(found) == {"/mems/acceleration", "/mems/indication", "/mems/calibration"}
    span_s = truth[0][-1] - truth[0][0]
    for topic in ("/mems/acceleration", "/mems/indication"):
        assert len(found[topic]) == pytest.approx(50 * span_s, abs=2)
    # The eleventh whole interval, as the samples of the truth make it.
    first = round((np.ceil(truth[0][0] * 50) + 10) / 50 * 1e9) * 1e-9
    inside = (truth[0] >= first) & (truth[0] < first + 0.02)
    near = min(found["/mems/indication"], key=lambda told: abs(told[0] * 1e-9 - first - 0.01))
    np.testing.assert_allclose(near[1]["position"], truth[1][inside].mean(axis=0), rtol=0.02)
    assert near[1]["name"] == ["x", "y", "z"]
    newest = content_of([recorded], None).calibrations[-1]
    told = dict(
        zip(found["/mems/calibration"][-1][1]["name"], found["/mems/calibration"][-1][1]["position"], strict=True)
    )
    assert told["Szy"] == newest.sensitivity[2][1]
    assert told["U_Qz"] == newest.coverage_factor * newest.standard_uncertainty[11]


@pytest.mark.slow
def test_the_reader_of_ros_2_reads_the_accelerations(plots: Path) -> None:
    with RosBag(plots) as bag:
        assert [column.group for column in bag.columns] == ["/mems/acceleration"] * 4
        table = np.vstack(list(bag.pieces(bag.columns, None)))
    told = [(t * 1e-9, *c["linear_acceleration"].values()) for topic, t, c in messages(plots) if "accel" in topic]
    np.testing.assert_allclose(table, told, rtol=1e-15)


def test_the_layout_shows_what_is_there(plots: Path) -> None:
    """Every curve of the layout for Lichtblick is a number of a message."""
    newest = {topic: content for topic, _, content in messages(plots)}
    layout = json.loads((VIEWERS / "lichtblick.json").read_text())
    shown = [path["value"] for panel in layout["configById"].values() for path in panel["paths"]]
    assert len(shown) == 9
    for path in shown:
        topic, _, rest = path.partition(".")
        value: Any = newest[topic]
        for part in re.findall(r"\w+", rest):
            value = value[int(part)] if part.isdigit() else value[part]
        assert isinstance(value, float)
    panels = re.findall(r'"(Plot!\w+)"', json.dumps(layout["layout"]))
    assert sorted(panels) == sorted(layout["configById"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--to", "out.xyz"], "must be one of .csv, .parquet, .uff, .mseed"),
        ([], "add --to FILE"),
        (["--to", "out.csv", "--device", "nobody"], "has no samples of 'nobody'"),
        (["--to", "there.csv"], "the file exists"),
        (["--to", "nowhere/out.csv"], "No such file or directory"),
    ],
)
def test_bad_input_is_named(
    arguments: list[str], words: str, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.csv").write_text("mine")
    status, told = run(capsys, recorded, *arguments)
    assert status == 2
    assert words in told
    assert (tmp_path / "there.csv").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["there.csv"]


def test_what_is_no_recording_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.mcap").write_bytes(b"no recording")
    status, told = run(capsys, tmp_path / "a.mcap", "--to", tmp_path / "out.csv")
    assert status == 2
    assert told.count("\n") == 1
    assert "a.mcap" in told


def test_a_torn_recording_gives_what_it_has(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = recorded.read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(data[: len(data) // 2])
    status, told = run(capsys, torn, "--to", tmp_path / "out.csv")
    assert status == 0
    assert "ends early" in told
    assert len((tmp_path / "out.csv").read_text().splitlines()) > 1000


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", "\tx"])
def test_a_cell_is_no_formula(text: str) -> None:
    assert cell(text).startswith(("'", "\"'"))


def test_the_unit_of_a_device_is_no_formula_in_a_header(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", RecordedContent("a", '=cmd|"x",', 1), [])
    with (tmp_path / "a.csv").open(newline="") as file:
        assert next(csv.reader(file)) == ["time_s", 'indication_=cmd|"x",']
    assert cell("=cmd") == "'=cmd"


@pytest.mark.slow
def test_memory_does_not_grow_with_the_length(tmp_path: Path) -> None:
    """Three times as many blocks, both more than a chunk of MCAP: the same memory."""

    def blocks(count: int, rows: int) -> Iterator[ExportedSamples]:
        for k in range(count):
            times = EPOCH_NS + (np.arange(rows) + rows * k) * 100_000_000
            yield ExportedSamples(times, np.zeros((rows, 3)), np.zeros((rows, 3)), rows * k, 10.0, None)

    def peak(write: Callable[..., int], count: int, rows: int, *more: float) -> int:
        tracemalloc.start()
        write(tmp_path / f"{write.__name__}{count}", RecordedContent("a", "count", 3), blocks(count, rows), *more)
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top

    assert peak(write_csv, 120, 100) < 1.3 * peak(write_csv, 40, 100)
    assert peak(write_plots, 450, 5, 10.0) < 1.3 * peak(write_plots, 150, 5, 10.0)


def test_samples_are_those_of_the_recording_once_each(recorded: Path) -> None:
    content = content_of([recorded], None)
    indices = np.concatenate([b.first_index + np.arange(len(b.values)) for b in samples([recorded], content)])
    np.testing.assert_array_equal(indices, np.arange(len(indices)))
