"""A site under TLS with the files in deploy: who can connect, what each may do, and commands from end to end."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import click
import pytest
import zenoh
from click.testing import CliRunner

from agent.cli.command import command
from agent.commanding.arguments import Hold
from agent.commanding.envelope import Order, seal
from agent.commanding.sending import send
from agent.core.events import Command, RunStart
from agent.delivery import instances
from agent.delivery.consumer import Consumer
from agent.delivery.instances import Instances
from agent.delivery.session import session_config
from agent.keys.files import read_signing_key
from agent.recording.reading import RecordingReader
from tests.scenarios.processes import fieldcal, recordings, wait_until
from tests.scenarios.secured_site import GATEWAY, KEY, SecuredSite, commanded_agent, make_keys, router
from tests.unit.zenoh_site import record

SEEN_S = 60.0  # s to wait for a message; it arrives within milliseconds where the machine is not under load


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredSite]:
    directory = tmp_path_factory.mktemp("secured")
    make_keys(directory / "keys")
    with router(directory, directory / "keys") as endpoint:
        yield SecuredSite(directory, endpoint)


def test_with_a_certificate_of_the_site_one_comes_in(site: SecuredSite) -> None:
    with site.session("dashboard") as session:
        assert session.info.routers_zid()


@pytest.mark.parametrize(
    ("who", "logged"),
    [
        ("nobody at all", "peer sent no certificates"),
        ("forged", "invalid peer certificate"),
        ("late", "certificate expired"),
    ],
)
def test_without_a_good_certificate_one_does_not(site: SecuredSite, who: str, logged: str) -> None:
    before = site.router_log.count(logged)
    config = session_config("client", connect=[site.endpoint], tls=site.files(who))
    if who == "nobody at all":
        config.insert_json5("transport/link/tls", json.dumps({"root_ca_certificate": str(site.keys / "ca.pem")}))
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        site.open(config)
    wait_until(lambda: site.router_log.count(logged) > before, SEEN_S, f"a line in the router's log: {logged}")


def test_plain_tcp_is_not_answered(site: SecuredSite) -> None:
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        site.open(session_config("client", connect=[site.endpoint.replace("tls/", "tcp/")]))


def test_we_do_not_talk_to_a_router_of_another_authority_or_name(site: SecuredSite, tmp_path: Path) -> None:
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        site.session("dashboard", ca="stranger")
    with router(tmp_path, site.keys, certificate="elsewhere") as endpoint:
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            site.session("dashboard", endpoint=endpoint)
        wrong = (tmp_path / "router.log").read_text()
        assert "BadCertificate" in wrong or "UnrecognisedName" in wrong or "alert" in wrong


def test_each_puts_only_what_is_theirs(site: SecuredSite) -> None:
    """A later result that arrives shows that the earlier one was refused; the router's log names the refused sender."""
    forged = record(1).payload
    with ExitStack() as stack:
        listener, gateway, *others = (
            stack.enter_context(site.session(name))
            for name in ("dashboard", "workshop.gateway-1", "dashboard", "operator", "nobody", "workshop.gateway-2")
        )
        got: list[bytes] = []
        subscriber = listener.declare_subscriber(
            "fieldcal/v1/**",
            zenoh.handlers.Callback(lambda s: got.append(s.payload.to_bytes()), indirect=False),  # type: ignore[arg-type]
        )

        def arrives(session: zenoh.Session, key: str, payload: bytes) -> bool:
            session.put(key, payload)
            return payload in got

        wait_until(lambda: arrives(gateway, f"{KEY}/mems/window", b"first"), SEEN_S, "the gateway's own result")
        gateway.put("fieldcal/v1/workshop/gateway-2/mems/window", forged)
        for session in others:
            session.put(f"{KEY}/mems/window", forged)
            session.put(f"{KEY}/mems/calibration", forged)
        wait_until(lambda: arrives(gateway, f"{KEY}/mems/window", b"last"), SEEN_S, "the gateway's last result")
        subscriber.undeclare()
    assert forged not in got
    for who in ("dashboard", "operator", "workshop/gateway-2"):
        wait_until(lambda who=who: turned_away(site, who), SEEN_S, f"a line in the router's log on {who}")


def turned_away(site: SecuredSite, who: str) -> bool:
    return any(
        f"CertCommonName({who})" in line and f"is unauthorized to Put (ingress) on {KEY}/mems/window" in line
        for line in site.router_log.splitlines()
    )


def test_nobody_but_the_gateway_answers_for_it(site: SecuredSite) -> None:
    with site.session("workshop.gateway-2") as forger, site.session("operator") as operator:
        forger.declare_queryable(f"{KEY}/*/command/*", zenoh.handlers.RingChannel(3), complete=True)
        own = forger.declare_queryable("fieldcal/v1/workshop/gateway-2/*/command/*", zenoh.handlers.RingChannel(3))

        def reaches() -> bool:
            operator.get("fieldcal/v1/workshop/gateway-2/mems/command/hold", timeout=0.5)
            return own.try_recv() is not None

        wait_until(reaches, SEEN_S, "the forger's own queryable")
        assert list(operator.get(f"{KEY}/mems/command/hold", timeout=0.5)) == []


def doubled(watched: Instances) -> set[str]:
    watched.look()
    return set(watched.doubled)


