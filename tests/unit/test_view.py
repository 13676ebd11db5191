"""The view of a run: what stands in the lines and on the screen, and at which size."""

from __future__ import annotations

import io
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from rich.console import Console

from agent.core.events import Gap
from agent.delivery.publication import PublicationState
from agent.terminal.quantity import counted, duration, size
from agent.terminal.screen import Screen, ScreenPicture
from agent.terminal.state import DeviceState, RecordingState, ViewState
from agent.terminal.view import LineView, open_view
from agent.terminal.wording import gap_line, truth_line
from calib.rounding import from_to, plus_minus
from tests.unit.results import calibration, status, window


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def full_state(windows: int = 9) -> ViewState:
    state = ViewState("virtual bench, plain", "virtual/bench", uptime_s=65.2)
    state.devices = {
        "mems": DeviceState("ADXL355 on I2C 1, 0x1d", "open", 1000.02, 130, 0),
        "reference": DeviceState("serial-csv /dev/pts/4", "lost", 0.0, 129, 3),
    }
    state.take(
        window(n, used=n != 4, reason="coherence 0.41 below 0.9" if n == 4 else "") for n in range(1, windows + 1)
    )
    held = window(windows + 1, used=False, reason="the window contradicts the calibration")
    held.numbers["innovation_chi2"] = 900.0
    state.take([held, status(windows + 2), calibration(windows + 3)])
    state.publication = PublicationState("fieldcal/v1/virtual/bench", ("tcp/127.0.0.1:7447",), True, 11, "")
    state.recording = RecordingState("data/fieldcal-000001.mcap.active", 1_234_567, True)
    state.say("a Zenoh router was started")
    return state


def picture(state: ViewState, width: int, height: int) -> list[str]:
    console = Console(width=width, height=height, file=io.StringIO(), color_system=None)
    with console.capture() as capture:
        console.print(ScreenPicture(state))
    return capture.get().splitlines()


@pytest.mark.parametrize(("width", "height"), [(100, 30), (80, 24)])
def test_all_that_matters_is_on_the_screen(width: int, height: int) -> None:
    lines = picture(full_state(), width, height)
    shown = "\n".join(lines)
    assert len(lines) < height
    assert max(map(len, lines)) <= width
    for words in (
        "virtual bench, plain", "gateway virtual/bench", "up 00:01:05", "VALID", "26154 ± 12", "250 ± 80",
        "U with k = 2, type A, white", "1000.0 Hz", "lost", "windows: 8 used, 1 held, 1 refused", "used, 6000 points",
        "fieldcal/v1/virtual/bench/** to tcp/127.0.0.1:7447 (connected)", "fieldcal-000001.mcap.active, 1.23 MB",
        "a Zenoh router was started",
    ):  # fmt: skip
        assert words in shown, words


def test_a_small_or_empty_terminal_is_no_fault() -> None:
    assert len(picture(full_state(), 40, 10)) == 9
    assert len(picture(full_state(), 20, 2)) == 1
    assert any("gateway" in line for line in picture(ViewState("t", "s/g"), 80, 24))


def test_the_newest_windows_are_shown_with_the_reason_of_a_refusal() -> None:
    state = full_state(90)
    state.take([window(200, used=False, reason="clipped")])
    shown = [line for line in picture(state, 100, 30) if "30 deg" in line]
    assert "1400.0 to 1406.0 s" in shown[-1]
    assert "refused: clipped" in shown[-1]
    assert 3 <= len(shown) < 20


def test_a_long_name_does_not_run_into_the_next_column() -> None:
    state = ViewState("t", "s/g", devices={"d" * 60: DeviceState("k" * 60, "open", 100.0, 1, 0)})
    row = next(line for line in picture(state, 100, 30) if line.startswith("dd"))
    assert row == "d" * 14 + "… " + "k" * 26 + "… open       100.0 Hz        1     0"


def test_names_with_markup_are_shown_as_they_are() -> None:
    state = full_state()
    state.say("reference: a line could not be read: '[bold]x[/]'")
    assert any("'[bold]x[/]'" in line for line in picture(state, 100, 30))


def test_the_error_against_the_truth_is_the_largest_of_each_kind() -> None:
    update = calibration(1)
    true = np.array(update.sensitivity)
    true[1, 1] -= 26.123  # 0.1 % of the main sensitivity
    true[0, 2] += 13.0
    truth = SimpleNamespace(sensitivity=true, offset=np.array(update.offset) - [0.0, 0.0, 263.0])
    expected = "largest errors: S main 0.100 %, transverse 0.050 %, Q 0.0100 m/s²"
    assert truth_line(update, truth) == expected
    state = full_state()
    state.truths["mems"] = truth
    assert any(expected in line for line in picture(state, 80, 24))


def test_what_is_not_determined_is_not_held_against_the_truth() -> None:
    update = calibration(1)
    truth = SimpleNamespace(sensitivity=np.array(update.sensitivity), offset=np.array(update.offset))
    prior = msgspec.structs.replace(
        update,
        sensitivity=[[1.0, 2.0, 3.0], *update.sensitivity[1:]],
        offset=[*update.offset[:2], 9999.0],
        determined=[False] * 3 + [True] * 8 + [False],
    )
    assert truth_line(prior, truth).endswith("S main 0.000 %, transverse 0.000 %, Q 0.0000 m/s²")
    nothing = msgspec.structs.replace(update, determined=[False] * 12)
    assert truth_line(nothing, truth).endswith("S main – %, transverse – %, Q – m/s²")


