"""Login to the fleet page and commands through it: who may, and what guessing, forged and foreign requests reach."""

from __future__ import annotations

import json
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from pathlib import Path

import pytest
import zenoh
from click.testing import CliRunner

from agent.cli.monitor import monitor
from agent.commanding.envelope import as_line
from agent.commanding.network import serve_queries
from agent.delivery.keys import gateway_key
from agent.delivery.session import session_config
from agent.keys.certificates import issue, make_authority
from agent.keys.files import write_new
from tests.unit.command_desk import GATEWAY, DeskSite, sealed
from tests.unit.zenoh_site import Site

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
pytest.importorskip("argon2", reason="the extra monitor is not installed")
from argon2 import PasswordHasher, extract_parameters

from agent.monitor import login
from agent.monitor import users as users_module
from agent.monitor.users import UsersError, read_users, set_user
from tests.unit.monitor_site import Answer, Served

PASSWORD = "correct horse battery staple"
DATA = ("/api/fleet", "/api/history", "/api/changes", "/api/events", "/fleet.csv", "/sensor.csv", "/events.csv")


@pytest.fixture(scope="module", autouse=True)
def cheap_hashes() -> Iterator[None]:
    """Hashes of little memory, so that the tests take less time; one test looks at the real ones."""
    with pytest.MonkeyPatch.context() as patch:
        hasher = PasswordHasher(time_cost=1, memory_cost=64, parallelism=1)
        patch.setattr(users_module, "_HASHER", hasher)
        patch.setattr(users_module, "_NOBODY", hasher.hash("no password"))
        yield


@pytest.fixture(scope="module")
def users_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Anna may hold and accept, bob may read."""
    path = tmp_path_factory.mktemp("users") / "users.txt"
    set_user(path, "anna", ("hold", "accept"), PASSWORD)
    set_user(path, "bob", (), "another long password")
    return path


@pytest.fixture
def users(users_file: Path, tmp_path: Path) -> Path:
    path = tmp_path / "users.txt"
    path.write_bytes(users_file.read_bytes())
    path.chmod(0o600)
    return path


@pytest.fixture
def served(site: Site, users: Path, tmp_path: Path) -> Iterator[Served]:
    with Served(site, tmp_path / "monitor", users=users) as server:
        yield server


class Browser:
    """Keeps the cookie, and sends the origin and the token."""

    def __init__(self, served: Served, name: str = "anna", password: str = PASSWORD) -> None:
        self._served = served
        self.headers = {"Origin": f"http://{served.address}"}
        self.answer = self.post("/api/login", json.dumps({"name": name, "password": password}))
        self.cookie = self.answer.headers.get("set-cookie", "")
        if self.cookie:
            self.headers["Cookie"] = self.cookie.split(";")[0]
            self.headers["X-CSRF-Token"] = self.get("/api/me").json["token"]

    def get(self, path: str) -> Answer:
        return self._served.ask(path, headers=self.headers)

    def post(self, path: str, body: str | bytes = b"", **headers: str) -> Answer:
        return self._served.ask(path, "POST", body, self.headers | headers)

    def command(self, verb: str, data: bytes, sensor: str = "mems", **headers: str) -> Answer:
        place, name = GATEWAY.split("/")
        return self.post(f"/api/command?site={place}&gateway={name}&sensor={sensor}&verb={verb}", data, **headers)


@pytest.fixture
def desk(site: Site, tmp_path: Path) -> Iterator[DeskSite]:
    """The gateway of anna's commands, on the bus."""
    (tmp_path / "desk").mkdir()
    desk = DeskSite(tmp_path / "desk")
    with ExitStack() as opened:
        session = opened.enter_context(zenoh.open(session_config("client", connect=[site.endpoint])))
        serve_queries(session, gateway_key(*GATEWAY.split("/")), desk.desk, opened)
        yield desk


