"""Logs as JSON: what is in them, what must not be, and a reader that hangs or goes away."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from agent.core.events import Command, DeviceChange, Gap, Pruned
from agent.supervision.logs import WAITING_MAX, JsonFormatter, JsonLog, log_event, under_journal, without_secrets
from tests.scenarios.processes import fieldcal
from tests.unit.results import calibration, clock, status, window
from tests.unit.zenoh_site import wait_for

KEY = "-----BEGIN PRIVATE KEY-----\nMC4CAQAwBQYDK2VwBCIEIB\n-----END PRIVATE KEY-----"


@dataclass
class Piped:
    """A logger whose log goes through a pipe."""

    logger: logging.Logger
    log: JsonLog
    end: int

    def entries(self) -> list[dict[str, Any]]:
        self.log.finish()
        os.set_blocking(self.end, False)
        read = b""
        while chunk := os.read(self.end, 1 << 20):
            read += chunk
            if read.endswith(b"\n") and len(chunk) < 1 << 20:
                break
        return [json.loads(line) for line in read.splitlines()]


@pytest.fixture
def piped() -> Iterator[Piped]:
    end, begin = os.pipe()
    log = JsonLog(begin)
    logger = logging.getLogger("fieldcal")
    logger.setLevel(logging.INFO)
    logger.addHandler(log)
    yield Piped(logger, log, end)
    logger.removeHandler(log)
    logger.setLevel(logging.NOTSET)
    os.close(end)
    log.finish()
    os.close(begin)


def test_what_happens_is_an_object_a_line_with_its_fields(piped: Piped) -> None:
    change: dict[str, Any] = {"device": "mems", "t_monotonic_ns": 1, "t_utc_ns": 1}
    log_event(DeviceChange(**change, state="lost", message="I2C 1, 0x1d:\nEIO", attempt=2), [])
    log_event(Gap(device="mems", t_monotonic_ns=1, dropped=3, unit="lines", reason="not a number"), [])
    pruned: dict[str, Any] = {"first_file": 3, "last_file": 5, "last_sha256": "0" * 64, "bytes": 7}
    log_event(Pruned(t_monotonic_ns=1, t_utc_ns=1, **pruned), [])
    command = Command(sensor="mems", verb="hold", t_monotonic_ns=1, t_utc_ns=1, key_id="k1", refused="expired")
    log_event(command, [window(1), calibration(2, qz_known=False), status(3), clock(4)])  # a routine result is not told
    entries = piped.entries()
    assert [(e["event"], e["level"]) for e in entries] == [
        ("device", "warning"), ("gap", "warning"), ("pruned", "info"), ("command", "warning"), ("window", "info"),
        ("calibration", "info"), ("status", "info"),
    ]  # fmt: skip
    lost, gap, pruning, refused, used, in_force, _ = entries
    assert (lost["message"], lost["state"], lost["attempt"]) == ("mems: lost, I2C 1, 0x1d:\nEIO", "lost", 2)
    assert (gap["dropped"], gap["unit"]) == (3, "lines")
    assert (pruning["first_file"], pruning["last_file"], pruning["bytes"]) == (3, 5, 7)
    assert (refused["key_id"], refused["refused"]) == ("k1", "expired")
    assert (used["used"], used["points"], used["sequence"]) == (True, 6000, 1)
    assert in_force["sensitivity"][0][0] == 26154.0
    assert in_force["offset"][2] is None, "what is not a number is null"
    assert "covariance" not in in_force
    assert lost["time"].endswith("+00:00")


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        (f"cannot read {KEY} here", "cannot read [removed] here"),
        ("torn " + KEY[:40], "torn [removed]"),
        ("no router at tls/10.0.0.1:7447#connect_private_key_base64=TUM0Q0;iface=eth0, tcp/h:1",
         "no router at tls/10.0.0.1:7447#[removed], tcp/h:1"),
        ("http://user:hunter2@host/x", "http://user:[removed]@host/x"),
        ('{"user": "gw", "password": "hun ter2"}', '{"user": "gw", "password": [removed]}'),
        ("TOKEN=abc123; next", "TOKEN=[removed]; next"),
        ("private_key_file: /etc/k.pem", "private_key_file: [removed]"),
    ],
)  # fmt: skip
def test_no_secret_is_in_it(text: str, kept: str) -> None:
    assert without_secrets(text) == kept


@pytest.mark.parametrize(
    "text", ["mems: window 1.0 to 6.0 s at 30 deg: used", "key fieldcal/v1/s/g/mems/status", "a:b@c"]
)
def test_what_is_no_secret_stays(text: str) -> None:
    assert without_secrets(text) == text


def test_secrets_in_fields_and_odd_values_do_no_harm(piped: Piped, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(piped.logger, "propagate", False)  # pytest would keep the odd line, and cannot send it on
    fields = {"path": "\udc80.toml", "endpoints": [{"a": "tls/h:1#k=v"}], "x": math.inf, "o": object}
    piped.logger.info("%s", "\ud800 torn", extra={"fields": fields})
    piped.log.emit(logging.LogRecord("x", logging.ERROR, "", 0, "%d and %d", (1,), None))
    (entry,) = piped.entries()
    assert entry["message"] == "? torn"
    assert (entry["path"], entry["endpoints"], entry["x"]) == ("?.toml", [{"a": "tls/h:1#[removed]"}], None)


def test_an_exception_is_named_without_a_traceback() -> None:
    try:
        raise ValueError("of no use")
    except ValueError:
        record = logging.LogRecord("x", logging.ERROR, "", 0, "failed", (), sys.exc_info())
    line = JsonFormatter().format(record)
    assert json.loads(line)["exception"] == "ValueError: of no use"
    assert "Traceback" not in line


def drain(end: int, into: bytearray) -> None:
    with contextlib.suppress(OSError):  # closed when the test is over
        while chunk := os.read(end, 1 << 16):
            into.extend(chunk)


def test_a_reader_that_hangs_costs_lines_that_are_counted_and_no_time(piped: Piped) -> None:
    begin = time.monotonic()
    for n in range(3 * WAITING_MAX):
        piped.logger.info("%s", f"{n} " + "x" * 1000)  # a pipe holds 64 of them
    assert time.monotonic() - begin < 30.0
    read = bytearray()
    threading.Thread(target=lambda: drain(piped.end, read), daemon=True).start()
    said = 0

    def all_is_told() -> bool:
        nonlocal said
        piped.logger.info("one more")  # a count of lost lines comes before the next line
        said += 1
        time.sleep(0.02)  # polls
        messages = [json.loads(line)["message"] for line in bytes(read).split(b"\n")[:-1]]
        numbers = [int(message.split()[0]) for message in messages if message.endswith("x")]
        assert numbers == sorted(set(numbers)), "what was taken is in order"
        lost = sum(int(message.split()[0]) for message in messages if message.endswith("nobody took them"))
        return len(numbers) + lost + messages.count("one more") == 3 * WAITING_MAX + said

    wait_for(all_is_told)


def test_a_line_made_to_cost_time_costs_little() -> None:
    for part in ("x", "a.", "tcp/", "private_key", "-----BEGIN PRIVATE KEY-----", "password", "a://", "a://b:"):
        begin = time.thread_time()
        without_secrets(part * (8192 // len(part)))
        assert time.thread_time() - begin < 0.5, part  # up to 40 ms; a square of the length would take seconds


def test_a_reader_that_went_away_is_no_fault() -> None:
    end, begin = os.pipe()
    log = JsonLog(begin)
    os.close(end)
    log.emit(logging.LogRecord("x", logging.ERROR, "", 0, "nobody hears", (), None))
    log.finish()
    log.emit(logging.LogRecord("x", logging.ERROR, "", 0, "nor this", (), None))
    os.close(begin)


def test_the_journal_is_known_by_device_and_inode() -> None:
    end, begin = os.pipe()
    there = os.fstat(begin)
    assert under_journal({"JOURNAL_STREAM": f"{there.st_dev}:{there.st_ino}"}, begin)
    assert not under_journal({"JOURNAL_STREAM": f"{there.st_dev}:{there.st_ino + 1}"}, begin)
    assert not under_journal({}, begin)
    os.close(end)
    os.close(begin)
    assert not under_journal({"JOURNAL_STREAM": "1:1"}, begin)


PROGRAM = """
import logging, sys, threading, warnings
from agent.supervision.logs import log_as_json
log = log_as_json()
logging.getLogger("agent.x").warning("a %s", "warning")
warnings.warn("from a library")
print("printed in two", "parts", file=sys.stderr)
thread = threading.Thread(target=lambda: 1 / 0)
thread.start()
thread.join()
log.finish()
logging.getLogger("agent.x").warning("after the end")
"""


def test_whatever_a_process_tells_on_standard_error_is_json() -> None:
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    entries = [json.loads(line) for line in ended.stderr.splitlines()]
    messages = [entry["message"] for entry in entries]
    assert messages[0] == "a warning"
    assert any("from a library" in m for m in messages)
    assert "printed in two parts" in messages
    assert "ZeroDivisionError: division by zero" in messages
    assert messages[-1] == "after the end"
    assert ended.stdout == ""


@pytest.mark.thorough
def test_faults_of_a_configuration_are_json_too(tmp_path: Path) -> None:
    config = tmp_path / "gateway.toml"
    config.write_text("speed = 1\n")
    ended = fieldcal("run", config, "--log", "json")
    assert (ended.returncode, ended.stdout) == (2, "")
    messages = [json.loads(line)["message"] for line in ended.stderr.splitlines()]
    told = f"{config}: line 1: speed: there is no such setting (1); remove it or correct its name; there are channels, "
    assert any(message.startswith(told) for message in messages)
