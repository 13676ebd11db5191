"""Simulated gateways: messages of many agents, made by the code of the agent from drawn windows to the bus.

Sensors of the same name and behaviour share what happens to them where the numbers of their gateways differ by a
multiple of VARIANTS; identities and numbers of results are their own.
"""

from __future__ import annotations

import hashlib
import sqlite3
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import repeat
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Protocol

import msgspec
import numpy as np
import zenoh

from agent import __version__
from agent.core.events import Result, StatusChange
from agent.delivery.history import FILE_NAME, StoredResult, connect_read_only
from agent.delivery.keys import PREFIX, result_key
from agent.delivery.publication import Publisher
from agent.delivery.received import LARGEST_RESULT
from agent.delivery.session import closed_in_time, session_config
from agent.delivery.store import Store
from agent.fleet.simulated_sensor import BEGINS, RUN_ID, VARIANTS, Behaviour, SimulatedSensor, Story
from agent.recording.result_signing import ResultSigner
from agent.recording.signing import Signer
from agent.supervision.health import GatewayStatus, PublicationHealth, RecordingHealth, SensorHealth

SITE = "simulated"
# In this order where there are too few gateways for all.
ODD: tuple[Behaviour, ...] = ("drifting", "held", "silent", "hostile", "stepped", "leaning", "dying", "cloned")
OF_GATEWAY: tuple[Behaviour, ...] = ("silent", "cloned")  # its sensors are sound
ONE_ODD_IN = 5  # gateways; at least one of each kind where there are enough
AT_ONCE = 32  # gateways that open, or commit, at the same time
POLL_S = 1.0  # s between two looks for a router; each look of each gateway costs time of the same process
CONNECT_S = 10.0  # s to wait for one gateway's connection
CLOSE_S = 10.0  # s to wait for one gateway's end
BEHIND_S = 60.0  # a gateway whose time is so far behind this machine's tells that it catches up


