"""The site watched together: against least squares that shares no code, naming, false alarms, turns, snapshots."""

from __future__ import annotations

import copy
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.model import Array
from calib.site_watch.day import Day, Hours, SelfTests, Visits, day_of
from calib.site_watch.scatter import Blocks
from calib.site_watch.steps import PRIOR, TERMS, Steps, inverted
from calib.site_watch.together import ALL, DIRECTIONS, design, jointly, turned
from calib.site_watch.verdicts import SiteVerdicts, _apart, examined, limit_of, result
from calib.site_watch.visits import teach
from calib.site_watch.watch import PRIOR_VISITS, VISIT, SiteWatch

BANDS_HZ = 10.0 ** (np.arange(0, 6) / 10.0)
GATEWAY = np.array([0, 0, 0, 1, 1, 1, 2, 2, 2])


class Site:
    """Days of sensors whose channels follow the temperature and a level, with independent scatter."""

    def __init__(self, seed: int, gateway: Array = GATEWAY, scatter: float = 0.004) -> None:
        self.random, self.n, self.scatter = np.random.default_rng(seed), len(gateway), scatter
        self.gateway = gateway
        shape = self.n, len(BANDS_HZ), 6
        self.shape = np.concatenate(
            [self.random.normal(0, 0.5, shape)[..., :3], self.random.uniform(-0.5, 0.5, shape)[..., 3:]], 2
        )
        self.slope, self.curve = self.random.normal(0, 0.002, shape), self.random.normal(0, 0.0005, shape)
        self.number = 20_000

    def day(self, change: Array | None = None) -> Day:
        """The next day; `change` (n, 6): log sensitivities and turns of the sensors."""
        degc = 10.0 + 8.0 * np.sin(self.number / 20.0) + self.random.normal(0, 2)
        T = (degc - 10.0) / 10.0
        value = self.shape + self.slope * T + self.curve * T * T + self.random.normal(0, self.scatter, self.shape.shape)
        if change is not None:
            value += np.einsum("nbcp,np->nbc", design(self.shape, np.zeros((len(BANDS_HZ), 3))), change)
        level = np.full((len(BANDS_HZ), 3), self.random.normal(0, 0.3))
        if (
            self.number > 20_015
        ):  # the level is free; hours are merged without it as far as a median over sensors tells it
            value[..., :3] += self.random.normal(0, 0.1, level.shape)
        noise = -4.0 + self.random.normal(0, 0.02, (self.n, 3))
        self.number += 1
        return Day(self.number - 1, value, np.full(value.shape, 0.003), level, noise, degc)


def watched(site: Site, days: int, watch: SiteWatch | None = None, change: Array | None = None) -> SiteWatch:
    watch = SiteWatch(site.gateway, BANDS_HZ) if watch is None else watch
    for _ in range(days):
        watch.update(site.day(change))
    return watch


@pytest.fixture(scope="module")
def learned() -> tuple[Site, SiteWatch]:
    site = Site(1)
    return site, watched(site, 60)


def after(learned: tuple[Site, SiteWatch], days: int, sensors: list[int], theta: list[float]) -> SiteVerdicts:
    site = copy.deepcopy(learned[0])
    change = np.zeros((site.n, 6))
    change[sensors] = theta
    return result(watched(site, days, SiteWatch.loaded(learned[1].snapshot()), change))


def kinds(found: SiteVerdicts) -> dict[int, str]:
    return {i: told.kind for i, told in enumerate(found.sensors) if told.kind != "none"}


def test_a_step_is_that_of_weighted_least_squares_with_the_prior() -> None:
    """Brute force: one design matrix with all days, the step as a column, and the prior as rows."""
    random, days, at = np.random.default_rng(2), 40, 25
    x = np.column_stack([np.ones(days), random.normal(size=(days, TERMS - 1))])
    w, y = random.uniform(0.5, 2.0, days), random.normal(size=days)
    steps = Steps(1)
    for t in range(days):
        steps.update(t, x[t][:, None], y[t : t + 1], w[t : t + 1])
    size, information, since = steps.step([steps.begins.index(b) for b in steps.begins if b >= at][:1])
    begin = next(b for b in steps.begins if b >= at)
    z = (np.arange(days) >= begin).astype(float)
    rows = np.vstack(
        [np.column_stack([x, z]) * np.sqrt(w)[:, None], np.column_stack([np.diag(1.0 / PRIOR), np.zeros(TERMS)])]
    )
    right = np.append(y * np.sqrt(w), np.zeros(TERMS))
    expected = np.linalg.lstsq(rows, right, rcond=None)[0][-1]
    variance = np.linalg.inv(rows.T @ rows)[-1, -1]
    assert size[0, 0] == pytest.approx(expected, rel=1e-8)
    assert 1.0 / information[0, 0] == pytest.approx(variance, rel=1e-8)
    assert since[0, 0] == days - begin


def test_inverses() -> None:
    random = np.random.default_rng(3)
    A = random.normal(size=(7, 5, 5))
    A = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(5)
    assert np.allclose(inverted(np.moveaxis(A, 0, -1)), np.moveaxis(np.linalg.inv(A), 0, -1), rtol=1e-9, atol=1e-9)


