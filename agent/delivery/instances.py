"""Whether two gateways are on the bus under one name, as after a memory card was copied.

Each run of a gateway declares a liveliness token `<gateway>/alive/<instance>`. The instance is the id of the run,
which is drawn at each start and kept nowhere, so that a copied card, a restored backup and a replaced machine have
their own.
Two of them that are there together for TOGETHER_S are two gateways. A run that was killed, or lost its network, leaves
its token until the router gives the link up, after 10 s by default; a restart is therefore no second gateway, and a
second one counts no more as soon as its token ends. Tokens are not signed.

A router passes tokens on to clients, and not from one peer to another. A gateway is a peer, so it looks with a session
of its own that is a client, for a while at the begin of a run.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Callable

import zenoh

from agent.delivery.keys import presence_key
from agent.delivery.presence import GATEWAYS_MAX
from agent.delivery.session import closed_in_time

TOGETHER_S = 30.0  # s; three times what a router takes to give up a link
INSTANCES_MAX = 8  # of one gateway that are looked at; a stranger may declare tokens for ever
LOOK_S = 1.0  # s between two looks
SPREAD_S = 10.0  # s; gateways that start together begin to look at any time within it
SHOWN = 12  # characters of an instance in a text

_log = logging.getLogger(__name__)


class Instances:
    """Watches the gateways under the key expression `key`. `look` brings `doubled` up to date.

    `doubled`: the instances that are there, the oldest first, of each gateway (`<site>/<gateway>`) with more than one.
    `clock`: a monotonic time in s. `close` before the session ends.
    """

    def __init__(self, session: zenoh.Session, key: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.doubled: dict[str, tuple[str, ...]] = {}
        self._mutex = threading.Lock()
        self._since_s: dict[str, dict[str, float]] = {}  # monotonic time of each instance, by gateway
        self._look_s = 0.0  # monotonic time of the next look
        handler = zenoh.handlers.Callback(self._hear, indirect=False)
        self._subscriber = session.liveliness().declare_subscriber(f"{presence_key(key)}/*", handler, history=True)

    def close(self) -> None:
        """End the subscription."""
        self._subscriber.undeclare()

    def look(self) -> None:
        """Find the gateways that are there twice, at most each LOOK_S; a new one is logged."""
        if (now_s := self._clock()) < self._look_s:
            return
        self._look_s = now_s + LOOK_S
        with self._mutex:
            found = {
                source: tuple(since_s)
                for source, since_s in self._since_s.items()
                if len(since_s) > 1 and now_s - sorted(since_s.values())[1] >= TOGETHER_S
            }
        for source in found.keys() - self.doubled.keys():
            _log.warning("%s", words_of(source, found[source]))
        self.doubled = found

    def _hear(self, token: zenoh.Sample) -> None:
        _, _, site, gateway, _, instance = str(token.key_expr).split("/")
        source = f"{site}/{gateway}"
        with self._mutex:
            since_s = self._since_s.get(source, {})
            if token.kind != zenoh.SampleKind.PUT:
                since_s.pop(instance, None)
            elif len(since_s) < INSTANCES_MAX and (since_s or len(self._since_s) < GATEWAYS_MAX):
                since_s.setdefault(instance, self._clock())
            if since_s:
                self._since_s[source] = since_s
            else:
                self._since_s.pop(source, None)


def watch_own_name(config: zenoh.Config, key: str, stop: threading.Event, tell: Callable[[str], None]) -> None:
    """Look whether another gateway has the name of this one, for TOGETHER_S, and as long as one has.

    For a thread that is started when a router is there. `config`: of a client; `key`: of this gateway. What is found is
    given to `tell`, "" where none is left.
    """
    pause_s = random.uniform(0.0, SPREAD_S)
    while not stop.wait(pause_s):
        try:
            with closed_in_time(zenoh.open(config)) as session:
                watched = Instances(session, f"{key}/**")
                end_s = time.monotonic() + TOGETHER_S + 2 * LOOK_S
                while (watched.doubled or time.monotonic() < end_s) and not stop.wait(LOOK_S):
                    watched.look()
                    tell("".join(words_of(*each) for each in watched.doubled.items()))
                watched.close()
                return
        except zenoh.ZError:
            pause_s = LOOK_S  # the router has gone


def words_of(source: str, instances: tuple[str, ...]) -> str:
    """What is said of a gateway that is there twice."""
    shown = ", ".join(instance[:SHOWN] for instance in instances)
    return (
        f"{len(instances)} gateways are on the bus as {source} (runs {shown}), and their results are mixed: "
        "stop one of them, or give it another name, data directory and key"
    )
