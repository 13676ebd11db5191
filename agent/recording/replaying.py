"""Runs recordings through the pipeline again and compares the computed results with the recorded ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol, cast

import msgspec

from agent import __version__
from agent.core.events import CalibrationUpdate, Event, Output, Pruned, RunStart, WindowReport
from agent.recording.comparison import Difference, compare
from agent.recording.messages import decode, encode, recorded_ones, schema_of, topic_of
from agent.recording.reading import RecordingReader, Step
from agent.recording.records import Fault


class PipelineLike(Protocol):
    """The methods needed of the pipeline that is replayed; agent.core.pipeline.Pipeline has them."""

    def step(self, event: Event) -> list[Output]: ...
    def snapshot(self) -> bytes: ...


LONGEST_REASON = 1000  # characters; a hostile configuration has a hundred thousand faults
Restore = Callable[[str, bytes], PipelineLike]


class ReplayedFile(msgspec.Struct, kw_only=True):
    """What the replay of one file gave."""

    path: str
    run_id: str = ""
    gateway: str = ""  # <site>/<gateway>
    file_sequence: int = 0
    in_chain: bool = False  # continues the previous file, whose state at its end equals this file's snapshot
    events: int = 0
    results: int = 0  # computed
    fault: Fault | None = None
    good_bytes: int = 0
    refused: str = ""  # why the file cannot be replayed
    different: int = 0  # events after which computed and recorded results differ
    first_difference: Difference | None = None
    undecidable: int = 0
    tolerance: float = 0.0
    notes: list[str] = []
    pruned: list[Pruned] = []  # events in this file that say which recordings retention deleted

    @property
    def equal(self) -> bool:
        """Whether all results recorded in this file follow from the events recorded in it."""
        return not self.different and not self.refused and self.events > 0


class Replay:
    """Replays files one after the other. `files`, `calibrations` and `windows` hold what came out.

    A file begins with a RunStart. `restore(config_json, snapshot)` makes the pipeline from the configuration and the
    snapshot in it, and the pipeline then steps the RunStart itself. A file that continues the previous one is replayed
    without restoring. Computed results must equal the recorded ones in every bit. Where the recording's numeric
    fingerprint is not `here`, they must agree within the relative tolerance `elsewhere`.
    """

    def __init__(self, restore: Restore, here: dict[str, str], elsewhere: float) -> None:
        self._restore = restore
        self._here = here
        self._elsewhere = elsewhere
        self._pipeline: PipelineLike | None = None  # as the last file left it, if the next file may continue with it
        self._next_event = 0
        self._same_version = True  # of the program that recorded
        self.files: list[ReplayedFile] = []
        self.calibrations: list[CalibrationUpdate] = []
        self.windows: list[WindowReport] = []

    @property
    def first_difference(self) -> Difference | None:
        """The first difference in any file."""
        return next((file.first_difference for file in self.files if file.first_difference), None)

    def run(self, path: Path) -> ReplayedFile:
        """Replay one more file. Raises OSError where it cannot be read."""
        file = ReplayedFile(path=str(path))
        self.files.append(file)
        reader = RecordingReader(path)
        for step in reader.steps():
            if isinstance(step.event, RunStart):
                self._begin(file, step.event)
            elif isinstance(step.event, Pruned):
                file.pruned.append(step.event)
            file.events += 1
            if not file.refused and not file.undecidable:
                self._step(file, step)
            self._next_event = step.event_sequence + 1
        file.fault, file.good_bytes = reader.fault, reader.good_bytes
        if not file.equal or file.fault or file.undecidable:
            self._pipeline = None
        return file

    def _begin(self, file: ReplayedFile, start: RunStart) -> None:
        file.run_id, file.file_sequence = start.run_id, start.file_sequence
        file.gateway = f"{start.site}/{start.gateway}"
        other = sorted(name for name, value in self._here.items() if start.fingerprint.get(name) != value)
        if other:
            file.tolerance = self._elsewhere
            file.notes.append(f"recorded with another {', '.join(other)} than on this machine: last bits may differ")
        version = start.versions.get("fieldcal", __version__)
        self._same_version = version == __version__
        if not self._same_version:
            file.notes.append(
                f"recorded by fieldcal {version}, this is {__version__}: texts of reasons, and fields that the older "
                "version did not have, are not compared"
            )
        before = self.files[-2] if len(self.files) > 1 else None
        follows = before is not None and before.run_id == start.run_id and start.continuation
        if follows and start.event_sequence > self._next_event:
            file.notes.append(f"events {self._next_event} to {start.event_sequence - 1} are in none of these files")
        if follows and self._pipeline is not None and start.event_sequence == self._next_event and not file.tolerance:
            if self._pipeline.snapshot() == start.snapshot:
                file.in_chain = True
                return
            self._differ(file, _snapshot_difference(file, start))
        try:
            self._pipeline = self._restore(start.config_json, start.snapshot)
        except Exception as error:  # a damaged or forged snapshot may raise any exception
            file.refused = (
                f"no pipeline can be made from its configuration and snapshot: {type(error).__name__}: {_short(error)}"
            )

    def _step(self, file: ReplayedFile, step: Step) -> None:
        assert self._pipeline is not None
        try:
            outputs = recorded_ones(self._pipeline.step(step.event))
            computed = [_as_recorded(step.event_sequence, output) for output in outputs]
        except Exception as error:  # as above
            file.refused = f"the pipeline fails at event {step.event_sequence}: {type(error).__name__}: {_short(error)}"
            return
        file.results += len(computed)
        self.calibrations += [result for result in computed if isinstance(result, CalibrationUpdate)]
        self.windows += [result for result in computed if isinstance(result, WindowReport)]
        if computed or step.results:
            found = compare(
                file.path, step.event_sequence, step.results, computed, file.tolerance,
                complete=step.complete, same_version=self._same_version,
            )  # fmt: skip
            if found is not None:
                self._differ(file, found)

    @staticmethod
    def _differ(file: ReplayedFile, difference: Difference) -> None:
        if difference.undecidable:
            # The replay has taken the other decision, so all later results of this file differ. The next file begins
            # with a snapshot and can be compared again.
            file.undecidable += 1
            file.notes.append(f"undecidable on this machine: {difference}")
            return
        file.different += 1
        file.first_difference = file.first_difference or difference


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
        recorded=f"{len(start.snapshot)} bytes",
        computed="other bytes",
    )