def test_all_sensors_jointly_are_generalised_least_squares_with_free_levels() -> None:
    """Brute force: levels of each band and axis, and one sensitivity of one sensor, are unknown together."""
    random, n, bands = np.random.default_rng(4), 6, 4
    step, info = random.normal(0, 0.02, (n, bands, 6)), random.uniform(1e4, 4e4, (n, bands, 6))
    info[..., 3:] = 0.0
    norm = np.zeros((1, n, bands, 6)), np.zeros((1, n, bands, 3))
    # Inflated so much that no sensor loses weight: the robust estimate is then least squares.
    joint = jointly(step[None], info[None], *norm, np.full((1, n, 7), 1e8), np.zeros(1))
    for i, axis in ((0, 0), (4, 2)):
        A = np.zeros((n * bands, bands + 1))
        for j in range(n):
            A[j * bands + np.arange(bands), np.arange(bands)] = 1.0
        A[i * bands + np.arange(bands), bands] = 1.0
        w = info[..., axis].ravel()
        normal = A.T @ (w[:, None] * A)
        expected = np.linalg.solve(normal, A.T @ (w * step[..., axis].ravel()))[-1]
        u = np.sqrt(np.linalg.inv(normal)[-1, -1] * 1e8)
        assert joint.size[0, i, axis] == pytest.approx(expected, rel=1e-4)
        assert joint.u[0, i, axis] == pytest.approx(u, rel=1e-4)


def channels(M: Array) -> Array:
    """The channels of co-spectra M (3, 3)."""
    a = 0.5 * np.log(np.diag(M))
    return np.array([*a, *(M[j, k] / np.exp(a[j] + a[k]) for j, k in ((0, 1), (0, 2), (1, 2)))])


def test_the_design_of_a_turn_is_the_difference_of_turned_spectra() -> None:
    random, angle = np.random.default_rng(5), 1e-5
    root = random.normal(size=(3, 3))
    M = root @ root.T
    G = design(channels(M)[None, None], np.zeros((1, 3)))[0, 0]
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        R = np.eye(3)
        R[j, k], R[k, j] = angle, -angle
        assert np.allclose((channels(R @ M @ R.T) - channels(M)) / angle, G[:, 3 + axis], rtol=1e-3, atol=1e-3)
    assert np.array_equal(G[:, :3], np.eye(6)[:, :3])


def test_turned_channels_are_those_of_turned_spectra() -> None:
    """By 20 deg about an axis askew; and an output that tells nothing stays so."""
    root, turn = np.random.default_rng(5).normal(size=(3, 3)), np.radians(20.0) * np.array([0.6, 0.0, 0.8])
    M, R = root @ root.T, Rotation.from_rotvec(-turn).as_matrix()  # the axes turn, not the motion
    level = np.array([0.3, -0.2, 0.9])
    value = channels(M) - np.append(level, np.zeros(3))
    after = turned(value[None, None], level[None, None], turn[None])[0, 0]
    assert np.allclose(after + np.append(level, np.zeros(3)), channels(R @ M @ R.T), atol=1e-12)
    value[[0, 3, 4]] = np.nan
    after = turned(value[None, None], level[None, None], turn[None])[0, 0]
    assert np.isnan(after[[0, 3, 4]]).all()
    assert np.isfinite(after[[1, 2, 5]]).all()


@pytest.mark.parametrize("degrees", [0.3, 1.0, 3.0])
def test_a_turn_of_a_sensor_with_a_weak_axis_explains_all_of_its_bands(degrees: float) -> None:
    """x of sensor 7 moves by a 12th to a 25th of z: a turn of 1 deg changes it by a fifth to a half."""
    random = np.random.default_rng(21)
    step, information, value, level = steps_of(np.zeros((9, 6, 3)))
    angle = np.radians(degrees)
    R = Rotation.from_rotvec([0.0, -angle, 0.0]).as_matrix()
    information[:] = 1.0 / 0.003**2
    for b in range(6):
        root = random.normal(size=(3, 5))
        root[0] *= random.uniform(0.04, 0.08)
        M = root @ root.T
        value[0, 7, b] = channels(M)
        step[0, 7, b] = channels(R @ M @ R.T) - channels(M)
    joint = jointly(step, information, value, level, np.ones((1, 9, 7)), np.zeros(1))
    assert np.argmax(np.abs(joint.statistic[0, 7])) == 5
    assert joint.size[0, 7, 5] == pytest.approx(angle, rel=0.02)
    assert _apart(joint)[0, 7] < 0.0


def test_turns_are_of_the_days_since_whatever_the_first_day_was() -> None:
    """The level of z is 4.5 times as large on the first day as on all others."""
    site = Site(22)
    watch = SiteWatch(site.gateway, BANDS_HZ)
    for number in range(40):
        day = site.day()
        day.level[:] = [0.0, 0.0, 1.5 if number == 0 else 0.0]
        watch.update(day)
    which = [watch.steps.begins.index(20_030)]
    value, level = watch.norm_since(which, watch.steps.step(which)[0].reshape(1, *watch.shape))
    assert level == pytest.approx(np.zeros(level.shape), abs=1e-12)
    assert np.abs(value[0, ..., 3:] - site.shape[..., 3:]).max() < 0.02
    watch.steps.restart(np.ones(int(np.prod(watch.shape)), dtype=bool))
    value, _ = watch.norm_since(which, np.zeros((1, *watch.shape)))
    assert np.isnan(value).all(), "no day counts"


@pytest.mark.slow
def test_one_sensor_is_named_with_size_and_date(learned: tuple[Site, SiteWatch]) -> None:
    found = after(learned, 12, [4], [0, 0, -0.01, 0, 0, 0])
    assert kinds(found) == {4: "sensitivity"}
    told = found.sensors[4]
    assert told.what == "sensitivity of z"
    assert abs(told.size + 0.01) < told.U < 0.006
    assert told.earliest <= 20_060 <= told.latest
    assert abs(told.since - 20_060) <= 2
    assert not found.gateways


def test_all_axes_of_two_sensors_are_named_and_no_other(learned: tuple[Site, SiteWatch]) -> None:
    found = after(learned, 12, [2, 6], [0.012, 0.012, 0.012, 0, 0, 0])
    assert kinds(found) == {2: "sensitivity", 6: "sensitivity"}
    assert {found.sensors[i].what for i in (2, 6)} == {"sensitivity of x, y and z"}


