"""An engine in its own process gives what the pipeline in this process gives, and its process is bounded."""

from __future__ import annotations

import re
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from agent.core.events import RunStart
from agent.core.pipeline import Pipeline
from agent.engine import frames, sandbox
from agent.engine.identity import ROOT
from agent.engine.process import EngineError, EngineFaultError, EngineProcess, ProcessLimits
from agent.engine.wheel import EngineWheel, build, read_wheel, wheel_of
from agent.recording.messages import encode, recorded_ones, schema_of, topic_of
from agent.recording.reading import RecordingReader

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the sandbox needs Linux")
GOLDEN = ROOT / "tests/replay/golden/format-3/fieldcal-000001.mcap"
# An engine that does what the test says as soon as it is called; it imports nothing of the real one.
ENTRY = """
import os, sys
from agent.engine import frames
def answer(*parts):
    with os.fdopen(os.dup(1), "wb") as target:
        target.write(frames.packed(parts))
def main():
    source = os.fdopen(0, "rb", buffering=0)
    frames.read(source)
    answer(b"engine", frames.VERSION, b"0" * 16)
    frames.read(source)
"""


def engine_that(does: str) -> EngineWheel:
    """An engine that begins a file by these lines of Python."""
    lines = "".join(f"    {line}\n" for line in does.splitlines())
    sources = {name: (ROOT / name).read_bytes() for name in ("agent/engine/__init__.py", "agent/engine/frames.py")}
    sources |= {"agent/__init__.py": b"", "agent/engine/entry.py": (ENTRY + lines).encode()}
    return read_wheel("a test", wheel_of(1, "0" * 16, sources))


def begun(does: str, limits: ProcessLimits | None = None) -> str:
    """What is told of an engine that does so."""
    with EngineProcess(engine_that(does), limits) as engine, pytest.raises((EngineError, EngineFaultError)) as told:
        engine.begin("fieldcal.v1.Event", b"")
    assert "\n" not in str(told.value)
    return f"{type(told.value).__name__}: {told.value}"


@pytest.fixture(scope="module")
def own() -> EngineWheel:
    return read_wheel("own", build())


@pytest.fixture(scope="module")
def process(own: EngineWheel) -> Iterator[EngineProcess]:
    with EngineProcess(own) as engine:
        yield engine


@pytest.mark.slow
def test_results_are_those_of_the_pipeline_bit_for_bit(process: EngineProcess) -> None:
    results = 0
    for step in RecordingReader(GOLDEN).steps():
        schema, data = schema_of(topic_of(step.event)), encode(step.event_sequence, step.event)
        if isinstance(step.event, RunStart):
            pipeline = Pipeline.restore(step.event.config_json, step.event.snapshot)
            begin, given = step.event, process.begin(schema, data)
        else:
            given = process.step(schema, data)
        expected = [
            (schema_of(topic_of(result)), encode(step.event_sequence, result))
            for result in recorded_ones(pipeline.step(step.event))
        ]
        assert given == (step.event_sequence, expected)
        results += len(expected)
    assert results == 10
    assert process.snapshot() == pipeline.snapshot() != begin.snapshot
    assert process.memories() == pipeline.all_memories() != []


