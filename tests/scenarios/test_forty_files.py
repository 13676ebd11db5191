"""Files that other programs wrote: the same S and Q as from the plain CSV; broken ones end in one line."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.cli.main import run_cli
from tests.scenarios.broken_files import BROKEN
from tests.scenarios.forty_files import MAPPING, STEPS, TIME_NS, TIME_S, WRITERS, samples

WORDS = ["--rotation", "1,0,0,0,1,0,0,0,1", "--plain", "--json", "-"]
SAMPLES = samples()


def calibrated(files: dict[str, Path], capsys: pytest.CaptureFixture[str], *more: str) -> dict[str, Any]:
    words = [word for role, path in files.items() for word in (f"--{role}", str(path))]
    assert run_cli(["calibrate", *words, *WORDS, *more]) == 0, capsys.readouterr().err
    found = json.loads(capsys.readouterr().out)
    assert isinstance(found, dict)
    return found


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, dict[str, Any]]:
    """The result of the plain CSV, with times since the begin and (True) since 1970."""
    found = {}
    for since_1970, time_s in {False: TIME_S, True: TIME_NS * 1e-9}.items():
        directory = tmp_path_factory.mktemp("plain")
        words = []
        for role, names in {"sensor": "time_s,vx,vy,vz", "reference": "time_s,ax,ay,az"}.items():
            rows = np.column_stack([time_s, SAMPLES[role]]).tolist()
            text = f"{names}\n" + "".join(f"{','.join(map(repr, row))}\n" for row in rows)
            (directory / f"{role}.csv").write_text(text)
            words += [f"--{role}", str(directory / f"{role}.csv")]
        to = directory / "result.json"
        assert run_cli(["calibrate", *words, *WORDS[:-1], str(to)]) == 0
        found[since_1970] = json.loads(to.read_text())
    return found


def test_there_are_forty() -> None:
    assert len(WRITERS) >= 40


@pytest.mark.one_case
@pytest.mark.filterwarnings("default")  # the libraries' own
@pytest.mark.parametrize(  # `make test` has each fourth
    "name", [pytest.param(name, marks=pytest.mark.thorough if k % 4 else ()) for k, name in enumerate(WRITERS)]
)
def test_the_same_s_and_q(
    name: str, expected: dict[bool, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    writer = WRITERS[name]
    for library in (writer.library, *writer.needs):
        pytest.importorskip(library, reason=f"{library} is not installed")
    files = {role: tmp_path / f"{role}{writer.suffix}" for role in SAMPLES}
    for role, path in files.items():
        writer.write(path, role, STEPS * SAMPLES[role] if writer.steps and role == "reference" else SAMPLES[role])
    options = list(writer.options)
    if options == ["--mapping"]:
        options.append(str(tmp_path / "mapping.toml"))
        (tmp_path / "mapping.toml").write_text(MAPPING)
    found = calibrated(files, capsys, *options)
    for value in ("sensitivity", "offset"):
        wanted = expected[writer.since_1970][value]
        np.testing.assert_allclose(writer.full_scale * np.array(found[value]), wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.one_case
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_ends_in_one_line(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = BROKEN[name]
    for library in broken.needs:
        pytest.importorskip(library, reason=f"{library} is not installed")
    path = tmp_path / broken.name
    broken.make(path, SAMPLES["sensor"])
    assert run_cli(["calibrate", "--sensor", str(path), "--json", "-"]) == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.startswith(f"fieldcal calibrate: {path}"), error
    assert error.count("\n") == 1, error
    told = error.removeprefix(f"fieldcal calibrate: {path.parent}")
    assert re.search(broken.place, told), error
    assert re.search(broken.remedy, told), error