def test_nothing_is_read_before_the_login_and_after_the_logout(served: Served) -> None:
    for path in DATA:
        assert served.ask(path).status == 401, path
        assert served.ask(path, headers={"Cookie": "fieldcal=guessed"}).status == 401
    for path in ("/", "/page.js", "/api/me"):  # what the login itself needs
        assert served.ask(path).status == 200
    anna = Browser(served)
    flags = {part.strip().lower() for part in anna.cookie.split(";")[1:]}
    assert {"httponly", "samesite=strict", "path=/"} <= flags
    assert anna.get("/api/fleet").status == 200
    assert anna.get("/api/me").json["verbs"] == ["hold", "accept"]
    assert anna.post("/api/logout").status == 204
    assert anna.get("/api/fleet").status == 401


def test_under_https_the_cookie_is_secure_and_of_this_host(site: Site, users: Path, tmp_path: Path) -> None:
    with Served(site, tmp_path / "monitor", users=users, behind_proxy=True) as served:
        body = json.dumps({"name": "anna", "password": PASSWORD})
        headers = {"Origin": f"https://{served.address}", "X-Forwarded-Proto": "https"}
        cookie = served.ask("/api/login", "POST", body, headers).headers["set-cookie"].lower()
    assert cookie.startswith("__host-fieldcal=")
    assert "; secure" in cookie


def test_each_wrong_password_makes_its_user_and_address_wait_longer(served: Served) -> None:
    answers = [Browser(served, "anna", f"guess number {k}").answer for k in range(5)]
    assert [answer.status for answer in answers] == [401] * 3 + [429] * 2
    assert [answers[k].headers["retry-after"] for k in (3, 4)] == ["1", "1"]  # what must wait changes nothing
    assert Browser(served).answer.status == 429  # the right one does not pass either
    assert Browser(served, "bob", "another long password").answer.status == 204
    names = [Browser(served, f"invented{k}", "x" * 20).answer.status for k in range(9)]
    assert names == [401] * 7 + [429] * 2  # ten wrong ones of one address


def test_the_delay_doubles_to_30_s_and_ends() -> None:
    delays, now_s, waits = login.Delays(3), 1e6, []
    for _ in range(5000):
        delays.begin("anna", now_s)
        waits.append(delays.wait_s("anna", now_s))
        now_s += waits[-1]
    assert waits[:9] == [0, 0, 1, 2, 4, 8, 16, 30, 30]
    assert set(waits[7:]) == {30}
    assert delays.wait_s("anna", now_s - 30) == 30
    assert delays.wait_s("anna", now_s) == 0
    delays.begin("anna", now_s + login.FORGOTTEN_S)
    assert delays.wait_s("anna", now_s + login.FORGOTTEN_S) == 0


def test_a_right_password_ends_the_delay_of_its_user_but_frees_no_guesser() -> None:
    user, address = login.Delays(3), login.Delays(3)
    for now_s in (1.0, 2.0):
        user.begin("anna", now_s)
        address.begin("192.0.2.1", now_s)
    user.right("anna", forget=True)
    address.right("192.0.2.1", forget=False)
    user.begin("anna", 3.0)
    address.begin("192.0.2.1", 3.0)
    address.begin("192.0.2.1", 3.0)
    assert (user.wait_s("anna", 3.0), address.wait_s("192.0.2.1", 3.0)) == (0.0, 1.0)


def test_invented_names_take_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(login, "NAMES_MAX", 3)
    delays = login.Delays(1)
    for k in range(100):
        delays.begin(f"invented {k}", 1e6)
    assert [delays.wait_s(f"invented {k}", 1e6) for k in range(96, 100)] == [0, 1, 1, 1]


def test_nobody_locks_a_user_out_from_another_address(site: Site, users: Path, tmp_path: Path) -> None:
    """Behind a proxy its client counts, the last address that the proxy itself has added."""
    with Served(site, tmp_path / "monitor", users=users, behind_proxy=True) as served:

        def login_from(address: str, password: str) -> int:
            headers = {"Origin": f"http://{served.address}", "X-Forwarded-For": address}
            body = json.dumps({"name": "anna", "password": password})
            return served.ask("/api/login", "POST", body, headers).status

        guesses = [login_from(f"203.0.113.{k}, 192.0.2.1", "a wrong password") for k in range(6)]
        assert guesses == [401] * 3 + [429] * 3
        assert login_from("192.0.2.1", PASSWORD) == 429
        assert login_from("192.0.2.2", PASSWORD) == 204
        assert [login_from(f"2001:db8::{k}", "a wrong password") for k in range(4)] == [401] * 3 + [429]  # one /64
        assert [login_from("nonsense", "a wrong password") for _ in range(4)] == [401] * 3 + [429]