def test_a_turn_is_told_as_a_turn(learned: tuple[Site, SiteWatch]) -> None:
    found = after(learned, 12, [7], [0, 0, 0, 0, 0.0175, 0])
    assert kinds(found) == {7: "turn"}
    assert found.sensors[7].what == "turn about y"
    assert abs(found.sensors[7].size - 0.0175) < found.sensors[7].U
    assert abs(found.sensors[7].U - 0.0035) < 0.0007, "a tenth of the angle, k = 2"


def test_a_gateway_is_told_as_the_gateway(learned: tuple[Site, SiteWatch]) -> None:
    found = after(learned, 12, [3, 4, 5], [-0.01, -0.01, -0.01, 0, 0, 0])
    assert kinds(found) == {}
    assert list(found.gateways) == [1]
    assert abs(found.gateways[1].size + 0.01) < found.gateways[1].U


@pytest.mark.thorough
def test_of_two_gateways_it_is_not_told_which_and_of_one_nothing_is_seen() -> None:
    for gateway, told in ((GATEWAY // 2, [0]), (0 * GATEWAY, [])):
        site = Site(6, gateway)
        watch, change = watched(site, 60), np.zeros((9, 6))
        change[gateway == 0, :3] = 0.01
        found = result(watched(site, 12, watch, change))
        assert list(found.gateways) == told
        assert all("not seen" in one.what for one in found.gateways.values())
        assert kinds(found) == {}


@pytest.mark.one_case
@pytest.mark.parametrize("gateway", [[0, 0], [0, 1]])
def test_of_two_sensors_it_is_not_told_which_one_has_changed(gateway: list[int]) -> None:
    """Both verdicts are of one size with opposite signs; nothing is told of two that stay; a turn is of one sensor."""
    site, changes = Site(11, np.array(gateway)), np.zeros((3, 2, 6))
    watch = watched(site, 60)
    changes[0, 1, 2], changes[2, 1, 4] = -0.02, 0.0175
    z, none, turn = (
        result(watched(copy.deepcopy(site), 12, SiteWatch.loaded(watch.snapshot()), change)) for change in changes
    )
    assert kinds(z) == {0: "one of two", 1: "one of two"}
    one, other = z.sensors
    assert one.what == "sensitivity of z, or that of the other sensor against it; which one is not seen"
    assert abs(other.size + 0.02) < other.U < 0.01
    assert (one.size, one.U, one.since) == pytest.approx((-other.size, other.U, other.since))
    assert z.site.kind == "none"
    assert not z.gateways
    assert kinds(none) == {}
    assert kinds(turn) == {1: "turn"}


@pytest.mark.nightly
def test_the_false_alarms_of_two_sensors_are_those_of_one_comparison() -> None:
    """The statistic of two sound sensors is a standard normal deviate, or less: over 16 sites its root mean square is
    at most 1.1. Were the scatter of their difference taken for half of it, as the level would have it, it were 1.28."""
    z = []
    for seed in range(16):
        tests = examined(watched(Site(300 + seed, np.array([0, 0])), 60))
        assert tests is not None
        assert tests.joint.pair.all()
        z.append(tests.joint.statistic[-1, 0, :ALL])
    assert np.sqrt(np.mean(np.square(z))) < 1.1


def test_a_band_of_two_sensors_names_none_where_three_are_compared_in_others() -> None:
    one, none = np.ones((1, 9, 7)), np.zeros(1)
    step, information, value, level = steps_of(np.zeros((9, 6, 3)))
    information[0, :7, :, 0] = 0.0
    step[0, 7, :, 0] = 0.5
    told = jointly(step, information, value, level, one, none)
    assert not told.pair.any()
    assert np.abs(told.statistic).max() < 1e-6
    information[0, 6, :, 0] = 1e4
    assert jointly(step, information, value, level, one, none).statistic[0, 7, 0] > 5.0


def test_bands_that_change_differently_are_the_structure(learned: tuple[Site, SiteWatch]) -> None:
    for sensors, kind in (([1], "sensor or structure"), ([1, 2, 3], "structure")):
        site, watch = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot())
        site.shape[sensors, :3, :3] += 0.03
        site.shape[sensors, 3:, :3] -= 0.02
        found = result(watched(site, 12, watch))
        assert kinds(found) == dict.fromkeys(sensors, kind)
        assert found.site.kind == ("structure" if len(sensors) > 1 else "none")


def test_a_noise_floor_that_doubles_is_noise(learned: tuple[Site, SiteWatch]) -> None:
    site, watch = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot())
    for _ in range(8):
        day = site.day()
        day.log_noise[5, 1] += 0.5 * np.log(2.0)
        watch.update(day)
    found = result(watch)
    assert kinds(found) == {5: "noise"}
    assert abs(found.sensors[5].size - (2**0.5 - 1)) < found.sensors[5].U


@pytest.mark.slow
def test_noise_that_a_sensitivity_moves_is_not_told(learned: tuple[Site, SiteWatch]) -> None:
    """2 % more noise, steady to 0.1 % so that it is sure: a sensitivity moves the noise alike."""
    site, watch = copy.deepcopy(learned[0]), SiteWatch(GATEWAY, BANDS_HZ)
    for number in range(80):
        day = site.day()
        day.log_noise[:] = -4.0 + site.random.normal(0, 0.001, (site.n, 3))
        day.log_noise[5, 1] += np.log(1.02) if number >= 60 else 0.0
        watch.update(day)
    assert kinds(result(watch)) == {}
    assert np.abs(watch.noise.step([watch.noise.begins.index(day.number - 19)])[0]).max() > 0.015


