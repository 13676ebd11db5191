"""A site under TLS: the router with deploy/zenoh/router.json5, an agent that accepts commands, and keys for all."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh
from click.testing import CliRunner

from agent.cli.keys import keys
from agent.config.tls import TlsFiles
from agent.delivery.session import session_config
from agent.keys.certificates import issue, make_authority
from agent.keys.files import write_new
from tests.scenarios.processes import ROOT, START_S, started, wait_until

READY = ROOT / "deploy" / "zenoh" / "router.json5"
GATEWAY = "workshop/gateway-1"
KEY = f"fieldcal/v1/{GATEWAY}"
OPEN_MS = 2500  # a session opens within milliseconds; a client that is refused waits for this whole time

AGENT = """
[gateway]
site = "workshop"
name = "gateway-1"
[[devices]]
name = "mems"
driver = "serial-csv"
options = {{ port = "{keys}/no-port", rate_hz = 100 }}
[[channels]]
sensor = "mems"
prior = {{}}
[zenoh]
connect = ["{endpoint}"]
[zenoh.tls]
ca = "{keys}/ca.pem"
certificate = "{keys}/workshop.gateway-1.pem"
key = "{keys}/workshop.gateway-1.key"
"""


@dataclass(frozen=True)
class SecuredSite:
    """The directory of the site and the endpoint of its router."""

    directory: Path
    endpoint: str

    @property
    def keys(self) -> Path:
        return self.directory / "keys"

    @property
    def router_log(self) -> str:
        return (self.directory / "router.log").read_text()

    def files(self, name: str, ca: str = "ca") -> TlsFiles:
        return TlsFiles(str(self.keys / f"{ca}.pem"), str(self.keys / f"{name}.pem"), str(self.keys / f"{name}.key"))

    def session(self, name: str, ca: str = "ca", endpoint: str | None = None) -> zenoh.Session:
        """Open a client session with the certificate of `name`. Raises zenoh.ZError where the router refuses it."""
        return self.open(session_config("client", connect=[endpoint or self.endpoint], tls=self.files(name, ca)))

    @staticmethod
    def open(config: zenoh.Config) -> zenoh.Session:
        config.insert_json5("connect/timeout_ms", json.dumps(OPEN_MS))
        return zenoh.open(config)

    def options(self, name: str) -> list[str]:
        """Options with which a command goes over the network with the certificate of `name`."""
        files = self.files(name)
        return ["--connect", self.endpoint, "--gateway", GATEWAY, "--ca", files.ca, "--certificate", files.certificate,
                "--certificate-key", files.key]  # fmt: skip


def make_keys(directory: Path) -> None:
    """Make the keys of a site as docs/security.md says, and keys that the router must not accept."""
    for arguments in (
        ["authority"], ["router", "--host", "localhost", "--host", "127.0.0.1"], ["consumer", "dashboard"],
        ["gateway", "workshop", "gateway-1"], ["gateway", "workshop", "gateway-2"], ["commander", "operator"],
        ["consumer", "nobody"], ["router", "--name", "elsewhere", "--host", "example.org"],
    ):  # fmt: skip
        assert CliRunner().invoke(keys, [*arguments, "--dir", str(directory)], standalone_mode=False).return_value == 0
    now = datetime.now(UTC)
    stranger = make_authority("fieldcal authority", 10, now)
    forged = issue(stranger, GATEWAY, 10, now)
    ours = make_authority("fieldcal authority", 10, now - timedelta(days=5))
    late = issue(ours, GATEWAY, 1, now - timedelta(days=5))
    write_new(directory, {"stranger.pem": stranger.certificate_pem, "late-ca.pem": ours.certificate_pem})
    write_new(directory, {"forged.pem": forged.certificate_pem, "forged.key": forged.key_pem})
    write_new(directory, {"late.pem": late.certificate_pem, "late.key": late.key_pem})
    # Signed by the same authority: only the time of validity is wrong.
    (directory / "ca-and-late.pem").write_bytes((directory / "ca.pem").read_bytes() + ours.certificate_pem)


def router_file(directory: Path, certificate: str = "router", ca: str = "ca-and-late") -> str:
    """The text of deploy/zenoh/router.json5 with a free port of this machine and the keys in `directory`."""
    text = READY.read_text().replace("tls/0.0.0.0:7447", "tls/127.0.0.1:0")
    text = text.replace("/etc/fieldcal/keys/router", f"{directory}/{certificate}")
    return text.replace("/etc/fieldcal/keys/ca.pem", f"{directory}/{ca}.pem")


@contextmanager
def router(directory: Path, keys_dir: Path, certificate: str = "router") -> Iterator[str]:
    """Run `fieldcal router` with this text; yields its endpoint. Its log goes to `directory`/router.log."""
    file, log = directory / "router.json5", directory / "router.log"
    file.write_text(router_file(keys_dir, certificate))
    with ExitStack() as stack:
        with pytest.MonkeyPatch.context() as patch:
            # Zenoh logs what its access control refuses at this level only.
            patch.setenv("RUST_LOG", "warn,zenoh::net::routing::interceptor::access_control=trace")
            process = stack.enter_context(started("router", "--config", file, output=log))
        wait_until(lambda: log.read_text().startswith("router at ") or process.poll() is not None, START_S, "a router")
        yield log.read_text().splitlines()[0].removeprefix("router at ").replace("127.0.0.1", "localhost")


@contextmanager
def commanded_agent(site: SecuredSite, name: str) -> Iterator[Path]:
    """Run `fieldcal run` at the site, which accepts anna's commands; yields its data directory once it is connected."""
    printed = CliRunner().invoke(keys, ["command", name, "--dir", str(site.keys)], standalone_mode=False).stdout
    config, data_dir, log = (site.directory / f"{name}{end}" for end in (".toml", "", ".log"))
    config.write_text(AGENT.format(keys=site.keys, endpoint=site.endpoint) + printed.replace(', "accept"', ""))
    with started("run", config, "--data-dir", data_dir, output=log), site.session("operator") as session:

        def answers() -> bool:
            found = session.get(f"{KEY}/mems/command/hold", target=zenoh.QueryTarget.ALL, timeout=1.0)
            return any(reply.ok is not None for reply in found)

        wait_until(answers, START_S, "an agent that takes commands")
        yield data_dir
