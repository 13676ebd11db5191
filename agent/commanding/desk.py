"""Checks each command that arrives: keeps its counter and puts it among the events, or refuses it with a reason."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from agent.commanding.allowance import RateLimit
from agent.commanding.arguments import VERBS, Accept, Arguments, Rollback, parse_arguments
from agent.commanding.counters import Counters
from agent.commanding.envelope import Order, parse_envelope
from agent.commanding.refusal import Refused
from agent.config.commands import CommandKey, Commands
from agent.config.key_file import KeyFileError
from agent.config.known_keys import WatchedKeys
from agent.core.events import Command
from agent.delivery.keys import CHUNK
from agent.delivery.record import StoredResult
from agent.delivery.schema import StoreError

# s by which a gateway's clock may be off: with NTP it is right within a second, but not soon after a start.
CLOCK_TOLERANCE_S = 30.0
# s that a command may be valid. A command that is valid for longer could be intercepted and sent when it does harm.
LONGEST_VALIDITY_S = 600.0
# Refusals that are recorded: 20 at once, then 0.1 per second, which is 8640 or 3 MB a day. All refusals are counted.
RECORDED_REFUSALS = (20, 0.1)
# Commands that are accepted: 20 at once, then 1 per second. A faulty script with a valid key cannot fill the disk.
TAKEN = (20, 1.0)
LONGEST_REASON = 300  # characters

Find = Callable[[str, str, int], StoredResult | None]


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to the sender of a command: whether it was accepted, and why not."""

    taken: bool
    reason: str = ""

    @property
    def json(self) -> bytes:
        """The answer as JSON, as it is sent."""
        return msgspec.json.encode({"taken": self.taken, "reason": self.reason})


