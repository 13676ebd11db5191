"""The states of the estimation with which a run begins: from the store, from the recordings, or from a calibration.

The states in the store count where they are those that the gateway signed, and where no recording goes on after them.
Otherwise the newest recording is replayed. What neither gives begins again from the newest calibration that is signed.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from agent.core.events import CalibrationUpdate
from agent.core.memory import Memory
from agent.delivery.gateway_key import GatewayKey
from agent.delivery.proof import UnprovenError, proven
from agent.delivery.record import JOINED, StoredResult
from agent.delivery.schema import read_memories, read_states
from agent.delivery.signed_states import StateList
from agent.recording.files import file_number, final_name, recordings
from agent.recording.head import HEAD_NAME
from agent.recording.reading import first_event
from agent.recording.result_signing import PUBLIC_KEY
from agent.recording.results_chain import FILE_METADATA, ResultsChain
from agent.recording.scan import metadata_of, scan
from agent.recording.signed_text import SignedTextError
from agent.recording.signing import SIGNATURE_METADATA, signed_results, signed_text

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys

# s; after this time no further recording is replayed at a start. One replay takes seconds for an hour of recording.
LONGEST_S = 60.0
# Of the store at a start; behind: a crash may have kept states from it.
Completeness = Literal["complete", "behind", "new"]

# Gives the states of the estimation at the end of a recording, as far as the keys cover it; without keys, all of it.
# None where it cannot be replayed or is not covered.
Recall = Callable[[Path, "KnownKeys | None"], Sequence[Memory] | None]


def no_memories(_: Path, __: KnownKeys | None) -> Sequence[Memory] | None:
    """A Recall that replays nothing."""
    return None


@dataclass(slots=True)
class States:
    """The states at a start, those of a sensor oldest first.

    `recording`, `sequence`: the highest numbers of a recording and of a result that they follow. `late`: the recordings
    go on after those in the store. `replayed`: how many come from recordings. `faults`: what was not as the gateway
    signed it, and what is done instead.
    """

    memories: list[Memory] = field(default_factory=list)
    recording: int = 0
    sequence: int = 0
    late: bool = False
    replayed: int = 0
    faults: list[str] = field(default_factory=list)

    def take(self, found: Sequence[Memory], number: int) -> None:
        """Take the states where the recording `number` ends; those in the store that are newer stay.

        None is newer where the recording began after the states were signed, whatever the numbers of results are.
        """
        sensors, end = {memory.sensor for memory in found}, max((memory.sequence for memory in found), default=0)
        stored = {(memory.sensor, memory.identity): memory for memory in self.memories}
        began_after = self.recording < number
        newer = {device: m for device, m in stored.items() if m.sequence > end and not began_after}
        others = [memory for memory in self.memories if memory.sensor not in sensors]
        taken = [newer.pop((memory.sensor, memory.identity), memory) for memory in found]
        self.replayed += sum(memory not in self.memories for memory in taken)
        self.memories = [*others, *taken, *(memory for memory in newer.values() if memory.sensor in sensors)]
        self.sequence = max(self.sequence, end)

    def add(self, memory: Memory) -> None:
        """Take the state of one more device, or a newer one; the oldest come first."""
        device = (memory.sensor, memory.identity)
        others = [known for known in self.memories if (known.sensor, known.identity) != device]
        self.memories = sorted([*others, memory], key=lambda known: known.sequence)

    def sequence_of(self, sensor: str, identity: str) -> int:
        """The result that the state of a device follows; 0 where there is none."""
        return next((m.sequence for m in self.memories if (m.sensor, m.identity) == (sensor, identity)), 0)


def _take_from(states: States, found: Sequence[Memory] | None, number: int, name: str, *, signed: bool) -> None:
    """Take the states where a recording ends; `found` is None where it does not give them."""
    if found is not None:
        states.take(found, number)
        states.faults[:] = [f"{fault}; {name} gives them instead" for fault in states.faults]
    elif signed:
        states.faults.append(f"{name} does not give the states of the estimation where it ends")


@dataclass(frozen=True)
class _Recordings:
    """Recordings by name, each of which may be replayed once. `keys`: of their signatures, as in Recall."""

    files: dict[str, Path]
    recall: Recall
    keys: KnownKeys | None

    def states(self, name: str) -> Sequence[Memory] | None:
        """The states where this recording ends; None where it does not give them."""
        return self.recall(self.files.pop(name), self.keys)


def states_at_start(
    connection: sqlite3.Connection,
    directory: Path,
    recall: Recall,
    key: GatewayKey | None,
    epoch: str,
    store_is: Completeness,
) -> States:
    """The states with which the next run begins. `epoch`: of the store. Raises sqlite3.Error, DamagedRow, OSError."""
    states = States() if store_is == "new" else _states_in_store(connection, key, epoch)
    lost = store_is == "new" or bool(states.faults)
    files = {final_name(path): path for _, path in recordings(directory)}
    keys, end_s = key.known_keys if key is not None else None, time.monotonic() + LONGEST_S
    if key is not None and _is_new(connection, directory, files.values()):
        states.faults.append(f"nothing in {directory} is signed: this start takes over once what is not signed")
        keys = None
    replayable = _Recordings(files, recall, keys)
    if _take_newest(replayable, key, states, behind=store_is == "behind", lost=lost):
        _take_calibrated(connection, replayable, states, end_s)
        if key is not None:
            _begin_from_calibrations(connection, key, states)
    return states


def _take_newest(replayable: _Recordings, key: GatewayKey | None, states: States, *, behind: bool, lost: bool) -> bool:
    """Take the states where the newest recording ends, if they may be newer than those in the store. Returns whether
    states may be lost: they were before, or this recording does not give them."""
    path = next((path for path in reversed(replayable.files.values()) if first_event(path) is not None), None)
    if path is None:
        return lost
    number, last = _end_of(path, key)
    states.late = states.recording < number or states.sequence < last
    if states.late and not (lost or behind):
        states.faults.append("the states of the estimation in the store are older than the newest recording")
    if behind or lost or states.late:
        found = replayable.states(final_name(path))
        _take_from(states, found, number, path.name, signed=key is not None)
        lost = lost or found is None
    states.recording, states.sequence = max(states.recording, number), max(states.sequence, last)
    return lost


def _states_in_store(connection: sqlite3.Connection, key: GatewayKey | None, epoch: str) -> States:
    """The states in the store; with a key only if they are those that it signed."""
    memories = read_memories(connection)
    if key is None:
        return States(memories, sequence=max((memory.sequence for memory in memories), default=0))
    data = read_states(connection)
    try:
        if not data and not memories:
            return States()
        if not data:
            raise SignedTextError("no signed list names them, as in a store of an earlier version")
        listed = StateList.read(data, key.gateway, key.known_keys)
        if listed.epoch != epoch:
            raise SignedTextError(f"they are of the epoch {listed.epoch!r:.40}, the store is of {epoch}")
        if fault := listed.fault(memories):
            raise SignedTextError(fault)
    except SignedTextError as error:
        return States(faults=[f"the states of the estimation in the store are refused: {error}"])
    return States(memories, listed.recording, listed.sequence)


def _end_of(path: Path, key: GatewayKey | None) -> tuple[int, int]:
    """(number of a recording, number of the last result in it or before it); both 0 without a key."""
    if key is None:
        return 0, 0
    number = file_number(path.name) or 0
    signature = metadata_of(path).get(SIGNATURE_METADATA, {})
    signed, chain = signed_text(signature), signed_results(signature)
    if chain is not None and f"\nrecording {number}\n" in signed.text:
        after = ResultsChain.of_text(chain).before
        return number, after if not signed.fault_by(key.known_keys, key.gateway) else _last_sequence(path)
    return number, _last_sequence(path)


def _last_sequence(path: Path) -> int:
    return max((result.sequence for result in scan(path).results), default=0)


def _is_new(connection: sqlite3.Connection, directory: Path, paths: Iterable[Path]) -> bool:
    """Whether nothing in a data directory with recordings was ever signed."""
    if not (paths := list(paths)) or (directory / HEAD_NAME).exists() or read_states(connection):
        return False
    if connection.execute("SELECT 1 FROM signed LIMIT 1").fetchone() is not None:
        return False
    newest = metadata_of(paths[-1])
    return PUBLIC_KEY not in newest.get(FILE_METADATA, {}) and SIGNATURE_METADATA not in newest


_CALIBRATED = """
SELECT sensor, identity, recording, max(sequence) AS newest FROM results
WHERE what = 'calibration' AND recorded = 1 GROUP BY sensor, identity, recording ORDER BY newest DESC"""


def _take_calibrated(connection: sqlite3.Connection, replayable: _Recordings, states: States, end_s: float) -> None:
    """Replay, newest first, the recordings with a calibration that is newer than the state known of its device."""
    for sensor, identity, name, sequence in connection.execute(_CALIBRATED).fetchall():
        if states.sequence_of(sensor, identity) >= sequence or name not in replayable.files:
            continue
        if time.monotonic() >= end_s:
            return
        for memory in replayable.states(name) or ():
            if memory.sequence > states.sequence_of(memory.sensor, memory.identity):
                states.add(memory)
                states.replayed += 1


def _begin_from_calibrations(connection: sqlite3.Connection, key: GatewayKey, states: States) -> None:
    """What nothing else is known of begins again from the newest calibration of the device that is signed."""
    from agent.core.kept import of_calibration

    done: set[tuple[str, str]] = set()
    for row in connection.execute(f"{JOINED} WHERE what = 'calibration' ORDER BY sequence DESC"):
        record = StoredResult.of_joined(row)
        device = (record.sensor, record.identity)
        if device in done or states.sequence_of(*device) >= record.sequence or not record.signed:
            continue
        with suppress(UnprovenError):
            update = proven(record, key.known_keys)[0].result
            if isinstance(update, CalibrationUpdate) and update.identity == record.identity:
                states.add(Memory(*device, record.sequence, of_calibration(update)))
                states.faults.append(f"{device[0]} begins again from calibration {record.sequence}, which is signed")
                done.add(device)
