"""`fieldcal simulate --fleet`: signed results of many gateways, with drifting, silent, wrong and hostile ones."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from agent.cli.simulate import simulate
from agent.config.known_keys import add_key
from agent.core.events import CalibrationUpdate, DriftReport, Estimate, Result, StatusChange
from agent.delivery.consumer import Consumer, Received
from agent.fleet import simulated_processes
from agent.fleet.simulated import NEVER, ODD, FleetPlan, SimulatedFleet, SimulatedGateway, Stories, behaviours
from agent.fleet.simulated_channel import NOMINAL
from agent.fleet.simulated_processes import FleetProcesses, ProcessEnded
from agent.fleet.simulated_sensor import BEGINS, Behaviour, SimulatedSensor, Story
from tests.unit.zenoh_site import Site, taken_until, wait_for

COMMAND = "import sys; from agent.cli.main import run_cli; sys.exit(run_cli(sys.argv[1:]))"
WORDS = Path(simulated_processes.__file__).parents[1] / "monitor" / "page" / "words.js"
T_NS, DAY_NS = 1_790_000_000_000_000_000, 86_400 * 10**9


@contextmanager
def consumer_of(site: Site, fleet: SimulatedFleet, directory: Path) -> Iterator[Consumer]:
    """A consumer that knows the keys of the gateways."""
    for gateway in fleet.gateways:
        add_key(directory / "known", gateway.source, gateway.public_key)
    with Consumer([site.endpoint], keys=directory / "known") as consumer:
        yield consumer


@pytest.mark.thorough
def test_a_fleet_goes_on_while_the_router_is_away(tmp_path: Path) -> None:
    site = Site()
    with SimulatedFleet(FleetPlan(4, 1, 1, [site.endpoint], tmp_path)) as fleet:
        assert fleet.names_of("hostile")
        assert fleet.step(T_NS) > 0
        site.kill()
        assert fleet.step(T_NS + DAY_NS) > 0


@pytest.mark.thorough
def test_every_result_arrives_once_in_order_and_signed_and_forged_ones_are_refused(site: Site, tmp_path: Path) -> None:
    with (
        SimulatedFleet(FleetPlan(4, 1, 1, [site.endpoint], tmp_path)) as fleet,
        consumer_of(site, fleet, tmp_path) as consumer,
    ):
        assert not fleet.unconnected
        got: dict[str, int] = {}
        results: list[Received] = []
        sent = 0
        for rounds in (range(4), range(4, 6)):  # a gateway that is silent from round 4 on has been heard before
            sent += sum(fleet.step(T_NS + number * DAY_NS) for number in rounds)
            wait_for(lambda: all(gateway.published == gateway.last_sequence for gateway in fleet.gateways))
            last = {gateway.source: gateway.last_sequence for gateway in fleet.gateways}

            def all_there(result: Received, last: dict[str, int] = last) -> bool:
                assert result.signed_by
                assert result.sequence > got.get(result.address.source, 0)
                got[result.address.source] = result.sequence
                return got == last

            results += taken_until(consumer, all_there, 15.0)
            assert got == last
        assert len(results) <= sent
        assert consumer.refused["simulated/gw0000"] > 0  # the hostile gateway sends in its name
        held = {r.address.gateway for r in results if r.address.what == "status" and r.fields["status"] == "HELD"}
        assert held == {*fleet.names_of("held"), *fleet.names_of("hostile")}


# Ten days apart, until all that is looked at has been said.
ROUNDS: dict[Behaviour, int] = {
    "sound": 6,
    "drifting": 12,
    "stepped": 10,
    "held": 9,
    "leaning": 12,
    "dying": 8,
    "hostile": 5,
}
SOUND = ["UNCALIBRATED", "VALID"]


def test_a_silent_gateway_makes_no_more_results(tmp_path: Path) -> None:
    gateway = SimulatedGateway(FleetPlan(1, 1, 1, [], tmp_path), 0, "silent", Stories(1).sensors(0, "silent", 1))
    made = [gateway.step(T_NS + k * DAY_NS, NEVER) for k in range(BEGINS["silent"] + 2)]
    gateway.close()
    assert min(made[:-2]) > 0
    assert made[-2:] == [0, 0]
    assert gateway.truth()["since_utc_ns"] == T_NS + BEGINS["silent"] * DAY_NS


@cache
def told(behaviour: Behaviour) -> tuple[list[Result], dict[str, Any]]:
    """The results of a sensor, and the truth at the end. Its gateway's results have numbers from 1001 on."""
    other, sensor = (
        SimulatedSensor(story, name) for story in [Story("s0", behaviour, [1, 4])] for name in ("S0", "S1")
    )
    results: list[Result] = []
    for k in range(ROUNDS[behaviour]):
        other.results(k, T_NS + 10 * k * DAY_NS, 1)
        results += sensor.results(k, T_NS + 10 * k * DAY_NS, len(results) + 1001)
    return results, sensor.truth()