def test_pipeline_that_raises_is_told_and_the_next_file_begins(process: EngineProcess) -> None:
    start = next(RecordingReader(GOLDEN).steps()).event
    assert isinstance(start, RunStart)
    with pytest.raises(EngineFaultError, match=r"MessageError: fieldcal\.v1\.Event"):
        process.step("fieldcal.v1.Event", b"\xff")
    broken = RunStart(**{name: getattr(start, name) for name in start.__struct_fields__} | {"snapshot": b"x"})
    with pytest.raises(EngineFaultError, match="snapshot"):
        process.begin("fieldcal.v1.Event", encode(0, broken))
    assert process.begin("fieldcal.v1.Event", encode(0, start)) == (0, [])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("does", "told"),
    [
        ("import socket; socket.socket()", "it was ended when it tried to open a connection, to start a process"),
        ("os.fork()", "it was ended when it tried"),
        ("os.execv('/bin/true', ['true'])", "it was ended when it tried"),
        ("import subprocess; subprocess.run(['true'])", "Function not implemented"),
        ("os.kill(os.getppid(), 15)", "it was ended when it tried"),
        ("import ctypes; ctypes.CDLL(None).ptrace(0, 0, 0, 0)", "it was ended when it tried"),
        ("import ctypes; ctypes.CDLL(None).mount(b'x', b'/', b'tmpfs', 0, 0)", "it was ended when it tried"),
        ("import ctypes; ctypes.CDLL(None).syscall(425, 8, 0)", "it was ended when it tried"),  # io_uring_setup
        ("import ctypes; ctypes.CDLL(None).syscall(0x40000000 + 39)", "it was ended when it tried"),  # getpid of x32
        ("open('written', 'w')", "PermissionError"),
        ("os.open('/tmp', os.O_TMPFILE | os.O_RDWR)", "PermissionError"),
        ("os.open('/proc/self/mem', os.O_RDWR)", "PermissionError"),
        ("os.unlink(__file__)", "PermissionError"),
        ("os.rename(__file__, 'x')", "PermissionError"),
        ("os.mkdir('made')", "PermissionError"),
        ("os.chmod(__file__, 0o777)", "PermissionError"),
        ("os.utime(__file__)", "PermissionError"),
        ("os.memfd_create('x')", "Function not implemented"),
        ("import resource; resource.setrlimit(resource.RLIMIT_AS, (-1, -1))", "not allowed to raise|PermissionError"),
        ("os.abort()", "it ended by signal SIGABRT"),
        ("bytearray(2 << 30)", "it took more than 1.5 GB of memory"),
        ("import sys; sys.exit(3)", "it ended with status 3"),
        ("sys.stderr.write('x' * 10_000_000 + '\\nlast \\x1b[2J line\\n'); sys.exit(1)", "it ended with status 1"),
        ("os.close(1); os.close(2); sys.stdin = None; frames.read(source)", "has closed its output"),
        ("raise ValueError('not\\x1b[2J today')", r"it ended with status 1: ValueError: not \[2J today"),
        ("answer(b'snapshot', b'')", "it answers 'snapshot' where 'results' is expected"),
        ("answer(b'results', b'x')", "results are incomplete"),
        ("os.write(1, b'\\xff\\xff\\xff\\xff')", "it breaks the format: a frame of 4294967299 bytes"),
        ("os.write(1, b'\\0\\0\\0\\0')", "it breaks the format: a frame without a name"),
        ("import tests", "No module named 'tests'"),
        ("import agent.cli", "No module named 'agent.cli'"),
        ("answer(b'fault', ' '.join(sorted(os.environ)).encode())", "^EngineFaultError: HOME [A-Z_ ]*"),
    ],
)  # fmt: skip
def test_engine_that_does_more_than_to_compute_is_told(does: str, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDCAL_SECRET", "x")
    text = begun(does, ProcessLimits(step_s=20.0))
    assert re.search(told, text), text
    assert "SECRET" not in text


def test_thread_of_an_engine_is_allowed() -> None:
    does = "import threading\nthread = threading.Thread(target=answer, args=(b'fault', b'from a thread'))\n"
    assert begun(does + "thread.start()\nthread.join()") == "EngineFaultError: from a thread"


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("does", "limits", "told"),
    [
        ("while True: pass", ProcessLimits(step_s=0.5), "it took more than 0.5 s for one event"),
        # This engine takes no processor time, so that only the clock of this process can end it.
        ("import time; time.sleep(60)", ProcessLimits(whole_s=1.0), "it took more than 1 s in all"),
        ("while True: os.write(1, b'x' * 100)", ProcessLimits(step_s=5.0), "it breaks the format"),
        (
            "import signal; signal.signal(signal.SIGXCPU, signal.SIG_IGN)\nwhile True: pass",
            ProcessLimits(step_s=1.0),
            "took more",
        ),
    ],
)
def test_engine_that_does_not_end_is_ended(does: str, limits: ProcessLimits, told: str) -> None:
    begin = time.monotonic()
    assert told in begun(does, limits)
    assert time.monotonic() - begin < 50  # by itself the one that sleeps ends after 60 s


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        (b"frames.VERSION, b", b'b"2", b', "it speaks the format 2, this program the format 1"),
        (b'b"0" * 16', b'b"1" * 16', "it calls itself 1111111111111111"),
        (b'    answer(b"engine"', b'    answer(b"motor"', "it answers 'motor' where 'engine' is expected"),
    ],
)
def test_engine_that_answers_the_first_frame_wrongly_is_told(before: bytes, after: bytes, told: str) -> None:
    entry = engine_that("").members["agent/engine/entry.py"]
    assert before in entry
    members = engine_that("").members | {"agent/engine/entry.py": entry.replace(before, after)}
    with pytest.raises(EngineError, match=told), EngineProcess(EngineWheel("", b"", "", 1, "0" * 16, members)):
        pass