def test_what_all_share_is_seen_by_a_sensor_beside_a_reference_alone(learned: tuple[Site, SiteWatch]) -> None:
    site, watch, change = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot()), np.zeros((9, 6))
    change[1:, :3] = 0.02
    watched(site, 12, watch, change)
    known = np.full(9, np.inf)
    blind = result(watch)
    known[0] = 0.002
    found = result(watch, known)
    assert blind.common is None
    assert blind.hidden == np.inf
    assert found.common is not None
    assert abs(found.common.size - 0.02) < found.common.U < 0.012
    assert found.hidden == found.common.U


def test_a_visit_begins_the_norm_anew(learned: tuple[Site, SiteWatch]) -> None:
    site, watch, change = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot()), np.zeros((9, 6))
    change[4, :3] = 0.05
    watch.update(site.day(change), Visits.unknown(np.arange(9) == 4))
    found = result(watched(site, 12, watch, change))
    assert kinds(found) == {4: "learning"}
    assert kinds(result(watched(site, 20, watch, change))) == {}


def test_outside_the_temperatures_of_the_norm_u_grows(learned: tuple[Site, SiteWatch]) -> None:
    u = []
    for degc in (10.0, 40.0):
        site, watch = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot())
        for _ in range(4):
            watch.update(replace(site.day(), temperature_degc=degc))
        tests = examined(watch)
        assert tests is not None
        assert tests.begins[-2] == 20_060
        u.append(np.median(tests.joint.u[-2, :, :3]))
    assert u[1] > 2.0 * u[0]


@pytest.mark.thorough
def test_sound_sites_are_left_alone() -> None:
    """16 sites of 9 sensors for 50 days each after the learning: 0.5 alarms a site and year are 1.1; with 99.5 % at
    most 4."""
    alarms = 0
    for seed in range(16):
        site = Site(100 + seed)
        watch = watched(site, 40)
        for _ in range(5):
            found = result(watched(site, 10, watch))
            alarms += len(kinds(found)) + len(found.gateways)
    assert alarms <= 4


@pytest.mark.slow
def test_u_is_that_of_the_days_where_noise_changes_and_the_scatter_does_not() -> None:
    """Eighty days with little noise, then thirty with three times as much, as a summer has; all scatter by 0.8 %. The
    mean square of 27 steps of sound axes over u is 0.44 to 1.84 with 99 % (chi-squared)."""
    site = Site(14, scatter=0.008)
    watch = watched(site, 80)
    for _ in range(30):
        day = site.day()
        watch.update(replace(day, u=np.full(day.value.shape, 0.009)))
    tests = examined(watch)
    assert tests is not None
    k = int(np.argmin([abs(watch.day - begin + 1 - 30) for begin in tests.begins]))
    z = tests.joint.size[k, :, :3] / tests.joint.u[k, :, :3]
    assert 0.44 < np.mean(np.square(z)) < 1.84


def test_the_limit_grows_with_the_number_of_tests() -> None:
    """Of a sensor seven directions, three noise floors and its bands; half an alarm a year in 1,000 looks at each."""
    for sensors, gateways in ((8, 3), (30, 5), (200, 10)):
        tests = 11 * sensors + gateways
        assert limit_of(sensors, gateways) == pytest.approx(NormalDist().inv_cdf(1.0 - 0.25 / (1000.0 * tests)))


@pytest.mark.slow
def test_a_watch_goes_on_from_its_snapshot_bit_for_bit() -> None:
    site = Site(7)
    watch = watched(site, 40)
    other = SiteWatch.loaded(copy.deepcopy(watch.snapshot()))
    for _ in range(8):
        day = site.day()
        watch.update(day)
        other.update(day)
    one, two = watch.snapshot(), other.snapshot()

    def same(a: object, b: object) -> bool:
        if isinstance(a, dict) and isinstance(b, dict):
            return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
        return np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True)

    assert same(one, two)
    with pytest.raises(ValueError, match="comes after"):
        watch.update(day)


def test_blocks_tell_how_far_days_depend_on_each_other() -> None:
    """AR(1) with 0.5: a mean over many days has (1 + 0.5) / (1 - 0.5) = 3 times the variance of independent days."""
    random, z = np.random.default_rng(8), np.zeros((40, 1))
    blocks = Blocks((40, 1))
    for _ in range(1400):
        z = 0.5 * z + np.sqrt(0.75) * random.normal(size=z.shape)
        blocks.update(z, np.ones(z.shape, dtype=bool))
    day, week, month = blocks.inflation()[:, 0]
    assert day == pytest.approx(1.0, abs=0.06)
    assert week == pytest.approx(3.0 - 4.0 * (1.0 - 0.5**7) / 7.0, rel=0.1)
    assert month == pytest.approx(3.0 - 4.0 / 28.0, rel=0.15)


def test_blocks_with_a_memory_follow_the_season() -> None:
    """A variance of 4 after a year of 1: 120 days later a memory of 60 days tells 3.6, and one without end 1.7."""
    random = np.random.default_rng(6)
    short, endless, there = Blocks((50, 1), (1,), memory_days=60.0), Blocks((50, 1), (1,)), np.ones((50, 1), dtype=bool)
    for day in range(485):
        z = random.normal(0.0, 1.0 if day < 365 else 2.0, (50, 1))
        short.update(z, there)
        endless.update(z, there)
    assert short.inflation()[0, 0] == pytest.approx(4.0 - 3.0 * np.exp(-2.0), abs=0.3)
    assert endless.inflation()[0, 0] == pytest.approx(1.0 + 3.0 * 120 / 485, abs=0.15)


def test_what_was_known_before_a_change_loosens_its_test_and_nothing_since() -> None:
    blocks, there = Blocks((9, 1), (1,)), np.ones((9, 1), dtype=bool)
    for day in range(100):
        blocks.update(np.where(np.arange(9)[:, None] % 2, 1.0, -1.0), there)
        blocks.remember([day])
    blocks.past[100] = blocks.past[99]
    for _ in range(100):
        blocks.update(np.full((9, 1), 3.0), there)
    assert blocks.over(200, [100])[0, :, 0] == pytest.approx(np.full(9, 1.0), abs=0.02)
    assert blocks.inflation()[0, 0] > 4.0, "today's is larger"


