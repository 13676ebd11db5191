"""Notices of the monitor: what is told and when, webhooks and mails through real sockets, and what they refuse."""

from __future__ import annotations

import json
import re
import smtplib
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from email import message_from_bytes
from email.utils import parsedate_to_datetime
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from urllib.error import URLError

import pytest

from agent.config.reading import ConfigError
from agent.keys.certificates import make_authority
from agent.monitor import notices as notices_module
from agent.monitor.fleet import Fleet
from agent.monitor.messages import Notice, fault_of, mail, message_of, post
from agent.monitor.notices import FleetWatch, NoticeSender
from agent.monitor.settings import Email, Notices, load_settings
from tests.unit.zenoh_site import wait_for

NOW = datetime(2026, 1, 1, tzinfo=UTC)
PLACE = ("site", "gw", "mems")
BAD = Notice("status", "site/gw/mems", "HELD: x\r\nBcc: all@example.org\r\n\r\nbody")


def held(reason: str = "the window contradicts") -> dict[str, object]:
    return {"status": "HELD", "reason": reason, "t_utc_ns": 1}


class Hook:
    """A web server that takes POST requests. `answers`: the status of each, the last for all others."""

    def __init__(self, *answers: int) -> None:
        self.taken: list[bytes] = []
        self.visited: list[str] = []
        hook = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                hook.taken.append(self.rfile.read(int(self.headers["Content-Length"])))
                self.send_response(answers[min(len(hook.taken), len(answers)) - 1])
                self.send_header("Location", "/elsewhere")
                self.end_headers()

            def do_GET(self) -> None:
                hook.visited.append(self.path)

            def log_message(self, *_: object) -> None:
                pass

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.server.server_port}/hook"


@contextmanager
def hooked(*answers: int) -> Iterator[Hook]:
    hook = Hook(*answers)
    yield hook
    hook.server.shutdown()
    hook.server.server_close()


def test_verdicts_and_states_are_told_once_and_old_ones_not() -> None:
    fleet = Fleet()
    fleet.take(*PLACE, "status", held(), fresh=False)  # of the database, when the monitor starts
    watch = FleetWatch(fleet, Notices(), [])
    assert watch.update(0.0, NOW) == []
    fleet.take(*PLACE, "status", held())
    fleet.take(*PLACE, "status", {"status": "VALID", "reason": "", "t_utc_ns": 1})
    drift = {"parameter": "Sxx", "verdict": "stepped", "reason": "a step", "change": 1.0, "t_utc_ns": 1}
    fleet.take(*PLACE, "drift", drift)
    fleet.take(*PLACE, "drift", drift | {"verdict": "stable"})
    assert [notice.line for notice in watch.update(1.0, NOW)] == [
        "site/gw/mems: HELD: the window contradicts", "site/gw/mems: Sxx stepped: a step"]  # fmt: skip
    assert watch.update(2.0, NOW) == []


def test_a_name_of_two_gateways_is_told_once_as_long_as_there_are_two() -> None:
    fleet = Fleet()
    watch = FleetWatch(fleet, Notices(), [])
    fleet.set_alive("site", "gw", True)
    told = []
    for k, runs in enumerate((["a", "b"], ["a", "b"], ["a", "b"], [], ["a", "b"])):
        fleet.set_doubled({"site/gw": runs} if runs else {}, {})
        told.append([n.line for n in watch.update(float(k), NOW)])
    both = ["site/gw: more than one gateway is on the bus under this name"]
    assert told == [both, [], [], [], both]


def test_a_silent_gateway_is_told_once_and_again_when_it_is_back() -> None:
    fleet = Fleet()
    watch = FleetWatch(fleet, Notices(silent_s=600), [])
    fleet.take(*PLACE, "status", held(), fresh=False)
    for k in range(50):
        fleet.set_alive("site", f"invented{k}", True)
        fleet.set_alive("site", f"invented{k}", False)
    fleet.set_alive("site", "gw", True)
    assert watch.update(0.0, NOW) == []
    fleet.set_alive("site", "gw", False)
    told = [watch.update(t, NOW) for t in (100.0, 699.0, 700.0, 5000.0)]
    assert [[n.line for n in each] for each in told] == [
        [], [], ["site/gw: the gateway has not been on the bus for 600 s"], []]  # fmt: skip
    fleet.set_alive("site", "gw", True)
    assert [n.text for n in watch.update(5001.0, NOW)] == ["the gateway is on the bus again"]


