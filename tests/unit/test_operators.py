"""An operator's hold, accept, rollback and pose: what they do, at odd moments too, and that a restart keeps to them."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from agent.config import parse_config
from agent.core.events import Command, Estimate
from agent.core.operators import CommandError, commanded_pose
from tests.clamp_windows import S_TRUE
from tests.unit.mounted_site import Site, begun, said, site_config, updates, windows

FAR = S_TRUE * np.array([1.0, 1.3, 1.0])  # beyond max_change


@pytest.mark.slow
def test_on_hold_nothing_changes_until_it_is_released() -> None:
    site = begun(site_config())
    before = updates(site.play(3))[-1]
    assert said(site.command("hold")) == [("HELD", "put on hold by k")]
    held = site.play(2)
    assert {(w.used, w.reason) for w in windows(held)} == {
        (False, "an operator put the calibration on hold; no window is used until an operator releases it")
    }
    assert updates(held) == []
    assert said(site.command("hold"))[0][1] == "hold refused: the calibration is on hold already"
    assert said(site.command("hold", release=True)) == [("VALID", "released by k")]
    assert updates(site.play(2))[-1].windows > before.windows


@pytest.mark.slow
def test_a_hold_outlives_a_kill() -> None:
    site = begun(site_config())
    site.play(3)
    site.command("hold")
    again = begun(site_config(), kept=site.kept(), day=1.0)
    assert said(again.results)[-1] == ("HELD", "restored from the previous run")
    assert not any(w.used for w in windows(again.play(2)))


def test_a_release_outlives_a_kill() -> None:
    site = begun(site_config())
    site.play(3)
    site.command("hold")
    site.command("hold", release=True)
    again = begun(site_config(), kept=site.kept(), day=1.0)
    assert said(again.results)[-1] == ("VALID", "restored from the previous run")


def proposing() -> Site:
    site = begun(site_config(gate={"policy": "propose"}))
    site.play(4)
    return site


def test_what_was_proposed_comes_in_force_when_it_is_accepted() -> None:
    site = proposing()
    proposed = [r for r in site.results if isinstance(r, Estimate)]
    assert updates(site.results) == []
    [update] = updates(site.command("accept", sequence=proposed[-2].sequence))
    assert update.sensitivity == proposed[-2].calibration.sensitivity
    assert said(site.results)[-1][0] == "VALID"
    refused = said(site.command("accept", sequence=proposed[-1].sequence))
    assert refused == [
        ("VALID", f"accept refused: estimate {proposed[-1].sequence} cannot be accepted; estimates that can be: none")
    ]
    assert (
        said(site.command("accept"))[0][1]
        == "accept refused: accept needs the sequence number of an estimate, not None"
    )


@pytest.mark.slow
def test_what_was_proposed_waits_through_a_kill() -> None:
    site = begun(site_config())
    site.play(3)
    site.play(7, S=FAR)
    waiting = [r for r in site.results if isinstance(r, Estimate)][-1]
    assert said(site.results)[-1][0] == "HELD"
    again = begun(site_config(), kept=site.kept(), day=1.0, last=waiting.sequence)
    [update] = updates(again.command("accept", sequence=waiting.sequence))
    assert abs(update.sensitivity[1][1] - FAR[1, 1]) < 0.01
    assert {w.used for w in windows(again.play(3, S=FAR))} == {True}


def test_an_estimate_of_another_device_is_not_there_to_accept() -> None:
    site = proposing()
    waiting = [r for r in site.results if isinstance(r, Estimate)][-1]
    site.open("s", "B")
    [(_, reason)] = said(site.command("accept", sequence=waiting.sequence))
    assert reason == f"accept refused: estimate {waiting.sequence} cannot be accepted; estimates that can be: none"


@pytest.mark.slow
def test_rolled_back_it_stays_so_until_released() -> None:
    site = begun(site_config())
    first = updates(site.play(3))[0]
    [update] = updates(site.command("rollback", first))
    assert (update.sensitivity, update.offset) == (first.sensitivity, first.offset)
    assert update.covariance == first.covariance
    assert updates(site.play(2)) == []
    site.command("hold", release=True)
    assert updates(site.play(2))


def test_a_rollback_to_another_devices_calibration_is_refused() -> None:
    site = begun(site_config())
    of_a = updates(site.play(3))[-1]
    site.open("s", "B")
    refused = site.command("rollback", of_a)
    assert updates(refused) == []
    [(status, reason)] = said(refused)
    assert status == "UNCALIBRATED"
    assert reason.startswith(f"rollback refused: calibration {of_a.sequence} belongs to serial-csv A ")


def test_a_rollback_that_is_no_calibration_is_refused_and_changes_nothing() -> None:
    site = begun(site_config())
    good = updates(site.play(3))[-1]
    whole = "is not complete: it must hold S, Q and a finite covariance of both"
    holes = [[float("nan")] * 12] * 12
    for bad in ({"covariance": holes}, {"covariance": [[0.0]]}, {"offset": [0.0]}):
        reasons = said(site.command("rollback", msgspec.structs.replace(good, **bad)))
        assert reasons == [("VALID", f"rollback refused: calibration {good.sequence} {whole}")]
    assert said(site.command("rollback"))[0][1].startswith(
        "rollback refused: the command holds no calibration that can be read: "
    )
    assert updates(site.play(2))  # it is not on hold


def test_words_to_a_sensor_that_was_never_there_are_refused() -> None:
    site = Site(site_config())
    assert said(site.command("hold")) == [("UNCALIBRATED", "hold refused: s has not been connected in this run")]


def test_a_sensor_beside_a_tri_axial_reference_takes_no_pose() -> None:
    # One of a uniaxial reference would leave it without windows for ever.
    site = begun(site_config())
    site.play(2)
    [(_, reason)] = said(site.command("pose", theta_deg=35.0, alpha_deg=0.0))
    assert reason.startswith("pose refused: the channel has a rotation to a tri-axial reference, so it takes no poses")
    assert {w.used for w in windows(site.play(2))} == {True}


def test_a_mount_that_never_turns_takes_no_pose() -> None:
    poses = [{"start_s": 0.0, "stop_s": 60.0, "theta_deg": 35.0, "alpha_deg": 0.0}]
    raw = {"devices": [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": 100}} for n in "sr"]}
    for count in (1, 2):
        stated = [pose | {"start_s": 60.0 * k, "stop_s": 60.0 * k + 50.0} for k, pose in enumerate(poses * count)]
        parts = {"sensor": "s", "reference": "r", "prior": {"sensitivity": 1.0}, "poses": stated}
        [channel] = parse_config(raw | {"channels": [parts]}, "").channels
        command = Command(
            sensor="s", verb="pose", t_monotonic_ns=0, t_utc_ns=0, arguments_json='{"theta_deg": 35, "alpha_deg": 120}'
        )
        if count == 1:
            with pytest.raises(CommandError, match="a single pose, so the mount never turns"):
                commanded_pose(command, channel)
        else:
            assert commanded_pose(command, channel).alpha_rad == pytest.approx(np.radians(120.0))