def test_without_the_option_no_header_says_from_where_a_login_comes(served: Served) -> None:
    given = {"Origin": f"http://{served.address}"}
    answers = []
    for k in range(5):
        forged = {"X-Forwarded-For": f"203.0.113.{k}", "Forwarded": f"for=203.0.113.{k}", "X-Real-IP": f"203.0.113.{k}"}
        body = json.dumps({"name": "anna", "password": "a wrong password"})
        answers.append(served.ask("/api/login", "POST", body, given | forged).status)
    assert answers == [401] * 3 + [429] * 2


def test_an_unknown_user_is_answered_as_a_wrong_password(served: Served) -> None:
    nobody, anna = Browser(served, "nobody", "x" * 20).answer, Browser(served, "anna", "x" * 20).answer
    assert (nobody.status, nobody.text) == (anna.status, anna.text) == (401, "the name or the password is wrong")


def test_hostile_logins_are_refused(served: Served) -> None:
    headers = {"Origin": f"http://{served.address}"}
    bodies = (b"", b"[]", b"{}", b'{"name": 1, "password": 2}', b"\xff", b"[" * 4000, b'{"name": "anna"}',
              b'{"name": "anna", "password": "x", "verbs": ["accept"]}')  # fmt: skip
    assert [served.ask("/api/login", "POST", body, headers).status for body in bodies] == [400] * len(bodies)
    assert served.ask("/api/login", "POST", b"x" * 5000, headers).status == 413
    assert served.ask("/api/login", "POST", b"{}", {"Origin": "http://evil.example.org"}).status == 400


def test_a_session_ends_with_its_user_and_its_password(served: Served, users: Path) -> None:
    anna = Browser(served)
    set_user(users, "anna", ("hold",), "a new and long password")
    assert anna.get("/api/fleet").status == 401
    bob = Browser(served, "bob", "another long password")
    assert bob.get("/api/fleet").status == 200
    users.write_text("".join(line for line in users.read_text().splitlines(True) if "bob" not in line))
    assert bob.get("/api/fleet").status == 401


def test_a_signed_command_is_forwarded_and_the_gateway_decides(served: Served, desk: DeskSite) -> None:
    anna, data = Browser(served), as_line(sealed()).encode() + b"\r\n"
    assert anna.command("hold", data).json == {"taken": True, "reason": ""}
    again = anna.command("hold", data).json  # the gateway's counter holds
    assert not again["taken"]
    assert "counter" in again["reason"]
    no_right = anna.command("accept", sealed({"sequence": 101}, verb="accept")).json  # the key has no right to it
    assert "no right to send accept" in no_right["reason"]
    assert [(event.verb, bool(event.refused)) for event in desk.events] == [
        ("hold", False), ("hold", True), ("accept", True)]  # fmt: skip
    texts = [event["text"] for event in anna.get("/api/events").json]
    assert texts[-1] == "hold by anna, key anna: taken"


def test_commands_without_right_token_or_signature_do_not_reach_the_gateway(served: Served, desk: DeskSite) -> None:
    anna, bob = Browser(served), Browser(served, "bob", "another long password")
    data = sealed()
    refused = {
        "without login": served.ask("/api/command?verb=hold", "POST", data, {"Origin": f"http://{served.address}"}),
        "without right": bob.command("hold", data),
        "another verb": anna.command("rollback", sealed({"sequence": 101}, verb="rollback")),
        "of another page": anna.command("hold", data, Origin="http://evil.example.org"),
        "without token": anna.command("hold", data, **{"X-CSRF-Token": ""}),
        "with bob's token": anna.command("hold", data, **{"X-CSRF-Token": bob.headers["X-CSRF-Token"]}),
        "not signed": anna.command("hold", b'{"verb": "hold"}'),
        "nothing": anna.command("hold", b""),
        "too large": anna.command("hold", data + b" " * 4096),
        "wildcard": anna.command("hold", data, sensor="*"),
    }
    assert {what: answer.status for what, answer in refused.items()} == {
        "without login": 401, "without right": 403, "another verb": 403, "of another page": 400, "without token": 403,
        "with bob's token": 403, "not signed": 400, "nothing": 400, "too large": 413, "wildcard": 400}  # fmt: skip
    assert desk.events == []


