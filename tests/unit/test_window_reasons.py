"""Each reason with which the running agent refuses or holds a window has a remedy, and its page is complete."""

from __future__ import annotations

import ast
import functools
import itertools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from agent.config.channel import Channel
from agent.config.gate import GateSettings
from agent.core.events import WindowReport
from agent.core.gate import Evidence, Gate
from agent.recording.reading import RecordingReader
from agent.terminal.held import CONTRADICTION, is_held
from agent.terminal.window_reasons import HELD, REFUSED, known
from calib.excitation.window_verdict import RULES
from calib.model import Calibration
from calib.signal.response import UNSETTLED
from docs.reference.pages import _models
from docs.reference.window_numbers import NUMBERS, THRESHOLD
from tests.unit.results import window

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests/replay/golden"
FILES = [*sorted((ROOT / "agent/core").glob("*.py")), *sorted((ROOT / "calib/excitation").glob("*.py"))]
ONLY_FILES = {"sd_over_floor"}  # the agent passes no floor: other positions are not known to it
# Functions that return why a window is not used.
WHY = ("not_certified", "_unsound", "change", "_too_far", "_no_start")
# Functions that say why an estimate is not proposed (agent.core.anchor.Anchor.refusal), and the characters that a
# sentence has at least.
UNFIT, SENTENCE = ("_number_reasons", "_dead_reasons", "_main_reasons", "axis_warnings"), 40
NOTHING_MOVED = "no main sensitivity (Sxx, Syy, Szz) is determined"  # one of them has no computed part
ALL = [one for stage in (*REFUSED, HELD) for one in stage.reasons]


class Said:
    """What the expressions of a file may say, with # for what is computed: the texts of windows that are not used."""

    def __init__(self, path: Path) -> None:
        tree = ast.parse(path.read_text("utf-8"))
        self._functions = {node.name: node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        self._constants = list(self._assigned(tree.body))
        self._local: list[tuple[str, int, ast.expr]] = []

    def reasons(self) -> Iterator[str]:
        """The texts of all calls that refuse or hold a window, and of the functions that say why one is refused."""
        for name, function in self._functions.items():
            self._local = list(self._assigned(ast.walk(function)))
            for node in ast.walk(function):
                for value in refusing(node) if isinstance(node, ast.Call) else []:
                    yield from self.texts(value)
            if name in WHY:
                yield from self._returned(function)

    def sentences(self, functions: Iterable[str]) -> Iterator[str]:
        """The texts with a computed part in these functions."""
        for name in functions:
            self._local = list(self._assigned(ast.walk(self._functions[name])))
            for node in ast.walk(self._functions[name]):
                if isinstance(node, ast.JoinedStr):
                    yield from (text for text in self.texts(node) if len(text) > SENTENCE)

    def texts(self, node: ast.expr) -> list[str]:
        """Nothing where an expression passes on what another one said."""
        match node:
            case ast.Constant(value=str(text)):
                return [text] if text else []
            case ast.JoinedStr(values=values):
                parts = [self.texts(part) or ["#"] for part in values]
                return [said for said in map("".join, itertools.product(*parts)) if not said.startswith("#; ")]
            case ast.FormattedValue(value=ast.Name() | ast.Call() as value):
                return self.texts(value)
            case ast.BoolOp(values=values):
                return [text for value in values for text in self.texts(value)]
            case ast.IfExp(body=body, orelse=orelse):
                return [*self.texts(body), *self.texts(orelse)]
            case ast.Name(id=name, lineno=line):
                before = {at: value for own, at, value in self._local if own == name and at < line}
                constant = [value for own, _, value in self._constants if own == name]
                newest = [before[max(before)]] if before else constant
                return self.texts(newest[0]) if newest else []
            case ast.Call(func=ast.Name(id=name)) if name in self._functions:
                return list(self._returned(self._functions[name]))
        return []

    def _returned(self, function: ast.FunctionDef) -> Iterator[str]:
        before, self._local = self._local, list(self._assigned(ast.walk(function)))
        for node in ast.walk(function):
            if isinstance(node, ast.Return) and node.value is not None:
                made = node.value.args if isinstance(node.value, ast.Call) else [node.value]
                yield from (text for value in made[:1] for text in self.texts(value))
        self._local = before

    @staticmethod
    def _assigned(nodes: Iterable[ast.AST]) -> Iterator[tuple[str, int, ast.expr]]:
        for node in nodes:
            if isinstance(node, ast.Assign):
                pairs = [(node.targets[0], node.value)]
                if isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple):
                    pairs = list(zip(node.targets[0].elts, node.value.elts, strict=True))
                yield from ((one.id, node.lineno, own) for one, own in pairs if isinstance(one, ast.Name))