def test_engine_is_not_run_where_no_filter_can_be_installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As in a container whose own filter denies it: the sandbox asks for what this kernel denies."""
    broken = tmp_path / "sandbox.py"
    broken.write_text(
        Path(sandbox.__file__).read_text().replace("_FILTER_MODE = 38, 22, 2", "_FILTER_MODE = 38, 22, 9")
    )
    monkeypatch.setattr("agent.engine.process.SANDBOX", str(broken))
    told = "is not run, for it can have no sandbox here: this kernel or container installs no filter"
    with pytest.raises(EngineError, match=told), EngineProcess(engine_that("")):
        pass


def test_filter_has_the_numbers_of_the_kernel() -> None:
    """The tables of both architectures, against the kernel's own headers where they are installed."""
    headers = {
        0: Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h"),
        1: Path("/usr/include/asm-generic/unistd.h"),
    }
    calls = {**sandbox._ALLOWED, **sandbox._REFUSED, **sandbox._ENDING}
    special = ("OPEN", "OPENAT", "CLONE", "IOCTL", "FCNTL", "PRCTL", "PRLIMIT64", "KILL", "TGKILL")
    calls |= {name.lower(): getattr(sandbox, f"_{name}") for name in special}
    for column, path in headers.items():
        if not path.exists():
            pytest.skip(f"no {path}; Debian's linux-libc-dev has it")
        text = path.read_text()
        numbers = dict(re.findall(r"#define __NR(?:3264)?_(\w+)\s+(\d+)", text))
        for name, general in re.findall(r"#define __NR_(\w+)\s+__NR3264_(\w+)", text):  # as 64-bit programs see it
            numbers |= {name: numbers[general]} if general in numbers else {}
        for name in calls.keys() - {"fchmodat2"}:  # of Linux 6.6; Debian 12 has the headers of 6.1
            assert calls[name][column] == (int(numbers[name]) if name in numbers else None), name


ALLOW, END, EPERM, ENOSYS = "allowed", "ended", "refused", "no such call"
DECISIONS = {0x7FFF0000: ALLOW, 0x80000000: END, 0x50001: EPERM, 0x50026: ENOSYS}
AUDIT = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}