@pytest.mark.two_cases
@pytest.mark.parametrize(
    ("behaviour", "statuses"),
    [("sound", SOUND), ("drifting", SOUND), ("stepped", [*SOUND, "HELD", "RECALIBRATING"]), ("held", [*SOUND, "HELD"]),
     ("leaning", [*SOUND, "HELD"]), ("dying", [*SOUND, "HELD", "INVALID"]), ("hostile", [*SOUND, "HELD"])],
)  # fmt: skip
def test_statuses_are_those_of_the_agent_and_a_held_sensor_puts_nothing_in_force(
    behaviour: Behaviour, statuses: list[str]
) -> None:
    results, truth = told(behaviour)
    changes = [r for r in results if isinstance(r, StatusChange)]
    assert [status for status, _ in groupby(r.status for r in changes)] == statuses
    held = next((r.sequence for r in changes if r.status == "HELD"), len(results) + 1001)
    ended = next((r.sequence for r in changes if r.sequence > held and r.status != "HELD"), len(results) + 1001)
    # What ends HELD is put in force just before the status tells it.
    assert [r for r in results if isinstance(r, CalibrationUpdate) and held < r.sequence < ended - 1] == []
    assert truth["begun"] == (behaviour != "sound")


@pytest.mark.parametrize("behaviour", ["sound", "stepped"])
def test_s_is_near_its_nominal_value_until_it_changes(behaviour: Behaviour) -> None:
    truth = Story("s0", behaviour, [1, 4]).truth(0)
    np.testing.assert_allclose(truth.sensitivity / NOMINAL, np.eye(3), atol=0.1)


@pytest.mark.thorough
@pytest.mark.two_cases
@pytest.mark.parametrize(
    ("behaviour", "verdict"), [("drifting", "drifting"), ("stepped", "stepped"), ("held", "stepped")]
)
def test_the_parameter_that_changes_is_found(behaviour: Behaviour, verdict: str) -> None:
    results, truth = told(behaviour)
    report = next(r for r in results if isinstance(r, DriftReport) and r.parameter == truth["parameter"])
    assert report.verdict == verdict
    assert np.sign(report.change) == np.sign(truth["change_pct"])
    assert truth["since_utc_ns"] == T_NS + 10 * BEGINS[behaviour] * DAY_NS


@pytest.mark.thorough
def test_a_mount_that_leans_is_named_with_its_angle() -> None:
    results, truth = told("leaning")
    reasons = " ".join(r.reason for r in results if isinstance(r, StatusChange))
    assert f"A mount that leans by {truth['lean_deg']:.0f} deg does the same" in reasons


@pytest.mark.thorough
def test_the_page_reads_what_the_agent_says_of_held_windows() -> None:
    (line,) = (line for line in WORDS.read_text().splitlines() if line.startswith("const EXPLAINED = /"))
    pattern = (
        line.removeprefix("const EXPLAINED = /").removesuffix("/;").replace("(?<", "(?P<").replace("[^]", r"[\s\S]")
    )
    for behaviour in ("leaning", "held", "stepped"):
        reasons = [r.reason for r in told(behaviour)[0] if isinstance(r, StatusChange) and " held windows " in r.reason]
        found = [re.fullmatch(pattern, reason) for reason in reasons]
        assert reasons
        assert None not in found
        assert any(each and each["best"] and int(each["least"]) < int(each["none"]) for each in found)
    assert re.fullmatch(pattern, "the window contradicts the calibration") is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "behaviour", ["sound", *(pytest.param(other, marks=pytest.mark.thorough) for other in ("drifting", "stepped"))]
)
def test_u_covers_the_truth(behaviour: Behaviour) -> None:
    results, truth = told(behaviour)
    last = [r for r in results if isinstance(r, CalibrationUpdate)][-1]
    true = [*np.ravel(truth["sensitivity"]), *truth["offset"]]
    error = np.subtract([*np.ravel(last.sensitivity), *last.offset], true)
    assert np.abs(error / last.standard_uncertainty).max() < 3.5  # of twelve, one in 180 has more
    assert 2 * max(last.standard_uncertainty[:9]) < 0.05 * 26154


@pytest.mark.thorough
def test_words_name_an_estimate_by_the_number_that_its_own_gateway_gave_it() -> None:
    results, _ = told("leaning")  # another gateway has the same story, and other numbers
    numbers = {r.sequence for r in results if isinstance(r, Estimate)}
    named = {int(n) for r in results if isinstance(r, StatusChange) for n in re.findall(r"--sequence (\d+)", r.reason)}
    assert named
    assert named <= numbers