def test_a_parameter_that_is_not_known_is_not_given_a_number() -> None:
    state = full_state()
    state.take([calibration(99, qz_known=False)])
    assert any("26295 ± 12" in line and "not known" in line for line in picture(state, 80, 24))


def test_lines_tell_each_thing_once() -> None:
    stream = io.StringIO()
    state = full_state(2)
    view = open_view(state, stream)
    assert isinstance(view, LineView)
    for _ in range(3):
        view.refresh()
    state.devices["reference"].state = "open"
    state.publication = PublicationState("fieldcal/v1/virtual/bench", ("tcp/127.0.0.1:7447",), False, 11, "")
    state.take([window(50, used=False, reason="clipped")])
    state.say("one")
    state.say("two")
    view.refresh(now=True)
    view.close()
    assert stream.getvalue().splitlines() == [
        "virtual bench, plain, gateway virtual/bench",
        "a Zenoh router was started",
        "device mems: ADXL355 on I2C 1, 0x1d, open",
        "device reference: serial-csv /dev/pts/4, lost",
        "recording: data/fieldcal-000001.mcap.active",
        "publishing: fieldcal/v1/virtual/bench/** to tcp/127.0.0.1:7447 (connected)",
        "mems: window 7.0 to 13.0 s at 30 deg: used, 6000 points",
        "mems: window 14.0 to 20.0 s at 30 deg: used, 6000 points",
        "mems: window 21.0 to 27.0 s at 30 deg: held: the window contradicts the calibration",
        "mems: VALID, 8 windows",
        "mems: calibration from 8 windows, U with k = 2, type A, white: main 0.046 %, transverse 0.046 %",
        "  Sxx 26154 ± 12  Sxy 120 ± 12  Sxz 50 ± 12  Qx 250 ± 80",
        "  Syx -195 ± 12  Syy 26123 ± 12  Syz 67 ± 12  Qy 250 ± 80",
        "  Szx -81 ± 12  Szy 87 ± 12  Szz 26295 ± 12  Qz 250 ± 80",
        "one",
        "two",
        "device reference: serial-csv /dev/pts/4, open",
        "publishing: fieldcal/v1/virtual/bench/** to tcp/127.0.0.1:7447 (no router answers; results wait in the store)",
        "mems: window 350.0 to 356.0 s at 30 deg: refused: clipped",
    ]


def test_a_gap_is_told_with_its_reason() -> None:
    gap = Gap(device="mems", dropped=1, unit="lines", reason="no numbers", t_monotonic_ns=0)
    assert gap_line(gap) == "mems: 1 line dropped: no numbers"


def test_lines_to_a_reader_that_went_away_are_no_fault() -> None:
    stream = io.StringIO()
    view = open_view(full_state(), stream)
    stream.close()
    view.refresh()
    view.close()


def test_the_screen_draws_seldom_and_leaves_the_terminal_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    stream = Terminal()
    state = full_state()
    view = open_view(state, stream)
    assert isinstance(view, Screen)
    drawn = len(stream.getvalue())
    assert drawn > 0
    for _ in range(100):
        view.refresh()
    assert len(stream.getvalue()) == drawn
    view.refresh(now=True)
    assert len(stream.getvalue()) > drawn
    view.close()
    view.close()
    assert stream.getvalue().count("\x1b[?25l") == stream.getvalue().count("\x1b[?25h") == 1, "the cursor is back"


@pytest.mark.parametrize(
    ("value", "expanded", "words"),
    [
        (26154.4321, 12.3, "26154 ± 12"),
        (0.99432, 0.00123, "0.9943 ± 0.0012"),
        (-0.5, 0.0999, "-0.50 ± 0.10"),
        (98765.0, 1234.0, "98800 ± 1200"),
        (26154.4321, 99.6, "26150 ± 100"),
        (-5.0, 1234.0, "0 ± 1200"),
        (1.5, float("inf"), "1.5 ± ?"),
        (1.5, 0.0, "1.5 ± ?"),
        (1.5, None, "1.5 ± ?"),
        (None, 1.0, "–"),
        (float("nan"), 1.0, "–"),
    ],
)
def test_a_value_is_written_to_the_second_digit_of_its_uncertainty(
    value: float | None, expanded: float | None, words: str
) -> None:
    assert plus_minus(value, expanded) == words


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [(0.5, 20.0, "0.5 to 20"), (2.9972, 3.0028, "2.997 to 3.003"), (3.0, 3.0, "3 to 3")],
)
def test_the_ends_of_a_range_have_digits_enough_to_differ(low: float, high: float, words: str) -> None:
    assert from_to(low, high) == words


def test_sizes_and_durations_are_written_for_people() -> None:
    assert [size(n) for n in (0, 999, 1000, 1_234_567, 10**13)] == ["0 B", "999 B", "1 kB", "1.23 MB", "10 TB"]
    assert [counted(n, "lines") for n in (0, 1, 2)] == ["0 lines", "1 line", "2 lines"]
    assert [duration(s) for s in (0.4, 3661.9, 200_000)] == ["00:00:00", "01:01:01", "2 d 07 h"]
