"""A full disk, recordings deleted by retention, kill -9: the audit knows what was deleted, and by whom."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.recording.deleted_list import LIST_NAME
from agent.recording.end_check import GivenHead
from agent.recording.files import RecordingFile, recordings
from agent.recording.head import HEAD_NAME, Head
from agent.recording.pruned_ranges import Deleted
from agent.recording.retention import KeepFiles
from agent.recording.scan import metadata_of
from agent.recording.set_aside import set_aside
from agent.recording.signed_text import SignedText, written
from agent.recording.signing import Signer
from agent.recording.writer import Recorder
from tests.attacks.chain_site import KEY, audited, record
from tests.replay.forgery import records
from tests.replay.stand_in import CONFIG, StandIn, run_start


def recorder_on(directory: Path, keep: KeepFiles | None = None) -> Recorder:
    """As a start makes it, with a limit that leaves two or three recordings."""
    size = sum(path.stat().st_size for _, path in recordings(directory))
    keep = keep or KeepFiles(bytes=size // 2)
    recorder = Recorder(directory, ["acc"], ["bridge-1"], keep=keep, signer=Signer(KEY))
    recorder.close_torn()
    return recorder


def start(recorder: Recorder, number: int = 0) -> bool:
    pipeline = StandIn(CONFIG)
    event = run_start(pipeline, number, recorder.next_file_sequence)
    return recorder.record(number, event, pipeline.step(event))


def cannot(*_: object) -> None:
    raise OSError(errno.EIO, os.strerror(errno.EIO), "fieldcal-000001.deleted")


def prune_while_full(directory: Path, monkeypatch: pytest.MonkeyPatch, keep: KeepFiles | None = None) -> list[int]:
    """Delete by retention while nothing can be recorded, then be killed; returns the numbers that are left."""
    with monkeypatch.context() as full:
        full.setattr("agent.recording.writer.free_bytes", lambda _: 0)
        recorder = recorder_on(directory, keep)
        assert not start(recorder)
        assert os.strerror(errno.ENOSPC) in recorder.fault
        number = 0
        while (pruned := recorder.pruning) is not None:
            number += 1
            assert (pruned.first_file, pruned.last_file) == (number, number), "one at a time, the oldest first"
            assert not recorder.record(number, pruned, [])
    left = [number for number, _ in recordings(directory)]
    assert left[0] == number + 1 >= 3
    return left


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def deletion(path: Path) -> Deleted:
    """What a statement about this recording says."""
    number, origin = int(path.name[9:15]), metadata_of(path)["fieldcal.file"]
    return Deleted(number, number, origin["epoch"], origin["previous_sha256"], sha256(path))


def test_deletions_on_a_full_disk_are_known_after_a_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = tmp_path / "a"
    heads: list[bytes] = []
    record(directory, heads=heads)
    whole = sum(path.stat().st_size for path in directory.glob("fieldcal-*"))
    left = prune_while_full(directory, monkeypatch)
    assert sum(path.stat().st_size for path in directory.glob("fieldcal-*")) < 0.7 * whole, "space was made"
    status, text = audited(directory)
    assert status == 0, text
    gone = left[0] - 1
    told = f"what {gone} recordings held: retention deleted them, as later recordings say of"
    assert f"not proven: {told} 0 and only statements in the directory of {gone}" in text
    recorder = recorder_on(directory)
    with monkeypatch.context() as failing:
        failing.setattr("agent.recording.writer.remove_statements", cannot)
        assert start(recorder), "what cannot be deleted costs no recording"
    assert list(directory.glob("*.deleted"))
    recorder.close()
    left.append(left[-1] + 1)
    recorder = recorder_on(directory)
    assert start(recorder)
    assert [number for number, _ in recordings(directory)] == [*left, left[-1] + 1]
    assert not list(directory.glob("*.deleted")), "the recording says it now"
    assert len((directory / LIST_NAME).read_text().splitlines()) == gone
    recorder.close()
    status, text = audited(directory, heads=[GivenHead("kept", head, elsewhere=True) for head in heads])
    assert status == 0, text
    assert f"{told} {gone} and only statements in the directory of 0" in text


def test_the_newest_recording_may_go_and_the_chain_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that holds one recording only: without this, nothing would be recorded for ever."""
    directory = tmp_path / "a"
    files = record(directory)
    last = sha256(files[-1])
    with monkeypatch.context() as full:
        full.setattr("agent.recording.writer.free_bytes", lambda _: 0)
        recorder = recorder_on(directory, KeepFiles(bytes=1))
        start(recorder)
        for number in range(1, len(files) + 1):
            recorder.record(number, recorder.pruning, [])  # type: ignore[arg-type]
    assert not recordings(directory)
    assert audited(directory)[0] == 3, "until the next recording begins, the newest is missing"
    recorder = recorder_on(directory)
    assert start(recorder)
    recorder.close()
    [(number, path)] = recordings(directory)
    assert number == len(files) + 1
    assert metadata_of(path)["fieldcal.file"]["previous_sha256"] == last
    status, text = audited(directory)
    assert status == 0, text