def test_a_step_does_not_loosen_its_own_test() -> None:
    """50 weeks of scatter, and 50 with a step of half a standard deviation of a day: their variance is 2.75.
    Where it begins, all of them scatter as if there was none, but for 5 blocks of the median."""
    random, blocks, shape = np.random.default_rng(8), Blocks((40, 1), (7,)), (40, 1)
    for day in range(700):
        blocks.update(random.normal(0.5 if day >= 350 else 0.0, 1.0, shape), np.ones(shape, dtype=bool))
        blocks.remember([day] if day < 350 else [349, day])
    assert blocks.today().mean() == pytest.approx(1.875, abs=0.05)
    began, today = blocks.without_steps([349, 699])
    assert began.mean() == pytest.approx((99.0 + 5.0 * 1.875) / 104.0, abs=0.05)
    assert np.array_equal(today, blocks.today()), "no block since"


class Slow(Site):
    """Channels whose days depend on each other: AR(1) by 0.6."""

    def day(self, change: Array | None = None) -> Day:
        day = super().day(change)
        self.slow = 0.6 * getattr(self, "slow", 0.0) + self.random.normal(0, 0.8 * self.scatter, day.value.shape)
        return replace(day, value=day.value + 3.0 * self.slow)


@pytest.mark.slow
def test_where_days_depend_on_each_other_u_of_a_few_days_holds_it() -> None:
    """Sizes over u of sound sites, five days after a begin. With u of independent days they are 1.27, and 1.13 where
    sums over a week count in units that hold the week already."""
    squares = []
    for seed in range(3):
        site = Slow(20 + seed)
        watch = watched(site, 100)
        for _ in range(12):
            tests = examined(watched(site, 5, watch))
            assert tests is not None
            at = tests.begins.index(watch.day - 4)
            squares.append(np.square(tests.joint.size[at] / tests.joint.u[at])[:, :4].mean())
    assert np.sqrt(np.mean(squares)) == pytest.approx(1.0, abs=0.06)


def steps_of(z: Array) -> tuple[Array, Array, Array, Array]:
    """Steps (1, n, B, 6) that are z standard deviations in the outputs alone, information, channels, levels."""
    step, information = np.zeros((1, *z.shape[:2], 6)), np.full((1, *z.shape[:2], 6), 1e4)
    step[0, :, :, :3] = 0.01 * z
    return step, information, np.zeros(step.shape), np.zeros((*step.shape[:3], 3))


def test_what_all_sensors_differ_by_at_a_begin_is_scatter_and_one_that_changes_is_not() -> None:
    """40 sensors whose steps scatter three times as they should: u is 2.5 times as large; the others' u stays."""
    z, one, none = np.random.default_rng(7).normal(size=(40, 6, 3)), np.ones((1, 40, 7)), np.zeros(1)
    sound = jointly(*steps_of(z), one, none)
    assert sound.scatter.max() < 1.2
    frost = jointly(*steps_of(3.0 * z), one, none)
    assert 2.2 < np.median(frost.u[..., :3] / sound.u[..., :3]) < 3.0, "by the bands of each, and by all sensors"
    assert frost.evidence[..., :4] == pytest.approx((frost.size / frost.u * frost.scatter)[..., :4]), "dates"
    z[4] += 20.0
    changed = jointly(*steps_of(z), one, none)
    assert changed.scatter.max() < 1.2
    assert changed.statistic[0, 4, ALL] > 30.0


def test_a_sensitivity_is_as_uncertain_as_its_bands_differ() -> None:
    """One of six bands moves by 30 standard deviations, which is 11.5 of their mean against the other eight sensors.
    The squares are then 30² 8/9 5/6 = 667, and with a prior of 22 bands u² grows by (22 + 667) / (22 + 5) = 25.5. What
    all bands share keeps its u."""
    z, one, none = np.zeros((9, 6, 3)), np.ones((1, 9, 7)), np.zeros(1)
    mean = np.sqrt(6.0 * 8.0 / 9.0)
    z[7, 2, 2] = 30.0
    assert jointly(*steps_of(z), one, none).statistic[0, 7, 2] == pytest.approx(5.0 * mean / np.sqrt(25.5), rel=0.01)
    z[7, :, 2] = 5.0
    assert jointly(*steps_of(z), one, none).statistic[0, 7, 2] == pytest.approx(5.0 * mean, rel=0.01)


def test_a_doubt_of_bands_counts_where_they_differ_and_in_no_sensitivity() -> None:
    z, one, none = np.random.default_rng(9).normal(size=(40, 6, 3)), np.ones((1, 40, 7)), np.zeros(1)
    sure, doubted = (jointly(*steps_of(z), one, none, np.full((1, 40, 6, 6), doubt)) for doubt in (1.0, 4.0))
    assert doubted.squares == pytest.approx(sure.squares / 4.0, rel=0.01)
    assert np.array_equal(doubted.size[..., :4], sure.size[..., :4])
    assert np.array_equal(doubted.u[..., :4], sure.u[..., :4])


def test_a_turn_stands_without_the_band_that_says_most() -> None:
    """Cross powers xy that move in one band are no turn about z; in all six they are. y moves by 1.6 times as much as
    x: a turn by 1 rad changes the cross power by 1."""
    one, none = np.ones((1, 9, 7)), np.zeros(1)
    step, information, value, level = steps_of(np.zeros((9, 6, 3)))
    value[0, 2, :, 1] = np.log(0.5 + np.sqrt(1.25))
    step[0, 2, 0, 3] = 0.04
    alone = jointly(step, information, value, level, one, none)
    assert abs(alone.statistic[0, 2, 6]) < 0.1 < abs(alone.size[0, 2, 6] / alone.u[0, 2, 6])
    step[0, 2, :, 3] = 0.1
    assert jointly(step, information, value, level, one, none).statistic[0, 2, 6] > 15.0


