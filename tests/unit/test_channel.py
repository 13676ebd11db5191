"""A channel through swapped devices, restarts, another configuration, and states that nobody can read."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

from agent.config.knowledge import Certificate
from agent.core.events import DriftReport, Estimate
from agent.core.identity import not_certified
from agent.core.kept import shelved
from agent.core.pipeline import Pipeline
from agent.core.snapshot import pack, unpack
from tests.building_windows import GRAVITY
from tests.clamp_windows import S_TRUE
from tests.unit.mounted_site import EPOCH_NS, SECOND, WINDOW_S, Site, begun, said, site_config, updates, windows

OF_B = S_TRUE * 0.97


@pytest.mark.slow
def test_a_to_b_to_a_goes_on_where_each_was() -> None:
    site = begun(site_config())
    of_a = updates(site.play(4))[-1]
    site.open("s", "B")
    of_b = updates(site.play(4, S=OF_B))[-1]
    assert abs(of_b.sensitivity[1][1] - OF_B[1, 1]) < 3e-3
    [again] = updates(site.open("s", "A"))
    assert (again.sensitivity, again.covariance, again.windows) == (of_a.sensitivity, of_a.covariance, of_a.windows)
    later = updates(site.play(3))[-1]
    assert later.identity == of_a.identity
    assert later.windows > of_a.windows
    assert abs(later.sensitivity[1][1] - S_TRUE[1, 1]) < 2e-3
    assert set(site.kept()) == {of_a.identity, of_b.identity}


def test_samples_of_the_device_before_are_nothing_to_the_next() -> None:
    site = begun(site_config())
    site.play(2)
    site.play(1, devices="s")  # the reference is late: this window waits for it
    site.lose("s")
    site.open("s", "B")
    closed = windows(site.play(1, devices="r")) + windows(site.wait(10))
    assert closed
    assert {(w.used, w.reason) for w in closed} == {(False, "no samples of s")}
    assert updates(site.results)[-1].identity.startswith("serial-csv A ")


def test_a_device_that_comes_back_goes_on_with_the_next_window() -> None:
    site = begun(site_config())
    site.play(3)
    site.lose("s")
    site.wait(60)
    assert said(site.results)[-1][0] == "INVALID"
    site.open("s", "A")
    assert any(w.used for w in windows(site.play(3)))
    assert ("VALID", "s sends data again") in said(site.results)


@pytest.mark.slow
def test_another_reference_is_told_and_taken_by_its_own_certificate() -> None:
    site = begun(site_config(certificate={"u_sensitivity_pct": 0.3}))
    site.play(4)
    assert said(site.open("r", "A")) == []
    [(_, reason)] = said(site.open("r", "C"))
    assert reason.startswith("the reference is another device now: serial-csv C ")
    assert [w.used for w in windows(site.play(3))][-2:] == [True, True]
    assert abs(updates(site.results)[-1].sensitivity[1][1] - S_TRUE[1, 1]) < 3e-3


def test_a_reference_that_is_not_the_certificates_is_not_used() -> None:
    config = site_config(certificate={"serial_number": "A"})
    site = Site(config)
    site.open("s", "A")
    told = [reason for _, reason in said(site.open("r", "C"))]
    reason = "the certificate is of serial number A, but the reference has serial number C"
    assert told == [f"S and Q are not updated: {reason}"]
    assert {(w.used, w.reason) for w in windows(site.play(3))} == {(False, reason)}
    restored = Pipeline.restore(config.model_dump_json(), site.pipeline.snapshot())
    assert restored.snapshot() == site.pipeline.snapshot()
    assert said(site.open("r", "A"))
    assert [w.used for w in windows(site.play(3))][-2:] == [True, True]


@pytest.mark.parametrize(("stated", "told"), [("", "C"), ("A", ""), ("A", "A")])
def test_a_certificate_or_reference_without_a_number_may_be_the_one(stated: str, told: str) -> None:
    info_json = json.dumps({"serial_number": told})
    assert not_certified(info_json, Certificate(serial_number=stated)) == ""


def test_states_of_many_devices_in_one_place_the_oldest_go() -> None:
    kept: dict[str, bytes] = {}
    for n in [*range(12), 5]:
        kept = shelved(kept, str(n), b"%d" % n)
    assert list(kept) == ["4", "6", "7", "8", "9", "10", "11", "5"]


@pytest.mark.slow
def test_windows_held_for_a_wrong_reference_go_with_it() -> None:
    site = begun(site_config())
    site.play(3)
    site.play(4, S=S_TRUE * 1.6)
    assert said(site.results)[-1][0] == "HELD"
    assert [status for status, _ in said(site.open("r", "C"))] == ["VALID"]
    assert [w.used for w in windows(site.play(3))][-2:] == [True, True]


@pytest.mark.slow
@pytest.mark.parametrize("order", ["rs", "sr"])
def test_another_reference_after_a_restart_is_not_taken_for_the_one_before(order: str) -> None:
    site = begun(site_config())
    site.play(4)
    for serial_number, references in (("A", 1), ("C", 2)):
        again = Site(site_config(), kept=site.kept(), day=1.0)
        for device in order:
            again.open(device, serial_number if device == "r" else "A")
        assert said(again.results)[0] == ("VALID", "restored from the previous run")
        again.play(2)
        estimation = again.pipeline._channels[0]._estimation
        assert estimation is not None
        assert len(estimation.state.references) == references


@pytest.mark.slow
def test_restored_after_a_kill_it_is_the_calibration_of_before() -> None:
    site = begun(site_config())
    before = updates(site.play(4))[-1]
    again = begun(site_config(), kept=site.kept(), day=30.0, last=before.sequence)
    [update] = updates(again.results)
    assert (update.sensitivity, update.offset, update.covariance) == (
        before.sensitivity, before.offset, before.covariance,
    )  # fmt: skip
    assert said(again.results) == [("VALID", "restored from the previous run")]
    # A month of wandering is in it: S may have gone 0.03 %, Q 11 mm/s2 and what the drift rate leaves.
    later = updates(again.play(3))[0]
    assert later.windows == before.windows + 1
    assert abs(later.sensitivity[1][1] - S_TRUE[1, 1]) < 2e-3


@pytest.mark.slow
def test_a_step_in_a_later_run_is_dated_in_utc() -> None:
    """The estimation counts its days through all runs; here the second one begins on day 30."""
    site = begun(site_config())
    site.play(3)
    again = begun(site_config(), kept=site.kept(), day=30.0, last=100)
    again.play(2)
    stepped_ns = EPOCH_NS + (30 * 86400 + again.t_s) * SECOND
    again.play(4, S=S_TRUE * np.array([1.0, 1.02, 1.0]))
    told = [(r.parameter, r.verdict) for r in again.results if isinstance(r, DriftReport)]
    assert told == [("Syy", "stepped")]
    [onset_ns] = [r.onset_utc_ns for r in again.results if isinstance(r, DriftReport)]
    assert stepped_ns < onset_ns < stepped_ns + (WINDOW_S + 2) * SECOND  # the end of the first window after it


def test_restored_in_the_midst_it_goes_on_bit_for_bit() -> None:
    site = begun(site_config(gate={"policy": "propose"}))
    site.play(3)
    state = site.pipeline.snapshot()
    restored = type(site.pipeline).restore(site_config(gate={"policy": "propose"}).model_dump_json(), state)
    assert restored.snapshot() == state
    site.play(2)
    assert [r for r in site.results if isinstance(r, Estimate)]


@pytest.mark.slow
def test_a_state_made_with_another_configuration_goes_on_with_what_is_stated_now() -> None:
    site = begun(site_config())
    before = updates(site.play(4))[-1]
    changed = site_config(temperature={"offset_order": 2, "sensitivity_order": 1}, uncertainty={"tilt_deg": 0.5})
    again = begun(changed, kept=site.kept(), day=1.0, last=before.sequence)
    changed_settings = "these settings have changed and were exchanged in the state: temperature, uncertainty"
    assert said(again.results) == [("VALID", f"restored from the previous run; {changed_settings}")]
    [update] = updates(again.results)
    np.testing.assert_allclose(update.sensitivity, before.sensitivity, rtol=0, atol=1e-3)
    assert update.standard_uncertainty[4] > 0.99 * before.standard_uncertainty[4]
    later = updates(again.play(3))[-1]
    assert len(later.offset_temperature) == 2
    assert abs(later.sensitivity[1][1] - S_TRUE[1, 1]) < 2e-3
    output = np.array(later.sensitivity) @ GRAVITY + later.offset
    np.testing.assert_allclose(output, np.array(before.sensitivity) @ GRAVITY + before.offset, rtol=0, atol=0.02)


def test_how_fast_things_may_change_is_no_other_state() -> None:
    site = begun(site_config())
    site.play(3)
    again = begun(site_config(process={"offset_mps2": 0.01}, gate={"confirm_windows": 7}), kept=site.kept(), day=1.0)
    assert said(again.results) == [("VALID", "restored from the previous run")]


def test_a_new_prior_takes_the_place_of_the_one_before() -> None:
    site = begun(site_config())
    before = updates(site.play(3))[-1]
    again = begun(site_config(prior={"sensitivity": 1.01}), kept=site.kept(), day=1.0)
    [update] = updates(again.results)
    assert update.sensitivity != before.sensitivity
    np.testing.assert_allclose(update.sensitivity, before.sensitivity, rtol=0, atol=1e-4)  # the windows tell it
    np.testing.assert_allclose(update.standard_uncertainty, before.standard_uncertainty, rtol=0.011)  # 1 % of nominal


def test_a_new_prior_that_the_calibration_in_force_contradicts_is_an_operators_word() -> None:
    site = begun(site_config())
    site.play(3)
    again = begun(site_config(prior={"sensitivity": 1.5}), kept=site.kept(), day=1.0)
    assert updates(again.results) == []
    [(status, reason)] = said(again.results)
    assert status == "UNCALIBRATED"
    assert reason.startswith("begun again from the prior: the calibration in force contradicts the changed prior: ")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "status", "reason"),
    [
        (lambda state: state[:-1], "UNCALIBRATED", "begun again from the prior: the stored state cannot be read: "),
        (
            lambda state: pack({"estimation": unpack(state)["estimation"]}),
            "UNCALIBRATED",
            "begun again from the prior: the stored state ",
        ),
        (
            lambda state: without(state, "state"),
            "VALID",
            "begun again from the calibration in force: the stored state ",
        ),
        (lambda state: without(state, "gate"), "VALID", "begun again from the calibration in force: the stored state "),
    ],
)
def test_a_state_that_cannot_be_read_is_said_and_not_the_end(
    spoil: Callable[[bytes], bytes], status: str, reason: str
) -> None:
    site = begun(site_config())
    site.play(3)
    kept = {identity: spoil(state) for identity, state in site.kept().items()}
    again = begun(site_config(), kept=kept, day=1.0)
    [(is_, why)] = said(again.results)
    assert is_ == status
    assert why.startswith(reason)
    assert any(w.used for w in windows(again.play(3)))


def without(state: bytes, part: str) -> bytes:
    """A state that another version of the program wrote, in which a part is missing."""
    held = unpack(state)
    del held["estimation"][part]
    return pack(held)


def test_windows_refused_for_ever_are_told() -> None:
    site = begun(site_config())
    site.play(5, devices="s")
    site.wait(2 * WINDOW_S)
    assert [reason for _, reason in said(site.results)].count(
        "S and Q are not updated: no samples of the reference r"
    ) == 1


@pytest.mark.slow
def test_the_status_has_the_reason_of_refused_windows_until_one_is_used_again() -> None:
    site = begun(site_config())
    site.play(4)
    site.spoiled["r"] = 0.0
    told = said(site.play(5))
    site.spoiled.clear()
    told += said(site.play(5))
    assert [(status, reason.partition(": ")[2][:24] or reason) for status, reason in told[:2]] == [
        ("VALID", "the reference is silent:"),
        ("VALID", "consistent with the calibration so far"),
    ]
    assert all(w.used for w in windows(site.results)[-3:])
