"""Simulated gateways: messages of many agents, made by the store, the signatures and the publication of the agent."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from time import monotonic, sleep

import numpy as np
import zenoh

from agent.core.events import Result
from agent.delivery.history import Record
from agent.delivery.keys import PREFIX, result_key
from agent.delivery.publication import Publisher
from agent.delivery.received import LARGEST_RESULT
from agent.delivery.session import session_config
from agent.delivery.store import Store
from agent.fleet.simulated_sensor import WRONG_FROM, Behaviour, SimulatedSensor
from agent.recording.result_signing import ResultSigner
from agent.recording.signing import Signer

SITE = "simulated"
ODD: tuple[Behaviour, ...] = ("drifting", "silent", "wrong", "hostile")
ONE_ODD_IN = 5  # gateways; at least one of each kind where there are enough
AT_ONCE = 32  # gateways that open, or commit, at the same time
POLL_S = 1.0  # s between two looks for a router; each look of each gateway costs time of the same process
CONNECT_S = 10.0  # s to wait for one gateway's connection


def behaviours(count: int, seed: int) -> list[Behaviour]:
    """The behaviour of each gateway, drawn by `seed`."""
    odd = min(max(count // ONE_ODD_IN, len(ODD)), count)
    chosen: list[Behaviour] = ["sound"] * count
    for k, place in enumerate(np.random.default_rng([seed, 0]).permutation(count)[:odd]):
        chosen[place] = ODD[k % len(ODD)]
    return chosen


class SimulatedGateway:
    """One gateway with a store, a signing key and a Zenoh client of its own."""

    def __init__(
        self, name: str, behaviour: Behaviour, sensors: int, seed: list[int], connect: Sequence[str], data_dir: Path
    ) -> None:
        """`seed`: of the sensors and of the signing key. Raises EndpointError, StoreError."""
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        self.name, self.behaviour = name, behaviour
        self._connect = connect
        secret = hashlib.sha256(f"simulated {seed}".encode()).digest()  # protects nothing: anyone can make it
        self._signer = Signer(Ed25519PrivateKey.from_private_bytes(secret))
        (data_dir / name).mkdir(parents=True)
        self._store = Store(data_dir / name)
        self._signing = ResultSigner(self._store.epoch, self._signer)
        self._signing.gateway = self.source
        self._publisher = Publisher(SITE, name, connect, self._store, mode="client", poll_s=POLL_S)
        # Of a gateway that is not sound only the first sensor is odd, so that the page has both.
        self._sensors = [SimulatedSensor(f"s{k}", behaviour if k == 0 else "sound", [*seed, k]) for k in range(sensors)]
        self._round = 0

    @property
    def source(self) -> str:
        """`<site>/<gateway>`."""
        return f"{SITE}/{self.name}"

    @property
    def public_key(self) -> bytes:
        """Of its signatures, 32 bytes."""
        return self._signer.public_key.public_bytes_raw()

    @property
    def published(self) -> int:
        """Number of the last result that was put while a router was connected."""
        return self._store.published()

    @property
    def last_sequence(self) -> int:
        """Number of its last result."""
        return self._store.last_sequence()

    def open(self) -> bool:
        """Connect; False where no router answers within CONNECT_S."""
        self._publisher.start()
        end = monotonic() + CONNECT_S
        while not self._publisher.state().connected and monotonic() < end:
            sleep(0.01)
        return self._publisher.state().connected

    def step(self, t_utc_ns: int) -> int:
        """Make, store and publish the results of the next round; returns how many.

        A silent gateway leaves the bus when all that it has made is published.
        """
        silent = self.behaviour == "silent" and self._round > WRONG_FROM
        if silent and self.published == self.last_sequence:
            self._publisher.close()
            return 0
        results: list[Result] = []
        for sensor in self._sensors:
            first = self._store.last_sequence() + 1 + len(results)
            results += sensor.results(self._round, t_utc_ns, first)
        records = [self._record(result) for result in results]
        self._store.commit(records)
        for record in records:
            self._publisher.publish(record)
        if self.behaviour == "hostile":
            self._attack(records)
        self._round += 1
        return len(records)

    def close(self) -> None:
        """Leave the bus and close the store."""
        self._publisher.close()
        self._store.close()

    def _record(self, result: Result) -> Record:
        signed = self._signing.signed(result.sequence, result)
        data = signed.data if signed is not None else b""
        return Record.of(result, recorded=True, recording="simulated.mcap", epoch=self._store.epoch, signed=data)

    def _attack(self, records: Sequence[Record]) -> None:
        """What a stranger on the bus may send: to keys of its own and of others, through a session of its own.

        While no router answers, it sends nothing.
        """
        try:
            session = zenoh.open(session_config("client", connect=self._connect))
        except zenoh.ZError:
            return
        with session:
            for key, payload, attachment in self._hostile(records):
                session.put(key, payload, attachment=attachment)

    def _hostile(self, records: Sequence[Record]) -> Iterator[tuple[str, bytes, bytes]]:
        own, victim = f"{PREFIX}/{SITE}/{self.name}", f"{PREFIX}/{SITE}/gw0000"
        yield result_key(own, "s0", "status"), b"\xff\xfe not JSON", b"0"
        yield result_key(own, "s0", "window"), b"[" * 100_000, b"0"
        yield result_key(own, "s0", "calibration"), b"x" * (LARGEST_RESULT + 1), b"0"
        yield result_key(own, "<b>s0", "status"), b"{}", b"not a number"
        yield f"{PREFIX}/{SITE}/<script>alert(1)/s0/status", b'{"sequence": 1, "sensor": "s0"}', b"0"
        for record in records[:1]:  # with the name and the key of another gateway, which did not sign it
            yield result_key(victim, record.sensor, record.what), record.payload, b"0\n" + record.signed


class SimulatedFleet(AbstractContextManager["SimulatedFleet"]):
    """`count` gateways with `sensors` sensors each. `unconnected`: those that found no router.

    `numbers`: which of the gateways are here; default: all. Raises EndpointError, StoreError.
    """

    def __init__(
        self, count: int, sensors: int, seed: int, connect: Sequence[str], data_dir: Path,
        numbers: Sequence[int] | None = None,
    ) -> None:  # fmt: skip
        numbers = range(count) if numbers is None else numbers
        kinds = behaviours(count, seed)
        with ExitStack() as opened:
            self._pool = opened.enter_context(ThreadPoolExecutor(min(AT_ONCE, len(numbers)), "simulated"))
            self.gateways: list[SimulatedGateway] = []
            opened.callback(lambda: list(self._pool.map(SimulatedGateway.close, self.gateways)))
            for k in numbers:
                gateway = SimulatedGateway(f"gw{k:04}", kinds[k], sensors, [seed, 1, k], connect, data_dir)
                self.gateways.append(gateway)
            connected = list(self._pool.map(SimulatedGateway.open, self.gateways))
            self.unconnected = connected.count(False)
            self._opened = opened.pop_all()

    def step(self, t_utc_ns: int, within_s: float = 0.0) -> int:
        """The next round of all gateways, evenly spread over `within_s` from now on; returns how many results.

        `t_utc_ns`: the time of the first gateway's results. Those of the others are as much later as they are made.
        """
        begun_s, apart_s = monotonic(), within_s / len(self.gateways)

        def later(k: int) -> int:
            sleep(max(0.0, begun_s + k * apart_s - monotonic()))
            return t_utc_ns + round(k * apart_s * 1e9)

        # `map` takes the times, and so waits for them, as it hands the gateways to the pool.
        return sum(self._pool.map(SimulatedGateway.step, self.gateways, map(later, range(len(self.gateways)))))

    def names_of(self, behaviour: Behaviour) -> list[str]:
        """The gateways that behave so."""
        return [gateway.name for gateway in self.gateways if gateway.behaviour == behaviour]

    def __exit__(self, *_: object) -> None:
        self._opened.close()
