"""Runs an engine in a process of its own, inside a sandbox, and hands it events."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from agent.core.memory import Memory
from agent.engine import frames
from agent.engine.wheel import EngineWheel

# What of the environment decides with which kernels numpy computes (agent/recording/fingerprint.py).
_PASSED_ON = ("OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE", "NPY_DISABLE_CPU_FEATURES")
SANDBOX = str(Path(__file__).with_name("sandbox.py"))  # a program of its own, which imports what other systems lack
NO_SANDBOX = 71  # its exit status where it cannot be made, as the program says
_MOST_SAID = 4000  # bytes of standard error that are kept
_END_S = 2.0  # s; a process that closes its output is about to end
_LONGEST = 300  # characters of a text by the engine


class EngineError(Exception):
    """The engine's process cannot be started, was ended, or broke the format. The message is one line."""


class EngineFaultError(Exception):
    """The engine's pipeline refuses what it was given. It can begin another file."""


class EngineResults(NamedTuple):
    """The results of an event: (schema, message) of each, as a recording holds them."""

    event_sequence: int
    messages: list[tuple[str, bytes]]


@dataclass(frozen=True, slots=True)
class ProcessLimits:
    """What the process of an engine may use."""

    memory_bytes: int = 1536 << 20  # address space; numpy and scipy take 0.4 GB of it
    step_s: float = 60.0  # for one answer; the first one includes the imports
    whole_s: float = 3600.0  # from the start to the end, and of CPU


