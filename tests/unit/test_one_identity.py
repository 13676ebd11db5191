"""A calibration has one date and one identity, however often it comes into force."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import msgspec
import pytest
from click.testing import CliRunner

from agent.cli.show import show
from agent.core.events import Acceleration, CalibrationUpdate, Event, Output
from agent.core.outcome import again
from agent.delivery.calibrations import calibrations
from agent.delivery.history import FILE_NAME, History, StoredResult
from agent.delivery.store import Store
from agent.recording.messages import decode, encode
from agent.report.material import gather
from tests.unit.mounted_site import Site, begun, said, site_config, updates
from tests.unit.recorded_bench import record
from tests.unit.results import calibration, status, window

DAY_NS = 86_400 * 10**9


def later(update: CalibrationUpdate, sequence: int) -> CalibrationUpdate:
    """It comes into force again a day later, in a run of that day."""
    moved = msgspec.structs.replace(
        update, run_id=f"run {sequence}", sequence=sequence, t_utc_ns=update.t_utc_ns + DAY_NS
    )
    return again(moved, update)


def commit(directory: Path, *results: object) -> None:
    store = Store(directory, 0)
    store.commit([StoredResult.of(r, recorded=True, recording="fieldcal-000009.mcap") for r in results])  # type: ignore[arg-type]
    store.close()


def shown(directory: Path, *options: str) -> str:
    done = CliRunner().invoke(show, ["--data-dir", str(directory), *options], standalone_mode=False)
    assert done.return_value == 0
    return done.stdout


def memories(site: Site) -> dict[str, bytes]:
    """What the run leaves when it ends."""
    return {memory.identity: memory.state for memory in site.pipeline.all_memories()}


# --- in the core


@pytest.mark.slow
def test_after_restarts_it_is_the_calibration_that_was_made() -> None:
    first = begun(site_config())
    made = updates(first.play(4))[-1]
    assert (made.made, made.date_utc_ns) == ((made.run_id, made.sequence), made.t_utc_ns)
    site: Site = first
    for day in (1.0, 2.0):
        site = begun(site_config(), kept=memories(site), day=day, last=made.sequence + 100)
        [restored] = updates(site.results)
        assert said(site.results)[0] == ("VALID", "restored from the previous run")
        assert restored.run_id == f"run {day}"
        assert restored.t_utc_ns > made.t_utc_ns
        assert (restored.made, restored.date_utc_ns) == (made.made, made.t_utc_ns)
        assert restored.sensitivity == made.sensitivity
        _, read = decode("fieldcal.v1.Calibration", encode(3, restored))
        assert isinstance(read, CalibrationUpdate)
        assert (read.made, read.date_utc_ns) == (made.made, made.t_utc_ns)
    fresh = updates(site.play(3))[-1]
    assert (fresh.made, fresh.date_utc_ns) == ((fresh.run_id, fresh.sequence), fresh.t_utc_ns)


@pytest.mark.slow
def test_a_rollback_brings_back_the_calibration_that_was_made() -> None:
    site = begun(site_config())
    first = updates(site.play(3))[-1]
    site.play(3)
    [back] = updates(site.command("rollback", first, sequence=first.sequence))
    assert (back.made, back.date_utc_ns) == (first.made, first.t_utc_ns)
    assert back.sequence > first.sequence
    assert back.sensitivity == first.sensitivity


def test_accelerations_name_the_calibration_that_was_made() -> None:
    config = site_config(acceleration="publish")
    first = begun(config)
    made = updates(first.play(4))[-1]
    site = begun(config, kept=memories(first), day=1.0, last=made.sequence + 100)
    named = set[tuple[str, int]]()
    step = site.pipeline.step

    def noted(event: Event) -> list[Output]:
        outputs = step(event)
        named.update((o.calibration_run_id, o.calibration_sequence) for o in outputs if isinstance(o, Acceleration))
        return outputs

    site.pipeline.step = noted  # type: ignore[method-assign, assignment]
    site.play(1)
    assert made.made in named


# --- in what people see


def test_show_lists_it_once_with_its_own_date(tmp_path: Path) -> None:
    one, two = calibration(2), calibration(4, sxx=26000.0)
    restored = later(two, 6)
    commit(tmp_path, window(1), one, status(3), two, window(5), restored, later(restored, 7), status(8))
    held = json.loads(shown(tmp_path, "--json", "-"))["sensors"]["mems"]
    assert [(r["sequence"], r["t_utc_ns"]) for r in held["history"]] == [(4, two.t_utc_ns), (2, one.t_utc_ns)]
    in_force = held["calibration"]
    assert (in_force["sequence"], in_force["made_sequence"], in_force["made_run_id"]) == (7, 4, "r")
    assert in_force["made_utc_ns"] == two.t_utc_ns
    text = shown(tmp_path)
    assert text.count("Sxx 26000 ± 12") == 1
    assert "8 windows, made 2023-11-14 22:13:20 UTC, in force again since 2023-11-16 22:13:20 UTC" in text
    limited = json.loads(shown(tmp_path, "--json", "-", "--limit", "2"))["sensors"]["mems"]["history"]
    assert [r["sequence"] for r in limited] == [4, 2]


def test_one_that_was_deleted_is_known_by_its_newest_record(tmp_path: Path) -> None:
    two = calibration(4)
    commit(tmp_path, later(two, 6), later(two, 7))
    with History(tmp_path / FILE_NAME) as history:
        [found] = calibrations(history, "mems", limit=10)
    assert found.sequence == 7
    assert "made 2023-11-14 22:13:20 UTC" in shown(tmp_path)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("identity") / "data"
    record(directory, 41.0)
    return directory


@pytest.mark.thorough
def test_a_report_after_a_restart_shows_the_run_in_which_it_was_made(recorded: Path, tmp_path: Path) -> None:
    before = gather([recorded], None)
    directory = tmp_path / "data"
    shutil.copytree(recorded, directory)
    with History(directory / FILE_NAME) as history:
        held = history.in_force(before.sensor)
    assert held is not None
    made = held.result
    assert isinstance(made, CalibrationUpdate)
    last = made.sequence + 1000
    new_run = [
        msgspec.structs.replace(window(last + k, used=False, reason="too calm"), run_id="new", sensor=before.sensor)
        for k in range(1, 1200)  # more than a report reads of a sensor
    ]
    commit(directory, later(made, last), *new_run)
    after = gather([directory], None)
    assert len(before.traces) > 1
    assert [r.fields["windows"] for r in after.results] == [r.fields["windows"] for r in before.results]
    assert after.traces.keys() == before.traces.keys()
    devices = [name for name in before.facts if name.startswith("device ")]
    assert len(devices) == 2
    assert {name: after.facts.get(name) for name in devices} == {name: before.facts[name] for name in devices}
    assert [u.made for u in after.history] == [u.made for u in before.history]
    assert [r.fields["sequence"] for r in after.results] == [made.sequence]
