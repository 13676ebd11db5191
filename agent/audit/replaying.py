"""Runs a recording through an engine again and compares the computed results with the recorded ones.

The engine that made the recording must give the same results. Another engine can only show how far its own results
depart from the recorded ones.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Protocol, cast

import msgspec

from agent.audit.departure import Departure
from agent.core.events import CalibrationUpdate, Event, Output, Pruned, Result, RunStart, WindowReport
from agent.core.memory import Memory
from agent.engine.process import EngineError
from agent.recording.comparison import Difference, compare
from agent.recording.continuation import UNKEPT_MAX, continues, states_left
from agent.recording.messages import decode, encode, recorded_ones, schema_of, topic_of
from agent.recording.reading import RecordedStep, RecordingReader
from agent.recording.records import FileFault

UNRECORDED = "the results between them are in no recording, as where a disk was full"
OTHER = "another engine made it, or it cannot be replayed here"
LONGEST_REASON = 1000  # characters; a hostile configuration has a hundred thousand faults


class ReplayEngine(Protocol):
    """Computes results from the events of a recording. Every method may raise any exception for a damaged recording."""

    name: str

    def begin(self, step: RecordedStep) -> list[Output]:
        """Take the RunStart of a file: make the pipeline from the configuration and the snapshot in it."""
        ...

    def step(self, step: RecordedStep) -> list[Output]:
        """Take the next event, and give its results as a recording holds them."""
        ...

    def snapshot(self) -> bytes:
        """The whole state."""
        ...

    def memories(self) -> list[Memory]:
        """The states with which a next run would begin."""
        ...


class PipelineLike(Protocol):
    """The methods needed of a pipeline in this process; agent.core.pipeline.Pipeline has them."""

    def step(self, event: Event) -> Sequence[Output]: ...
    def snapshot(self) -> bytes: ...
    def all_memories(self) -> list[Memory]: ...


Restore = Callable[[str, bytes], PipelineLike]


class EngineHere:
    """The engine of this program, in this process. `restore(config_json, snapshot)` makes its pipeline."""

    def __init__(self, restore: Restore, name: str) -> None:
        self.name = name
        self._restore = restore
        self._pipeline: PipelineLike

    def begin(self, step: RecordedStep) -> list[Output]:
        start = cast(RunStart, step.event)
        try:
            self._pipeline = self._restore(start.config_json, start.snapshot)
        except Exception as error:
            raise ValueError(
                f"no pipeline can be made from its configuration and snapshot: {type(error).__name__}: {error}"
            ) from error
        return self.step(step)

    def step(self, step: RecordedStep) -> list[Output]:
        return [_as_recorded(step.event_sequence, item) for item in recorded_ones(self._pipeline.step(step.event))]

    def snapshot(self) -> bytes:
        return self._pipeline.snapshot()

    def memories(self) -> list[Memory]:
        return self._pipeline.all_memories()


@dataclass(frozen=True, slots=True)
class Candidate:
    """An engine for a file; it runs within the context that `open` gives.

    `own`: it may be the one that made the file, so its results must be the recorded ones. `missing`: why the one that
    made the file is not here.
    """

    open: Callable[[], AbstractContextManager[ReplayEngine]]
    own: bool
    missing: str = ""


Choose = Callable[[RunStart], Iterable[Candidate]]
"""Gives the engines to try for a file, at least one. Where the file names its engine, the first that runs counts; else
the first that gives the recorded results, or the last one."""


class ReplayedFile(msgspec.Struct, kw_only=True):
    """What the replay of one file gave.

    `engine`: the one that made the file, as the file says; `replayed_by`: the one that computed here. Where this is
    another one, `departure` says how far its results depart, nothing else is compared, and `engine_missing` says why
    the one that made the file did not run.
    """

    path: str
    run_id: str = ""
    gateway: str = ""  # <site>/<gateway>
    file_sequence: int = 0
    in_chain: bool = False  # continues the previous file, whose state at its end equals this file's snapshot
    events: int = 0
    results: int = 0  # computed
    fault: FileFault | None = None
    undecoded: bool = False  # the fault is a message that this program cannot decode
    good_bytes: int = 0
    refused: str = ""  # why the file cannot be replayed
    different: int = 0  # events after which computed and recorded results differ
    first_difference: Difference | None = None
    undecidable: int = 0
    tolerance: float = 0.0
    engine: str = ""
    replayed_by: str = ""
    engine_missing: str = ""
    departure: Departure | None = None
    notes: list[str] = []
    pruned: list[Pruned] = []  # events in this file that say which recordings retention deleted

    @property
    def equal(self) -> bool:
        """Whether all results recorded in this file follow from the events recorded in it, by the engine that ran."""
        near = self.departure is None or self.departure.near
        return not self.different and not self.refused and self.events > 0 and near

    @property
    def by_own_engine(self) -> bool:
        """Whether the engine that ran may be the one that made the file."""
        return self.departure is None

    @property
    def made_by(self) -> str:
        """The sentence that names the engine which made the file."""
        return f"made by engine {self.engine}" if self.engine else "made by a version that does not name its engine"


@dataclass(slots=True)
class Replayed:
    """The replay of one file, and what its neighbours are compared with.

    `start`: its RunStart without the snapshot, of which `began_sha256` is the SHA-256. `first_result`, `last_result`:
    numbers of its results; 0 without any. `kept`: states with which it begins, where it begins a run. `next_event`,
    `left_sha256`, `left`: number of the event after its end, SHA-256 of the state and the states for a next run there;
    "" and empty where they are not known. Of each state in `kept` and `left` only the SHA-256 is here: a state has 0.1
    MB, and a year has thousands of files.
    """

    file: ReplayedFile
    calibrations: list[CalibrationUpdate] = field(default_factory=list)
    windows: list[WindowReport] = field(default_factory=list)
    start: RunStart | None = None
    began_sha256: str = ""
    first_result: int = 0
    last_result: int = 0
    kept: list[Memory] = field(default_factory=list)
    next_event: int = 0
    left_sha256: str = ""
    left: list[Memory] = field(default_factory=list)

    def add(self, recorded: Sequence[Output], computed: Sequence[Output]) -> None:
        """Take the results of one event: those that are recorded, and those that were computed."""
        numbers = [result.sequence for result in recorded if isinstance(result, Result)]
        self.first_result = self.first_result or next(iter(numbers), 0)
        self.last_result = max([self.last_result, *numbers])
        self.calibrations += [result for result in computed if isinstance(result, CalibrationUpdate)]
        self.windows += [result for result in computed if isinstance(result, WindowReport)]


@dataclass(frozen=True, slots=True)
class Replayer:
    """Replays files, each from its own snapshot.

    `choose`: gives the engines for a file. Their results must equal the recorded ones in every bit. Where the
    recording's numeric fingerprint is not `here`, they must agree within the relative tolerance `elsewhere`.
    """

    choose: Choose
    here: dict[str, str]
    elsewhere: float

    def run(self, path: Path) -> Replayed:
        """Replay a file by the first engine that gives its results, or the last one. Raises OSError."""
        first = next(RecordingReader(path).steps(), None)
        start = first.event if first is not None and isinstance(first.event, RunStart) else None
        if start is None:
            reader = RecordingReader(path)
            for _ in reader.steps():
                pass
            return Replayed(ReplayedFile(path=str(path), fault=reader.fault, good_bytes=reader.good_bytes))
        missing = ""
        for candidate in self.choose(start):
            try:
                with candidate.open() as engine:
                    replayed = _FileReplay(path, engine, candidate.own, self).run()
            except EngineError as error:
                missing = str(error)
                continue
            replayed.file.engine_missing = missing or candidate.missing
            if replayed.file.equal or start.engine:
                break
        return replayed


class _FileReplay:
    """The replay of one file by one engine."""

    def __init__(self, path: Path, engine: ReplayEngine, own: bool, how: Replayer) -> None:
        self._path, self._engine, self._how = path, engine, how
        self._file = ReplayedFile(path=str(path), replayed_by=engine.name)
        self._file.departure = None if own else Departure()
        self._found = Replayed(self._file)
        self._left: list[Memory] | None = None  # before an event whose results a crash kept from the file

    def run(self) -> Replayed:
        file, reader = self._file, RecordingReader(self._path)
        for step in reader.steps():
            if isinstance(step.event, RunStart):
                self._describe(step.event)
            elif isinstance(step.event, Pruned):
                file.pruned.append(step.event)
            file.events += 1
            if not file.refused and not file.undecidable:
                self._step(step)
            self._found.next_event = step.event_sequence + 1
        file.fault, file.undecoded, file.good_bytes = reader.fault, reader.undecoded, reader.good_bytes
        corrupt = file.fault is not None and file.fault.kind != "torn"
        if file.equal and not corrupt and not file.undecidable and not file.tolerance and file.by_own_engine:
            self._found.left_sha256 = hashlib.sha256(self._engine.snapshot()).hexdigest()
            self._found.left = self._left if self._left is not None else self._digests()
        return self._found

    def _digests(self) -> list[Memory]:
        """The states with which a next run would begin, each as its SHA-256."""
        return [replace(one, state=hashlib.sha256(one.state).digest()) for one in self._engine.memories()]

    def _describe(self, start: RunStart) -> None:
        file = self._file
        self._found.start = msgspec.structs.replace(start, snapshot=b"")
        self._found.began_sha256 = hashlib.sha256(start.snapshot).hexdigest()
        file.run_id, file.file_sequence, file.engine = start.run_id, start.file_sequence, start.engine
        file.gateway = f"{start.site}/{start.gateway}"
        here = self._how.here
        other = sorted(name for name, value in here.items() if start.fingerprint.get(name) != value)
        if other and file.by_own_engine:
            file.tolerance = self._how.elsewhere
            file.notes.append(f"recorded with another {', '.join(other)} than on this machine: last bits may differ")

    def _step(self, step: RecordedStep) -> None:
        file = self._file
        try:
            before, computed = self._computed(step)
        except EngineError:
            raise
        except Exception as error:  # a damaged or forged recording may raise any exception
            file.refused = _refusal(step, error)
            return
        if not step.complete and len(computed) > len(step.results):
            self._left = before
        file.results += len(computed)
        self._found.add(step.results, computed)
        if not computed and not step.results:
            return
        if file.departure is not None:
            file.departure.add(step.event_sequence, step.results, computed, step.complete)
            return
        found = compare(file.path, step.event_sequence, step.results, computed, file.tolerance, complete=step.complete)
        if found is not None:
            differ(file, found)

    def _computed(self, step: RecordedStep) -> tuple[list[Memory], Sequence[Output]]:
        """The states before an event that is not complete, and the results of the engine."""
        if not isinstance(step.event, RunStart):
            return [] if step.complete else self._digests(), self._engine.step(step)
        computed = self._engine.begin(step)
        if not step.event.continuation:
            self._found.kept = self._digests()
        return [], computed


def _refusal(step: RecordedStep, error: Exception) -> str:
    """Why a file cannot be replayed."""
    begins = isinstance(step.event, RunStart)
    kind = "" if begins and isinstance(error, ValueError) else f"{type(error).__name__}: "
    place = "" if begins else f"the pipeline fails at event {step.event_sequence}: "
    return f"{place}{kind}{_short(error)}"


def differ(file: ReplayedFile, difference: Difference) -> None:
    """Count a difference in a file."""
    if difference.undecidable:
        # The replay has taken the other decision, so all later results of this file differ. The next file begins with
        # a snapshot and can be compared again.
        file.undecidable += 1
        file.notes.append(f"undecidable on this machine: {difference}")
        return
    file.different += 1
    file.first_difference = file.first_difference or difference


def link(replayed: Sequence[Replayed]) -> tuple[list[tuple[int, str]], list[str]]:
    """Compare what each file begins with to what the file before it leaves, by the numbers of the files.

    Returns (index, fault) of each file that begins with another state, and what cannot be shown. A difference within a
    run is also counted in the replay of the file.
    """
    faults, unproven = list[tuple[int, str]](), list[str]()
    known = _LeftState(from_first=bool(replayed) and replayed[0].file.file_sequence == 1)
    for index, (before, after) in enumerate(pairwise(replayed), start=1):
        start, file = after.start, after.file
        if start is None or before.start is None:
            continue
        known.take(before, before.start)
        if before.start.run_id != start.run_id or not start.continuation:
            fault, open_question = known.compare(before, after, start)
            if open_question:
                unproven.append(
                    f"that {file.path} begins with the states that {before.file.path} left: {open_question}"
                )
            elif fault:
                faults.append((index, f"this run does not go on from {before.file.path}: {fault}"))
        elif start.event_sequence > before.next_event:
            file.notes.append(f"events {before.next_event} to {start.event_sequence - 1} are in none of these files")
        elif start.event_sequence == before.next_event and before.left_sha256 and file.by_own_engine:
            file.in_chain = after.began_sha256 == before.left_sha256
            if not file.in_chain:
                differ(file, difference := _snapshot_difference(file, start))
                faults.append((index, f"the results do not follow from the data: {difference}"))
    return faults, unproven


class _LeftState:
    """The states that recordings leave for the next run, as far as the replays tell.

    `from_first`: the first recording is number 1, so there are no states of earlier ones.
    """

    def __init__(self, *, from_first: bool) -> None:
        self._memories: list[Memory] = []
        self._sensors: set[str] = set()  # of which the states are known
        self._all = from_first
        self._last_result = 0

    def take(self, replayed: Replayed, start: RunStart) -> None:
        """Take the next recording."""
        sensors, known = _sensors(start), bool(replayed.left_sha256)
        self._memories = states_left(self._memories, replayed.left, sensors)
        self._sensors = self._sensors | sensors if known else self._sensors - sensors
        self._all = self._all and known
        self._last_result = max(self._last_result, replayed.last_result)

    def compare(self, before: Replayed, after: Replayed, start: RunStart) -> tuple[str, str]:
        """(why the run that begins after these recordings does not begin with these states, why it cannot be said)."""
        if before.file.gateway != after.file.gateway or before.file.file_sequence + 1 != after.file.file_sequence:
            return "", ""  # what is between them is told by the chain
        if not (before.left_sha256 and after.file.by_own_engine and after.file.engine == before.file.engine):
            return "", OTHER
        sensors = _sensors(start) if self._all else _sensors(start) & self._sensors
        fault = continues(self._memories, [one for one in after.kept if one.sensor in sensors], sensors)
        between = after.first_result - self._last_result - 1
        unrecorded = self._last_result and between > 0 and between != UNKEPT_MAX
        return fault, UNRECORDED if fault and unrecorded else ""


def _sensors(start: RunStart) -> set[str]:
    """The sensors in the configuration of a run; none where this is not one."""
    try:
        return {str(channel["sensor"]) for channel in msgspec.json.decode(start.config_json)["channels"]}
    except (msgspec.DecodeError, KeyError, TypeError):
        return set()


def _short(error: Exception) -> str:
    text = str(error)
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]}..."


def _as_recorded(event_sequence: int, result: Output) -> Output:
    """A result as it is after writing to and reading from a recording: numpy's scalars become Python's."""
    _, read = decode(schema_of(topic_of(result)), encode(event_sequence, result))
    return cast(Output, read)


def _snapshot_difference(file: ReplayedFile, start: RunStart) -> Difference:
    return Difference(
        file=file.path,
        event_sequence=start.event_sequence,
        what="snapshot",
        field="state at the end of the previous file",
        recorded="its snapshot",
        computed="another state",
    )