def test_hours_are_merged_without_their_levels_and_without_noise() -> None:
    random, n, bands = np.random.default_rng(9), 5, len(BANDS_HZ)
    own = random.normal(0, 0.4, (n, bands, 3))
    level = random.normal(0, 0.8, (24, 1, bands, 3))
    width = (10**0.05 - 10**-0.05) * BANDS_HZ[:, None]
    psd = np.full((24, n, 3), 1e-3)
    power = np.exp(2.0 * (own + level)) + 1e-3 * width
    cross = 0.3 * np.exp(own + level)[..., [0, 0, 1]] * np.exp(own + level)[..., [1, 2, 2]]
    power[3:9, 2], power[5, 1] = np.nan, 1e6  # hours without a sensor; a blow at another
    hour = 24.0 * 20_000 + np.arange(24.0)
    day = day_of(Hours(hour, power, cross, psd, np.full((24, n), 12.0)), BANDS_HZ)
    assert day.number == 20_000
    assert day.temperature_degc == 12.0
    away = day.value[..., :3] - own
    assert np.allclose(away - away[:1], 0.0, atol=1e-9), "the same for all sensors: the level"
    assert np.allclose(np.delete(day.value[..., 3:], 1, axis=0), 0.3, atol=1e-9)
    power[:, 0, 0] = 2.4 * 1e-3 * width[0]  # the signal has 1.4 times the noise, then 1.6 times
    quiet = day_of(Hours(hour, power, cross, psd, np.full((24, n), np.nan)), BANDS_HZ)
    assert np.isnan(quiet.value[0, 0]).all()
    power[:, 0, 0] = 2.6 * 1e-3 * width[0]
    told = day_of(Hours(hour, power, cross, psd, np.full((24, n), np.nan)), BANDS_HZ)
    assert np.isfinite(told.value[0, 0, :3]).all()
    assert np.isinf(quiet.u[0, 0]).all()
    assert np.isfinite(quiet.value[0, 1:]).all()


def hours_of(number: int, late: dict[int, int], level: Array) -> Hours:
    """A day of nine sensors; `late`: hours by which the clock of some is late. `level` (72, B, 3): of three days, of
    which this is the middle one."""
    random, bands = np.random.default_rng(number), len(BANDS_HZ)
    own = np.random.default_rng(1).normal(0, 0.4, (9, bands, 3))
    amplitude = np.empty((24, 9, bands, 3))
    for i in range(9):
        at = 24 - late.get(i, 0)
        amplitude[:, i] = own[i] + level[at : at + 24] + random.normal(0, 0.02, (24, bands, 3))
    cross = 0.3 * np.exp(amplitude[..., [0, 0, 1]] + amplitude[..., [1, 2, 2]])
    none = np.full((24, 9, 3), 1e-9)
    return Hours(24.0 * number + np.arange(24.0), np.exp(2.0 * amplitude), cross, none, np.full((24, 9), 12.0))


def test_a_clock_that_is_hours_off_is_told_and_its_hours_do_not_count() -> None:
    random = np.random.default_rng(10)
    level = np.repeat(random.normal(0, 0.3, (72, 1, 1)), 3, axis=2) + random.normal(0, 0.05, (72, len(BANDS_HZ), 3))
    for late in ({}, {0: 1, 1: 1, 2: 1}, {4: -2}, {3: 3, 7: -1}):
        day = day_of(hours_of(20_000, late, level), BANDS_HZ)
        expected = [late.get(i, 0) for i in range(9)]
        assert (day.lag_h is None) == (not late)
        assert np.array_equal(np.zeros(9) if day.lag_h is None else day.lag_h, expected)
        assert np.isnan(day.value).all(axis=(1, 2)).tolist() == [i in late for i in range(9)]


NIGHT = np.arange(24) < 8


def otherwise(hours: Hours, sensor: int, by_night: float, by_day: float) -> Hours:
    """The same hours, in which the amplitudes of a sensor are larger by these parts in all bands."""
    power, cross = hours.power.copy(), hours.cross.copy()
    grown = (1.0 + np.where(NIGHT, by_night, by_day)[:, None, None]) ** 2
    power[:, sensor] *= grown
    cross[:, sensor] *= grown
    return replace(hours, power=power, cross=cross)


@pytest.fixture(scope="module")
def lived() -> tuple[SiteWatch, Array]:
    """A site of nine sensors for 50 days, with quiet nights, and the levels of its hours."""
    level = np.random.default_rng(12).normal(0, 0.1, (24 * 70, 1, 1)) - 0.8 * np.tile(NIGHT, 70)[:, None, None]
    hourly, watch = np.repeat(np.repeat(level, 6, axis=1), 3, axis=2), SiteWatch(GATEWAY, BANDS_HZ)
    for k in range(50):
        watch.update(day_of(hours_of(20_000 + k, {}, hourly[24 * k : 24 * k + 72]), BANDS_HZ))
    return watch, hourly


@pytest.mark.parametrize(
    ("by_night", "by_day", "told"),
    [(0.03, 0.0, "excitation"), (0.0, 0.015, "excitation"), (0.01, 0.01, "sensitivity"), (0.0, 0.0, "none")],
)
def test_what_quiet_hours_show_and_loud_ones_do_not_is_the_excitation(
    lived: tuple[SiteWatch, Array], by_night: float, by_day: float, told: str
) -> None:
    """A factory that runs at night beside sensor 4 adds as much to its motion as another sensitivity by 1 % would, in
    the mean of a day and in all bands. Works by day do so as well."""
    watch, hourly = SiteWatch.loaded(lived[0].snapshot()), lived[1]
    for k in range(50, 60):
        hours = otherwise(hours_of(20_000 + k, {}, hourly[24 * k : 24 * k + 72]), 4, by_night, by_day)
        watch.update(day_of(hours, BANDS_HZ))
    found = result(watch)
    assert kinds(found) == ({4: told} if told != "none" else {})
    assert not found.gateways
    assert found.site.kind == "none"
    if told == "excitation":
        assert found.sensors[4].earliest <= 20_050 <= found.sensors[4].latest
        assert np.isinf(found.sensors[4].U)


