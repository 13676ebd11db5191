"""`fieldcal fleet replay`: the same bits whatever the workers, killed and resumed, bad files and settings refused."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from agent.cli.fleet_replay import replay
from agent.config import recorded_config
from agent.core.anew import anew
from agent.core.events import CalibrationUpdate, RunStart, WindowReport
from agent.core.pipeline import Pipeline
from agent.fleet.results import Summary, results_of
from agent.fleet.settings import ChangedSetting, SettingError
from agent.fleet.sources import SourceError, local, recordings_in
from agent.fleet.task import RecordingTask, run_task
from agent.fleet.workers import LocalWorkers, outcome
from agent.recording.reading import RecordingReader
from tests.unit.recorded_bench import record
from tests.unit.zenoh_site import wait_for

NAME = "fieldcal-000001.mcap"
GOLDEN = Path(__file__).parents[1] / "replay" / "golden" / "format-3" / NAME
COMMAND = "import sys; from agent.cli.main import run_cli; sys.exit(run_cli(sys.argv[1:]))"
LOW = "channels.*.certificate.sensitivity*=0.996"  # the reference indicates 0.4 % less than was assumed


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four recordings, one of them with two changed bytes in its first chunk."""
    directory = tmp_path_factory.mktemp("recordings")
    for seed in (1, 2, 3):
        record(directory / f"made-{seed}", 20.0, seed=seed)
        shutil.move(directory / f"made-{seed}" / NAME, directory / f"gateway-{seed}.mcap")
    data = bytearray((directory / "gateway-1.mcap").read_bytes())
    data[90_000:90_002] = b"xx"
    (directory / "damaged.mcap").write_bytes(data)
    return directory


class Here(LocalWorkers):
    """This process itself, which needs no second to start."""

    def __init__(self) -> None:
        pass

    def run(self, tasks: Iterable[RecordingTask]) -> Iterator[tuple[RecordingTask, bytes | str]]:
        return ((task, outcome(partial(run_task, task))) for task in tasks)


def here(place: Path, *settings: str, out: Path | None = None) -> Summary:
    """What `fieldcal fleet replay` says of one recording."""
    (summary,) = results_of(recordings_in([str(place)]), settings, Here(), out, audit=False)
    return summary


def fleet_replay(*arguments: object) -> tuple[int, dict[str, Any]]:
    """Exit status and object of `fieldcal fleet replay --json -`."""
    done = CliRunner().invoke(replay, [*map(str, arguments), "--json", "-"], standalone_mode=False)
    assert done.exception is None, done.output
    return int(done.return_value), json.loads(done.stdout)


def written(directory: Path) -> dict[str, bytes]:
    """The results in a directory, each by the name of its file."""
    return {path.name: path.read_bytes() for path in directory.iterdir()}


@pytest.mark.thorough
def test_one_bad_file_is_told_and_the_others_have_the_same_bits_with_one_and_two_processes(
    recordings: Path, tmp_path: Path
) -> None:
    status, one = fleet_replay(recordings, "--audit", "--workers", 1, "-o", tmp_path / "one")
    assert status == 3
    bad, *good = one["files"]
    assert bad["place"].endswith("damaged.mcap")
    assert re.search(r"byte \d+ \(Chunk\): (decompression error|its CRC does not fit)", bad["reasons"][0])
    assert [Path(file["place"]).name for file in good] == [f"gateway-{seed}.mcap" for seed in (1, 2, 3)]
    assert all(file["results"] and not file["reasons"] for file in good)
    assert fleet_replay(recordings, "--audit", "--workers", 2, "-o", tmp_path / "two") == (status, one)
    assert written(tmp_path / "one") == written(tmp_path / "two")
    assert len(written(tmp_path / "one")) == 4


