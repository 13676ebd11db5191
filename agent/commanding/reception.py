"""All ways by which commands reach an agent: the local socket and Zenoh, both leading to the CommandDesk."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import zenoh

from agent.commanding.desk import CommandDesk, Find
from agent.commanding.local import LocalDoor
from agent.commanding.network import serve_queries
from agent.config import Config
from agent.core.events import Command
from agent.delivery.keys import gateway_key

_log = logging.getLogger(__name__)


class Reception:
    """Accepts commands from construction to `close`. `put` is called with every command, accepted or refused.

    Where the local socket cannot be opened a warning is logged, and commands come over Zenoh only.
    """

    def __init__(self, config: Config, data_dir: Path, find: Find, put: Callable[[Command], None]) -> None:
        gateway = config.gateway
        name = f"{gateway.site}/{gateway.name}"
        self._key = gateway_key(gateway.site, gateway.name)
        sensors = [channel.sensor for channel in config.channels]
        self.desk = CommandDesk(name, sensors, config.commands, data_dir, find, put)
        if self.desk.counters.set_aside:
            _log.warning(
                "the file of command counters was unreadable and is kept as %s; commands signed before now are refused",
                self.desk.counters.set_aside,
            )
        self._open = ExitStack()
        try:
            self._open.enter_context(LocalDoor(data_dir, name, self.desk))
        except OSError as error:
            _log.warning("commands cannot be sent on the gateway itself, its socket cannot be opened: %s", error)

    def serve(self, session: zenoh.Session, open_things: ExitStack) -> None:
        """Accept commands from a Zenoh session too. Closing `open_things` ends this."""
        serve_queries(session, self._key, self.desk, open_things)

    def close(self) -> None:
        """Accept no more commands."""
        self.desk.close()
        self._open.close()