def test_the_contrast_of_a_day_is_that_of_its_quiet_hours(lived: tuple[SiteWatch, Array]) -> None:
    """12 of 24 hours are quiet, and all 8 of the night are among them."""
    hours = hours_of(20_000, {}, lived[1][:72])
    sound, day = (day_of(one, BANDS_HZ).contrast for one in (hours, otherwise(hours, 4, 0.03, 0.0)))
    assert sound is not None
    assert day is not None
    assert day[4] - sound[4] == pytest.approx(np.full(3, np.log(1.03) * 8 / 12), abs=3e-3)
    assert np.abs(np.delete(day - sound, 4, axis=0)).max() < 3e-3, "the level of each hour is a median"


@pytest.mark.parametrize(("by_night", "told"), [(0.0, "sensitivity"), (0.02, "excitation")])
def test_a_contrast_that_grows_with_the_level_of_the_site_is_learnt(by_night: float, told: str) -> None:
    """Sensor 4 loses 1 % when a season of less excitation begins, and its quiet hours differ more in it, as they always
    did on such days. What they differ by in addition is the excitation."""
    site, random = Site(1), np.random.default_rng(14)
    watch, grown = SiteWatch(site.gateway, BANDS_HZ), random.uniform(-0.03, 0.03, (9, 3))
    grown[4], change, shown = (0.03, -0.02, 0.03), np.zeros((9, 6)), np.zeros((9, 3))
    for k in range(70):
        if k == 60:
            change[4, :3], shown[4] = -0.01, by_night
        day = site.day(change)
        level = day.level - (1.0 if k >= 60 else 0.0)
        contrast = grown * level.mean() + shown + random.normal(0, 0.003, (9, 3))
        watch.update(replace(day, level=level, contrast=contrast))
    assert kinds(result(watch)) == {4: told}


@pytest.mark.thorough
def test_a_gateway_whose_clock_is_an_hour_off_is_told_as_its_clock() -> None:
    """For 12 days, then its clock is set: nothing else is told of it, and nothing of the others."""
    random, watch = np.random.default_rng(11), SiteWatch(GATEWAY, BANDS_HZ)
    hourly = np.repeat(random.normal(0, 0.3, (24 * 75, 1, 1)), 3, axis=2) + random.normal(0, 0.05, (24 * 75, 6, 3))
    for k in range(70):
        late = dict.fromkeys((3, 4, 5), 1) if 45 <= k < 57 else {}
        watch.update(day_of(hours_of(20_000 + k, late, hourly[24 * k : 24 * k + 72]), BANDS_HZ))
        if k == 56:
            found = result(SiteWatch.loaded(watch.snapshot()))
            assert kinds(found) == dict.fromkeys((3, 4, 5), "clock")
            assert found.sensors[3].what == "its hours come 1 h late against those of the other sensors"
            assert not found.gateways
    assert kinds(result(watch)) == {}


def test_directions_name_all_parts_once() -> None:
    assert np.array_equal(np.delete(DIRECTIONS, ALL, axis=0), np.eye(6))


def found_at(sensors: list[int], found: float, u: float = 0.002) -> Visits:
    """Visits at these sensors that find this change of all three sensitivities."""
    told = Visits(np.isin(np.arange(9), sensors), np.full((9, 3), np.nan), np.full(9, np.inf))
    told.found[sensors], told.u[sensors] = found, u
    return told


def test_a_visit_that_confirms_changes_nothing_and_one_that_refutes_loosens_all_tests(
    learned: tuple[Site, SiteWatch],
) -> None:
    site, watch, change = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot()), np.zeros((9, 6))
    change[4, :3] = -0.03
    watched(site, 12, watch, change)
    before = examined(watch)
    assert before is not None
    confirmed, refuted = (SiteWatch.loaded(watch.snapshot()) for _ in range(2))
    teach(confirmed, found_at([4], -0.03))
    teach(refuted, found_at([4], 0.0))
    row = dict(zip(VISIT, confirmed.visits[0].tolist(), strict=True))
    assert (row["sensor"], row["suspected"], row["found"], row["day"]) == (
        4,
        1,
        pytest.approx(np.log(0.97)),
        watch.day + 1,
    )
    assert abs(row["size"] + 0.03) < 3.0 * row["u"]
    assert confirmed.taught() == 1.0
    z2 = row["size"] ** 2 / (row["u"] ** 2 + 0.002**2)
    assert z2 > 40.0
    assert refuted.taught() == pytest.approx((PRIOR_VISITS + z2) / (PRIOR_VISITS + 1))
    after = examined(refuted)
    assert after is not None
    walk = before.joint.u[0, 0, ALL]
    assert after.joint.u[0, 0, ALL] == pytest.approx(walk * np.sqrt(refuted.taught()), rel=0.05)
    teach(refuted, Visits.unknown(np.arange(9) == 2))
    assert len(refuted.visits) == 1, "what nobody knows teaches nothing"
    again = SiteWatch.loaded(refuted.snapshot())
    assert np.array_equal(again.visits, refuted.visits)