def test_a_kill_while_a_recording_begins_loses_no_deletion(tmp_path: Path) -> None:
    """Killed behind each record up to the first event, and within it: the file is removed, its number used again."""
    size = record(tmp_path / "size")[0].stat().st_size
    record(tmp_path / "a", keep=KeepFiles(bytes=3 * size))
    record(tmp_path / "a", blocks=2, seed=2)
    newest = recordings(tmp_path / "a")[-1][1]
    data = newest.read_bytes()
    first = next(one for one in records(data) if one.name == "Chunk")
    cuts = [one.end for one in records(data) if one.end <= first.offset] + [first.offset + 20, first.end]
    assert len(cuts) == 5
    for cut in cuts:
        b = copied(tmp_path / "a", "b")
        (b / newest.name).unlink()
        (b / f"{newest.name}.active").write_bytes(data[:cut])
        (b / HEAD_NAME).unlink()
        recorder = recorder_on(b, KeepFiles())
        assert start(recorder)
        recorder.close()
        (b / "state.sqlite").unlink()
        status, text = audited(b, strict=False)
        assert status == 0, (cut, text)
        shutil.rmtree(b)


def test_a_kill_between_the_steps_of_a_deletion_loses_nothing(tmp_path: Path) -> None:
    files = record(tmp_path / "a")
    whole, said = files[0].read_bytes(), deletion(files[0])
    aside = files[0].rename(files[0].with_name("fieldcal-000001.deleted"))
    recorder_on(tmp_path / "a")  # killed after the renaming: the recording is still there
    assert files[0].read_bytes() == whole
    set_aside(tmp_path / "a", said, "site/gateway", Signer(KEY))
    statement = aside.read_bytes()
    aside.write_bytes(statement + whole[len(statement) :])  # killed before the file was cut
    status, text = audited(tmp_path / "a")
    assert status == 0, text
    recorder_on(tmp_path / "a")
    assert aside.read_bytes() == statement


FORGED = ["another key", "another number", "another gateway", "another directory", "version 1", "unsigned", "rubbish"]