def test_nobody_is_told_of_what_was_taken_down(tmp_path: Path) -> None:
    path = tmp_path / "monitor.toml"
    path.write_text('[fleet]\nretired = ["site/gw", "site/other/mems"]\n')
    fleet = Fleet(retired=load_settings(path).fleet.retired)
    watch = FleetWatch(fleet, Notices(silent_s=600), [])
    for gateway in ("gw", "other"):
        fleet.take("site", gateway, "mems", "status", held(), fresh=False)
    told = [watch.update(t, NOW) for t in (0.0, 700.0)]
    assert [[n.subject for n in each] for each in told] == [[], ["site/other"]]
    path.write_text('[fleet]\nretired = ["site", "a/b/c/d"]\n')
    with pytest.raises(ConfigError, match=r"retired.*a gateway is SITE/GATEWAY"):
        load_settings(path)


def test_a_certificate_that_ends_is_told_each_week(tmp_path: Path) -> None:
    path = tmp_path / "fleet.pem"
    path.write_bytes(make_authority("fleet", 40, NOW).certificate_pem)
    watch = FleetWatch(Fleet(), Notices(certificate_days=30), [path, tmp_path / "none.pem"])
    texts = [
        [n.text for n in watch.update(86400.0 * day, NOW + timedelta(days=day))] for day in (0, 9, 11, 12, 17, 18, 41)
    ]
    ends = "the certificate ends on 2026-02-10 00:00 UTC"
    assert texts == [[], [], [ends], [], [], [ends], [ends.replace("ends", "ended")]]


def test_a_webhook_gets_json_and_no_redirection_is_followed() -> None:
    with hooked(200, 307, 302, 500) as hook:
        post(hook.url, [BAD] * 60)
        told = json.loads(hook.taken[0])
        assert len(told["notices"]) == 50
        assert told["text"].splitlines()[-1] == "and 10 more"
        assert told["notices"][0]["subject"] == "site/gw/mems"
        for answer in (307, 302, 500):
            with pytest.raises(OSError, match=f"answers {answer}"):
                post(hook.url, [BAD])
        assert hook.visited == []
        assert len(hook.taken) == 4


def test_what_could_not_be_sent_is_sent_with_the_next_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notices_module, "LOOK_S", 0.01)
    monkeypatch.setattr(notices_module, "APART_S", 0.05)
    fleet = Fleet()
    with hooked(500, 200) as hook:
        settings = Notices(webhooks=(hook.url,))
        notifier = NoticeSender(FleetWatch(fleet, settings, []), settings)
        fleet.take(*PLACE, "status", held("first"))
        wait_for(lambda: len(hook.taken) == 2 and notifier.fault == "")
        fleet.take(*PLACE, "status", held("second"))
        wait_for(lambda: len(hook.taken) == 3)
        notifier.close()
    texts = [json.loads(taken)["text"] for taken in hook.taken]
    assert texts == [*["site/gw/mems: HELD: first"] * 2, "site/gw/mems: HELD: second"]


def serve_badly(listening: socket.socket, answers: list[bytes], ended: threading.Event) -> None:
    """Answer the first requests with these bytes, and the next one never."""
    held = []
    while not ended.is_set():
        connection, _ = listening.accept()
        connection.recv(1 << 16)
        if answers:
            connection.sendall(answers.pop(0))
            connection.close()
        else:
            held.append(connection)


