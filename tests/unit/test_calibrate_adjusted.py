"""`fieldcal calibrate` with the adjustment, as a user runs it: faults undone, priors taken and contradicted."""

from __future__ import annotations

import contextlib
import copy
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.cli import run_cli
from agent.simulate import write_files
from hw.virtual.bench import Bench
from hw.virtual.presets import faulty

STATED = ("--u-offset-position-mps2", "0.05")


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("faulty")


@pytest.fixture(scope="module")
def bench(directory: Path) -> Bench:
    bench = Bench(faulty(11), 11)
    write_files(bench, directory, bench.parameters.schedule.duration_s(2), {})
    return bench


def run(directory: Path, *more: str) -> tuple[int, dict[str, Any], str]:
    files = [part for n in ("sensor", "reference", "poses") for part in (f"--{n}", str(directory / f"{n}.csv"))]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = run_cli(["calibrate", *files, *more, "--json", "-"])
    return status, json.loads(out.getvalue() or "{}"), err.getvalue()


@pytest.fixture(scope="module")
def accepted(directory: Path, bench: Bench) -> dict[str, Any]:
    nominal = bench.parameters.sensor.nominal_sensitivity
    status, found, said = run(directory, *STATED, "--nominal", f"{nominal}", "--u-nominal-pct", "20")
    assert (status, found["status"], found["reasons"], said) == (0, "valid", [], "")
    return found


@pytest.fixture
def found(accepted: dict[str, Any]) -> dict[str, Any]:
    return copy.deepcopy(accepted)


def test_faults_are_undone_within_the_stated_uncertainty(found: dict[str, Any], bench: Bench) -> None:
    truth = np.append(bench.truth.sensitivity.ravel(), bench.truth.offset)
    value = np.append(np.ravel(found["sensitivity"]), found["offset"])
    u = np.append(np.ravel(found["standard_uncertainty"]["sensitivity"]), found["standard_uncertainty"]["offset"])
    # Twelve correlated values of one recording whose faults are drawn from what is stated: none beyond 4 u.
    assert np.abs((value - truth) / u).max() < 4
    assert found["lag_s"] == pytest.approx(0.005, abs=2e-4)  # the clocks leave 0.1 ms
    assert sum(w["left_out"] for w in found["windows"]) > 100
    assert set(found["nuisances"]) >= {"theta", "gravity", "reference", "lag"}
    for nuisance in found["nuisances"].values():
        assert set(nuisance) == {"value", "standard_uncertainty", "unit"}


def test_plain_method_3_is_off_by_many_of_its_own_uncertainties(directory: Path, bench: Bench) -> None:
    status, plain, _ = run(directory, "--plain")
    assert status == 0
    u = np.ravel(plain["standard_uncertainty"]["sensitivity"])
    assert np.abs((np.ravel(plain["sensitivity"]) - bench.truth.sensitivity.ravel()) / u).max() > 4


def test_an_earlier_result_is_a_prior_and_a_wrong_one_is_refused(
    found: dict[str, Any], directory: Path, tmp_path: Path
) -> None:
    earlier = tmp_path / "earlier.json"
    looser = found | {"covariance": (np.array(found["covariance"]) * 100).tolist()}
    earlier.write_text(json.dumps(looser))
    status, again, _ = run(directory, *STATED, "--prior", str(earlier))
    assert status == 0
    # Each is linearised where it ends: their u agree to some per cent.
    np.testing.assert_allclose(np.diag(again["covariance"]), np.diag(found["covariance"]), rtol=0.1)
    looser["sensitivity"][0][0] *= 1.5
    earlier.write_text(json.dumps(looser))
    status, refused, said = run(directory, *STATED, "--prior", str(earlier))
    assert (status, refused["status"]) == (3, "refused")
    assert "contradict" in refused["reasons"][0]
    assert said.startswith("refused: ")


def test_the_same_data_again_add_too_little_to_be_a_result(
    found: dict[str, Any], directory: Path, tmp_path: Path
) -> None:
    (tmp_path / "earlier.json").write_text(json.dumps(found))
    status, again, _ = run(directory, *STATED, "--prior", str(tmp_path / "earlier.json"))
    assert (status, again["determined"]["offset"]) == (3, [False] * 3)  # u falls by a third, not by half


@pytest.mark.usefixtures("bench")
def test_a_nominal_value_of_another_unit_is_refused(directory: Path) -> None:
    status, refused, _ = run(directory, *STATED, "--nominal", "256000", "--u-nominal-pct", "5")  # counts per g
    assert (status, refused["status"]) == (3, "refused")
    assert refused["sensitivity"] == [[None] * 3] * 3


@pytest.mark.usefixtures("bench")
def test_the_wrong_static_sign_is_refused_and_named(directory: Path) -> None:
    status, refused, _ = run(directory, *STATED, "--static-sign", "-1")
    assert status == 3
    assert "sign" in " ".join(refused["reasons"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a result of fieldcal calibrate"),
        ("{}", "not a result of fieldcal calibrate"),
        ('{"sensitivity": [[1]], "offset": [0], "covariance": [[1]]}', "of another size"),
    ],
)
@pytest.mark.usefixtures("bench")
def test_a_prior_that_is_none_is_bad_input(directory: Path, tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "prior.json"
    path.write_text(text)
    status, found, said = run(directory, "--prior", str(path))
    assert (status, found) == (2, {})
    assert said.count("\n") == 1
    assert f"{path}: " in said
    assert message in said