def test_visits_tell_what_all_sensors_share(learned: tuple[Site, SiteWatch]) -> None:
    """All sensors lose 2 %, sensor 4 another 3 %: two visits find it, whichever of the sensors they are at."""
    site, watch, change = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot()), np.zeros((9, 6))
    change[4, :3] = -0.03
    watched(site, 12, watch, change - np.repeat([0.02, 0.0], 3))
    assert kinds(result(watch)) == {4: "sensitivity"}
    visits = found_at([4], -0.05)
    visits.there[1], visits.found[1], visits.u[1] = True, -0.02, 0.002
    teach(watch, visits)
    watch.update(site.day(change - np.repeat([0.02, 0.0], 3)), visits)
    found = result(watch)
    assert found.common is not None
    assert found.common.what == "all sensors, by 2 visits in 400 days"
    assert abs(found.common.size + 0.02) < found.common.U < 0.006
    assert found.common.U >= 2.0 * 0.002, "both rest on one reference"
    assert found.hidden == found.common.U
    assert found.sensors[4].kind == "learning"


def test_a_visit_of_a_gateway_that_was_told_finds_its_change_not_a_common_one(
    learned: tuple[Site, SiteWatch],
) -> None:
    site, watch, change = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot()), np.zeros((9, 6))
    change[3:6, :3] = -0.02
    watched(site, 12, watch, change)
    assert list(result(watch).gateways) == [1]
    teach(watch, found_at([3, 4, 5], -0.02))
    found = result(watch)
    assert found.common is not None
    assert abs(found.common.size) < found.common.U
    assert watch.visits[:, VISIT.index("suspected")].tolist() == [1, 1, 1]


@pytest.mark.slow
def test_gravity_is_asked_at_the_date_of_the_change(learned: tuple[Site, SiteWatch]) -> None:
    """z of sensor 4 loses 3 %, gravity with it; of sensor 6 it loses 3 % too, which gravity does not share."""
    site, watch, change = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot()), np.zeros((9, 6))
    random, gravity = np.random.default_rng(4), np.tile([0.3, -0.2, 9.8], (9, 1))
    change[[4, 6], 2] = -0.03
    for k in range(40):
        mean = gravity.copy()
        mean[4, 2] *= 0.97 if k >= 28 else 1.0
        day = site.day(change if k >= 28 else None)
        mean += 0.002 * (day.temperature_degc - 10.0) + random.normal(0.0, 0.005, (9, 3))
        watch.update(replace(day, mean_mps2=mean))
    told = result(watch).sensors
    assert [(i, one.what) for i, one in enumerate(told) if one.kind != "none"] == [
        (4, "sensitivity of z"), (6, "sensitivity of z")]  # fmt: skip
    says = [{one.name: one for one in told[i].witnesses} for i in (4, 6)]
    assert [list(one) for one in says] == [["structure", "gravity", "noise"]] * 2
    assert (says[0]["gravity"].says, says[1]["gravity"].says) == ("agrees", "contradicts")
    assert abs(says[0]["gravity"].size + 0.03) < 3.0 * says[0]["gravity"].u < 0.01
    assert abs(says[1]["gravity"].size) < 3.0 * says[1]["gravity"].u
    assert says[0]["noise"].says == "silent"


@pytest.mark.slow
def test_the_self_test_is_asked_at_the_date_of_the_change_at_the_temperature_of_its_nights(
    learned: tuple[Site, SiteWatch],
) -> None:
    """x of sensors 4 and 6 loses 3 %; the response of sensor 4 with it. All responses follow the temperature of their
    night by 0.2 %/K, each axis otherwise, and the supply by 1 % from night to night; that of sensor 6 falls by 4 % at
    the same date. Sensor 2 has none, and sensor 6 has not every night.
    """
    site, watch, change = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot()), np.zeros((9, 6))
    random = np.random.default_rng(5)
    change[[2, 4, 6], 0] = -0.03
    for k in range(40):
        day = site.day(change if k >= 28 else None)
        T = (15.0 + random.normal(0.0, 6.0, 9) - 10.0) / 10.0
        warmed = np.outer(T, [0.02, -0.02, 0.01]) + np.outer(T**2, [0.03, 0.0, -0.03])
        shown = 1.0 + warmed + random.normal(0.0, 0.001, (9, 3))
        shown += random.normal(0.0, 0.02, (9, 1))
        if k >= 28:
            shown[4, 0] -= 0.03
            shown[6] -= 0.08
        shown[2] = np.nan
        if k % 5 == 2:
            shown[6] = np.nan
        tests = SelfTests(shown, np.full((9, 3), 5e-4), np.full((9, 3), 0.01), 10.0 + 10.0 * T)
        watch.update(replace(day, self_tests=tests))
    again = SiteWatch.loaded(watch.snapshot())
    for one in (result(watch), result(again)):
        told = {
            i: {w.name: w for w in sensor.witnesses} for i, sensor in enumerate(one.sensors) if sensor.kind != "none"
        }
        assert list(told) == [2, 4, 6]
        assert "self-test" not in told[2]
        says = told[4]["self-test"], told[6]["self-test"]
        assert [one.says for one in says] == ["agrees", "contradicts"]
        assert abs(says[0].size + 0.03) < 3.0 * says[0].u < 0.01
        assert abs(says[1].size) < 3.0 * says[1].u < 0.025


def test_a_visit_begins_the_history_of_the_self_test_anew(learned: tuple[Site, SiteWatch]) -> None:
    site, watch = copy.deepcopy(learned[0]), SiteWatch.loaded(learned[1].snapshot())
    tests = SelfTests(np.ones((9, 3)), np.full((9, 3), 1e-3), np.full((9, 3), 0.02), np.full(9, 10.0))
    for _ in range(5):
        watch.update(replace(site.day(), self_tests=tests))
    there = np.arange(9) == 3
    watch.update(replace(site.day(), self_tests=tests), Visits.unknown(there))
    assert watch.self_tests.days.reshape(9, 3)[:, 0].tolist() == [0.0 if visited else 6.0 for visited in there]
