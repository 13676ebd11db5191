"""What must hold after every end of the agent: no accepted result is lost, the store is readable, recordings replay."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from agent.audit.engines import Engines
from agent.audit.replaying import Replayer
from agent.core.events import CalibrationUpdate, Result
from agent.core.pipeline import Pipeline
from agent.delivery.consumer import Received
from agent.delivery.history import FILE_NAME, History, StoredResult, StoreError
from agent.delivery.store import Store
from agent.recording.fingerprint import fingerprint
from agent.recording.reading import RecordingReader
from tests.faults.rig import OFFSET, SENSITIVITY
from tests.scenarios.processes import recordings

# In a window of 1.25 s, each sample from a wrong position shifts the mean by 0.1 m/s2 or more; noise shifts it by 1e-4.
S_TOLERANCE = 0.005
Q_TOLERANCE_MPS2 = 0.05


@dataclass
class Findings:
    """Counts of violations, which must be zero, with their first descriptions; and counts of what was checked."""

    lost: int = 0  # calibrations that a consumer or the store had, and that are missing now
    unreadable: int = 0  # stores
    not_replaying: int = 0  # recordings
    wrong: int = 0  # calibrations that differ from the true values
    not_restored: int = 0  # runs whose first calibration is not the last one of the run before
    calibrations: int = 0
    recordings: int = 0
    restored: int = 0
    words: list[str] = field(default_factory=list)

    def say(self, words: str) -> None:
        """Keep the description of a violation, if it is among the first."""
        if len(self.words) < 20:
            self.words.append(words)

    @property
    def zeros(self) -> bool:
        """Whether there is no violation."""
        return not (self.lost or self.unreadable or self.not_replaying or self.wrong or self.not_restored)


class Ledger:
    """Inspects a data directory repeatedly; a result that was seen once must be there at every later inspection."""

    def __init__(self, data_dir: Path) -> None:
        self.data_dir = data_dir
        self.findings = Findings()
        self._seen: dict[int, bytes] = {}
        self._lost: set[int] = set()
        self._aside: set[Path] = set()
        self._replayed: dict[str, int] = {}
        self.records: list[StoredResult] = []

    def inspect(self, witnessed: Iterable[Received] = ()) -> None:
        """Inspect the store and the new recordings. No agent may be running."""
        found = self.findings
        for path in {*self.data_dir.glob(f"{FILE_NAME}.corrupt-*")} - self._aside:
            self._aside.add(path)
            found.unreadable += 1
            found.say(f"{path.name}: set aside at a start")
        try:
            self.records = read_store(self.data_dir)
        except StoreError as error:
            found.unreadable += 1
            found.say(str(error))
            return
        kept = {record.sequence: record.payload for record in self.records}
        for result in witnessed:
            self._seen.setdefault(result.sequence, b"")
        for sequence in self._seen.keys() - kept.keys() - self._lost:
            self._lost.add(sequence)
            found.lost += 1
            found.say(f"result {sequence} is lost")
        for sequence, payload in self._seen.items():
            if payload and kept.get(sequence, payload) != payload:
                found.lost += 1
                found.say(f"result {sequence} is another now")
        self._judge(
            [record for record in self.records if record.sequence not in self._seen or not self._seen[record.sequence]]
        )
        self._seen |= kept
        self._look_for_restored()
        self._replay()

    def _look_for_restored(self) -> None:
        """Check that the first calibration of each run is the one that was in force before."""
        before: CalibrationUpdate | None = None
        self.findings.restored = self.findings.not_restored = 0
        for record in self.records:
            if record.what != "calibration":
                continue
            update = record.result
            assert isinstance(update, CalibrationUpdate)
            if before is not None and before.run_id != update.run_id:
                same = (before.sensitivity, before.offset, before.covariance) == (
                    update.sensitivity,
                    update.offset,
                    update.covariance,
                )
                self.findings.restored += same
                if not same:
                    self.findings.not_restored += 1
                    self.findings.say(f"calibration {record.sequence} begins a run and is not {before.sequence}")
            before = update

    def _judge(self, records: list[StoredResult]) -> None:
        for record in records:
            if record.what != "calibration":
                continue
            self.findings.calibrations += 1
            update = record.result
            assert isinstance(update, CalibrationUpdate)
            if not near_truth(update):
                self.findings.wrong += 1
                self.findings.say(f"calibration {record.sequence} is off: {update.sensitivity} {update.offset}")

    def _replay(self) -> None:
        """Check that each recording replays bit for bit and holds the results that the store says are in it."""
        found = self.findings
        for path in recordings(self.data_dir):
            name = path.name.removesuffix(".active")
            size = path.stat().st_size
            if self._replayed.get(name) == size:
                continue
            self._replayed[name] = size
            found.recordings += 1
            file = Replayer(Engines(Pipeline.restore), fingerprint(), elsewhere=0.0).run(path).file
            expected = {
                r.sequence: r for r in self.records if r.recorded and r.recording.removesuffix(".active") == name
            }
            held = set(_sequences(path))
            if (file.events and not file.equal) or (file.fault is not None and file.fault.kind != "torn"):
                found.not_replaying += 1
                found.say(f"{name}: {file.fault or file.refused or file.first_difference}")
            elif missing := expected.keys() - held:
                found.not_replaying += 1
                found.say(f"{name}: {len(missing)} results that were flushed are not in it, first {min(missing)}")


def read_store(data_dir: Path) -> list[StoredResult]:
    """Read all results of a store, from a copy, so that the next start finds the files exactly as the fault left them.

    Raises StoreError, also where the file would be set aside as corrupt.
    """
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name)
        for end in ("", "-wal", "-journal"):  # not -shm: SQLite makes it anew, as after a power cut
            path = data_dir / f"{FILE_NAME}{end}"
            if path.exists():
                shutil.copy(path, copy)
        if not (copy / FILE_NAME).exists():
            return []  # killed before there was one
        store = Store(copy)
        store.close()
        if store.set_aside is not None:
            raise StoreError(f"{data_dir / FILE_NAME}: corrupt")
        with History(copy / FILE_NAME) as history:
            return history.after(-1, limit=10_000_000)


def near_truth(update: CalibrationUpdate) -> bool:
    """Whether S and Q are the virtual sensor's."""
    s = np.abs(np.array(update.sensitivity) - SENSITIVITY).max()
    q = np.abs(np.array(update.offset) - OFFSET).max()
    return bool(s < S_TOLERANCE and q < Q_TOLERANCE_MPS2)


def _sequences(path: Path) -> Iterable[int]:
    for step in RecordingReader(path).steps():
        for result in step.results:
            if isinstance(result, Result):
                yield result.sequence


def as_text(findings: Findings) -> str:
    """For an assertion."""
    return msgspec.json.encode(findings).decode()