class CommandDesk:
    """Accepts or refuses commands for the gateway `gateway` (`<site>/<gateway>`) and its `sensors`.

    `settings`: the keys and their rights. `data_dir`: where the counters are kept. `find(sensor, what, sequence)` gives
    the result that accept or rollback names, as the store does (agent.delivery.store). `put`: called with each accepted
    command and with each recorded refusal.
    All methods may be called from any thread.
    """

    def __init__(
        self,
        gateway: str,
        sensors: list[str],
        settings: Commands,
        data_dir: Path,
        find: Find,
        put: Callable[[Command], None],
    ) -> None:
        self._gateway = gateway
        self._sensors = frozenset(sensors)
        self._rights = {key.id: key for key in settings.keys}
        self._keys = {key.id: Ed25519PublicKey.from_public_bytes(key.public_bytes) for key in settings.keys}
        self._revoked = WatchedKeys(settings.revoked_keys) if settings.revoked_keys is not None else None
        self._find = find
        self._put = put
        self.counters = Counters(data_dir)
        self._mutex = threading.Lock()
        self._taken = RateLimit(*TAKEN)
        self._recorded = RateLimit(*RECORDED_REFUSALS)
        self._unrecorded = 0
        self._counts: Counter[str] = Counter()
        self._closed = False

    def counts(self) -> dict[str, int]:
        """Number of commands since the start: accepted under "taken", refused under each kind of refusal."""
        with self._mutex:
            return dict(sorted(self._counts.items()))

    def close(self) -> None:
        """Refuse all further commands, since the main loop no longer takes what `put` gives it."""
        with self._mutex:
            self._closed = True

    def receive(self, address: str, data: bytes) -> Answer:
        """Check a command sent to `address` (`<sensor>/command/<verb>`). Returns an answer for any bytes."""
        with self._mutex:
            if self._closed:
                return Answer(False, "the agent is stopping; send the command again after it has started")
            try:
                event = self._check(address, data)
            except Refused as refused:
                self._refuse(address, data, refused)
                return Answer(False, str(refused)[:LONGEST_REASON])
            self._counts["taken"] += 1
            self._put(event)
            return Answer(True)

    def _check(self, address: str, data: bytes) -> Command:
        envelope = parse_envelope(data)
        key = self._keys.get(envelope.key_id)
        if key is None:
            raise Refused("unknown key", f"the gateway's configuration has no key {envelope.key_id} in commands.keys")
        self._check_revoked(key)
        order = envelope.open(key)
        now_utc_ns = time.time_ns()
        self._check_place(order, address)
        self._check_right(order, self._rights[envelope.key_id])
        _check_time(order, now_utc_ns)
        last = self.counters.last(envelope.key_id)
        if order.counter <= last:
            raise Refused("replayed", f"its counter {order.counter} is not above {last}, the last one of this key")
        arguments = parse_arguments(order.verb, bytes(order.arguments))
        kept = self._rollback_calibration(order.sensor, arguments)
        if not self._taken.passes(time.monotonic()):
            raise Refused("too many", "too many commands; wait a few seconds and send it again")
        try:
            self.counters.take(envelope.key_id, order.counter)
        except OSError as error:
            raise Refused("not kept", f"the gateway cannot write its counter: {error.strerror}") from None
        return Command(
            sensor=order.sensor,
            verb=order.verb,
            t_monotonic_ns=time.monotonic_ns(),
            t_utc_ns=now_utc_ns,
            arguments_json=msgspec.json.encode(arguments).decode(),
            calibration_json=kept,
            key_id=envelope.key_id,
            counter=order.counter,
        )

    def _check_place(self, order: Order, address: str) -> None:
        if order.gateway != self._gateway:
            raise Refused("other gateway", f"it is for {order.gateway!r}, but this gateway is {self._gateway!r}")
        if f"{order.sensor}/command/{order.verb}" != address:
            raise Refused("malformed", f"{order.verb} for {order.sensor!r} was sent to {address}")
        if order.sensor not in self._sensors:
            known = ", ".join(sorted(self._sensors))
            raise Refused("no such sensor", f"there is no sensor {order.sensor!r}; the sensors are {known}")

    def _check_revoked(self, key: Ed25519PublicKey) -> None:
        """The list is read again when it changes, so that a key can be revoked while the agent runs."""
        if self._revoked is None:
            return
        try:
            revoked = self._revoked.now().revoked
        except KeyFileError as error:
            raise Refused(
                "revoked key", f"commands are refused while the list of revoked keys is bad: {error}"
            ) from None
        if (reason := revoked.get(key.public_bytes_raw())) is not None:
            raise Refused("revoked key", f"this key is revoked: {reason}")

    def _check_right(self, order: Order, rights: CommandKey) -> None:
        if not rights.may(order.verb, order.sensor):
            raise Refused("no right", f"key {rights.id} has no right to send {order.verb} to {order.sensor}")

    def _rollback_calibration(self, sensor: str, arguments: Arguments) -> str:
        """The calibration that a rollback names, as JSON; "" for other commands.

        Raises Refused where the store does not have the calibration or estimate that the command names.
        """
        if not isinstance(arguments, (Accept, Rollback)):
            return ""
        what = "calibration" if isinstance(arguments, Rollback) else "estimate"
        try:
            found = self._find(sensor, what, arguments.sequence)
        except StoreError as error:
            raise Refused("not kept", str(error)) from None
        if found is None:
            raise Refused("out of limits", f"{sensor} has no {what} with the sequence number {arguments.sequence}")
        return found.payload.decode() if what == "calibration" else ""

    def _refuse(self, address: str, data: bytes, refused: Refused) -> None:
        self._counts[refused.kind] += 1
        sensor, _, verb = address.partition("/command/")
        if not CHUNK.fullmatch(sensor) or verb not in VERBS or not self._recorded.passes(time.monotonic()):
            self._unrecorded += 1
            return
        others = f" ({self._unrecorded} more were refused before this one and not recorded)" if self._unrecorded else ""
        self._unrecorded = 0
        self._put(
            Command(
                sensor=sensor,
                verb=verb,
                t_monotonic_ns=time.monotonic_ns(),
                t_utc_ns=time.time_ns(),
                key_id=_claimed_key(data),
                refused=f"{refused.kind}: {refused}"[:LONGEST_REASON] + others,
            )
        )


def _check_time(order: Order, now_utc_ns: int) -> None:
    left_s = (order.expires_utc_ns - now_utc_ns) * 1e-9
    if left_s < -CLOCK_TOLERANCE_S:
        raise Refused("expired", f"it expired {-left_s:.0f} s ago by this gateway's clock")
    if left_s > LONGEST_VALIDITY_S + CLOCK_TOLERANCE_S:
        raise Refused(
            "expired",
            f"it is valid for {left_s:.0f} s by this gateway's clock; at most {LONGEST_VALIDITY_S:g} s are allowed",
        )

    ahead_s = (order.counter - now_utc_ns) * 1e-9
    if ahead_s > CLOCK_TOLERANCE_S:  # if accepted, no command of this key would be accepted until that time
        raise Refused(
            "expired",
            f"its counter (time of signing) is {ahead_s:.0f} s ahead of this gateway's clock",
        )


def _claimed_key(data: bytes) -> str:
    try:
        return parse_envelope(data).key_id
    except Refused:
        return ""
