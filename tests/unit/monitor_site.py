"""The web server of the monitor within the test, and as a process of its own."""

from __future__ import annotations

import http.client
import json
import resource
import signal
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from agent.monitor.database import Database
from agent.monitor.engines import Sqlite
from agent.monitor.fleet import Fleet
from agent.monitor.following import Following
from agent.monitor.forwarding import Forwarding
from agent.monitor.live import Live
from agent.monitor.login import Access
from agent.monitor.notices import NoticeSender
from agent.monitor.plan import Plans
from agent.monitor.running import Web, web_server
from agent.monitor.server import PageData, application
from agent.monitor.settings import FloorPlan
from agent.monitor.site_watching import SiteWatching
from tests.unit.zenoh_site import Site, wait_for

STARTS_S = 60.0


class Answer:
    """An answer of the server. Header names are in lower case."""

    def __init__(self, answer: http.client.HTTPResponse) -> None:
        self.status = answer.status
        self.headers = {name.lower(): value for name, value in answer.getheaders()}
        self.text = answer.read().decode(errors="replace")

    @property
    def json(self) -> Any:
        return json.loads(self.text)


class Served(AbstractContextManager["Served"]):
    """The server in a thread, on a free port of loopback, with a fleet that the test fills.

    `keys`: known keys; `users`: who may log in; `plan`: that of the configuration; `behind_proxy`: on loopback;
    `more`: of the application.
    """

    def __init__(
        self, site: Site, directory: Path, keys: Path | None = None, users: Path | None = None,
        plan: FloorPlan | None = None, *, behind_proxy: bool = False, names: Sequence[str] = (),
        notifier: NoticeSender | None = None,
    ) -> None:  # fmt: skip
        self._open = ExitStack()
        directory.mkdir(exist_ok=True)
        engine = Sqlite(directory / "monitor.sqlite")
        self.database = self._open.enter_context(closing(Database(engine)))
        self.fleet = Fleet()
        self.following = Following([site.endpoint], None, self.database, self.fleet, keys)
        self._open.callback(self._end_following)
        access = Access(users)
        forwarding = Forwarding([site.endpoint], None, access, self.fleet)
        stopping = threading.Event()
        self.live = Live([site.endpoint], None, stopping)
        plans = Plans(engine, access, plan)
        self.watching = SiteWatching(self.database, self.fleet)
        data = PageData(self.database, self.fleet, self.following, stopping, self.watching, notifier)
        app = application(data, access, forwarding, self.live, plans, names)
        listening = self._open.enter_context(closing(socket.create_server(("127.0.0.1", 0))))
        self.address = f"127.0.0.1:{listening.getsockname()[1]}"
        web = Web(names=(), users=users, certificate=None, key=None, behind_proxy=behind_proxy)
        server, bounded = web_server(app, listening, web, stopping)
        thread = threading.Thread(target=server.run, args=([bounded],), daemon=True)
        thread.start()

        def stop() -> None:
            stopping.set()
            server.should_exit = True
            thread.join(5)

        self._open.callback(stop)
        wait_for(lambda: server.started)

    def _end_following(self) -> None:
        assert self.following.close(30.0), "a thread is still in Zenoh"

    def ask(
        self, path: str, method: str = "GET", body: bytes | str = b"", headers: Mapping[str, str] | None = None
    ) -> Answer:
        """One request, with the path exactly as it is given."""
        with closing(http.client.HTTPConnection(self.address, timeout=60)) as connection:
            given = {name.lower(): value for name, value in (headers or {}).items()}
            connection.putrequest(method, path, skip_host="host" in given, skip_accept_encoding=True)
            data = body.encode() if isinstance(body, str) else body
            for name, value in ({"content-length": str(len(data))} | given).items():
                connection.putheader(name, value)
            connection.endheaders(data)
            return Answer(connection.getresponse())

    def __exit__(self, *_: object) -> None:
        self._open.close()


class Monitor:
    """`fieldcal monitor` in a process of its own. `ca`: the authority of its certificate, where it serves HTTPS.

    `files`: how many it may have open.
    """

    def __init__(
        self, endpoint: str, directory: Path, *options: str, address: str = "", ca: Path | None = None, files: int = 0
    ) -> None:
        with closing(socket.socket()) as free:
            free.bind(("127.0.0.1", 0))
            self.address = address or f"127.0.0.1:{free.getsockname()[1]}"
        self.tls = ssl.create_default_context(cafile=ca) if ca is not None else None
        self.url = f"http{'s' if ca is not None else ''}://{self.address}"
        given = ["--connect", endpoint, "--listen", self.address, "--data-dir", str(directory), *options]
        limit = ["prlimit", f"--nofile={files}"] if files else []
        command = [*limit, sys.executable, "-m", "agent", "monitor", *given]
        self._process = subprocess.Popen(command, stderr=subprocess.PIPE)
        try:
            wait_for(self._answers, STARTS_S)
        except AssertionError:
            self._process.kill()
            raise

    def _answers(self) -> bool:
        try:
            self.get("")
        except OSError:
            return False
        return True

    def get(self, path: str) -> Any:
        with urlopen(f"{self.url}/{path}", timeout=60, context=self.tls) as answer:
            assert answer.headers["Content-Security-Policy"].startswith("default-src 'self'")
            text = answer.read().decode()
        return json.loads(text) if path.startswith("api") else text

    def sensors(self) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = self.get("api/fleet")["sensors"]
        return rows

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the process."""
        self._process.send_signal(number)

    def kill(self) -> None:
        """Kill -9."""
        self._process.kill()
        self._process.communicate()

    def stop(self, number: signal.Signals = signal.SIGINT) -> str:
        """Ctrl-C, or another signal; returns the log. Fails where the program does not end well."""
        self._process.send_signal(number)
        said = self._process.communicate(timeout=60)[1].decode()
        assert (self._process.returncode, "Traceback" in said, "FATAL" in said) == (0, False, False), said
        return said


@contextmanager
def many(address: str, count: int) -> Iterator[list[socket.socket]]:
    """So many connections to a server, which send nothing."""
    host, port = address.split(":")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 8192), hard))
    with ExitStack() as opened:
        yield [opened.enter_context(socket.create_connection((host, int(port)), 10)) for _ in range(count)]
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