def behaviours(count: int, seed: int) -> list[Behaviour]:
    """The behaviour of each gateway, drawn by `seed`."""
    odd = min(max(count // ONE_ODD_IN, len(ODD)), count)
    chosen: list[Behaviour] = ["sound"] * count
    for k, place in enumerate(np.random.default_rng([seed, 0]).permutation(count)[:odd]):
        chosen[place] = ODD[k % len(ODD)]
    return chosen


NOTHING = SensorHealth(status="", reason="", windows_used=0, windows_refused=0, calibrations=0)
NO_RECORDING = RecordingHealth(active=False, file="", size_bytes=0, fault="")


class StopEvent(Protocol):
    """The part of an event of threads or processes that is used here."""

    def is_set(self) -> bool: ...
    def wait(self, timeout: float | None = None) -> bool: ...


NEVER: StopEvent = threading.Event()


class Stories:
    """What happens to the sensors of a fleet, of which several may share a story."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._known: dict[tuple[str, Behaviour, int], Story] = {}

    def sensors(self, number: int, behaviour: Behaviour, count: int) -> list[SimulatedSensor]:
        """The sensors of gateway `number`. Only the first one has the behaviour, so that the page has both kinds."""
        odd: Behaviour = "sound" if behaviour in OF_GATEWAY else behaviour
        return [
            self._sensor(f"s{k}", odd if k == 0 else "sound", number, f"S{100 * number + k:06}") for k in range(count)
        ]

    def of_twin(self, number: int, count: int) -> list[SimulatedSensor]:
        """The sensors of the twin of gateway `number`, whose stories begin when the twin does."""
        return [self._sensor(f"s{k}", "sound", number, f"T{100 * number + k:06}", VARIANTS) for k in range(count)]

    def _sensor(
        self, name: str, behaviour: Behaviour, number: int, serial_number: str, of_twins: int = 0
    ) -> SimulatedSensor:
        variant = number % VARIANTS + of_twins
        seed = [self._seed, 2, variant, *name.encode(), *behaviour.encode()]
        story = self._known.setdefault((name, behaviour, variant), Story(name, behaviour, seed))
        return SimulatedSensor(story, serial_number)


@dataclass(frozen=True)
class FleetPlan:
    """So many gateways with so many `sensors` each, the routers, and the directory of the stores."""

    gateways: int
    sensors: int
    seed: int
    connect: Sequence[str]
    data_dir: Path


class SimulatedGateway:
    """One gateway with a store, a signing key and a Zenoh client of its own."""

    def __init__(
        self, plan: FleetPlan, number: int, behaviour: Behaviour, sensors: Sequence[SimulatedSensor],
        twin: Sequence[SimulatedSensor] = (),
    ) -> None:  # fmt: skip
        """`twin`: the sensors of another gateway that has the same name, key and store from BEGINS["cloned"] on, as
        after a copy of the whole SD card. Raises EndpointError, StoreError."""
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        self.name = name = f"gw{number:04}"
        self.behaviour, self._plan, self._number, data_dir = behaviour, plan, number, plan.data_dir
        # Protects nothing: anyone can make it.
        secret = hashlib.sha256(f"simulated {[plan.seed, 1, number]}".encode()).digest()
        self._signer = Signer(Ed25519PrivateKey.from_private_bytes(secret))
        (data_dir / name).mkdir(parents=True, exist_ok=True)
        self._store = Store(data_dir / name)
        self._signing = ResultSigner(self._store.epoch, self._signer)
        self._signing.gateway = self.source
        self._publisher = Publisher(SITE, name, plan.connect, self._store, mode="client", poll_s=POLL_S)
        self._sensors, self._of_twin = sensors, twin
        self._twin: SimulatedGateway | None = None
        self._health = dict.fromkeys((sensor.name for sensor in sensors), NOTHING)
        self._begun = monotonic()
        self._round = 0
        self._since_utc_ns: int | None = None

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
        """Number of the last result that a router has taken."""
        return self._store.published()

    @property
    def last_sequence(self) -> int:
        """Number of its last result."""
        return self._store.last_sequence()

    def open(self, stop: StopEvent) -> bool:
        """Connect; False where no router answers within CONNECT_S."""
        self._publisher.start()
        end = monotonic() + CONNECT_S
        while not self._publisher.state().connected and monotonic() < end and not stop.is_set():
            sleep(0.01)
        return self._publisher.state().connected

    def step(self, t_utc_ns: int, stop: StopEvent) -> int:
        """Make, store and publish the results of the next round; returns how many, 0 where it is to stop.

        A silent gateway leaves the bus when all that it has made is published.
        """
        if stop.is_set():
            return 0
        begun = self.behaviour in OF_GATEWAY and self._round >= BEGINS[self.behaviour]
        if begun and self._since_utc_ns is None:
            self._since_utc_ns = t_utc_ns
        if begun and self.behaviour == "silent":
            if self.published == self.last_sequence:
                self._publisher.close(CLOSE_S)
            return 0
        if begun and self._twin is None and self._of_twin:
            self._twin = self._cloned(stop)
        if self._twin is not None:
            self._twin.step(t_utc_ns, stop)
        results = self._results(t_utc_ns)
        self._round += 1
        records = [self._record(result) for result in results]
        self._store.commit(records)
        for record in records:
            self._publisher.publish(record)
        self._tell(t_utc_ns, results)
        if self.behaviour == "hostile":
            self._attack(records)
        return len(records)

    def _results(self, t_utc_ns: int) -> list[Result]:
        """The results of all sensors in this round."""
        results: list[Result] = []
        for sensor in self._sensors:
            first = self._store.last_sequence() + 1 + len(results)
            results += sensor.results(self._round, t_utc_ns, first)
        return results

    def truth(self) -> dict[str, Any]:
        """What is true of the gateway and its sensors now, for comparison with what is said of them."""
        of_gateway = self.behaviour in OF_GATEWAY
        return {
            "site": SITE, "gateway": self.name, "behaviour": self.behaviour if of_gateway else "sound",
            "begun": self._since_utc_ns is not None, "since_utc_ns": self._since_utc_ns,
            "sensors": [sensor.truth() for sensor in self._sensors],
            "sensors_of_twin": [] if self._twin is None else [sensor.truth() for sensor in self._of_twin],
        }  # fmt: skip

    def close(self) -> None:
        """Leave the bus and close the store."""
        if self._twin is not None:
            self._twin.close()
        self._publisher.close(CLOSE_S)
        self._store.close()

    def _cloned(self, stop: StopEvent) -> SimulatedGateway:
        """Another gateway with a copy of all that this one has, but for its sensors."""
        directory = self._plan.data_dir / f"{self.name}-twin"
        (directory / self.name).mkdir(parents=True)
        with (
            closing(connect_read_only(self._plan.data_dir / self.name / FILE_NAME)) as read,
            closing(sqlite3.connect(directory / self.name / FILE_NAME)) as write,
        ):
            read.backup(write)
        twin = SimulatedGateway(replace(self._plan, data_dir=directory), self._number, "sound", self._of_twin)
        twin.open(stop)
        return twin

    def _tell(self, t_utc_ns: int, results: Sequence[Result]) -> None:
        """Publish the gateway's status, which says how far its time is behind."""
        for result in results:
            if isinstance(result, StatusChange):
                self._health[result.sensor] = msgspec.structs.replace(
                    self._health[result.sensor], status=result.status, reason=result.reason)  # fmt: skip
        connected = self._publisher.state().connected
        status = GatewayStatus(
            site=SITE, gateway=self.name, version=__version__, run_id=RUN_ID, t_utc_ns=t_utc_ns,
            uptime_s=monotonic() - self._begun, state="running", reasons=[], advice=[], devices={},
            sensors=self._health, queues={}, recording=NO_RECORDING, disk_free_bytes=None, process=None,
            publication=PublicationHealth(enabled=True, connected=connected, unpublished=None, fault=""),
        )  # fmt: skip
        told = msgspec.structs.asdict(status)
        behind_s = time.time() - 1e-9 * t_utc_ns
        if behind_s > BEHIND_S:
            at = datetime.fromtimestamp(t_utc_ns * 1e-9, UTC)
            reason = f"simulated time {at:%Y-%m-%d %H:%M} UTC is {behind_s / 86400:.3g} days behind and runs faster"
            told |= {"state": "catching up", "reasons": [reason]}
        self._publisher.tell_status(msgspec.json.encode(told))

    def _record(self, result: Result) -> StoredResult:
        signed = self._signing.signed(result.sequence, result)
        data = signed.data if signed is not None else b""
        return StoredResult.of(result, recorded=True, recording="simulated.mcap", epoch=self._store.epoch, signed=data)

    def _attack(self, records: Sequence[StoredResult]) -> None:
        """What a stranger on the bus may send: to keys of its own and of others, through a session of its own.

        While no router answers, it sends nothing.
        """
        try:
            session = zenoh.open(session_config("client", connect=self._plan.connect))
        except zenoh.ZError:
            return
        with closed_in_time(session):
            for key, payload, attachment in self._hostile(records):
                session.put(key, payload, attachment=attachment)

    def _hostile(self, records: Sequence[StoredResult]) -> Iterator[tuple[str, bytes, bytes]]:
        own, victim = f"{PREFIX}/{SITE}/{self.name}", f"{PREFIX}/{SITE}/gw0000"
        yield result_key(own, "s0", "status"), b"\xff\xfe not JSON", b"0"
        yield result_key(own, "s0", "window"), b"[" * 100_000, b"0"
        yield result_key(own, "s0", "calibration"), b"x" * (LARGEST_RESULT + 1), b"0"
        yield result_key(own, "<b>s0", "status"), b"{}", b"not a number"
        yield f"{PREFIX}/{SITE}/<script>alert(1)/s0/status", b'{"sequence": 1, "sensor": "s0"}', b"0"
        for record in records[:1]:  # with the name and the key of another gateway, which did not sign it
            yield result_key(victim, record.sensor, record.what), record.payload, b"0\n" + record.signed


class SimulatedFleet(AbstractContextManager["SimulatedFleet"]):
    """Gateways as planned. `unconnected`: the number of those that found no router.

    `numbers`: which of the gateways are here; default: all. `stop`: once it is set, what is going on ends soon.
    Raises EndpointError, StoreError.
    """

    def __init__(self, plan: FleetPlan, numbers: Sequence[int] | None = None, stop: StopEvent = NEVER) -> None:
        self._stop = stop
        numbers = range(plan.gateways) if numbers is None else numbers
        kinds, stories = behaviours(plan.gateways, plan.seed), Stories(plan.seed)
        with ExitStack() as opened:
            self._pool = opened.enter_context(ThreadPoolExecutor(min(AT_ONCE, len(numbers)), "simulated"))
            self.gateways: list[SimulatedGateway] = []
            opened.callback(lambda: list(self._pool.map(SimulatedGateway.close, self.gateways)))
            for k in numbers if not stop.is_set() else ():
                sensors = stories.sensors(k, kinds[k], plan.sensors)
                twin = stories.of_twin(k, plan.sensors) if kinds[k] == "cloned" else ()
                self.gateways.append(SimulatedGateway(plan, k, kinds[k], sensors, twin))
            connected = list(self._pool.map(SimulatedGateway.open, self.gateways, repeat(stop)))
            self.unconnected = connected.count(False)
            self._opened = opened.pop_all()

    def step(self, t_utc_ns: int, within_s: float = 0.0) -> int:
        """The next round of all gateways, evenly spread over `within_s` from now on; returns how many results.

        `t_utc_ns`: the time of the first gateway's results. Those of the others are as much later as they are made.
        """
        begun_s, apart_s = monotonic(), within_s / len(self.gateways)

        def later(k: int) -> int:
            self._stop.wait(max(0.0, begun_s + k * apart_s - monotonic()))
            return t_utc_ns + round(k * apart_s * 1e9)

        # `map` takes the times, and so waits for them, as it hands the gateways to the pool.
        times = map(later, range(len(self.gateways)))
        return sum(self._pool.map(SimulatedGateway.step, self.gateways, times, repeat(self._stop)))

    def names_of(self, behaviour: Behaviour) -> list[str]:
        """The gateways that behave so."""
        return [gateway.name for gateway in self.gateways if gateway.behaviour == behaviour]

    def __exit__(self, *_: object) -> None:
        self._opened.close()
