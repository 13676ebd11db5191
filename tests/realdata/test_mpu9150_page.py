"""docs/real-sensors.md: its commands give its table, and the published values are within its U."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from tests.realdata.datasets import dataset
from tests.realdata.test_mpu9150 import _expected
from tests.scenarios.processes import ROOT

PAGE = (ROOT / "docs/real-sensors.md").read_text("utf-8")
TABLE = PAGE.split("<!-- mpu9150: begin -->")[1].split("<!-- mpu9150: end -->")[0]


def numbers(text: str) -> list[str]:
    """The numbers of the three rows of a printed table, as they are printed."""
    rows = re.findall(r"^ +[xyz] .*$", text, flags=re.MULTILINE)
    assert len(rows) == 3, text
    return [word for row in rows for word in row.split()[1:] if word != "±"]


def commands() -> tuple[str, list[str]]:
    """The line of awk, and the words of the command after it."""
    awk, calibrate = re.findall(r"^    ((?:awk|fieldcal calibrate --sensor mpu9150).*)$", PAGE, flags=re.MULTILINE)
    return awk, shlex.split(calibrate)


def test_the_commands_give_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "imu0.log").symlink_to(dataset("mikoff_mpu9150") / "imu0.log")
    monkeypatch.chdir(tmp_path)
    awk, (_, *arguments) = commands()
    subprocess.run(awk, shell=True, check=True)
    assert run_cli(arguments) == 0
    shown, printed = numbers(TABLE), numbers(capsys.readouterr().out)
    assert len(shown) == len(printed) == 21
    for one, other in zip(shown, printed, strict=True):  # another CPU may round the last digit to the other side
        last_digit = 10.0 ** -len(one.partition(".")[2])
        assert abs(float(one) - float(other)) < 1.1 * last_digit, (one, other)


def test_what_was_published_is_within_u() -> None:
    words = iter(numbers(TABLE))
    values, expanded = np.zeros((3, 4)), np.zeros((3, 4))
    for i in range(3):
        for j in range(4):
            values[i, j] = next(words)
            expanded[i, j] = 0.0 if j < i else next(words)
    S, Q = _expected("imu0")
    assert (np.abs(values - np.column_stack([S, Q])) <= expanded + 1e-12).all()
    for told in ("1.00363, 1.00315 and 1.00647", "0.103, 0.097 and 0.344"):
        assert told in " ".join(PAGE.split())
    np.testing.assert_allclose(np.diag(S), [1.00363, 1.00315, 1.00647], rtol=0, atol=1e-9)
    np.testing.assert_allclose(Q, [0.103, 0.097, 0.344], rtol=0, atol=1e-9)
