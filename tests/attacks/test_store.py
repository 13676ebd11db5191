"""Who can write the data directory, but has not the key, changes no calibration that comes into force."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner

from agent.cli.show import show
from agent.core.events import CalibrationUpdate, Result
from agent.delivery.history import FILE_NAME, History, StoredResult
from agent.delivery.schema import StoreError, row_crc
from tests.attacks.chain_site import KEY, public_pem
from tests.attacks.signed_site import OTHER
from tests.attacks.store_site import Run, change, forge_memory, forge_result, put_back, rests, rows, states


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Run]:
    """A data directory after a run that ended, and this run."""
    directory = tmp_path_factory.mktemp("ended")
    return directory, Run(directory).feed(rests(1)).stop()


@pytest.fixture
def data(ended: tuple[Path, Run], tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(ended[0], tmp_path / "data"))


def said(result: Result) -> bytes:
    """For a comparison: NaN is not equal to itself."""
    return msgspec.json.encode(result)


def in_force(data: Path) -> StoredResult | None:
    with History(data / FILE_NAME) as history:
        return history.in_force("s")


Begin = Callable[..., Run]


@pytest.fixture
def begin(data: Path) -> Iterator[Begin]:
    """Begins a run on the copy; one that the test does not end is killed."""
    runs: list[Run] = []

    def begun(directory: Path = data, **options: Any) -> Run:
        runs.append(Run(directory, len(runs) + 2, **options))
        return runs[-1]

    yield begun
    for run in runs:
        if run.alive:
            run.kill()


def test_a_run_goes_on_with_the_states_after_the_last_event(ended: tuple[Path, Run], begin: Begin) -> None:
    again = begin()
    assert again.faults == []
    assert states(again.begun_with) == states(ended[1].pipeline.all_memories())


def test_a_state_that_was_changed_is_refused_and_made_anew(ended: tuple[Path, Run], data: Path, begin: Begin) -> None:
    forge_memory(data)
    again = begin()
    assert "is not the one that the gateway signed" in again.faults[0]
    assert states(again.begun_with) == states(ended[1].pipeline.all_memories())
    again.stop()
    third = begin()
    assert (third.faults, states(third.begun_with)) == ([], states(again.begun_with))


def test_an_older_state_that_the_gateway_signed_is_refused(data: Path, begin: Begin, tmp_path: Path) -> None:
    """In the place of the newest states, with their list: those of the run before, and those in the middle of a run."""
    older = Path(shutil.copy(data / FILE_NAME, tmp_path / "older"))
    second = begin().feed(rests(2)).stop()
    put_back(data, older)
    third = begin()
    assert "older than the newest recording" in third.faults[0]
    assert states(third.begun_with) == states(second.pipeline.all_memories())


@pytest.mark.parametrize("what", ["deleted", "another device", "list", "list deleted", "epoch", "other gateway"])
def test_states_that_are_not_in_the_list_are_refused(
    what: str, ended: tuple[Path, Run], data: Path, begin: Begin, tmp_path: Path
) -> None:
    if what == "deleted":
        change(data, "DELETE FROM memory")
    elif what == "another device":
        ((identity, sequence, state),) = rows(data, "SELECT identity, sequence, state FROM memory")
        row = ("s", "another", sequence, state)
        change(data, "UPDATE memory SET identity = ?, crc = ? WHERE identity = ?", "another", row_crc(*row), identity)
    elif what == "list":
        ((signed,),) = rows(data, "SELECT signed FROM states")
        signed = signed.replace(b"sequence ", b"sequence 1")
        change(data, "UPDATE states SET signed = ?, crc = ?", signed, row_crc(1, signed))
    elif what == "list deleted":
        change(data, "DELETE FROM states")
    elif what == "epoch":
        change(data, "UPDATE marks SET value = 7, crc = ? WHERE name = 'epoch'", row_crc("epoch", 7))
    else:
        Run(tmp_path / "twin", gateway="site/twin").feed(rests(3)).stop()
        put_back(data, tmp_path / "twin" / FILE_NAME)
    again = begin()
    assert "the states of the estimation in the store are refused" in again.faults[0]
    assert states(again.begun_with) == states(ended[1].pipeline.all_memories())


@pytest.mark.parametrize("what", ["row", "signed row deleted", "signed row of another", "row and signature"])
def test_a_result_that_was_changed_is_refused_made_anew_and_never_shown(
    what: str, ended: tuple[Path, Run], data: Path, begin: Begin
) -> None:
    """A rollback names it: the calibration before the last, whose S is three times what it was."""
    made = [r for r in ended[1].results if isinstance(r, CalibrationUpdate)]
    right, sequence = made[-2], made[-2].sequence
    again = begin()
    forge_result(data, sequence, sensitivity=(3 * np.array(right.sensitivity)).tolist())
    if what == "signed row deleted":
        change(data, "DELETE FROM signed WHERE sequence = ?", sequence)
    elif what == "signed row of another":
        ((other,),) = rows(data, f"SELECT data FROM signed WHERE sequence = {made[-1].sequence}")
        change(data, "UPDATE signed SET data = ?, signed_crc = ? WHERE sequence = ?", other,
               row_crc(sequence, other), sequence)  # fmt: skip
    elif what == "row and signature":
        ((signed,),) = rows(data, f"SELECT data FROM signed WHERE sequence = {sequence}")
        changed = signed[:-70] + bytes([signed[-70] ^ 1]) + signed[-69:]
        change(data, "UPDATE signed SET data = ?, signed_crc = ? WHERE sequence = ?", changed,
               row_crc(sequence, changed), sequence)  # fmt: skip
    with again.store.history() as history:
        shown = history.after(sequence - 1, [("s", "calibration")], limit=1)[0]
    values = [list(map(list, right.sensitivity)), [[3 * v for v in row] for row in right.sensitivity]]
    assert shown.sequence != sequence or values.index(shown.fields["sensitivity"]) == (what == "signed row deleted")
    with pytest.raises(StoreError, match=f"calibration {sequence} in the store is not what this gateway signed"):
        again.store.find("s", "calibration", sequence)
    assert f"calibration {sequence}" in again.store.faults[-1]
    found = again.store.find("s", "calibration", sequence)
    assert found is not None
    assert (said(found.result), bool(found.signed)) == (said(right), True)


def test_a_changed_result_that_no_recording_has_never_comes_into_force(data: Path, begin: Begin) -> None:
    again = begin()
    sequence = rows(data, "SELECT max(sequence) FROM results WHERE what = 'calibration'")[0][0]
    forge_result(data, sequence, sensitivity=[[3.0] * 3] * 3)
    change(data, "DELETE FROM signed WHERE sequence = ?", sequence)
    for path in data.glob("fieldcal-000001.mcap"):
        path.unlink()
    for _ in range(2):
        with pytest.raises(StoreError, match="it is not signed; no recording has it"):
            again.store.find("s", "calibration", sequence)


def test_what_is_published_at_a_start_is_what_was_signed(ended: tuple[Path, Run], data: Path, begin: Begin) -> None:
    forge_result(data, ended[1].calibration.sequence, sensitivity=[[3.0] * 3] * 3)
    again = begin()
    with again.store.history() as history:
        (shown,) = [record for record in history.latest() if record.what == "calibration"]
    assert said(shown.result) == said(ended[1].calibration)
    assert "its row says something else than what was signed: sensitivity" in again.faults[0]
    assert rows(data, "SELECT count(*) FROM results WHERE CAST(payload AS TEXT) LIKE '%[3.0,3.0,3.0]%'") == [(0,)]


def test_a_gateway_that_has_lost_its_recordings_begins_from_the_newest_signed_calibration(
    ended: tuple[Path, Run], data: Path, begin: Begin
) -> None:
    """Its U is that of the calibration; a calibration with another S is none that it signed."""
    for path in data.glob("*.mcap"):
        path.unlink()
    forge_memory(data)
    forge_result(data, ended[1].calibration.sequence, sensitivity=[[3.0] * 3] * 3)
    again = begin()
    assert "begins again from calibration" in str(again.faults)
    again.feed([next(rests(2))])
    first, last = again.calibration, ended[1].calibration
    assert (first.sensitivity, first.offset, first.covariance) == (last.sensitivity, last.offset, last.covariance)
    assert "begun again from the calibration in force: nothing else was left" in str(again.results[-1])


def test_a_state_without_signature_is_never_believed(data: Path, begin: Begin) -> None:
    """Somebody takes everything signed away, so that the store looks like one of a gateway without a key."""
    for path in [*data.glob("*.mcap"), *data.glob("head.json")]:
        path.unlink()
    forge_memory(data)
    for table in ("signed", "states"):
        change(data, f"DELETE FROM {table}")
    assert begin().begun_with == []


@pytest.mark.parametrize("version", [4, 5])
def test_a_store_of_the_version_before_gets_its_states_from_the_recordings(
    version: int, ended: tuple[Path, Run], data: Path, begin: Begin
) -> None:
    if version == 4:
        change(data, "DROP TABLE states")
        change(data, "PRAGMA user_version = 4")
    forge_memory(data)
    again = begin()
    assert states(again.begun_with) == states(ended[1].pipeline.all_memories())


def test_the_states_of_a_gateway_that_gets_a_key_come_once_from_its_unsigned_recordings(
    begin: Begin, tmp_path: Path
) -> None:
    data = tmp_path / "of its own"
    before = begin(data, key=None).feed(rests(1)).stop()
    sequence = before.calibration.sequence
    first = begin(data)
    assert "nothing in" in first.faults[-1]
    assert states(first.begun_with) == states(before.pipeline.all_memories())
    first.feed(rests(2)).rotate().stop()
    again = begin(data)
    assert again.faults == []
    found = again.store.find("s", "calibration", sequence)
    assert found is not None
    assert said(found.result) == said(before.calibration), "its recording is named by a signed one"
    forge_result(data, sequence, sensitivity=[[3.0] * 3] * 3)
    with pytest.raises(StoreError, match="it is not signed; it was made anew"):
        again.store.find("s", "calibration", sequence)
    found = again.store.find("s", "calibration", sequence)
    assert found is not None
    assert said(found.result) == said(before.calibration)


@pytest.mark.parametrize(("mark", "value"), [("floor", 0), ("floor", 2**60), ("published", 2**52), ("file", 2**60)])
def test_marks_that_somebody_changed_are_harmless(mark: str, value: int, data: Path, begin: Begin) -> None:
    change(data, "UPDATE marks SET value = ?, crc = ? WHERE name = ?", value, row_crc(mark, value), mark)
    known = {sequence for (sequence,) in rows(data, "SELECT sequence FROM results")}
    again = begin().feed(rests(2))
    fresh = [result.sequence for result in again.results]
    assert fresh
    assert min(fresh) > max(known)
    assert again.store.published() <= again.store.last_sequence() < 2**53


def test_a_calibration_that_was_withdrawn_is_not_shown_as_in_force(begin: Begin, data: Path) -> None:
    first = begin().feed(rests(1))
    first.feed([next(rests(2, "B", 26.0))]).stop()
    assert in_force(data) is None
    row = ("s", "calibration", first.calibration.sequence, 0)
    change(data, "UPDATE latest SET withdrawn = 0, crc = ? WHERE what = 'calibration'", row_crc(*row))
    with History(data / FILE_NAME) as history, pytest.raises(StoreError, match="no longer in force"):
        history.check()
    begin().stop()
    assert in_force(data) is None


def insert(data: Path, sequence: int, like: int) -> None:
    """Add a copy of a result, with another number and without a signature."""
    columns = "run_id, sensor, what, payload, t_utc_ns, recorded, recording, identity"
    ((*held,),) = rows(data, f"SELECT {columns} FROM results WHERE sequence = {like}")
    held[3] = msgspec.json.encode(msgspec.json.decode(held[3]) | {"sequence": sequence, "sensitivity": [[3.0] * 3] * 3})
    row = (sequence, *held)
    change(data, "INSERT INTO results VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", *row, row_crc(*row))
    latest = (held[1], held[2], sequence, 0)
    change(data, "INSERT OR REPLACE INTO latest VALUES (?, ?, ?, ?, ?)", *latest, row_crc(*latest))


@pytest.mark.parametrize("sequence", [2000, 2**62])
def test_a_result_that_somebody_adds_hides_none_and_comes_nowhere(
    sequence: int, ended: tuple[Path, Run], data: Path, begin: Begin
) -> None:
    insert(data, sequence, ended[1].calibration.sequence)
    again = begin()
    with again.store.history() as history:
        (shown,) = [record for record in history.latest() if record.what == "calibration"]
    assert said(shown.result) == said(ended[1].calibration)
    assert again.store.last_sequence() < 2**53
    if sequence == 2000:
        with pytest.raises(StoreError, match="it is not signed; no recording has it"):
            again.store.find("s", "calibration", sequence)


def test_what_an_earlier_key_signed_counts_only_where_the_configuration_names_it(
    ended: tuple[Path, Run], data: Path, begin: Begin, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(data, tmp_path / "copy"))
    refused = begin(key=OTHER)
    assert (refused.begun_with, "signed with the key" in str(refused.faults)) == ([], True)
    again = begin(copy, key=OTHER, earlier=[KEY.public_key().public_bytes_raw()])
    assert (again.faults, states(again.begun_with)) == ([], states(ended[1].pipeline.all_memories()))
    again.feed(rests(2)).stop()
    third = begin(copy, key=OTHER)
    assert (third.faults, bool(third.begun_with)) == ([], True), "the new key has signed the states"


def test_an_older_file_beside_the_newer_log_of_sqlite_is_set_aside_or_refused(
    data: Path, begin: Begin, tmp_path: Path
) -> None:
    older = Path(shutil.copy(data / FILE_NAME, tmp_path / "older"))
    second = begin().feed(rests(2))
    log = (data / f"{FILE_NAME}-wal").read_bytes()
    second.stop()
    shutil.copy(older, data / FILE_NAME)
    (data / f"{FILE_NAME}-wal").write_bytes(log)
    assert states(begin().begun_with) == states(second.pipeline.all_memories())


def test_show_tells_what_is_refused_what_is_unsigned_and_whose_key_it_is(
    ended: tuple[Path, Run], data: Path, tmp_path: Path
) -> None:
    def shown(*options: str) -> tuple[int, str]:
        found = CliRunner().invoke(show, ["--data-dir", str(data), *options], standalone_mode=False)
        return found.return_value, found.stdout

    for name, key in (("right.pub", KEY), ("other.pub", OTHER)):
        (tmp_path / name).write_bytes(public_pem(key))
    status, text = shown()
    assert (status, "signed with the key 56475aa75463474c; `--public-key` checks" in text) == (0, True)
    assert "signed" not in shown("--public-key", str(tmp_path / "right.pub"))[1]
    status, text = shown("--public-key", str(tmp_path / "other.pub"))
    assert (status, "no calibration in force" in text, "is refused: signed with the key" in text) == (3, True, True)
    sequence = ended[1].calibration.sequence
    forge_result(data, sequence, sensitivity=[[3.0] * 3] * 3)
    status, text = shown("--json", "-")
    told = msgspec.json.decode(text)
    assert (status, told["sensors"]["s"]["calibration"]["sensitivity"]) == (3, ended[1].calibration.sensitivity)
    refused = f"result {sequence} is refused: its row says something else than what was signed: sensitivity"
    assert refused in told["evidence"]
    change(data, "DELETE FROM signed WHERE sequence = ?", sequence)
    status, text = shown()
    assert "results shown are not signed, though this gateway has a key" in text
    status, text = shown("--public-key", str(tmp_path / "right.pub"))
    assert (status, f"result {sequence} is refused: it is not signed" in text) == (3, True)


def test_the_store_of_an_earlier_epoch_is_older_whatever_its_numbers_are(
    data: Path, begin: Begin, tmp_path: Path
) -> None:
    """A clock that was ahead gave it higher numbers than the present store has."""
    earlier = begin(tmp_path / "earlier")
    earlier.store._last, earlier.pipeline._next_sequence = 10**12, 10**12 + 1
    earlier.feed(rests(5)).stop()
    second = begin().feed(rests(2)).stop()
    shutil.copy(tmp_path / "earlier" / FILE_NAME, data)
    again = begin()
    there = {sequence for (sequence,) in rows(data, "SELECT sequence FROM results")}
    assert there >= {result.sequence for result in second.results}, "results that it lacks come from the recordings"
    assert "older than the newest recording" in again.faults[0]
    assert states(again.begun_with) == states(second.pipeline.all_memories())