@pytest.mark.parametrize("forged", FORGED)
def test_a_thief_cannot_say_that_retention_deleted_a_recording(tmp_path: Path, forged: str) -> None:
    files = record(tmp_path / "a")
    other = record(tmp_path / "b", gateway="other" if forged == "another gateway" else "gateway", seed=2)
    key = Ed25519PrivateKey.generate() if forged == "another key" else KEY
    path = other[1 if forged == "another number" else 0]
    gateway = "site/other" if forged == "another gateway" else "site/gateway"
    said = deletion(path)
    set_aside(path.parent, said, gateway, None if forged == "unsigned" else Signer(key))
    files[0].unlink()
    statement = (path.parent / f"fieldcal-{said.last:06d}.deleted").read_bytes()
    of_version_1 = Signer(KEY).sign(written("fieldcal deletion, version 1", {"gateway": gateway, "recording": "1"}))
    aside = tmp_path / "a" / "fieldcal-000001.deleted"
    aside.write_bytes({"rubbish": b"rubbish", "version 1": of_version_1.json}.get(forged, statement))
    for attempt in range(2):
        status, text = audited(tmp_path / "a")
        assert status == 3
        if forged == "another directory" and not attempt:
            assert "the SHA-256 of the deleted recording 1 is not the one that this recording names" in text
        elif forged != "another directory":
            assert "recording 1 is missing before it" in text
        recorder = recorder_on(tmp_path / "a")  # nor does the agent repeat it in a signed recording
        assert start(recorder)
        recorder.close()


def copied(path: Path, name: str) -> Path:
    return Path(shutil.copytree(path, path.with_name(name)))


def six_of_seven(a: Path, b: Path) -> None:
    for path in sorted(a.glob("*.mcap"))[:-1]:
        path.unlink()
        shutil.copy(b / path.with_suffix(".deleted").name, a)


@pytest.mark.parametrize("restored", [False, True], ids=["another directory", "an earlier copy of this directory"])
def test_statements_of_another_directory_replace_no_recording(tmp_path: Path, *, restored: bool) -> None:
    """The gateway signed these statements, but about other recordings of the same numbers."""
    heads: list[bytes] = []
    if restored:  # both have the same epoch and the same first recording
        record(tmp_path / "a", blocks=2)
        copied(tmp_path / "a", "b")
    a = record(tmp_path / "a", heads=heads, blocks=22)
    b = record(tmp_path / "b", seed=2, blocks=22)
    assert len(a) >= 7
    for path in b[: len(a) - 1]:
        set_aside(tmp_path / "b", deletion(path), "site/gateway", Signer(KEY))
    six_of_seven(tmp_path / "a", tmp_path / "b")
    kept = [GivenHead("kept", heads[-1], elsewhere=True)]
    for options in ({}, {"heads": kept}, {"strict": False}):
        status, text = audited(tmp_path / "a", **options)
        assert status == 3
        assert "the SHA-256 of the deleted recording" in text


def test_a_head_needs_more_than_a_statement(tmp_path: Path) -> None:
    """A copy of the directory on a full disk signs statements about exactly these recordings."""
    heads: list[bytes] = []
    a = record(tmp_path / "a", heads=heads)
    b = copied(tmp_path / "a", "b")
    for path in a[:-1]:
        set_aside(b, deletion(b / path.name), "site/gateway", Signer(KEY))
    six_of_seven(tmp_path / "a", b)
    by_number = {Head.of(SignedText.read(head)).statement.file_sequence: head for head in heads}
    assert audited(tmp_path / "a", heads=[GivenHead("kept", by_number[len(a)], elsewhere=True)])[0] == 0
    status, text = audited(tmp_path / "a", heads=[GivenHead("kept", by_number[2], elsewhere=True)])
    assert status == 3
    assert "kept: recording 2, which this head names, is not there: only a statement says that it was deleted" in text


def test_statements_are_no_longer_believed_when_a_recording_has_begun(tmp_path: Path) -> None:
    a = record(tmp_path / "a")
    b = copied(tmp_path / "a", "b")
    set_aside(b, deletion(b / a[0].name), "site/gateway", Signer(KEY))
    record(tmp_path / "a", seed=3)  # the next recordings do not repeat that one was deleted
    shutil.copy(b / "fieldcal-000001.deleted", tmp_path / "a")
    status, text = audited(tmp_path / "a")
    assert (status, "a statement says so" in text) == (0, False), text
    a[0].unlink()
    status, text = audited(tmp_path / "a")
    assert status == 3
    assert "recording 1 is missing before it" in text
    assert f"it was made when recording {len(a)} was the newest, and recording" in text