def test_no_gateway_is_told_as_such(served: Served) -> None:
    answer = Browser(served).command("hold", sealed())
    assert (answer.status, "nobody answers at" in answer.text) == (502, True)


def test_a_hash_takes_memory_and_time() -> None:
    script = "from agent.monitor.users import _NOBODY; print(_NOBODY)"
    made = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.strip()
    used = extract_parameters(made)
    assert (used.type.name, used.memory_cost >= 64 << 10, used.time_cost >= 3) == ("ID", True, True)  # RFC 9106, 4


def test_the_file_of_users_is_private_hashed_and_checked(users: Path, tmp_path: Path) -> None:
    assert stat.S_IMODE(users.stat().st_mode) == 0o600
    assert PASSWORD not in users.read_text()
    for password in ("short", "x" * 201):
        with pytest.raises(UsersError, match="a password has 12 to 200 characters"):
            set_user(users, "carl", (), password)
    users.chmod(0o644)
    with pytest.raises(UsersError, match="chmod 600"):
        read_users(users)
    for line in ("user anna", "user <b> - $argon2id$x", "user anna fly $argon2id$x", "user anna - plain", "bob - x y"):
        (tmp_path / "bad.txt").write_text(line + "\n")
        (tmp_path / "bad.txt").chmod(0o600)
        with pytest.raises(UsersError, match=r"bad\.txt: line 1"):
            read_users(tmp_path / "bad.txt")


def test_add_user_reads_the_password_from_the_standard_input(tmp_path: Path) -> None:
    path = tmp_path / "users.txt"
    options = ["--users", str(path), "--add-user", "carl", "--verb", "hold", "--verb", "pose"]
    done = CliRunner().invoke(monitor, options, input=f"{PASSWORD}\n", standalone_mode=False)
    assert (done.return_value, read_users(path)["carl"].verbs) == (0, ("pose", "hold"))
    refused = CliRunner().invoke(monitor, options, input="short\n", standalone_mode=False)
    assert (refused.return_value, "12 to 200" in refused.output) == (2, True)


def test_passwords_are_not_taken_over_plain_http_from_the_network(users: Path) -> None:
    done = CliRunner().invoke(monitor, ["--users", str(users), "--listen", "0.0.0.0:8460"])
    assert (done.exit_code, "needs HTTPS" in done.output) == (2, True)


def test_what_cannot_be_served_is_told_in_one_line(site: Site, tmp_path: Path) -> None:
    authority = make_authority("authority", 10, datetime.now(UTC))
    others = [issue(authority, "fleet", 10, datetime.now(UTC), ["127.0.0.1"]) for _ in range(2)]
    write_new(tmp_path, {"a.pem": others[0].certificate_pem, "a.key": others[0].key_pem, "b.key": others[1].key_pem})
    (tmp_path / "empty.keys").write_text("gateway nonsense\n")
    certificate = ["--https-certificate", str(tmp_path / "a.pem")]
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = taken.getsockname()[1]
        for options, status, words in (
            (certificate, 2, "must be given together"),
            ([*certificate, "--https-key", str(tmp_path / "b.key")], 2, "not a certificate in PEM of the key"),
            (["--keys", str(tmp_path / "empty.keys")], 2, "line 1: not `gateway"),
            (["--users", str(tmp_path / "none.txt")], 2, "cannot be read"),
            (["--listen", f"127.0.0.1:{port}"], 1, "Address already in use"),
        ):
            where = ["--connect", site.endpoint, "--data-dir", str(tmp_path / "data")]
            done = CliRunner().invoke(monitor, [*where, *options], standalone_mode=False)
            said = done.output + str(done.exception or "")
            assert (words in said, "Traceback" in said) == (True, False), said
            assert (done.return_value or 2) == status