def test_a_server_that_answers_badly_or_never_delays_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """An answer that is no HTTP once ended the thread, and nobody was told of anything any more."""
    monkeypatch.setattr(notices_module, "LOOK_S", 0.01)
    monkeypatch.setattr(notices_module, "APART_S", 0.05)
    monkeypatch.setattr(notices_module, "LATE_S", 0.3)
    fleet, ended = Fleet(), threading.Event()
    with hooked(200) as good, socket.create_server(("127.0.0.1", 0)) as listening:
        bad = threading.Thread(target=serve_badly, args=(listening, [b"what?\r\n\r\n"], ended), daemon=True)
        bad.start()
        settings = Notices(webhooks=(f"http://127.0.0.1:{listening.getsockname()[1]}/", good.url))
        notifier = NoticeSender(FleetWatch(fleet, settings, []), settings)
        fleet.take(*PLACE, "status", held("first"))
        wait_for(lambda: len(good.taken) == 1)
        wait_for(lambda: "the server has not come to an end" in notifier.fault)
        fleet.take(*PLACE, "status", held("second"))
        wait_for(lambda: len(good.taken) == 2)
        ended.set()
        notifier.close()
    assert json.loads(good.taken[1])["text"] == "site/gw/mems: HELD: second"


def serve_mail(listening: socket.socket, taken: list[bytes], unknown: bytes = b"nobody") -> None:
    """One session of a mail server that takes everything, but for one user."""
    connection, _ = listening.accept()
    with connection, connection.makefile("rb") as lines:
        connection.sendall(b"220 test\r\n")
        for line in lines:
            if line.upper().startswith(b"DATA"):
                connection.sendall(b"354 go on\r\n")
                while (part := lines.readline()) != b".\r\n":
                    taken.append(part)
            answer = b"550 no such user" if line.startswith(b"rcpt TO:<" + unknown) else b"250 ok"
            connection.sendall((b"221 bye" if line.upper().startswith(b"QUIT") else answer) + b"\r\n")


@contextmanager
def mail_server(sessions: int = 1) -> Iterator[tuple[Callable[..., Email], list[bytes]]]:
    """A mail server. Yields what makes its settings for recipients, and the lines that it has taken."""
    taken: list[bytes] = []

    def serve() -> None:
        for _ in range(sessions):
            serve_mail(listening, taken)

    with socket.create_server(("127.0.0.1", 0)) as listening:
        port, server = listening.getsockname()[1], threading.Thread(target=serve, daemon=True)
        server.start()
        yield lambda *recipients: Email(host="127.0.0.1", port=port, security="none",
                                        sender="fieldcal@example.org", recipients=recipients), taken  # fmt: skip
        server.join(5)


def test_a_mail_has_the_texts_of_the_bus_in_its_body_alone() -> None:
    before = datetime.now(UTC).replace(microsecond=0)
    with mail_server() as (email, taken):
        mail(email("a@example.org", "b@example.org"), [BAD, BAD])
    message = message_from_bytes(b"".join(taken))
    assert {name.lower() for name in message.keys()} == {  # noqa: SIM118 - a message gives no names by iteration
        "subject", "from", "to", "date", "message-id", "auto-submitted", "content-type", "content-transfer-encoding",
        "mime-version"}  # fmt: skip
    assert before <= parsedate_to_datetime(message["Date"]) <= datetime.now(UTC)
    assert re.fullmatch(r"<[^@\s]+@example\.org>", message["Message-ID"])
    assert message["Subject"] == "fieldcal: 2 notices, status of site/gw/mems"
    assert message["To"] == "a@example.org, b@example.org"
    body = message.get_payload(decode=True)
    assert isinstance(body, bytes)
    assert (
        body.decode().splitlines()
        == ["site/gw/mems: HELD: x\ufffd\ufffdBcc: all@example.org\ufffd\ufffd\ufffd\ufffdbody"] * 2
    )
    named = message_of(email("a@example.org"), [Notice("status", "a\r\nBcc: all@example.org", "")])
    assert named["Subject"] == "fieldcal: 1 notice, status of a\ufffd\ufffdBcc: all@example.org"
    assert "bcc" not in named