@pytest.mark.parametrize("same", [True, False])
def test_a_statement_about_a_recording_that_is_there(tmp_path: Path, *, same: bool) -> None:
    record(tmp_path / "a")
    b = copied(tmp_path / "a", "b")
    said = deletion(b / "fieldcal-000002.mcap")
    set_aside(
        b, said if same else Deleted(2, 2, said.epoch, said.previous_sha256, "0" * 64), "site/gateway", Signer(KEY)
    )
    shutil.copy(b / "fieldcal-000002.deleted", tmp_path / "a")
    status, text = audited(tmp_path / "a")
    assert status == (0 if same else 3), text
    told = "that recording 2 was deleted: a statement says so, but it is there"
    assert (told if same else "gives recording 2 another SHA-256") in text


@pytest.mark.parametrize("older", [True, False], ids=["an older version recorded", "this version recorded"])
def test_a_statement_of_version_1_proves_nothing_and_accuses_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, older: bool
) -> None:
    """An update of the program while the disk was full leaves one. A thief may put one there at any time."""
    directory = tmp_path / "a"
    with monkeypatch.context() as before:
        if older:
            before.setattr(RecordingFile, "note", lambda *_: None)  # older versions named no list
        first = record(directory)[0]
    values = {"gateway": "site/gateway", "recording": "1"}
    statement = Signer(KEY).sign(written("fieldcal deletion, version 1", values)).json
    first.unlink()
    first.with_suffix(".deleted").write_bytes(statement + b"\n")
    told = "that retention deleted recording 1: a statement of version 1 says so, which does not say its SHA-256"
    for options, expected in (({"keys": None, "strict": False}, 0), ({"strict": False}, 3), ({}, 3)):
        status, text = audited(directory, **options)
        assert status == expected, text
        assert f"not proven: {told}" in text
        assert "forged" not in text
    record(directory, seed=2)
    status, text = audited(directory)
    if older:
        assert status == 0, text
        assert "not proven: which recordings 1 were: an older version deleted them" in text
    else:
        assert status == 3
        assert "recording 1 is missing before it" in text


@pytest.mark.parametrize(
    "name", ["fieldcal-0000001.mcap", "fieldcal-0000009.mcap", "copy.mcap", "fieldcal-000001.mcap.active"]
)
def test_a_file_that_is_like_a_recording_is_named(tmp_path: Path, name: str) -> None:
    files = record(tmp_path / "a")
    shutil.copy(files[0], tmp_path / "a" / name)
    status, text = audited(tmp_path / "a")
    assert status == (3 if "1.mcap" in name else 0)
    words = {
        "fieldcal-0000001.mcap": "FAILED: {}: this is not the name of a recording, and recording 1 is there already",
        "fieldcal-000001.mcap.active": "it has the number 1, and so has",
    }
    other = "not proven: what {} holds: it was not looked at, because this is not the name of a recording"
    assert words.get(name, other).format(tmp_path / "a" / name) in text


@pytest.fixture
def lived(tmp_path: Path) -> tuple[Path, list[bytes]]:
    """A directory whose retention deleted more than half of its recordings, in two runs, with all heads."""
    heads: list[bytes] = []
    size = record(tmp_path / "size")[0].stat().st_size
    keep = KeepFiles(bytes=4 * size)
    record(tmp_path / "a", heads=heads, keep=keep)
    record(tmp_path / "a", heads=heads, keep=keep, seed=2)
    assert recordings(tmp_path / "a")[0][0] > 5
    return tmp_path / "a", heads


def given(heads: list[bytes]) -> list[GivenHead]:
    return [GivenHead(f"kept {n}", head, elsewhere=True) for n, head in enumerate(heads)]


