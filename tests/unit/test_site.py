"""All devices of a site in one adjustment: against a dense batch of all samples, and who contradicts the others."""

from __future__ import annotations

import numpy as np
import pytest

from calib.estimate.nuisances import Priors
from calib.site_adjustment.contradiction import alternatives, suspects, verdicts
from calib.site_adjustment.device import SiteDevice
from calib.site_adjustment.link import Link, link
from calib.site_adjustment.site import MAX_STEPS, Site
from tests.dense_site import Meeting, SimulatedSite, dense

NOMINAL = np.append(np.eye(3).ravel(), np.zeros(3))
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def known(site: SimulatedSite) -> np.ndarray:
    stated = site.stated
    return np.diag(np.append(np.full(9, 4.0 * stated.sensor), np.full(3, stated.sensor_offset_mps2)) ** 2)


def linked(site: SimulatedSite, meeting: Meeting) -> Link:
    stated = site.stated
    priors = Priors(
        {
            **Priors.none().values,
            "rotation_rad": stated.rotation_rad,
            "offset_mps2": stated.offset_mps2,
            "reference": stated.reference,
            "gravity_mps2": stated.gravity_mps2,
        },
        NOMINAL,
        known(site),
    )
    return link(meeting.sensor, meeting.reference, meeting.windows, priors)


def adjusted(site: SimulatedSite) -> Site:
    devices = [SiteDevice.with_covariance(name, NOMINAL, known(site)) for name in site.S]
    clamped = {m.reference for m in site.meetings if m.clamped}
    devices += [SiteDevice.reference(name, site.stated.reference, 1 if name in clamped else 3) for name in site.gain]
    devices.append(SiteDevice.gravity(site.stated.gravity_mps2))
    return Site(devices, [linked(site, meeting) for meeting in site.meetings])


@pytest.fixture(scope="module")
def small() -> SimulatedSite:
    """Two sensors beside both references, one on a clamp and beside a reference, one beside another sensor only."""
    site = SimulatedSite(5, sensors=4, references=3)
    site.meet("s0", "r0")
    site.meet("s0", "r1", rotation=QUARTER_TURN)
    site.meet("s1", "r0")
    site.meet("s1", "r1")
    site.clamp("s2", "r2")
    site.meet("s2", "r0")
    site.meet("s3", "s1", rotation=QUARTER_TURN)
    return site


@pytest.mark.slow
def test_sparse_adjustment_is_the_dense_one_of_all_samples(small: SimulatedSite) -> None:
    sparse, batch = adjusted(small), dense(small)
    assert set(sparse.leaves) == {"s0", "s2", "s3"}
    for name in small.S:
        u = np.sqrt(np.diag(batch.between((name,), (name,))))
        assert np.abs((sparse.x[name] - batch.of(name)) / u).max() < 0.1
        for other in small.S:
            v = np.sqrt(np.diag(batch.between((other,), (other,))))
            away = (sparse.covariance(name, other) - batch.between((name,), (other,))) / np.outer(u, v)
            assert np.abs(away).max() < 0.03
    for name, channels in (("r0", 3), ("r1", 3), ("r2", 1)):
        diagonal = [0, 4, 8][:channels]
        u = np.sqrt(np.diag(batch.between((name,), (name,))))[:channels]
        found = sparse.x[name][diagonal] - 1.0
        assert np.abs((found - batch.of(name)[:channels]) / u).max() < 0.1
        assert sparse.standard_uncertainty(name)[diagonal] == pytest.approx(u, rel=0.02)
    cross = batch.between(("s0",), ("r1",)) / small.stated.reference
    assert np.abs(cross[:9]).max() > 1e-4  # there is something to compare
    assert sparse.covariance("s0", "r1")[:, [0, 4, 8]] / small.stated.reference == pytest.approx(cross, abs=1e-4)
    u = np.sqrt(batch.between(("gravity",), ("gravity",))[0, 0])
    assert sparse.x["gravity"][0] == pytest.approx(batch.of("gravity")[0], abs=0.1 * u)
    assert sparse.standard_uncertainty("gravity")[0] == pytest.approx(u, rel=0.02)


def test_links_of_one_device_beside_itself_or_of_an_unknown_one_are_refused(small: SimulatedSite) -> None:
    own = linked(small, small.meetings[0])
    with pytest.raises(ValueError, match="r0 is in a link, but there is no such device"):
        Site([SiteDevice.with_covariance("s0", NOMINAL, known(small))], [own])


def test_a_bad_reference_is_named_and_its_bias_told() -> None:
    site = SimulatedSite(11, sensors=6, references=4)
    site.gain["r2"] = np.full(3, 4.0 * site.stated.reference)
    for k in range(6):
        site.meet(f"s{k}", f"r{k % 4}", windows=4)
        site.meet(f"s{k}", f"r{(k + 1) % 4}", windows=4)
    whole = adjusted(site)
    assert whole.steps < MAX_STEPS  # it ends where it has converged
    found = verdicts(whole)
    (bad,) = suspects(found)
    assert bad.device == "r2"
    assert bad.is_reference
    assert bad.degrees_of_freedom == 3.0
    # The bias is that against the others, whose own errors are drawn from u.
    assert bad.bias[[0, 4, 8]] == pytest.approx(site.gain["r2"], abs=2.0 * site.stated.reference)
    assert bad.statistic > 3.0 * max(v.statistic for v in found if v.is_reference and v is not bad)