@pytest.mark.slow
def test_the_same_seed_gives_the_same_results() -> None:
    def made(seed: int) -> list[list[Result]]:
        story = Story("s0", "drifting", [seed])
        return [story.results(k, T_NS + k * DAY_NS) for k in range(3)]

    assert made(1) == made(1) != made(2)


def test_the_odd_gateways_are_drawn_by_the_seed() -> None:
    assert behaviours(1000, 1) == behaviours(1000, 1) != behaviours(1000, 2)
    assert Counter(behaviours(1000, 1)) == {"sound": 800, **dict.fromkeys(ODD, 25)}
    assert Counter(behaviours(9, 7)) == dict.fromkeys(("sound", *ODD), 1)
    assert behaviours(1, 1) == ["drifting"]


def fleet_command(site: Site, directory: Path, *options: str) -> subprocess.Popen[str]:
    """The command with five gateways, when they are on the bus."""
    told = [sys.executable, "-c", COMMAND, "simulate", "--fleet", "5", "--sensors", "1", "--every", "0.2",
            "--connect", site.endpoint, *options]  # fmt: skip
    environment = {"TMPDIR": str(directory), "PATH": "/usr/bin:/bin"}
    process = subprocess.Popen(told, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    assert process.stdout.readline() == f"5 gateways with 1 sensors each at {site.endpoint}, seed 1\n"
    return process


@pytest.mark.thorough
def test_ctrl_c_ends_the_command_in_order(site: Site, tmp_path: Path) -> None:
    process = fleet_command(site, tmp_path, "--keys", str(tmp_path / "known"))
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    assert out.endswith("results sent\n")
    assert [path.name for path in tmp_path.iterdir()] == ["known"]
    assert (tmp_path / "known").read_text().count("gateway simulated/gw") == 5


@pytest.mark.thorough
def test_the_command_tells_that_a_process_has_ended(site: Site, tmp_path: Path) -> None:
    process = fleet_command(site, tmp_path)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    of_fleet = [int(pid) for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    os.kill(of_fleet[0], signal.SIGSEGV)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert err == "fieldcal simulate: a process of the fleet was ended by SIGSEGV\n"
    assert "results sent" not in out


def test_options_that_do_not_belong_together() -> None:
    for words, told in (
        (["--fleet", "3", "--preset", "plain"], "--fleet goes with"),
        (["--preset", "plain", "--every", "5"], "need --fleet"),
        ([], "give --preset, --play or --fleet"),
    ):
        done = CliRunner().invoke(simulate, words)
        assert (done.exit_code, told in done.stderr) == (2, True)


def test_an_invalid_endpoint_is_bad_input() -> None:
    done = CliRunner().invoke(simulate, ["--fleet", "2", "--connect", "nonsense"], standalone_mode=False)
    assert (done.return_value, "not an endpoint" in done.stderr) == (2, True)


@pytest.mark.thorough
def test_a_fleet_in_several_processes_is_the_same_fleet(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulated_processes, "GATEWAYS_EACH", 2)
    with (
        SimulatedFleet(FleetPlan(3, 1, 7, [site.endpoint], tmp_path / "one")) as one,
        FleetProcesses(FleetPlan(3, 1, 7, [site.endpoint], tmp_path / "many")) as many,
    ):
        assert len(set(many.pids())) == 2
        assert sorted((g.name, g.behaviour, g.public_key) for g in many.gateways) == [
            (g.name, g.behaviour, g.public_key) for g in one.gateways
        ]
        before = many.last_sequence()
        begun_s = time.monotonic()
        results = many.step(T_NS, 0.6)
        assert time.monotonic() - begun_s > 0.3
        after = many.last_sequence()
        assert results == one.step(T_NS) == sum(after.values()) - sum(before.values())
        assert all(after[name] > before[name] for name in after)


@pytest.mark.slow
def test_gateways_make_their_results_one_after_the_other(site: Site, tmp_path: Path) -> None:
    with (
        SimulatedFleet(FleetPlan(5, 1, 1, [site.endpoint], tmp_path)) as fleet,
        consumer_of(site, fleet, tmp_path) as consumer,
    ):
        fleet.step(T_NS, 0.5)
        times: dict[str, int] = {}

        def all_there(result: Received) -> bool:
            times[result.address.gateway] = result.fields["t_utc_ns"] - T_NS
            return len(times) == 5

        taken_until(consumer, all_there, 15.0)
        assert sorted(times.values()) == [k * 100_000_000 for k in range(5)]


@pytest.mark.thorough
def test_a_process_that_ends_is_told(site: Site, tmp_path: Path) -> None:
    with FleetProcesses(FleetPlan(2, 1, 1, [site.endpoint], tmp_path)) as fleet:
        os.kill(fleet.pids()[0], signal.SIGKILL)
        with pytest.raises(ProcessEnded, match="ended by SIGKILL, as Linux does where there is too little memory"):
            fleet.step(T_NS)