def test_all_heads_that_were_ever_kept_pass(lived: tuple[Path, list[bytes]]) -> None:
    directory, heads = lived
    status, text = audited(directory, heads=given(heads))
    assert status == 0, text
    assert "that deleted recordings began with the bytes which heads name" in text
    closed = [head for head in heads if b"closed yes" in head]
    status, text = audited(directory, heads=given(closed))
    assert status == 0, text
    assert "deleted recordings began" not in text, "a head of a closed recording is compared exactly"
    newest = metadata_of(recordings(directory)[-1][1])["fieldcal.pruned"]["recordings"]
    assert newest.count(",") == 0, "the record does not grow with the number of deleted recordings"
    assert len(newest) < 200


def other_list(directory: Path) -> None:
    path = directory / LIST_NAME
    line, *rest = path.read_text().splitlines(keepends=True)
    digit = "0" if line[-2] != "0" else "1"
    path.write_text("".join([line[:-2] + digit + "\n", *rest]))


CHANGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no list": (lambda at: (at / LIST_NAME).unlink(), f"{LIST_NAME} is missing; the newest recording names its first"),
    "an entry changed": (other_list, f"{LIST_NAME} is not the list that the newest recording names"),
    "an entry dropped": (
        lambda at: (at / LIST_NAME).write_text("".join((at / LIST_NAME).read_text().splitlines(keepends=True)[1:])),
        f"{LIST_NAME} is not the list that the newest recording names",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_list_that_was_changed_is_told(lived: tuple[Path, list[bytes]], change: str) -> None:
    directory, _ = lived
    do, words = CHANGES[change]
    do(directory)
    status, text = audited(directory)
    assert status == 3
    assert words in text


def test_what_is_added_to_the_list_by_others_does_not_count(lived: tuple[Path, list[bytes]]) -> None:
    directory, heads = lived
    epoch = metadata_of(recordings(directory)[0][1])["fieldcal.file"]["epoch"]
    before = (directory / LIST_NAME).read_text()
    with open(directory / LIST_NAME, "a") as file:
        file.write(f"2-2 {epoch} - {'0' * 64}\n2-2 012345")
    status, text = audited(directory, heads=given(heads))
    assert status == 0, text
    record(directory, seed=3, heads=heads, keep=KeepFiles(bytes=1 << 16))
    after = (directory / LIST_NAME).read_text()
    assert after.startswith(before), "the agent drops it"
    assert len(after.splitlines()) > len(before.splitlines()), "and goes on behind what it wrote itself"
    assert "0" * 64 not in after
    status, text = audited(directory, heads=given(heads))
    assert status == 0, text


def test_a_lost_list_leaves_something_unproven(lived: tuple[Path, list[bytes]]) -> None:
    directory, heads = lived
    (directory / LIST_NAME).unlink()
    record(directory, seed=3, heads=heads)
    status, text = audited(directory, heads=given(heads))
    assert status == 0, text
    assert "their SHA-256 is not in the list of deleted recordings (recording 1)" in text


@pytest.mark.parametrize("closed", ["yes", "no"])
@pytest.mark.parametrize("restored", [False, True], ids=["another epoch", "the same epoch"])
def test_a_head_of_another_history_is_told_though_the_recording_is_deleted(
    tmp_path: Path, lived: tuple[Path, list[bytes]], *, closed: str, restored: bool
) -> None:
    directory, _ = lived
    heads: list[bytes] = []
    epoch = metadata_of(recordings(directory)[0][1])["fieldcal.file"]["epoch"] if restored else "0123456789abcdef"
    record(tmp_path / "b", heads=heads, seed=5)
    head = next(one for one in heads if b"recording 3\\n" in one and f"closed {closed}".encode() in one)
    signed = SignedText.read(head)
    own = Head.of(signed).statement.epoch
    forged = Signer(KEY).sign(signed.text.replace(f"epoch {own}", f"epoch {epoch}"))
    status, text = audited(directory, heads=given([forged.json]))
    assert status == 3
    words = "the deleted recording 3 was not the one that this head names" if restored else f"of the epoch {epoch}"
    assert words in text