def decided(machine: str, number: int, *arguments: int, audit: int | None = None) -> str:
    """What the kernel would do with a call: the filter, run here (linux/filter.h, struct seccomp_data)."""
    program = list(struct.iter_unpack("<HBBI", sandbox.filter_program(machine, process=4711)))
    values = (*arguments, *(0,) * (6 - len(arguments)))
    data = struct.pack("<IIQ6Q", number, AUDIT[machine] if audit is None else audit, 0, *values)
    place, loaded = 0, 0
    while True:
        code, where_true, where_false, constant = program[place]
        place += 1
        if code == 0x06:
            return DECISIONS[constant]
        if code == 0x20:
            (loaded,) = struct.unpack_from("<I", data, constant)
        else:
            true = {0x15: loaded == constant, 0x35: loaded >= constant, 0x45: bool(loaded & constant)}[code]
            place += where_true if true else where_false


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_decisions_of_the_filter_on_both_architectures(machine: str) -> None:
    arm = machine == "aarch64"
    openat, clone, fcntl = (56, 220, 25) if arm else (257, 56, 72)
    prlimit64, kill, tgkill, getpid = (261, 129, 131, 172) if arm else (302, 62, 234, 39)
    socket, getrandom, unlinkat = (198, 278, 35) if arm else (41, 318, 263)
    thread = 0x3D0F00  # as pthread_create calls clone
    calls = {
        (getpid,): ALLOW, (getrandom,): ALLOW, (socket,): END, (unlinkat,): EPERM, (9999,): ENOSYS,
        (getpid + 0x40000000,): END,  # x32
        (437,): ENOSYS, (435,): ENOSYS,  # openat2, clone3
        (openat, 0, 0, 0o2000000): ALLOW, (openat, 0, 0, 1): EPERM, (openat, 0, 0, 2): EPERM,
        (openat, 0, 0, 0o100): EPERM, (openat, 0, 0, 0o1000): EPERM, (openat, 0, 0, 0o20200000 | 2): EPERM,
        (openat, 0, 0, 1 << 32): ALLOW,  # the kernel takes 32 bits
        (clone, thread): ALLOW, (clone, 17): END, (clone, thread & ~0x10000): END, (clone, thread | 0x10000000): END,
        (clone, thread | 0x20000): END,  # a user namespace, a mount namespace
        (prlimit64, 0, 9, 0, 1): ALLOW, (prlimit64, 0, 9, 1, 0): EPERM, (prlimit64, 0, 9, 1 << 32, 0): EPERM,
        (kill, 4711, 6): ALLOW, (kill, 1, 9): END, (kill, 0xFFFFFFFF, 9): END, (tgkill, 4711, 4711, 6): ALLOW,
        (tgkill, 1, 1, 9): END, (fcntl, 1, 4): ALLOW, (fcntl, 1, 8): EPERM,  # F_SETFL, F_SETOWN
    }  # fmt: skip
    assert {call: decided(machine, *call) for call in calls} == calls
    for audit in {*AUDIT.values(), 0x40000003, 0x40000028} - {AUDIT[machine]}:  # of 32-bit programs too
        assert decided(machine, getpid, audit=audit) == END


def test_directory_for_engines_that_is_full_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    wheel = engine_that("")
    monkeypatch.setattr("tempfile.tempdir", "/proc")
    with pytest.raises(EngineError, match=r"cannot be unpacked: .*; TMPDIR names another place"), EngineProcess(wheel):
        pass


@pytest.mark.slow
def test_frames_that_arrive_byte_by_byte_are_those_that_were_sent() -> None:
    sent = [[b"step", b"x" * 70_000, b""], [b"snapshot"]]
    unpacker = frames.Unpacker()
    got = []
    for parts in sent:
        for byte in frames.packed(parts):
            answer = unpacker.feed(bytes([byte]))
            got += [answer] if answer is not None else []
    assert got == sent


@pytest.mark.slow
def test_size_of_memory_that_a_real_engine_needs(process: EngineProcess) -> None:
    """The default limit leaves three quarters of the address space free."""
    status = Path(f"/proc/{process._process.pid}/status").read_text()
    peak_kb = int(status.split("VmPeak:")[1].split()[0])
    assert peak_kb * 1024 < ProcessLimits().memory_bytes / 2
    assert "Seccomp:\t2\n" in status