def test_a_recipient_that_is_refused_is_told_and_the_others_get_a_mail_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(notices_module, "LOOK_S", 0.01)
    monkeypatch.setattr(notices_module, "APART_S", 0.05)
    fleet = Fleet()
    with mail_server(2) as (email, taken):
        settings = Notices(email=email("a@example.org", "nobody@example.org"))
        notifier = NoticeSender(FleetWatch(fleet, settings, []), settings)
        fleet.take(*PLACE, "status", held("first"))
        wait_for(lambda: notifier.fault != "")
        assert notifier.fault.startswith("a notice could not be sent: mail server 127.0.0.1:")
        assert notifier.fault.endswith("others have it: nobody@example.org (550 no such user)")
        fleet.take(*PLACE, "status", held("second"))
        wait_for(lambda: len([line for line in taken if b"HELD" in line]) > 1)
        notifier.close()
    assert [line.split()[-1] for line in taken if b"HELD" in line] == [b"first", b"second"]


def test_a_mail_that_nobody_gets_is_a_fault() -> None:
    with (
        mail_server() as (email, _),
        pytest.raises(OSError, match=r"no recipient is accepted: nobody@example\.org \(550 no such user\)"),
    ):
        mail(email("nobody@example.org"), [BAD])


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (smtplib.SMTPAuthenticationError(535, b"5.7.8 no\r\nway"), "the server answers 535 5.7.8 no\ufffd\ufffdway"),
        (URLError(ConnectionRefusedError(111, "Connection refused")), "[Errno 111] Connection refused"),
        (TimeoutError(), "TimeoutError"),
    ],
)
def test_why_a_notice_was_not_sent_is_said_in_words(error: Exception, words: str) -> None:
    assert fault_of(error) == words


def test_a_server_with_a_certificate_of_its_own_is_told_with_the_remedy(tmp_path: Path) -> None:
    authority, ends = make_authority("mail", 40, datetime.now(UTC)), tmp_path / "mail.pem"
    ends.write_bytes(authority.key_pem + authority.certificate_pem)
    served = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    served.load_cert_chain(ends)
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def serve() -> None:
            with suppress(ssl.SSLError):
                served.wrap_socket(listening.accept()[0], server_side=True)

        threading.Thread(target=serve, daemon=True).start()
        with pytest.raises(URLError) as refused:
            post(f"https://127.0.0.1:{listening.getsockname()[1]}/", [BAD])
    assert re.search(r"not accepted \(.+\); .+SSL_CERT_FILE", fault_of(refused.value))


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ('webhooks = ["file:///etc/passwd"]', "webhook"),
        ('webhooks = ["https://user:word@example.org/"]', "without a user"),
        ('webhooks = ["https://example.org/a\\r\\nX: y"]', "webhook"),
        ('email = {host = "h", sender = "a@b\\r\\nBcc: c@d", recipients = ["a@example.org"]}', "mail address"),
        ('email = {host = "h", sender = "a@example.org", recipients = []}', "recipients"),
        ('email = {host = "h", sender = "a@example.org", recipients = ["x"]}', "mail address"),
        ("silent_s = 0", "silent_s"),
    ],
)
def test_targets_are_checked(tmp_path: Path, line: str, what: str) -> None:
    path = tmp_path / "monitor.toml"
    path.write_text(f"[notices]\n{line}\n")
    with pytest.raises(ConfigError, match=rf"monitor\.toml: line 2: notices.*{what}"):
        load_settings(path)


def test_files_are_found_beside_the_configuration_and_must_be_there(tmp_path: Path) -> None:
    path, secret = tmp_path / "monitor.toml", tmp_path / "mail.password"
    path.write_text(
        '[plan]\npicture = "plan.png"\npositions = {"site/gw/mems" = [0.5, 1]}\n[notices.email]\nhost = "h"\n'
        'password_file = "mail.password"\nsender = "a@example.org"\nrecipients = ["b@example.org"]\n'
    )
    secret.write_text("secret\n")
    with pytest.raises(ConfigError) as refused:
        load_settings(path)
    assert ["there is no file" in fault or "chmod 600" in fault for fault in refused.value.faults] == [True, True]
    secret.chmod(0o600)
    (tmp_path / "plan.png").write_bytes(b"\x89PNG")
    settings = load_settings(path)
    assert settings.plan is not None
    assert settings.plan.picture == tmp_path / "plan.png"
    path.write_text('[plan]\npicture = "plan.svg"\npositions = {}\n')
    with pytest.raises(ConfigError, match="a picture is a file"):
        load_settings(path)