@pytest.mark.nightly
def test_dask_gives_the_same_bits(recordings: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra fleet is not installed")
    (tmp_path / "one").mkdir()
    assert len(list(results_of(recordings_in([str(recordings)]), (), Here(), tmp_path / "one", audit=False))) == 4
    # in a process of its own: Dask's threads and sockets would outlive this test
    script = (
        "import os, sys\nos.environ['OPENBLAS_NUM_THREADS'] = '1'\nfrom distributed import LocalCluster\n"
        "from agent.cli.main import run_cli\nif __name__ == '__main__':\n"
        "    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:\n"
        "        sys.exit(run_cli([*sys.argv[1:], '--scheduler', cluster.scheduler_address]))\n"
    )
    assert distributed.__version__
    (tmp_path / "cluster.py").write_text(script)
    told: list[str | Path] = [
        sys.executable,
        tmp_path / "cluster.py",
        "fleet",
        "replay",
        recordings,
        "-o",
        tmp_path / "dask",
    ]
    done = subprocess.run(
        told, capture_output=True, text=True, timeout=120, env=os.environ | {"PYTHONPATH": os.getcwd()}
    )
    assert done.returncode == 3, done.stderr
    assert written(tmp_path / "one") == written(tmp_path / "dask")


@pytest.mark.thorough
def test_a_killed_run_leaves_whole_results_and_no_process_and_goes_on(recordings: Path, tmp_path: Path) -> None:
    many, out = tmp_path / "many", tmp_path / "out"
    many.mkdir()
    for k in range(16):
        shutil.copy(recordings / f"gateway-{1 + k % 3}.mcap", many / f"{k:02}.mcap")
    told = [sys.executable, "-c", COMMAND, "fleet", "replay", str(many), "--workers", "2", "-o", str(out)]
    process = subprocess.Popen(told, stdout=subprocess.DEVNULL)
    wait_for(lambda: out.exists() and len(list(out.glob("*.json"))) >= 3, 60.0)
    children = [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    assert len(children) >= 2
    process.kill()
    process.wait()
    before = {name: data for name, data in written(out).items() if name.endswith(".json")}
    assert 3 <= len(before) < 16
    wait_for(lambda: not any(_runs(pid) for pid in children))
    after = list(results_of(recordings_in([str(many)]), (), Here(), out, audit=False))
    assert (sum(summary.unchanged for summary in after), len(after)) == (len(before), 16)
    assert not any(summary.reasons for summary in after)
    assert {name: written(out)[name] for name in before} == before


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.slow
def test_a_changed_file_another_setting_and_a_spoilt_result_are_computed_again(
    recordings: Path, tmp_path: Path
) -> None:
    file, out = tmp_path / "file.mcap", tmp_path / "out"
    out.mkdir()
    shutil.copy(recordings / "gateway-1.mcap", file)

    def unchanged(*settings: str) -> bool:
        return here(file, *settings, out=out).unchanged

    assert (unchanged(), unchanged()) == (False, True)
    assert (unchanged(LOW), unchanged(LOW), unchanged()) == (False, True, False)
    shutil.copy(recordings / "gateway-2.mcap", file)
    assert (unchanged(), unchanged()) == (False, True)
    (result,) = out.iterdir()
    result.write_bytes(result.read_bytes()[:-20])
    assert (unchanged(), unchanged()) == (False, True)


def run_or_end(task: RecordingTask) -> bytes:
    if "deadly" in task.place:
        os.kill(os.getpid(), signal.SIGKILL)
    return run_task(task)


@pytest.mark.thorough
def test_a_file_that_ends_its_process_is_refused_alone(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "deadly"):
        shutil.copy(recordings / "gateway-1.mcap", tmp_path / f"{name}.mcap")
    monkeypatch.setattr("agent.fleet.workers.run_task", run_or_end)
    status, told = fleet_replay(tmp_path, "--workers", 1)
    assert status == 3
    assert [bool(file["reasons"]) for file in told["files"]] == [False, True]
    assert "worker process ended" in told["files"][1]["reasons"][0]


@pytest.mark.slow
def test_a_reference_04_percent_low_makes_s_04_percent_low() -> None:
    """S is indication over acceleration, and the acceleration is indication over the reference's sensitivity. The prior
    of S, 5 %, holds S by a thirtieth."""
    as_stated, low = (here(GOLDEN, setting) for setting in ("channels.*.certificate.sensitivity*=1", LOW))
    assert not as_stated.reasons + low.reasons
    (before,), (after,) = as_stated.calibrations, low.calibrations
    for axis in range(3):
        ratio = after["sensitivity"][axis][axis] / before["sensitivity"][axis][axis]
        assert ratio == pytest.approx(0.996, abs=2e-4)


def test_a_recording_that_continues_another_is_recomputed_from_its_own_windows_alone() -> None:
    """A snapshot in the middle holds what the windows before it taught; anew, only the later windows count. The
    first calibration needs two of them."""
    start, *steps = RecordingReader(GOLDEN).steps()
    assert isinstance(start.event, RunStart)
    config = start.event.config_json
    pipeline = Pipeline.restore(config, start.event.snapshot)
    before = [result for step in steps[:10] for result in pipeline.step(step.event)]
    assert sum(isinstance(result, WindowReport) and result.used for result in before) == 2
    again = Pipeline.restore(config, anew(recorded_config(config), pipeline.snapshot()))
    after = [result for step in steps[10:] for result in again.step(step.event)]
    assert [result.windows for result in after if isinstance(result, CalibrationUpdate)] == [2]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("channels.*.certificate.sensitivty=1", "channels.*.certificate.sensitivty: there is no such setting"),
        ("channels.mems.certificate.sensitivity=-3", "channels.mems.certificate.sensitivity: must be above 0"),
        ('channels.*.window_s="a"', "channels.*.window_s: a number is needed"),
        ("channels.*.certificate.sensitivity*=big", "needs a number"),
        ("recording.signing_key=/etc/shadow", "only channels decide"),
        ("channels.*", "must be channels.<sensor>.<key>=<value>"),
        ("channels.*." + "a." * 5000 + "b=1", "must be channels.<sensor>.<key>=<value>"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_path_before_any_file_is_read(text: str, told: str) -> None:
    done = CliRunner().invoke(replay, ["/nowhere", "--set", text], standalone_mode=False)
    assert done.return_value == 2
    assert told in done.stderr
    with pytest.raises(SettingError):
        ChangedSetting.of(text)


@pytest.mark.slow
def test_a_setting_that_a_recording_cannot_have_refuses_that_recording(recordings: Path) -> None:
    for setting, told in (
        ("channels.other.window_s=20", "channels.other: the recording has no such channel; there is mems"),
        ("channels.*.poses.99.theta_deg=1", "channels.mems.poses.99.theta_deg: the recorded configuration has nothing"),
        ("channels.*.gravity_mps2*=2", "channels.0.gravity_mps2: must be below 9.9"),
    ):
        assert here(recordings / "gateway-1.mcap", setting).reasons[0].startswith(told)


def test_what_names_no_recording_is_bad_usage(tmp_path: Path) -> None:
    for name in (tmp_path, tmp_path / "missing.mcap", tmp_path / "*.mcap"):
        done = CliRunner().invoke(replay, [str(name)], standalone_mode=False)
        assert (done.return_value, str(name) in done.stderr) == (2, True)


@pytest.mark.slow
def test_directories_patterns_and_files_name_each_recording_once(recordings: Path) -> None:
    three = [str(recordings / f"gateway-{seed}.mcap") for seed in (1, 2, 3)]
    assert recordings_in([f"{recordings}/gateway-*.mcap", three[0]]) == three
    assert recordings_in([three[2], str(recordings)]) == [three[2], str(recordings / "damaged.mcap"), *three[:2]]


@pytest.mark.parametrize(
    "place",
    ["s3://key:SECRET@bucket/a.mcap", "https://h/a.mcap?X-Amz-Signature=SECRET", "filecache::s3://k:SECRET@b/a"],
)
def test_an_address_with_credentials_is_refused_and_not_repeated(place: str) -> None:
    with pytest.raises(SourceError, match="environment") as refused:
        recordings_in([place])
    assert "SECRET" not in str(refused.value)


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """An object store on loopback, with the credentials in the environment only."""
    pytest.importorskip("s3fs", reason="the extra fleet is not installed")
    server = pytest.importorskip("moto.server", reason="moto is not installed")
    running = server.ThreadedMotoServer(port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    for name, value in (
        ("ACCESS_KEY_ID", "AKIDTEST"),
        ("SECRET_ACCESS_KEY", "s3cretWORD"),
        ("REGION", "us-east-1"),
        ("ENDPOINT_URL", f"http://{host}:{port}"),
    ):
        monkeypatch.setenv(f"AWS_{name}", value)
    yield running
    running.stop()


@pytest.mark.thorough
@pytest.mark.usefixtures("bucket")
def test_recordings_in_an_object_store(recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import s3fs

    fetched = tmp_path / "fetched"
    fetched.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(fetched))

    store = s3fs.S3FileSystem()
    store.mkdir("fleet")
    for name in ("gateway-1", "damaged"):
        store.put(str(recordings / f"{name}.mcap"), f"fleet/site/{name}.mcap")
    (tmp_path / "out").mkdir()
    told = list(results_of(recordings_in(["s3://fleet/"]), (), Here(), tmp_path / "out", audit=False))
    assert [summary.place for summary in told] == ["s3://fleet/site/damaged.mcap", "s3://fleet/site/gateway-1.mcap"]
    local_one = json.loads(run_task(RecordingTask(place=str(recordings / "gateway-1.mcap"))))
    stored_one = json.loads(next((tmp_path / "out").glob("gateway-1*")).read_bytes())
    differing = {name for name in stored_one if stored_one[name] != local_one[name]}
    assert differing <= {"place", "replayed"}
    everything = b"".join(written(tmp_path / "out").values()) + repr(told).encode()
    assert b"s3cretWORD" not in everything
    assert b"AKIDTEST" not in everything
    assert not list(fetched.iterdir())


def test_a_fetched_recording_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    fsspec = pytest.importorskip("fsspec", reason="the extra fleet is not installed")
    fsspec.filesystem("memory").pipe("/large.mcap", b"x" * 100)
    monkeypatch.setattr("agent.fleet.sources.LARGEST_FETCHED", 99)
    with pytest.raises(SourceError, match="larger than the limit of 99 bytes"), local("memory://large.mcap"):
        pass
