"""Files are whole or not there: a limit of their size stands for a full disk, and /dev/full is one."""

from __future__ import annotations

import errno
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from agent.cli.main import run_cli
from agent.config.whole_files import MACHINE, new_file, status_of, whole_file, write_together, write_whole
from tests.unit.test_strangers_files import along_each_axis

LIMIT = 1000


@contextmanager
def largest(size: int) -> Iterator[None]:
    """No file of this process may become larger."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_what_was_there_stays_where_the_new_file_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    write_whole(path, b"old")
    path.chmod(0o640)
    with largest(LIMIT), pytest.raises(OSError, match="File too large") as refused:
        write_whole(path, b"x" * (LIMIT + 1))
    assert refused.value.filename == str(path)
    assert [(one.name, one.read_bytes()) for one in tmp_path.iterdir()] == [("r.json", b"old")]
    write_whole(path, b"new")
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"new", 0o640)
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_left_of_a_file_that_does_not_fit_or_that_is_interrupted(tmp_path: Path) -> None:
    for opened in (whole_file, new_file):
        with largest(LIMIT), pytest.raises(OSError, match="File too large"), opened(tmp_path / "a.csv") as file:
            file.write(b"x" * (LIMIT + 1))
        with pytest.raises(KeyboardInterrupt), opened(tmp_path / "a.csv") as file:
            raise KeyboardInterrupt(file.write(b"x"))
        assert list(tmp_path.iterdir()) == []


def test_a_link_stays_a_link_and_a_device_a_device(tmp_path: Path) -> None:
    link, target = tmp_path / "link.json", tmp_path / "target.json"
    link.symlink_to(target)
    write_whole(link, b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
    write_whole(Path("/dev/null"), b"x")
    assert Path("/dev/null").is_char_device()


def test_files_of_one_content_are_all_there_or_none(tmp_path: Path) -> None:
    write_together(tmp_path, {"a": b"1", "b": b"1"})
    with largest(LIMIT), pytest.raises(OSError, match="File too large") as refused:
        write_together(tmp_path, {"a": b"2", "b": b"2" * (LIMIT + 1)})
    assert refused.value.filename == str(tmp_path / "b")
    assert {one.name: one.read_bytes() for one in tmp_path.iterdir()} == {"a": b"1", "b": b"1"}


def test_a_full_disk_is_a_fault_of_the_machine_and_a_missing_directory_is_not() -> None:
    assert {status_of(OSError(number, "")) for number in MACHINE} == {1}
    assert status_of(FileNotFoundError(errno.ENOENT, "")) == status_of(ValueError()) == 2


@pytest.mark.slow
def test_a_result_is_printed_where_its_file_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = along_each_axis(tmp_path, "time_s,a", 1.0)
    for to, status, told in (("/dev/full", 1, "No space left on device"), (f"{tmp_path}/no/r.json", 2, "No such file")):
        assert run_cli(["calibrate", *options, "--json", to]) == status
        out, err = capsys.readouterr()
        assert f"fieldcal calibrate: {to}: {told}" in err
        assert "S holds at" in out
