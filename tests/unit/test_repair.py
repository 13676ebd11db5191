"""A file that a crash left open is closed: every sound byte stays where it is, what was torn is kept beside."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest
from mcap.reader import make_reader

from agent.recording.files import recordings
from agent.recording.integrity import check_integrity
from agent.recording.reading import REPAIR_METADATA, RecordingReader
from agent.recording.records import walk
from agent.recording.repair import TAIL_ATTACHMENT, TAIL_MAX, close_torn
from tests.replay.stand_in import record_run

NAME = "fieldcal-000001.mcap"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    directory = tmp_path_factory.mktemp("whole")
    record_run(directory, blocks=9)
    return (directory / NAME).read_bytes()


def left(directory: Path, data: bytes) -> Path:
    """A file as a crash leaves it."""
    path = directory / f"{NAME}.active"
    path.write_bytes(data)
    return path


def events(path: Path) -> list[int]:
    return [step.event_sequence for step in RecordingReader(path).steps()]


def ends(data: bytes, path: Path) -> list[int]:
    path.write_bytes(data)
    with open(path, "rb") as file:
        return [record.end for record in walk(file, len(data))]


@pytest.mark.slow
def test_cut_anywhere_it_is_closed_and_loses_no_byte(whole: bytes, tmp_path: Path) -> None:
    record_ends = ends(whole, tmp_path / "whole")
    sizes = sorted({*range(0, len(whole), 211), *record_ends, *(end - 1 for end in record_ends), len(whole) - 3})
    closed = 0
    for size in sizes:
        path = left(tmp_path, whole[:size])
        expected = events(path)
        close_torn(tmp_path)
        assert not path.exists(), size
        if not expected:
            assert recordings(tmp_path) == [], f"{size}: a file without its first event holds nothing"
            continue
        final = tmp_path / NAME
        data = final.read_bytes()
        with open(final, "rb") as file:
            found = check_integrity(file, len(data))
            assert found.faults == [], size
            if REPAIR_METADATA in found.metadata:
                note = found.metadata[REPAIR_METADATA]
                kept, torn = int(note["kept_bytes"]), int(note["torn_bytes"])
                assert kept + torn == size == int(note["found_bytes"])
                assert data[:kept] == whole[:kept]
                file.seek(0)
                tails = [a.data for a in make_reader(file).iter_attachments() if a.name == TAIL_ATTACHMENT]
                assert tails == ([whole[kept:size]] if torn else [])
                closed += 1
            else:
                assert data == whole, "it only lacked its name"
        assert events(final) == expected, size
        final.unlink()
    assert closed > 50


def test_what_a_file_system_filled_with_zeros_is_torn(whole: bytes, tmp_path: Path) -> None:
    left(tmp_path, whole[: len(whole) // 2] + bytes(TAIL_MAX + 5))
    close_torn(tmp_path)
    final = tmp_path / NAME
    with open(final, "rb") as file:
        assert check_integrity(file, final.stat().st_size).faults == []
    assert events(final) == events(left(tmp_path, whole[: len(whole) // 2]))


def last_chunk(whole: bytes, tmp_path: Path) -> tuple[int, int]:
    (tmp_path / "whole").write_bytes(whole)
    with open(tmp_path / "whole", "rb") as file:
        *_, last = (record for record in walk(file, len(whole)) if record.name == "Chunk")
    return last.offset, last.end


def test_a_last_chunk_whose_content_was_lost_is_torn(whole: bytes, tmp_path: Path) -> None:
    begin, end = last_chunk(whole, tmp_path)
    data = whole[: begin + 60] + bytes(end - begin - 60)
    left(tmp_path, data)
    close_torn(tmp_path)
    final = tmp_path / NAME
    assert final.read_bytes()[:begin] == whole[:begin]
    with open(final, "rb") as file:
        assert check_integrity(file, final.stat().st_size).faults == []


def test_damage_that_no_crash_does_is_left_for_the_audit(
    whole: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = bytearray(whole[: last_chunk(whole, tmp_path)[1]])
    data[1500] ^= 1  # within the first chunk
    path = left(tmp_path, bytes(data))
    close_torn(tmp_path)
    assert path.read_bytes() == bytes(data)
    assert f"{path} was left unfinished and cannot be closed: byte" in caplog.text


def test_on_a_full_disk_the_file_stays_as_it_was(
    whole: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = whole[: last_chunk(whole, tmp_path)[1] - 50]
    path = left(tmp_path, data)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(data) + 100, before[1]))
    try:
        close_torn(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == data
    assert "File too large" in caplog.text
    close_torn(tmp_path)
    assert events(tmp_path / NAME) == events(left(tmp_path, data))


def test_a_file_that_is_there_under_its_final_name_is_not_replaced(whole: bytes, tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(whole)
    path = left(tmp_path, whole[:5000])
    close_torn(tmp_path)
    assert (tmp_path / NAME).read_bytes() == whole
    assert path.exists()


def test_it_is_on_the_disk_before_it_has_its_name(
    whole: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[bool, int]] = []
    fsync = os.fsync

    def watched(descriptor: int) -> None:
        fsync(descriptor)
        seen.append(((tmp_path / NAME).exists(), os.fstat(descriptor).st_ino))

    path = left(tmp_path, whole[:5000])
    inode = path.stat().st_ino
    monkeypatch.setattr(os, "fsync", watched)
    close_torn(tmp_path)
    assert seen == [(False, inode), (True, tmp_path.stat().st_ino)]
