"""A gateway with a key, its recordings and its store, without ports: runs that end or are killed, and forgers."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.audit.recalling import memories_of
from agent.core.events import CalibrationUpdate, Event, Result, RunStart
from agent.core.memory import Memory
from agent.core.pipeline import Pipeline
from agent.core.snapshot import pack, unpack
from agent.delivery.gateway_key import GatewayKey
from agent.delivery.history import FILE_NAME, StoredResult
from agent.delivery.schema import row_crc
from agent.delivery.store import Store
from agent.recording.files import final_name
from agent.recording.fingerprint import fingerprint
from agent.recording.signing import Signer
from agent.recording.writer import Recorder
from tests.attacks.chain_site import KEY
from tests.unit.test_pipeline import EPOCH_NS, OFFSET, POSE_S, SECOND, SENSITIVITY, block, opened, pipeline

GATEWAY = "site/gateway"
CONFIG = pipeline(False, 100.0)._config
CHANNEL = CONFIG.channels[0].model_copy(update={"poses_repeat_s": 4 * POSE_S})
CONFIG = CONFIG.model_copy(update={"channels": (CHANNEL,)})
RATE_HZ, BLOCK = 100.0, 50
G_MPS2 = np.array([[0, 0, 9.8], [9.8, 0, 0], [0, 9.8, 0], [0, -9.8, 0]])


def rests(seed: int = 1, serial_number: str = "A", begin_s: float = 0.0, count: int = 6) -> Iterator[Event]:
    """A sensor is opened and turned through so many rests, the first event at `begin_s`."""
    noise = np.random.default_rng(seed)
    shift_ns = round(begin_s * SECOND)
    yield opened("s", begin_s, serial_number=serial_number)
    for first in range(0, round((count * POSE_S + 1.0) * RATE_HZ), BLOCK):
        pose = ((first + np.arange(BLOCK)) / RATE_HZ // POSE_S).astype(int) % 4
        values = G_MPS2[pose] @ SENSITIVITY.T + OFFSET + noise.normal(0, 1e-3, (BLOCK, 3))
        made = block("s", first, values, nominal_hz=RATE_HZ, true_hz=RATE_HZ)
        arrivals_ns = made.burst_t_monotonic_ns + shift_ns
        yield replace(made, t_utc_ns=made.t_utc_ns + shift_ns, burst_t_monotonic_ns=arrivals_ns)


class Run:
    """One run of the gateway on a data directory: begun as `fieldcal run` does it, then `stop`ped or `kill`ed."""

    def __init__(
        self,
        directory: Path,
        number: int = 1,
        *,
        key: Ed25519PrivateKey | None = KEY,
        gateway: str = GATEWAY,
        earlier: Sequence[bytes] = (),
        engine: str = "",
        **options: Any,
    ) -> None:
        """`options` are those of the recorder."""
        directory.mkdir(exist_ok=True)
        signer = Signer(key, earlier) if key is not None else None
        held = GatewayKey(gateway, signer) if signer is not None else None
        self.store = Store(directory, 0, recall=partial(memories_of, restore=Pipeline.restore), key=held)
        self.faults = self.store.faults
        self.recorder = Recorder(
            directory, ["s"], ["s"], ledger=self.store, signer=signer, epoch=self.store.epoch, **options
        )
        self.recorder.close_torn()
        kept: dict[str, dict[str, bytes]] = {"s": {}}
        for memory in self.store.states:
            kept.setdefault(memory.sensor, {})[memory.identity] = memory.state
        self.run_id, self._gateway, self._engine, self._event = f"run-{number}", gateway, engine, 0
        self.pipeline = Pipeline.begin(CONFIG, self.run_id, 0, self.store.last_sequence(), kept)
        self.begun_with = self.pipeline.all_memories()
        self.results: list[Result] = []
        self.alive = True
        self._begin_file(0)

    def _begin_file(self, t_monotonic_ns: int) -> None:
        start = self._start(t_monotonic_ns)
        self._record(start, self.pipeline.step(start))
        while self.recorder.pruning is not None:
            self._record(self.recorder.pruning, self.pipeline.step(self.recorder.pruning))

    def _start(self, t_monotonic_ns: int) -> RunStart:
        site, _, gateway = self._gateway.partition("/")
        return RunStart(
            run_id=self.run_id, site=site, gateway=gateway, boot_id="boot", t_monotonic_ns=t_monotonic_ns,
            t_utc_ns=EPOCH_NS + t_monotonic_ns, config_json=CONFIG.model_dump_json(), versions={},
            fingerprint=fingerprint(), snapshot=self.pipeline.snapshot(),
            file_sequence=self.recorder.next_file_sequence, event_sequence=self._event, continuation=self._event > 0,
            engine=self._engine,
        )  # fmt: skip

    def _record(self, event: Event, outputs: Sequence[Any]) -> None:
        number, self._event = self._event, self._event + 1
        recorded = self.recorder.record(number, event, outputs)
        path = self.recorder.path
        name = final_name(path) if recorded and path is not None else ""
        signed = [self.recorder.results.signed(number, result) for result in outputs]
        records = [
            StoredResult.of(r, recorded=recorded, recording=name, epoch=self.store.epoch, signed=s.data if s else b"")
            for r, s in zip(outputs, signed, strict=True)
        ]
        if records:
            self.store.commit(records, self.pipeline.memories(outputs))

    def feed(self, events: Iterable[Event]) -> Run:
        """Give it events."""
        for event in events:
            outputs = self.pipeline.step(event)
            self.results += [output for output in outputs if isinstance(output, Result)]
            self._record(event, outputs)
        return self

    def rotate(self) -> Run:
        """Begin a new file."""
        self._begin_file(self._event * SECOND)
        return self

    def stop(self) -> Run:
        """End as the service does."""
        self.alive = False
        self.recorder.close()
        self.store.end(["s"], self.pipeline.all_memories())
        self.store.close()
        return self

    def kill(self) -> Run:
        """A killed process lets go of its lock and does no more."""
        self.alive = False
        self.recorder.sync()
        assert self.recorder._file is not None
        self.recorder._file.abandon()
        self.store._connection.close()
        os.close(self.store._lock)
        return self

    @property
    def calibration(self) -> CalibrationUpdate:
        """The last one in force."""
        return [result for result in self.results if isinstance(result, CalibrationUpdate)][-1]


def states(memories: Iterable[Memory]) -> dict[tuple[str, str], bytes]:
    """The states by device."""
    return {(memory.sensor, memory.identity): memory.state for memory in memories}


def forge_memory(directory: Path, factor: float = 1.05) -> None:
    """Multiply S in every state of the store, with the right CRC."""
    with closing(sqlite3.connect(directory / FILE_NAME)) as connection, connection:
        for sensor, identity, sequence, state in connection.execute(
            "SELECT sensor, identity, sequence, state FROM memory"
        ).fetchall():
            held = unpack(state)
            held["estimation"]["state"]["now"]["x"][:9] *= factor
            if held["in_force"] is not None:
                held["in_force"]["sensitivity"] = (np.array(held["in_force"]["sensitivity"]) * factor).tolist()
            row = (sensor, identity, sequence, pack(held))
            connection.execute(
                "UPDATE memory SET state = ?, crc = ? WHERE sensor = ? AND identity = ?",
                (row[3], row_crc(*row), sensor, identity),
            )


def forge_result(directory: Path, sequence: int, **changes: Any) -> None:
    """Change fields of the JSON of a result, with the right CRC."""
    columns = "sequence, run_id, sensor, what, payload, t_utc_ns, recorded, recording, identity"
    with closing(sqlite3.connect(directory / FILE_NAME)) as connection, connection:
        (row,) = connection.execute(f"SELECT {columns} FROM results WHERE sequence = ?", (sequence,)).fetchall()
        payload = msgspec.json.encode(msgspec.json.decode(row[4]) | changes)
        row = (*row[:4], payload, *row[5:])
        connection.execute(
            "UPDATE results SET payload = ?, crc = ? WHERE sequence = ?", (payload, row_crc(*row), sequence)
        )


def rows(directory: Path, sql: str) -> list[Any]:
    """Read from the store."""
    with closing(sqlite3.connect(directory / FILE_NAME)) as connection:
        return connection.execute(sql).fetchall()


def put_back(directory: Path, store: Path, *tables: str) -> None:
    """Replace tables of the store by those of another one; the states and their list, where none is named."""
    with closing(sqlite3.connect(directory / FILE_NAME)) as connection:
        connection.execute("ATTACH DATABASE ? AS other", (str(store),))
        with connection:
            for table in tables or ("memory", "states"):
                connection.execute(f"DELETE FROM main.{table}")
                connection.execute(f"INSERT INTO main.{table} SELECT * FROM other.{table}")


def change(directory: Path, sql: str, *values: Any) -> None:
    """Execute a statement on the store."""
    with closing(sqlite3.connect(directory / FILE_NAME)) as connection, connection:
        connection.execute(sql, values)
