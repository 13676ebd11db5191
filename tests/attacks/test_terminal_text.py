"""Text from outside reaches no terminal, page or figure in a form that is obeyed there."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from agent.audit.replaying import ReplayedFile
from agent.cli import probe
from agent.cli.audit import describe as describe_audit
from agent.cli.main import run_cli
from agent.core.events import StatusChange
from agent.delivery.history import StoredResult
from agent.delivery.store import Store
from agent.terminal.console import TextConsole
from agent.terminal.screen import ScreenPicture
from agent.terminal.state import DeviceState, ViewState
from agent.terminal.text import figure_text, one_line, page_text, visible
from agent.terminal.view import LineView
from tests.scenarios.processes import ROOT
from tests.unit.results import calibration, status

# Renames the window, clears the screen, goes back over a line, the same with C1, turns the direction, and ends a line.
HOSTILE = "x\x1b]0;owned\x07\x1b[2Jy\rpassed\x9b31mz\u202eq\u2028w\x00\x7f\ndata: passed"
OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2028\u2029\ud800-\udfff]")


def harmless(text: str) -> str:
    """The text, after the check that no terminal obeys a part of it."""
    assert not OBEYED.search(text), ascii(OBEYED.search(text))
    return text


def test_every_character_that_a_terminal_obeys_is_written_out() -> None:
    for code in [*range(32), *range(0x7F, 0xA0), 0x200B, 0x202E, 0x2066, 0xFEFF, 0xD800, 0xE0041]:
        if chr(code) not in "\t\n":
            shown = visible(f"a{chr(code)}b")
            assert shown.isascii()
            assert shown.isprintable()
            told = json.loads(f'"{shown}"')
            assert told.encode("utf-16", "surrogatepass") == f"a{chr(code)}b".encode("utf-16", "surrogatepass")
    plain = "26154 ± 12 m/s², θ 35°\tΔ … 测\n"
    assert visible(plain) == plain
    assert "\n" not in one_line(HOSTILE)


class FakeTerminal:
    """A stream that says it is a terminal and keeps what is written."""

    encoding = "utf-8"

    def __init__(self) -> None:
        self.text = ""

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        return None

    def isatty(self) -> bool:
        return True


def test_rich_draws_only_its_own_control_sequences(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    stream = FakeTerminal()
    state = ViewState(title=HOSTILE, gateway=HOSTILE)
    state.devices = {HOSTILE: DeviceState(kind=HOSTILE)}
    hostile = StatusChange(**{**json.loads(json.dumps(_fields(status(1)))), "status": HOSTILE, "reason": HOSTILE})
    state.statuses = {HOSTILE: hostile}
    state.say(HOSTILE)
    console = TextConsole(stream, width=200)
    console.print(ScreenPicture(state))
    console.print("[link=http://x]no markup[/link] :warning:")
    without_colours = re.sub(r"\x1b\[[0-9;]*m", "", stream.text)
    assert "\x1b[" in stream.text
    harmless(without_colours.replace("\n", ""))
    assert "[link=http://x]no markup[/link] :warning:" in without_colours


def _fields(result: Any) -> dict[str, Any]:
    return {name: getattr(result, name) for name in result.__struct_fields__}


def test_the_lines_of_a_run_are_lines(capsys: pytest.CaptureFixture[str]) -> None:
    state = ViewState(title="t", gateway="g")
    view = LineView(state, sys.stdout)
    state.devices = {"mems": DeviceState(kind=HOSTILE)}
    state.say(HOSTILE)
    view.refresh()
    told = capsys.readouterr().out
    assert harmless(told.replace("\n", ""))
    assert told.count("\n") == 3


def test_a_verdict_cannot_be_forged_by_a_line_break() -> None:
    from agent.audit.auditing import AuditedFile

    replayed = ReplayedFile(path="f", notes=[HOSTILE], refused=HOSTILE)
    verdict = AuditedFile(
        path="f", ok=False, incomplete=False, repaired=False, reasons=[HOSTILE],
        undecided=[HOSTILE], notes=[HOSTILE], size=1, sha256="",
        good_bytes=0, faults=[], fault_count=0, chunks=0, messages=0, replay=replayed,
    )  # fmt: skip
    for line in describe_audit(verdict):
        harmless(one_line(line))


def test_probe_shows_strings_of_usb_devices(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ports = [{"port": "/dev/ttyUSB0", "device": "d", "description": HOSTILE, "serial_number": HOSTILE}]
    monkeypatch.setattr(probe, "serial_ports", lambda: ports)
    monkeypatch.setattr(probe, "i2c_buses", list)
    assert run_cli(["probe"]) == 0
    assert len(harmless(capsys.readouterr().out.replace("\n", "")))
    assert run_cli(["probe", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["serial"] == ports


def test_whatever_the_program_prints_is_guarded(tmp_path: Path) -> None:
    """The real program, on a terminal: a store that somebody else wrote, and a file name that is hostile."""
    store = Store(tmp_path, 0)
    results = [calibration(1), StatusChange(**{**_fields(status(2)), "reason": HOSTILE})]
    store.commit([StoredResult.of(r, recorded=True, recording="") for r in results])
    store.close()
    mine, its = pty.openpty()
    command = [sys.executable, "-m", "agent", "show", "--data-dir", str(tmp_path)]
    env = os.environ | {"TERM": "xterm", "COLUMNS": "120"}
    process = subprocess.Popen(command, cwd=ROOT, env=env, stdout=its, stderr=its)
    os.close(its)
    told = b""
    try:
        while part := os.read(mine, 65536):
            told += part
    except OSError:
        pass
    os.close(mine)
    assert process.wait(60) == 0
    text = re.sub(r"\x1b\[[0-9;]*m", "", told.decode()).replace("\r\n", "")
    assert "\\u001b]0;owned\\u0007" in text
    harmless(text)


def test_a_page_and_a_figure_obey_nothing() -> None:
    shown = page_text(f"<script>{HOSTILE}</script>&\"'")
    assert harmless(shown.replace("\n", ""))
    assert "<" not in shown
    assert '"' not in shown
    assert figure_text("$\\frac{$x") == r"\$\frac{\$x"
    assert len(figure_text("y" * 10_000)) < 100


@pytest.mark.thorough
def test_a_report_of_a_hostile_result_is_made(tmp_path: Path) -> None:
    """Names, units and reasons in a RESULT.json that somebody else made."""
    label, long = "$\\frac{-->" + HOSTILE, "y" * 100_000
    result = {
        "sensitivity": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        "offset": [0.0, 0.0, 0.0],
        "standard_uncertainty": {"sensitivity": [[0.01] * 3] * 3, "offset": [0.1] * 3},
        "budget": {label: [0.01] * 12, long: [0.02] * 12},
        "status": "refused",
        "reasons": [label, long],
        "method": label,
        "output_unit": label,
        "windows": [{"start_s": 0.0, "stop_s": 1.0, "used": True, "reason": "", "points": 3, "position": label}],
    }
    path = tmp_path / "r.json"
    path.write_text(json.dumps(result))
    assert run_cli(["report", str(path), "-o", str(tmp_path / "out")]) == 3
    page = (tmp_path / "out" / "report.html").read_text()
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e]", page)