class EngineProcess:
    """The process of one engine, to be used in a `with`. Its methods raise EngineError, after which it has ended, and
    EngineFaultError.

    Each takes and gives messages as a recording holds them: the full name of the schema, and the bytes.
    """

    def __init__(self, wheel: EngineWheel, limits: ProcessLimits | None = None) -> None:
        self._wheel = wheel
        self._limits = limits or ProcessLimits()
        self._ends_at = time.monotonic() + self._limits.whole_s
        self._said = b""  # by the engine, on standard error

    def __enter__(self) -> EngineProcess:
        if sys.platform != "linux":
            raise EngineError(f"the engine {self._wheel.name} is not run: its sandbox needs Linux")
        with contextlib.ExitStack() as held:
            directory = self._unpacked(held)
            self._process = self._start(directory)
            held.callback(self._stop)
            self._unpacker = frames.Unpacker()
            self._greet()
            self._held = held.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def begin(self, schema: str, data: bytes) -> EngineResults:
        """Make the pipeline anew from the configuration and the snapshot of a RunStart, and step this event."""
        return self._results(self._ask(2, b"begin", schema.encode(), data))

    def step(self, schema: str, data: bytes) -> EngineResults:
        """The results of the next event; also of a RunStart, where a file continues the one before it."""
        return self._results(self._ask(2, b"step", schema.encode(), data))

    def snapshot(self) -> bytes:
        """The state of the pipeline, as a RunStart holds it."""
        return self._ask(2, b"snapshot")[1]

    def memories(self) -> list[Memory]:
        """The states for later runs, after the last event."""
        parts = self._ask(1, b"memories")[1:]
        if len(parts) % 4 or not all(map(bytes.isdigit, parts[2::4])):
            raise self._broken("memories are incomplete")
        groups = zip(parts[0::4], parts[1::4], parts[2::4], parts[3::4], strict=True)
        return [Memory(_text(sensor), _text(identity), int(last), state) for sensor, identity, last, state in groups]

    def _results(self, parts: list[bytes]) -> EngineResults:
        if len(parts) % 2 or not parts[1].isdigit() or len(parts[1]) > 20:
            raise self._broken("results are incomplete")
        messages = zip(parts[2::2], parts[3::2], strict=True)
        return EngineResults(int(parts[1]), [(_text(schema), data) for schema, data in messages])

    def _greet(self) -> None:
        version, engine = self._ask(3, b"engine", frames.VERSION, self._wheel.engine_id.encode())[1:3]
        if version != frames.VERSION:
            raise self._broken(
                f"it speaks the format {_text(version)}, this program the format {_text(frames.VERSION)}"
            )
        if engine != self._wheel.engine_id.encode():
            raise self._broken(f"it calls itself {_text(engine)}")

    def _unpacked(self, held: contextlib.ExitStack) -> str:
        try:
            directory = held.enter_context(tempfile.TemporaryDirectory(prefix="fieldcal-engine-"))
            self._wheel.unpack(Path(directory))
        except OSError as error:
            raise EngineError(
                f"the engine {self._wheel.name} cannot be unpacked: {error.strerror}; TMPDIR names another place for it"
            ) from None
        return directory

    def _start(self, directory: str) -> subprocess.Popen[bytes]:
        # Not sys.path as it is: that of an editable installation has the sources of this program.
        packages = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
        limits = [str(self._limits.memory_bytes), str(max(1, int(self._limits.whole_s)))]
        passed_on = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
        # Without HOME, sysconfig asks the system's database of users, over a socket where it can.
        own = {
            "HOME": directory,
            "OPENBLAS_NUM_THREADS": "1",
            "PYDANTIC_DISABLE_PLUGINS": "__all__",
            "LC_ALL": "C.UTF-8",
        }
        command = [sys.executable, "-I", "-S", "-B", SANDBOX, *limits, directory, *packages]
        try:
            process = subprocess.Popen(
                command, env=passed_on | own, cwd=directory, start_new_session=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0,
            )  # fmt: skip
        except OSError as error:
            raise EngineError(f"the engine {self._wheel.name} cannot be started: {error.strerror}") from None
        for pipe in (process.stdin, process.stdout, process.stderr):
            assert pipe is not None
            os.set_blocking(pipe.fileno(), False)
        return process

    def _stop(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            assert pipe is not None
            pipe.close()

    def _ask(self, fewest_parts: int, *question: bytes) -> list[bytes]:
        """Write a frame and read its answer, which has the name of its kind and at least so many parts."""
        answer = self._exchange(frames.packed(question))
        if answer[0] == b"fault":
            text = _text(b" ".join(answer[1:]))
            if text.startswith("MemoryError"):
                raise self._broken(f"it took more than {self._limits.memory_bytes / 2**30:g} GB of memory")
            raise EngineFaultError(text)
        expected = b"results" if question[0] in (b"begin", b"step") else question[0]
        if answer[0] != expected or len(answer) < fewest_parts:
            raise self._broken(f"it answers {_text(answer[0])!r} where {_text(expected)!r} is expected")
        return answer

    def _exchange(self, question: bytes) -> list[bytes]:
        """Write and read at once, for both sides could wait for each other. Raises EngineError."""
        source, target, said = self._process.stdin, self._process.stdout, self._process.stderr
        assert source is not None
        left, until = memoryview(question), min(time.monotonic() + self._limits.step_s, self._ends_at)
        with selectors.DefaultSelector() as selector:
            selector.register(source, selectors.EVENT_WRITE)
            selector.register(target, selectors.EVENT_READ)  # type: ignore[arg-type] # a pipe
            selector.register(said, selectors.EVENT_READ)  # type: ignore[arg-type]
            while (remaining := until - time.monotonic()) > 0:
                for key, _ in selector.select(remaining):
                    if key.fileobj is source:
                        left = left[self._write(key.fd, left) :]
                        if not left:
                            selector.unregister(source)
                        continue
                    data = os.read(key.fd, 1 << 20)
                    if key.fileobj is target:
                        if not data:
                            raise self._end_reason()
                        if (answer := self._answer(data)) is not None:
                            return answer
                    elif data:
                        self._said += data[: _MOST_SAID - len(self._said)]
                    else:
                        selector.unregister(said)  # type: ignore[arg-type]
        whole = until == self._ends_at
        allowed = f"{self._limits.whole_s:g} s in all" if whole else f"{self._limits.step_s:g} s for one event"
        raise self._broken(f"it took more than {allowed}")

    def _write(self, descriptor: int, data: memoryview) -> int:
        try:
            return os.write(descriptor, data)
        except BrokenPipeError:
            raise self._end_reason() from None

    def _answer(self, data: bytes) -> list[bytes] | None:
        try:
            return self._unpacker.feed(data)
        except frames.FrameError as error:
            raise self._broken(f"it breaks the format: {error}") from None

    def _end_reason(self) -> EngineError:
        """Why the process has ended on its own."""
        try:
            status = self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            return self._broken("it has closed its output")
        with contextlib.suppress(OSError):
            while data := os.read(self._process.stderr.fileno(), 1 << 16):  # type: ignore[union-attr] # a pipe
                self._said += data[: _MOST_SAID - len(self._said)]
        last = _text(self._said.strip().rpartition(b"\n")[2])
        if status == NO_SANDBOX:
            return EngineError(f"the engine {self._wheel.name} is not run, for it can have no sandbox here: {last}")
        if status == -signal.SIGSYS:
            return self._broken("it was ended when it tried to open a connection, to start a process, or the like")
        if status == -signal.SIGXCPU:
            return self._broken(f"it was ended after {int(self._limits.whole_s)} s of CPU")
        if last.startswith("MemoryError"):
            return self._broken(f"it took more than {self._limits.memory_bytes / 2**30:g} GB of memory")
        how = f"by signal {signal.Signals(-status).name}" if status < 0 else f"with status {status}"
        return self._broken(f"it ended {how}{f': {last}' if last else ''}")

    def _broken(self, what: str) -> EngineError:
        return EngineError(f"the engine {self._wheel.name} was stopped: {what}")


def _text(data: bytes) -> str:
    """What an engine says, in one line."""
    text = "".join(c if c.isprintable() else " " for c in data.decode(errors="replace"))
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