def refusing(call: ast.Call) -> list[ast.expr]:
    """The arguments of a call that are the reason of a window that is not used."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    first = call.args[0].value if call.args and isinstance(call.args[0], ast.Constant) else ""
    if name in ("Unusable", "refused"):
        return call.args[-1:]
    if name == "OutputFault":
        return call.args[:1]
    off = name in ("Placed", "Verdict") and first in (None, False)
    if off or name == "_refuse" or (name == "_decision" and first in ("hold", "refuse")):
        return call.args[1:2]
    keys = {word.arg: word.value for word in call.keywords}
    return [keys["reason"]] if name == "replace" and "used" in keys and "reason" in keys else []


@functools.cache
def reasons() -> frozenset[str]:
    """All reasons for which the agent does not use a window, or does not propose an estimate."""
    of_windows = {text for path in FILES for text in Said(path).reasons()}
    return frozenset(of_windows | set(Said(ROOT / "calib/estimate/axes.py").sentences(UNFIT)))


RULED = {name: re.sub(r"\{[^}]*\}", "3", sentence) for name, _, sentence in RULES}


def test_the_reasons_are_found_in_the_code() -> None:
    """One of each kind of call that refuses or holds a window, and their number."""
    found = "\n".join(sorted(reasons()))
    for part in (
        "this pose needs", "not been connected", "at none of the stated", "the reference is calm", "clipped: #",
        "serial number", "the same samples twice", "contradicts the calibration", "max_change", "is dead",
    ):  # fmt: skip
        assert part in found, f"{part} is not among\n{found}"
    assert len(reasons()) >= 40


def test_each_reason_has_a_remedy() -> None:
    without = [reason for reason in sorted(reasons()) if known(reason) is None]
    assert without == [], "add them to agent/terminal/window_reasons.py"


def test_each_rule_that_acts_on_line_has_a_remedy_of_its_own() -> None:
    found = {name: known(sentence) for name, sentence in RULED.items()}
    assert {name for name, one in found.items() if one is None} == ONLY_FILES
    rows = [id(one) for one in found.values() if one is not None]
    assert len(set(rows)) == len(RULES) - len(ONLY_FILES)
    assert not any("floor=" in path.read_text("utf-8") for path in (ROOT / "agent/core").glob("*.py"))


def test_no_row_is_of_a_reason_that_nobody_gives() -> None:
    """A sentence that was changed in the code would otherwise leave its row behind."""
    said = [*reasons(), *RULED.values(), UNSETTLED, NOTHING_MOVED]
    for one in ALL:
        for pattern in one.sentences:
            assert any(list(one.places(text)) for text in said), pattern


def test_the_last_part_of_a_reason_says_most() -> None:
    held = "S or Q changed by more than max_change: Sxx, Sxy"
    scaled, dead = known(f"{held}; held until an operator accepts it"), known(f"{held}; output y is dead: its largest")
    assert scaled is not None
    assert "accept the estimate" in scaled.do
    assert dead is not None
    assert "wiring" in dead.do
    lag = known("the sensor does not follow the reference: coherence 0.312, 0.5 needed; a lag of 150 ms explains the "
                "window, but the lag is stated as 0 ms with u = 20 ms, and 4 u is the limit")  # fmt: skip
    assert lag is not None
    assert "uncertainty.lag_s" in lag.do
    assert known("mems has 1 axis, this pose needs 3") is not known("no samples of mems")
    assert known("no samples of the reference laser") is not known("no samples of mems")
    assert known("so") is None


@pytest.mark.parametrize("setting", sorted({setting for one in ALL for setting in one.settings}))
def test_each_setting_exists(setting: str) -> None:
    model: type[BaseModel] = Channel
    *sections, name = setting.split(".")
    for section in sections:
        model = _models(model.model_fields[section].annotation)[0]
    assert name in model.model_fields


def test_held_is_what_was_compared_with_the_state() -> None:
    """The gate's own decisions: one that holds, and one that refuses."""
    S = Calibration(np.eye(3), np.zeros(3), np.diag(np.full(12, 1e-6)), np.ones(12, dtype=bool), np.inf, "prior")
    gate = Gate(GateSettings(least_determined=1), S)
    held = gate.judge(Evidence(0.0, 1e3, 3.0), S)
    gate.hold("anna")
    refused = gate.judge(Evidence(0.0, 1e3, 3.0), S)
    assert (held.action, refused.action) == ("hold", "refuse")
    assert CONTRADICTION in held.numbers
    assert CONTRADICTION not in refused.numbers
    shown = {action: window(1, used=False) for action in ("hold", "refuse")}
    shown["hold"].numbers.update(held.numbers)
    assert is_held(shown["hold"])
    assert not is_held(shown["refuse"])


def test_the_names_in_numbers_are_those_of_the_code() -> None:
    names = {name for row in NUMBERS for name in row.split(", ")}
    code = "".join(path.read_text("utf-8") for path in FILES)
    for name in names:
        part = re.sub("^(reference_|change_|u_found_)", "", name)
        assert re.search(rf'"\w*{part}"|[}}"]{part}"|{part}=', code), name
    assert {name for name, _, _ in RULES} - ONLY_FILES <= names


@pytest.mark.parametrize("directory", sorted(GOLDEN.glob("engine-*")), ids=lambda path: path.name)
def test_the_numbers_of_recorded_windows_are_in_the_documentation(directory: Path) -> None:
    names = {name for row in NUMBERS for name in row.split(", ")}
    steps = RecordingReader(directory / "fieldcal-000001.mcap").steps()
    windows = [result for step in steps for result in step.results if isinstance(result, WindowReport)]
    told = {name.removesuffix(THRESHOLD) for one in windows for name in one.numbers}
    assert len(told) >= 8
    assert told <= names
