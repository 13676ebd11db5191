"""`fieldcal simulate --fleet`: signed results of many gateways, with drifting, silent, wrong and hostile ones."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner

from agent.cli.simulate import simulate
from agent.config.known_keys import add_key
from agent.core.events import DriftReport, StatusChange, WindowReport
from agent.delivery.consumer import Consumer, Received
from agent.fleet import simulated_processes
from agent.fleet.simulated import ODD, SimulatedFleet, behaviours
from agent.fleet.simulated_processes import FleetProcesses
from agent.fleet.simulated_sensor import SimulatedSensor
from tests.unit.zenoh_site import Site, taken_until, wait_for

COMMAND = "import sys; from agent.cli.main import run_cli; sys.exit(run_cli(sys.argv[1:]))"
T_NS, DAY_NS = 1_790_000_000_000_000_000, 86_400 * 10**9


@contextmanager
def consumer_of(site: Site, fleet: SimulatedFleet, directory: Path) -> Iterator[Consumer]:
    """A consumer that knows the keys of the gateways."""
    for gateway in fleet.gateways:
        add_key(directory / "known", gateway.source, gateway.public_key)
    with Consumer([site.endpoint], keys=directory / "known") as consumer:
        yield consumer


def test_a_fleet_goes_on_while_the_router_is_away(tmp_path: Path) -> None:
    site = Site()
    with SimulatedFleet(4, 1, 1, [site.endpoint], tmp_path) as fleet:
        assert fleet.names_of("hostile")
        assert fleet.step(T_NS) > 0
        site.kill()
        assert fleet.step(T_NS + DAY_NS) > 0


def test_every_result_arrives_once_in_order_and_signed_and_forged_ones_are_refused(site: Site, tmp_path: Path) -> None:
    with (
        SimulatedFleet(6, 2, 1, [site.endpoint], tmp_path) as fleet,
        consumer_of(site, fleet, tmp_path) as consumer,
    ):
        assert not fleet.unconnected
        got: dict[str, int] = {}
        results: list[Received] = []
        sent = 0
        for rounds in (range(4), range(4, 7)):  # a gateway that is silent from round 4 on has been heard before
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
        told = Counter((r.address.gateway, r.address.what) for r in results)
        for name in fleet.names_of("drifting"):
            assert told[name, "drift"] >= 1


def test_what_each_behaviour_tells() -> None:
    def rounds(behaviour: str, count: int = 12) -> list[object]:
        sensor = SimulatedSensor("s", behaviour, [1, 2])  # type: ignore[arg-type]
        return [result for k in range(count) for result in sensor.results(k, T_NS + k * DAY_NS, 1 + 10 * k)]

    statuses = {kind: [r.status for r in rounds(kind) if isinstance(r, StatusChange)] for kind in ("sound", *ODD)}
    assert statuses == {
        "sound": ["VALID"], "drifting": ["VALID", "HELD"], "silent": ["VALID", "INVALID"], "wrong": ["VALID", "HELD"],
        "hostile": ["VALID", "HELD"],
    }  # fmt: skip
    drifts = [r for r in rounds("drifting") if isinstance(r, DriftReport)]
    assert [r.verdict for r in drifts] == ["drifting"] * 7
    days = [(r.t_utc_ns - r.onset_utc_ns) / DAY_NS for r in drifts]
    assert [r.rate * d for r, d in zip(drifts, days, strict=True)] == pytest.approx([r.change for r in drifts])
    assert not any(r.used for r in rounds("wrong")[-3:] if isinstance(r, WindowReport))
    assert rounds("sound") == rounds("sound")


def test_the_odd_gateways_are_drawn_by_the_seed() -> None:
    assert behaviours(1000, 1) == behaviours(1000, 1) != behaviours(1000, 2)
    assert Counter(behaviours(1000, 1)) == {"sound": 800, "drifting": 50, "silent": 50, "wrong": 50, "hostile": 50}
    assert Counter(behaviours(5, 7)) == dict.fromkeys(("sound", *ODD), 1)
    assert behaviours(1, 1) == ["drifting"]


def test_ctrl_c_ends_the_command_in_order(site: Site, tmp_path: Path) -> None:
    told = [sys.executable, "-c", COMMAND, "simulate", "--fleet", "5", "--sensors", "1", "--every", "0.2",
            "--connect", site.endpoint, "--keys", str(tmp_path / "known")]  # fmt: skip
    environment = {"TMPDIR": str(tmp_path), "PATH": "/usr/bin:/bin"}
    process = subprocess.Popen(told, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    assert process.stdout.readline() == f"5 gateways with 1 sensors each at {site.endpoint}, seed 1\n"
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (0, "")
    assert out.endswith("results sent\n")
    assert [path.name for path in tmp_path.iterdir()] == ["known"]
    assert (tmp_path / "known").read_text().count("gateway simulated/gw") == 5


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


def test_a_fleet_in_several_processes_is_the_same_fleet(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulated_processes, "GATEWAYS_EACH", 4)
    with (
        SimulatedFleet(9, 1, 7, [site.endpoint], tmp_path / "one") as one,
        FleetProcesses(9, 1, 7, [site.endpoint], tmp_path / "many") as many,
    ):
        assert len(set(many.pids())) == 3
        assert sorted((g.name, g.behaviour, g.public_key) for g in many.gateways) == [
            (g.name, g.behaviour, g.public_key) for g in one.gateways
        ]
        before = many.last_sequence()
        begun_s = time.monotonic()
        results = many.step(T_NS, 1.5)
        assert time.monotonic() - begun_s > 1.0
        after = many.last_sequence()
        assert results == one.step(T_NS) == sum(after.values()) - sum(before.values())
        assert all(after[name] > before[name] for name in after)


def test_gateways_make_their_results_one_after_the_other(site: Site, tmp_path: Path) -> None:
    with (
        SimulatedFleet(5, 1, 1, [site.endpoint], tmp_path) as fleet,
        consumer_of(site, fleet, tmp_path) as consumer,
    ):
        fleet.step(T_NS, 0.5)
        times: dict[str, int] = {}

        def all_there(result: Received) -> bool:
            times[result.address.gateway] = result.fields["t_utc_ns"] - T_NS
            return len(times) == 5

        taken_until(consumer, all_there, 15.0)
        assert sorted(times.values()) == [k * 100_000_000 for k in range(5)]


def test_a_process_that_ends_is_told(site: Site, tmp_path: Path) -> None:
    with FleetProcesses(2, 1, 1, [site.endpoint], tmp_path) as fleet:
        os.kill(fleet.pids()[0], signal.SIGKILL)
        with pytest.raises(BrokenProcessPool):
            fleet.step(T_NS)
