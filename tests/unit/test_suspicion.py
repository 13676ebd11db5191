"""A suspected change in words, in the covariance, in a report and in an export."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.export.samples import content_of, start_of
from agent.site_watch.source import WatchError
from agent.site_watch.suspicion import Suspicion, sentence, suspicion_of
from calib.model import PARAMETERS
from calib.site_watch.verdicts import SensorVerdict
from calib.site_watch.witnesses import Witness, gravity, noise, self_test, supply_basis
from tests.unit.recorded_bench import EPOCH_NS, record
from tests.unit.results import calibration

DAY = 19_675  # 2023-11-14, the day of `calibration`
S = np.array([[26154.0, 120.0, 50.0], [-195.0, 26123.0, 67.0], [-81.0, 87.0, 26295.0]])


def suspicion(**more: Any) -> Suspicion:
    told: dict[str, Any] = {
        "gateway": "gw", "sensor": "mems", "axes": "z", "turn": False, "size": -0.011, "expanded_uncertainty": 0.003,
        "since": "2023-11-12", "earliest": "2023-11-10", "latest": "2023-11-15", "witnesses": [], "text": "fallen",
    }  # fmt: skip
    return Suspicion(**told | more)


def verdicts(path: Path, *found: Suspicion) -> Path:
    sensors = [{"suspected": one} for one in (*found, None)]
    path.write_bytes(msgspec.json.encode({"until": "2023-11-20", "sensors": sensors, "more": 1}))
    return path


@pytest.mark.parametrize(("axes", "turn"), [("x", False), ("xyz", False), ("y", True)])
def test_the_enlarged_u_holds_the_true_sensitivity(axes: str, turn: bool) -> None:
    """20,000 sites: the true change is the told size with its u, and S in force has its own. At least 95 % of the true
    values lie within the enlarged U (99.9 % lower bound of a binomial), which is no wider than the change and both U.
    """
    random, n, size, u_size, u = np.random.default_rng(3), 20_000, -0.011, 0.0024, 5.0
    one = suspicion(axes=axes, turn=turn, size=size, expanded_uncertainty=2.0 * u_size)
    covariance = one.enlarged(S, np.diag(np.full(12, u**2)))
    U = 2.0 * np.sqrt(np.diag(covariance))[:9].reshape(3, 3)
    true = random.normal(size, u_size, n)
    D = np.zeros((3, 3))
    if turn:  # about y: z turns towards x
        D[2, 0], D[0, 2] = 1.0, -1.0
    else:
        for axis in axes:
            D["xyz".index(axis), "xyz".index(axis)] = 1.0
    moved = true[:, None, None] * (S @ D) + random.normal(0.0, u, (n, 3, 3))
    inside = np.mean(np.abs(moved) <= U, axis=0)
    assert inside.min() >= 0.95 - 3.3 * np.sqrt(0.05 * 0.95 / n)
    assert np.all(2.0 * np.hypot(np.abs(size * S @ D), np.hypot(u_size * np.abs(S @ D), u)) + 1e-9 >= U)
    assert np.array_equal(np.diag(covariance)[9:], np.full(3, u**2)), "Q stays"


def test_a_result_from_before_the_change_or_made_after_it_stays() -> None:
    update, one = calibration(4), suspicion()
    later = one.update(update)
    assert (later.sensitivity, later.offset) == (update.sensitivity, update.offset)
    i = PARAMETERS.index("Szz")
    wanted = np.sqrt(update.standard_uncertainty[i] ** 2 + 26295.0**2 * (0.011**2 + 0.0015**2))
    assert later.standard_uncertainty[i] == pytest.approx(wanted)
    assert later.standard_uncertainty[0] == update.standard_uncertainty[0]
    with_budget = one.update(msgspec.structs.replace(update, budget={"all": update.standard_uncertainty}))
    assert with_budget.budget["suspected change"][i] == pytest.approx(26295.0 * np.hypot(0.011, 0.0015))
    assert np.sqrt(sum(np.square(part) for part in with_budget.budget.values())) == pytest.approx(
        with_budget.standard_uncertainty)  # fmt: skip
    before = suspicion(since="2023-12-01", earliest="2023-11-30", latest="2023-12-02")
    assert before.update(update) is update
    visited = suspicion(since="2023-10-01", earliest="2023-10-01", latest="2023-10-02")
    assert visited.update(update) is update, "it was made after the change"


def test_what_gravity_and_noise_say() -> None:
    mean, u = np.array([0.1, -0.2, 9.8]), np.array([0.01, 0.01, 0.01])
    yes = gravity(2, -0.011, 0.0015, mean, np.array([0.0, 0.0, -0.12]), u)
    assert (yes.says, yes.size, yes.u) == ("agrees", pytest.approx(-0.12 / 9.8), pytest.approx(0.01 / 9.8))
    assert gravity(2, -0.011, 0.0015, mean, np.zeros(3), u).says == "contradicts"
    assert gravity(0, -0.011, 0.0015, mean, np.zeros(3), u).says == "silent", "0.1 m/s2 changes by 1 mm/s2"
    assert gravity(2, -0.011, 0.0015, mean, np.zeros(3), np.full(3, np.inf)).says == "silent", "no mean is told"
    # A turn by 1 degree about x takes gravity from y: a_y' = a_y + theta a_z, as calib.site_watch.together has it.
    turned = gravity(4, np.radians(1.0), 0.002, mean, np.array([0.0, 9.8 * np.radians(1.0), 0.0]), u)
    assert turned.says == "agrees"
    assert turned.size == pytest.approx(np.radians(1.0), rel=1e-3)
    louder = noise(3, np.array([0.01, 0.3, 0.0]), np.full(3, 0.05))
    assert (louder.says, louder.size) == ("agrees", pytest.approx(np.exp(0.3) - 1.0))
    assert noise(0, np.array([0.01, 0.3, 0.0]), np.full(3, 0.05)).says == "silent", "of x nothing has changed"
    assert noise(4, np.full(3, 0.3), np.full(3, 0.05)).says == "silent", "noise keeps its axes in a turn"


def test_what_the_self_test_says() -> None:
    u, supply = np.full(3, 0.002), np.full(3, 0.02)
    own, common = 0.002**2 + (0.1 * 0.02) ** 2, 3.0 * 0.02**2  # variance across and along what the supply does

    def said(direction: int, size: float, step: Any, u_step: Any = u, u_supply: Any = supply) -> Witness:
        return self_test(direction, size, 0.0015, supply_basis(u_supply[None])[0] @ step, u_step, u_supply)

    # One axis: it is seen against the others, whatever the supply has done to all of them.
    yes = said(0, -0.011, np.array([-0.013, 0.0, 0.0]) + 0.001)
    assert (yes.says, yes.u) == ("agrees", pytest.approx((2.0 / 3.0 / own + 1.0 / 3.0 / (own + common)) ** -0.5))
    assert said(0, -0.011, np.array([-0.013, 0.0, 0.0]) + 0.05).size == pytest.approx(-0.013, abs=0.001)
    assert said(0, -0.011, np.full(3, 0.05)).says == "contradicts"
    # All axes: no more than the supply lets be seen.
    assert said(3, -0.011, np.full(3, -0.011)).says == "silent"
    both = said(3, -0.06, np.full(3, -0.06))
    assert (both.says, both.u) == ("agrees", pytest.approx(np.sqrt((own + common) / 3.0)))
    assert said(3, -0.06, np.zeros(3)).says == "contradicts"
    assert said(3, -0.06, np.full(3, 0.06)).says == "contradicts", "it has risen"
    # An ADXL345: the supply changes x and y more than z, so that all axes alike is another thing.
    uneven = np.array([0.0206, 0.0206, 0.0139])
    assert said(3, -0.02, np.full(3, -0.02), u, uneven).says == "agrees"
    assert said(3, -0.02, uneven, u, uneven).says == "contradicts"
    # Neither as large as the structure tells nor none: nothing is said against it.
    assert said(0, -0.011, np.array([-0.006, 0.0, 0.0])).says == "silent"
    # Another size of the same sign: how much of a change the response shows is not known.
    assert said(0, -0.011, np.array([-0.03, 0.0, 0.0])).says == "agrees"
    assert said(5, 0.02, np.full(3, 0.02)).says == "silent", "a turn moves nothing within the sensor"
    assert said(0, -0.011, np.zeros(3), np.array([np.inf, 0.002, 0.002])).says == "silent", "too few nights"
    assert self_test(0, -0.011, 0.0015, np.zeros(3), u, np.full(3, np.nan)).says == "silent"
    steady = said(3, -0.011, np.full(3, -0.011), u, np.zeros(3))
    assert (steady.says, steady.u) == ("agrees", pytest.approx(0.002 / np.sqrt(3.0)))


def test_the_sentence_names_each_witness() -> None:
    told = SensorVerdict(
        "sensitivity", "sensitivity of x", np.log1p(-0.011), 0.003, DAY, DAY - 2, DAY + 1, 4.1, 0,
        (Witness("structure", "agrees", -0.011, 0.0027), Witness("gravity", "silent"), Witness("noise", "silent")),
    )  # fmt: skip
    assert sentence(told) == (
        "sensitivity of x has fallen by 1.10 ± 0.30 % since 2023-11-14 ± 2 d: the structure says so (4.1 u), "
        "gravity is silent, noise is silent"
    )
    told = replace(told, witnesses=(Witness("self-test", "agrees", -0.013, 0.004),))
    assert sentence(told).endswith(": the self-test says so (3.2 u)")
    told = replace(told, witnesses=(Witness("self-test", "contradicts", 0.001, 0.002),))
    assert sentence(told).endswith(": the self-test contradicts it (+0.10 % ± 0.40 %)")


def test_files_of_verdicts_that_cannot_be_used(tmp_path: Path) -> None:
    def refused(data: bytes) -> str:
        path = tmp_path / "told.json"
        path.write_bytes(data)
        with pytest.raises(WatchError) as error:
            suspicion_of(path, "mems")
        return str(error.value)

    assert "not a result of `fieldcal fleet watch --json`" in refused(b"{}")
    assert "not a result of" in refused(b"\xff\x00")
    each: list[dict[str, Any]] = [
        {"size": 10.0}, {"expanded_uncertainty": -11.0}, {"axes": "w"}, {"since": "tomorrow"},
        {"axes": "xyz", "turn": True},
    ]  # fmt: skip
    for wrong in each:
        assert "gw/mems" in refused(verdicts(tmp_path / "v", suspicion(**wrong)).read_bytes())
    two = verdicts(tmp_path / "two", suspicion(), suspicion(gateway="other"))
    with pytest.raises(WatchError, match="2 gateways have a suspected sensor mems"):
        suspicion_of(two, "mems")
    assert suspicion_of(two, "mems", "other") == suspicion(gateway="other")
    assert suspicion_of(two, "pier") is None


@pytest.mark.thorough
def test_report_and_export_use_the_enlarged_u(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "data", 41.0)
    [recording] = (tmp_path / "data").glob("*.mcap")
    day = str(np.datetime64(EPOCH_NS, "ns").astype("datetime64[D]"))
    found = content_of([recording], None).calibrations[-1]
    start = {"gateway": start_of(recording).gateway, "since": day, "earliest": day, "latest": "2099-01-01"}
    told = verdicts(tmp_path / "told.json", suspicion(**start))
    enlarged = suspicion(**start).update(found)

    def done(*given: str | Path) -> str:
        assert run_cli([str(part) for part in given]) == 0
        return capsys.readouterr().err

    assert "mems: fallen" in done("export", recording, "-o", tmp_path / "out.csv", "--site-verdicts", told)
    head = (tmp_path / "out.csv").read_text().splitlines()[:3]
    U = 100.0 * found.coverage_factor * enlarged.standard_uncertainty[8] / abs(found.sensitivity[2][2])
    assert head[0] == "# suspected: fallen"
    assert head[1].startswith("# U of Sxx, Syy, Szz, %: ")
    assert head[1].endswith(f", {U:.2g}")
    assert head[2].startswith("time_s,")
    for ending in ("uff", "mseed"):
        out = str(tmp_path / f"o.{ending}")
        assert run_cli(["export", str(recording), "-o", out, "--site-verdicts", str(told)]) == 2
        assert "has no place for U" in capsys.readouterr().err
    pytest.importorskip("matplotlib", reason="the extra report is not installed")
    done("report", recording, "-o", tmp_path / "report", "--site-verdicts", told)
    held = json.loads((tmp_path / "report" / "report.json").read_text())
    [result] = held["results"]
    assert result["sensitivity"] == pytest.approx(np.array(found.sensitivity))
    u = np.ravel(result["standard_uncertainty"]["sensitivity"])
    assert u == pytest.approx(enlarged.standard_uncertainty[:9])
    in_force = np.ravel(result["suspected"]["in_force"]["standard_uncertainty"]["sensitivity"])
    assert in_force == pytest.approx(found.standard_uncertainty[:9])
    assert "suspected by the other sensors of the site: fallen. U holds this change" in held["notices"]
    assert "the site: fallen. U holds this change" in (tmp_path / "report" / "report.html").read_text()
    other = verdicts(tmp_path / "none.json")
    done("report", recording, "-o", tmp_path / "again", "--site-verdicts", other)
    again = json.loads((tmp_path / "again" / "report.json").read_text())
    assert "the verdicts of the site suspect nothing of this sensor" in again["notices"]