def test_a_gateway_sees_a_copy_of_itself_and_no_other(site: SecuredSite, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instances, "TOGETHER_S", 0.0)
    monkeypatch.setattr(instances, "LOOK_S", 0.0)
    with site.session(GATEWAY.replace("/", ".")) as copy:
        tokens = [copy.liveliness().declare_token(f"{KEY}/alive/{name}") for name in ("a", "b")]
        for name, key in ((GATEWAY, f"{KEY}/**"), ("dashboard", "fieldcal/v1/**")):
            with site.session(name.replace("/", ".")) as session, closing(Instances(session, key)) as watched:
                wait_until(lambda watched=watched: doubled(watched) == {GATEWAY}, SEEN_S, f"both tokens, by {name}")
        other = "workshop/gateway-2"
        with site.session(other.replace("/", ".")) as session, site.session(other.replace("/", ".")) as again:
            held = [again.liveliness().declare_token(f"fieldcal/v1/{other}/alive/{name}") for name in ("a", "b")]
            # The router answers in the order of the questions: the second one is answered after the first one.
            with (
                closing(Instances(session, f"{KEY}/**")) as watched,
                closing(Instances(session, f"fieldcal/v1/{other}/**")) as own,
            ):
                wait_until(lambda: doubled(own) == {other}, SEEN_S, "the gateway's own tokens")
                assert doubled(watched) == set()
            assert len(held) == 2
        for token in tokens:
            token.undeclare()


@pytest.mark.thorough
def test_commands_from_end_to_end(site: SecuredSite) -> None:
    with commanded_agent(site, "anna") as data_dir:
        signing = ["--key", str(site.keys / "anna.command.key")]
        over = site.options("operator")
        taken = fieldcal("command", "hold", "--sensor", "mems", *signing, *over)
        assert (taken.returncode, taken.stdout, taken.stderr) == (0, "taken: hold of mems\n", "")
        local = fieldcal("command", "pose", "--gravity", "0", "0", "-9.81", "--sensor", "mems", *signing,
                         "--data-dir", data_dir)  # fmt: skip
        assert (local.returncode, local.stderr) == (0, "")
        for arguments, status, said in (
            (
                ["accept", "--sequence", "5", "--sensor", "mems"],
                3,
                "refused: key anna has no right to send accept to mems\n",
            ),
            (["rollback", "--sequence", "5", "--sensor", "mems"], 3, "refused: mems has no calibration with the"),
            (["hold", "--sensor", "other"], 3, "refused: there is no sensor 'other'; the sensors are mems\n"),
            (["pose", "--theta-deg", "100", "--alpha-deg", "0", "--sensor", "mems"], 2, "theta_deg"),
        ):
            found, words = command_line(*arguments, *signing, *over)
            assert (found, said in words) == (status, True), words
        found, words = command_line("hold", "--sensor", "mems", *signing, *site.options("dashboard"))
        assert (found, "nobody answers at" in words) == (1, True), "the router holds it back"
        check_replay_and_flood(site)
        check_consumer(site)
        check_recording(site, data_dir)


def command_line(*arguments: str) -> tuple[int, str]:
    """Run `fieldcal command` in this process; returns its exit status and its output."""
    result = CliRunner().invoke(command, arguments, standalone_mode=False)
    if isinstance(result.exception, click.ClickException):
        return result.exception.exit_code, result.exception.format_message()
    return result.return_value, result.stderr


def check_replay_and_flood(site: SecuredSite) -> None:
    key = read_signing_key(site.keys / "anna.command.key")
    now = time.time_ns()
    body = Order.of(GATEWAY, "mems", "hold", Hold(), now, now + 10**10)
    data = seal(body, key.key_id, key.key)
    asked = ([site.endpoint], site.files("operator"), f"{KEY}/mems/command/hold")
    assert json.loads(send(*asked, data)) == {"taken": True, "reason": ""}
    again = json.loads(send(*asked, data))
    assert not again["taken"]
    assert "counter" in again["reason"]
    with suppress(ConnectionError):
        send(*asked, b"x" * 100_000_000)  # dropped on its way
        raise AssertionError("100 MB were answered")
    assert "4096" in json.loads(send(*asked, b"x" * 100_000))["reason"]


def check_consumer(site: SecuredSite) -> None:
    """The client library receives, over TLS, the status INVALID of the sensor, which has no port."""
    with Consumer([site.endpoint], f"{KEY}/**", tls=site.files("dashboard")) as consumer:
        first = next(iter(consumer))
    assert (first.address.what, first.fields["status"]) == ("status", "INVALID")


def recorded_commands(data_dir: Path) -> list[Command]:
    (path,) = recordings(data_dir)
    return [step.event for step in RecordingReader(path).steps() if isinstance(step.event, Command)]


def check_recording(site: SecuredSite, data_dir: Path) -> None:
    """Accepted and refused commands are in the recording, and no secret is in the data directory."""
    wait_until(lambda: any("too large" in c.refused for c in recorded_commands(data_dir)), SEEN_S, "the last command")
    (path,) = recordings(data_dir)
    events = [step.event for step in RecordingReader(path).steps()]
    commands = recorded_commands(data_dir)
    assert [c.verb for c in commands if not c.refused] == ["hold", "pose", "hold"]
    kinds = [c.refused.split(":")[0] for c in commands if c.refused]
    wanted = ["no right", "out of limits", "no such sensor", "replayed", "too large"]
    # "unsigned": the fixture had asked whether the agent answers.
    assert [kind for kind in kinds if kind != "unsigned"] == wanted
    start = next(event for event in events if isinstance(event, RunStart))
    assert "workshop.gateway-1.key" in start.config_json
    assert b"PRIVATE" not in path.read_bytes()
    assert b"PRIVATE" not in (site.directory / "anna.log").read_bytes()