def test_a_reference_with_one_bad_axis_is_named_with_the_axis() -> None:
    site = SimulatedSite(16, sensors=6, references=4)
    site.gain["r1"][1] = 6.0 * site.stated.reference
    for k in range(6):
        site.meet(f"s{k}", f"r{k % 4}", windows=4)
        site.meet(f"s{k}", f"r{(k + 1) % 4}", windows=4)
    (bad,) = suspects(verdicts(adjusted(site)))
    assert (bad.device, bad.axis, bad.degrees_of_freedom) == ("r1", "y", 1.0)
    assert not bad.bias[[0, 8]].any()
    assert bad.bias[4] == pytest.approx(site.gain["r1"][1], abs=2.0 * site.stated.reference)


def test_an_error_in_one_axis_of_a_certificate_is_supposed_in_its_row_of_s_and_its_offset() -> None:
    """A certificate whose 12 parameters are correlated, at the scale of a sensor in counts."""
    root = np.random.default_rng(17).normal(size=(12, 12)) * np.append(np.full(9, 0.2), np.full(3, 5.0))[:, None]
    site = SimulatedSite(17, sensors=2, references=2)
    for k in range(2):
        site.meet(f"s{k}", "r0")
        site.meet(f"s{k}", "r1")
    mean = np.append(200.0 * np.eye(3).ravel(), np.zeros(3))
    devices = [SiteDevice.with_covariance(name, NOMINAL, known(site)) for name in site.S]
    devices += [SiteDevice.reference("r0", 1e-3, 3), SiteDevice.with_covariance("r1", mean, root @ root.T)]
    links = [linked(site, m) for m in site.meetings]
    found = {v.axis: v.bias for v in alternatives(Site(devices, links)) if v.device == "r1"}
    assert set(found) == {"", "x", "y", "z"}
    for i, axis in enumerate("xyz"):
        own = [3 * i, 3 * i + 1, 3 * i + 2, 9 + i]
        assert np.abs(np.delete(found[axis], own)).max() < 1e-9 * np.abs(found[axis][own]).max()


def test_a_sensor_that_changed_between_two_references_is_named() -> None:
    site = SimulatedSite(12, sensors=6, references=3)
    for k in range(6):
        site.meet(f"s{k}", f"r{k % 3}", windows=4)
    site.S["s4"] = site.S["s4"] * 0.97
    for k in range(6):
        site.meet(f"s{k}", f"r{(k + 1) % 3}", windows=4)
    (bad,) = suspects(verdicts(adjusted(site)))
    assert bad.device == "s4"
    assert not bad.is_reference
    assert np.isnan(bad.bias).all()


def test_a_sensor_that_is_wrong_as_a_reference_is_named() -> None:
    site = SimulatedSite(13, sensors=4, references=3)
    for k in range(3):
        site.meet("s0", f"r{k}", windows=4)
    site.S["s0"] = site.S["s0"] * 1.02
    for k in (1, 2, 3):
        site.meet(f"s{k}", "s0", windows=4)
        site.meet(f"s{k}", f"r{k - 1}", windows=4)
    (bad,) = suspects(verdicts(adjusted(site)))
    assert bad.device == "s0"
    assert bad.is_reference


@pytest.mark.slow
def test_a_sound_site_names_nobody_and_statistics_are_chi_squared() -> None:
    """Of 4 references of a sound site, over 8 sites: the mean statistic is within 4 SD of the degrees of freedom."""
    statistics: list[float] = []
    of_axes: list[float] = []
    for seed in range(8):
        site = SimulatedSite(100 + seed, sensors=2, references=4)
        for k in range(4):
            site.meet(f"s{k % 2}", f"r{k}", windows=3)
            site.meet(f"s{k % 2}", f"r{(k + 2) % 4}", windows=3)
        assert not suspects(verdicts(adjusted(site)))
        found = [v for v in alternatives(adjusted(site)) if v.is_reference]
        assert {(v.axis, v.degrees_of_freedom) for v in found} == {("", 3.0), ("x", 1.0), ("y", 1.0), ("z", 1.0)}
        statistics += [v.statistic for v in found if not v.axis]
        of_axes += [v.statistic for v in found if v.axis]
    # Two pairs of references: within a pair both statistics are the same number, so 16 independent ones.
    assert np.mean(statistics) == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / 16.0))
    assert np.mean(of_axes) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 48.0))


def test_two_references_that_accuse_each_other_are_both_told() -> None:
    site = SimulatedSite(14, sensors=2, references=2)
    site.gain["r1"] = site.gain["r0"] + 8.0 * site.stated.reference
    for k in range(2):
        site.meet(f"s{k}", "r0", windows=4)
        site.meet(f"s{k}", "r1", windows=4)
    assert {v.device for v in suspects(verdicts(adjusted(site)))} == {"r0", "r1"}


def test_a_sensor_of_which_nothing_was_known_is_tested_by_its_second_link_alone() -> None:
    site = SimulatedSite(15, sensors=2, references=2)
    for sensor, reference in (("s0", "r0"), ("s1", "r0"), ("s1", "r1")):
        site.meet(sensor, reference, windows=4)
    devices = [SiteDevice.with_covariance(name, NOMINAL, np.diag(np.full(12, np.inf))) for name in site.S]
    devices += [SiteDevice.reference(name, site.stated.reference, 3) for name in site.gain]
    found = {v.device: v for v in verdicts(Site(devices, [linked(site, m) for m in site.meetings]))}
    assert "s0" not in found
    assert found["s1"].degrees_of_freedom == pytest.approx(12.0, abs=0.01)
    assert found["s1"].statistic < 33.0  # chi-squared of 12 at 0.999
