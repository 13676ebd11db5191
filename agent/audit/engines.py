"""Chooses the engines with which a recording is replayed: its own one, where that is here and trusted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from agent.audit.replaying import Candidate, Choose, EngineHere, Restore
from agent.core.events import Output, RunStart
from agent.core.memory import Memory
from agent.engine import identity
from agent.engine.known import find_engine, known_engines
from agent.engine.process import EngineProcess, EngineResults
from agent.engine.wheel import EngineWheel
from agent.recording.messages import MessageError, decode
from agent.recording.reading import RecordedStep

MOST_TRIED = 32  # engines that are tried for a file that names none


@dataclass(frozen=True, slots=True)
class Engines:
    """A Choose. `restore(config_json, snapshot)` makes the pipeline of this program.

    `directories`: where wheels of engines may lie. `trusted`: what the user says of the SHA-256 of engines
    (agent.engine.known.check_trusted). `offered`: directories whose engines are tried for a file that names none.
    """

    restore: Restore
    directories: tuple[Path, ...] = ()
    trusted: tuple[str, ...] = ()
    offered: tuple[Path, ...] = ()

    def __call__(self, start: RunStart) -> Iterator[Candidate]:
        """The own engine of a file, if it is here and trusted, and then the engine of this program."""
        here = EngineHere(self.restore, identity.name())
        own, missing = start.engine == here.name, ""
        if not own:
            for wheel in self._wheels(start):
                if isinstance(wheel, EngineWheel):
                    yield Candidate(partial(_process, wheel), own=True)
                else:
                    missing = wheel
        yield Candidate(lambda: nullcontext(here), own=own, missing=missing)

    def trusts(self, engine: str) -> bool:
        """Whether an engine with this name is a release: then its results pass where those of this program are near."""
        return any(f"{known.number}-{known.id}" == engine for known in known_engines())

    def _wheels(self, start: RunStart) -> Sequence[EngineWheel | str]:
        """The trusted wheels that may have made a file; or why its own one is not run."""
        if start.engine:
            own = find_engine(start.engine.rpartition("-")[2], self.directories, self.trusted)
            named = f"; the recording names the SHA-256 {start.engine_sha256}" if start.engine_sha256 else ""
            return [f"{own}{named}" if isinstance(own, str) else own]
        names = sorted({path.stem for directory in self.offered for path in directory.glob("*.whl")})
        found = [find_engine(name, self.offered, self.trusted) for name in names[:MOST_TRIED]]
        return [wheel for wheel in found if isinstance(wheel, EngineWheel)]


def as_if_own(restore: Restore) -> Choose:
    """Choose the engine of this program, and hold it to the recorded results whatever engine a file names."""
    engine = EngineHere(restore, identity.name())
    return lambda _: [Candidate(lambda: nullcontext(engine), own=True)]


class _EngineOfWheel:
    """An engine in a process of its own."""

    def __init__(self, name: str, process: EngineProcess) -> None:
        self.name = name
        self._process = process

    def begin(self, step: RecordedStep) -> list[Output]:
        return _decoded(step, self._process.begin(step.schema, step.data))

    def step(self, step: RecordedStep) -> list[Output]:
        return _decoded(step, self._process.step(step.schema, step.data))

    def snapshot(self) -> bytes:
        return self._process.snapshot()

    def memories(self) -> list[Memory]:
        return self._process.memories()


@contextmanager
def _process(wheel: EngineWheel) -> Iterator[_EngineOfWheel]:
    with EngineProcess(wheel) as process:
        yield _EngineOfWheel(wheel.name, process)


def _decoded(step: RecordedStep, results: EngineResults) -> list[Output]:
    """The results of an engine. Raises MessageError where they are none."""
    items = [decode(schema, data) for schema, data in results.messages]
    if not all(number == step.event_sequence and isinstance(item, Output) for number, item in items):
        raise MessageError(f"the engine gives other messages than results of event {step.event_sequence}")
    return [item for _, item in items if isinstance(item, Output)]
