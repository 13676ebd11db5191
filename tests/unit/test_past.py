"""S(t), Q(t) and U(t) of the past: against one dense least-squares problem, and what stands between epochs."""

from __future__ import annotations

import numpy as np
import pytest

from calib.estimate.estimate import Estimate
from calib.estimate.nuisances import Priors
from calib.estimate.statements import Step
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import PARAMETERS, Array, Pose
from calib.state.past import FURTHEST_DAYS, REACH_DAYS, Past
from calib.state.state import State
from calib.windows.record import Record
from tests.building_windows import building_window
from tests.clamp_windows import G_MPS2, Q_TRUE, S_TRUE
from tests.drawn_records import UP, Truth, template, told
from tests.unit.test_estimate import MEAN, STILL, U

DAYS = (0.0, 1.0, 2.5, 2.6, 17.0, 18.0, 18.5)
WALKS = {"sensitivity": 2e-3, "offset_mps2": 0.02, "offset_rate_mps2": 1e-3}
LEVEL = np.append(np.eye(3).ravel(), np.zeros(3))
PLACE = Pose("beside", np.eye(3), UP)
U_STEP, STEP_DAY = 0.1, float(np.nextafter(DAYS[3], np.inf))


def filled(seed: int, *, fixed: bool = False, stepped: str = "Syy", step: float = 0.03) -> State:
    """An element of S steps by so much of S_yy between the fourth and the fifth window."""
    random, S = np.random.default_rng(seed), S_TRUE.copy()
    wander = Wander(dict(STILL.values) | WALKS)
    state = State(MEAN, U, Priors(), wander, TemperatureModel(), fixed=fixed)
    for k, day in enumerate(DAYS):
        if k == 4:
            S[np.unravel_index(PARAMETERS.index(stepped), (3, 3))] += step * S_TRUE[1, 1]
            state.step({stepped: U_STEP})
        state.update(Record.of(building_window(random, level_mps2=(0.1, 0.1, 0.1), S=S), day))
    return state


class Dense:
    """One problem whose unknowns are S and Q at every epoch, the step, and all constants. The rows of windows are those
    of the estimate; priors, walks, rates and the step are written down here by themselves. `values` (K, 12),
    `covariance` (K, 12, 12); `step` in its own standard uncertainty, with `u_step`. `cost`: chi-squared and the
    logarithm of the determinant."""

    def __init__(self, whole: Estimate, step_day: float = STEP_DAY, stated_u: float = U_STEP) -> None:
        self._step_day, self._stated_u = step_day, stated_u
        self._rows: list[Array] = []
        self.days, keys = whole.days.tolist(), list(whole.unknowns.at)
        self._constants = {key: 12 * len(self.days) + n for n, key in enumerate(keys[12:])}
        self._step = 12 * len(self.days) + len(self._constants)
        self._row({self._step: 1.0}, 0.0, 1.0)
        for n, own in enumerate(whole.unknowns.all):
            self._row({n if n < 12 else self._constants[own.key]: 1.0}, own.mean, own.u)
        for at, rows in zip(whole.epoch_of.tolist(), whole.rows, strict=True):
            column = [12 * at + n if n < 12 else self._constants[key] for n, key in enumerate(keys)]
            for line in rows:
                seen = float(line[-1] + line[:-1] @ whole.x[at])
                self._row(dict(zip(column, line[:-1].tolist(), strict=True)), seen, 1.0)
        for k in range(len(self.days) - 1):
            for n in range(12):
                self._walk(k, n)
        table = np.array(self._rows)
        found, *_ = np.linalg.lstsq(table[:, :-1], table[:, -1], rcond=None)
        factor = np.linalg.pinv(table[:, :-1], rcond=1e-15)
        covariance, count = factor @ factor.T, 12 * len(self.days)
        self.values = found[:count].reshape(-1, 12)
        self.covariance = np.array([covariance[k : k + 12, k : k + 12] for k in range(0, count, 12)])
        triangle = np.asarray(np.linalg.qr(table, mode="r"))
        self.cost = float(triangle[-1, -1] ** 2 + 2.0 * np.log(np.abs(triangle.diagonal()[:-1])).sum())
        self.step, self.u_step = found[self._step], np.sqrt(covariance[self._step, self._step])

    def _row(self, columns: dict[int, float], seen: float, u: float) -> None:
        made = np.zeros(self._step + 2)
        made[list(columns)] = np.array(list(columns.values())) / u
        made[-1] = seen / u
        self._rows.append(made)

    def _walk(self, k: int, n: int) -> None:
        """S or Q at an epoch after the one before: a Gauss-Markov process about a centre that rate and step move."""
        before, after, name = self.days[k], self.days[k + 1], PARAMETERS[n]
        a_day = (WALKS["sensitivity"] if n < 9 else WALKS["offset_mps2"]) ** 2  # output unit per m/s2: 1
        kept = np.exp(-a_day * (after - before) / (2.0 * U[n] ** 2))
        columns, rate = {12 * (k + 1) + n: 1.0, 12 * k + n: -kept}, self._constants.get(f"{name}_rate")
        centre = self._constants.get(f"{name}, centre")
        if rate is not None:
            columns[rate] = -(after - before) - (1.0 - kept) * (before - self.days[0])
        if centre is not None:
            columns[centre] = -(1.0 - kept)
        if name == "Syy":
            moved = float(before < self._step_day <= after) + (1.0 - kept) * (before >= self._step_day)
            columns[self._step] = -self._stated_u * moved
        seen = 0.0 if centre is not None else (1.0 - kept) * MEAN[n]
        self._row(columns, seen, max(U[n] * np.sqrt(1.0 - kept**2), 1e-10))


def test_it_is_the_solution_of_one_dense_problem() -> None:
    state = filled(1)
    past = state.past()
    dense = Dense(state.estimate(also=past.days.tolist()))
    assert past.days.tolist() == dense.days
    for law, value, own in zip(past.laws, dense.values, dense.covariance, strict=True):
        u = np.sqrt(own.diagonal())
        np.testing.assert_allclose(law.mean / u, value / u, rtol=0, atol=1e-5)
        np.testing.assert_allclose(law.covariance / np.outer(u, u), own / np.outer(u, u), rtol=0, atol=1e-5)
    (change,) = past.changes
    assert (change.day, change.stated) == (STEP_DAY, {"Syy": U_STEP})
    assert change.found[4] == pytest.approx(U_STEP * dense.step, rel=1e-5)
    assert change.standard_uncertainty[4] == pytest.approx(U_STEP * dense.u_step, rel=1e-4)
    assert change.found[4] == pytest.approx(0.03 * S_TRUE[1, 1], abs=3.0 * change.standard_uncertainty[4])


@pytest.mark.slow
def test_the_date_of_a_step_is_that_of_the_dense_problem_with_the_step_in_each_gap() -> None:
    """The step, as large as it was found to be, is as likely beforehand at any time; at 1 % it is in doubt."""
    state = filled(1, step=0.01)
    past = state.past()
    (change,), whole = past.changes, state.estimate(also=past.days.tolist())
    edges, size = np.array(DAYS), abs(float(change.found[4]))
    costs = np.array([Dense(whole, float(np.nextafter(day, -np.inf)), size).cost for day in DAYS[1:]])
    share = np.diff(edges) * np.exp(-0.5 * (costs - costs.min()))
    share /= share.sum()
    assert share.max() < 0.95  # so that both ends of the interval are in other gaps
    even = np.random.default_rng(1).permutation((np.arange(100_000) + 0.5) / 100_000)  # quantiles of the mixture
    days = np.interp(even, np.append(0.0, np.cumsum(share)), edges)
    date = change.dated()
    assert date.by_windows
    np.testing.assert_allclose([date.day, *date.interval], [days.mean(), *np.quantile(days, [0.025, 0.975])], atol=2e-3)
    assert date.standard_uncertainty == pytest.approx(days.std(), rel=1e-3)


@pytest.mark.slow
def test_a_step_within_merged_windows_is_dated_to_them_and_no_closer() -> None:
    """Four windows a day; the step is found a week later, when whole days were merged. Its share of the day's windows
    does not tell the hour, for nobody knows how they were spread."""
    days, day = np.arange(0.0, 40.0, 0.25), 14.6
    walks = {"sensitivity": 1e-6, "offset_rate_mps2": 1e-3, "offset_rate_walk_mps2": 2e-5}
    wander, priors = Wander(dict(STILL.values) | walks), Priors(offset_mps2=1e-3)
    state, window = State(LEVEL, U, priors, wander, TemperatureModel(), fixed=True), template(PLACE, noise=0.05)
    S = [np.eye(3) + np.diag([0.0, 0.02 * (t >= day), 0.0]) for t in days.tolist()]
    records = [told(window, Truth(own, np.zeros(3)), t) for own, t in zip(S, days.tolist(), strict=True)]
    found = float(np.nextafter(days[86], -np.inf))
    state.take_also(records, [Step(found, {"Syy": U_STEP})])
    state.merge_old(float(days[-1]))
    (change,) = state.past().changes
    assert change.day == found
    date = change.dated()
    np.testing.assert_allclose(date.interval, [14.0 + 0.025 * 0.75, 14.75 - 0.025 * 0.75], rtol=0, atol=1e-3)
    assert date.standard_uncertainty == pytest.approx(0.75 / np.sqrt(12.0), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("every", "last"), [(0.5, 19.0), (0.5, 29.5), (5.0, 40.0)])
def test_the_date_of_a_found_drift_is_its_onset(every: float, last: float) -> None:
    """A drift by 0.3 % a day, found on day 19. A window tells S to 0.13 %, so the onset to half a day, also between two
    windows that are five days apart, and where no window came since it was found."""
    days, day = np.arange(0.0, last + every, every), 12.2
    wander, priors = Wander(dict(STILL.values) | {"sensitivity": 1e-6}), Priors(offset_mps2=1e-3)
    state, window = State(LEVEL, U, priors, wander, TemperatureModel(), fixed=True), template(PLACE, noise=0.05)
    S = [np.eye(3) + np.diag([0.0, 3e-3 * max(t - day, 0.0), 0.0]) for t in days.tolist()]
    records = [told(window, Truth(own, np.zeros(3)), t) for own, t in zip(S, days.tolist(), strict=True)]
    state.take_also(records, [Step(float(np.nextafter(19.0, np.inf)), {"Syy": 0.02, "Syy_rate": 3e-3})])
    (change,) = state.past().changes
    date = change.dated()
    assert date.interval[0] < day < date.interval[1]
    assert date.day == pytest.approx(day, abs=2.0 * date.standard_uncertainty)
    assert 0.1 < date.standard_uncertainty < 0.7


@pytest.mark.slow
def test_the_date_of_a_stated_change_is_between_the_windows_before_and_after_it() -> None:
    state = filled(7)
    state.remount()
    state.update(Record.of(building_window(np.random.default_rng(8), level_mps2=(0.1, 0.1, 0.1)), 22.5))
    change = state.past().changes[-1]
    assert change.day == np.nextafter(18.5, np.inf)
    date = change.dated()
    assert not date.by_windows
    np.testing.assert_allclose([date.day, *date.interval], [20.5, 18.6, 22.4], rtol=1e-12)
    assert date.standard_uncertainty == pytest.approx(4.0 / np.sqrt(12.0))


def test_epochs_stand_at_windows_on_both_sides_of_a_change_and_within_long_gaps() -> None:
    past = filled(2).past()
    assert past.days.tolist()[:5] == [*DAYS[:4], STEP_DAY]
    assert np.diff(past.days).max() <= FURTHEST_DAYS
    assert dict(zip(past.days.tolist(), past.windows, strict=True)) == {
        day: int(day in DAYS) for day in past.days.tolist()
    }


@pytest.mark.slow
@pytest.mark.parametrize("stepped", ["Syy", "Syz"])
def test_a_change_is_the_difference_of_both_sides(stepped: str) -> None:
    """Of a fixed mount, whose mean output stays: with S_yz, along which gravity acts, Q_y changes as well."""
    past = filled(2, fixed=True, stepped=stepped).past()
    (change,), sides = past.changes, past.laws[3:5]
    np.testing.assert_allclose(change.found, sides[1].mean - sides[0].mean, rtol=0, atol=1e-6)
    k = PARAMETERS.index(stepped)
    assert change.found[k] == pytest.approx(0.03 * S_TRUE[1, 1], abs=3.0 * change.standard_uncertainty[k])
    ratio = change.standard_uncertainty[10] / change.standard_uncertainty[k]
    assert ratio == pytest.approx(G_MPS2 if stepped == "Syz" else 0.0, rel=1e-2, abs=1e-6)


def test_another_lag_alone_is_no_change_of_s_and_q() -> None:
    state = filled(5)
    state.step({"lag": 1e-3})
    state.update(Record.of(building_window(np.random.default_rng(6), level_mps2=(0.1, 0.1, 0.1)), 19.0))
    past = state.past()
    assert [change.day for change in past.changes] == [STEP_DAY]
    assert past.days.tolist()[-2:] == [18.5, 19.0]


def test_between_two_epochs_it_is_on_their_line_as_an_epoch_there_would_be() -> None:
    state = filled(3)
    past, day = state.past(), 9.9
    whole = state.estimate(also=[*past.days.tolist(), day])
    (then,) = (then.now for then in whole.past() if then.now.day == day)
    there, u = past.at(day), np.sqrt(then.variance[:12])
    np.testing.assert_allclose(there.mean / u, then.mean[:12] / u, rtol=0, atol=0.01)
    np.testing.assert_allclose(np.sqrt(there.covariance.diagonal()), u, rtol=0.1)
    first, last = past.at(past.begin - 1.0), past.at(past.days[-1] + 1.0)
    np.testing.assert_array_equal(first.mean, past.laws[0].mean)
    np.testing.assert_array_equal(last.mean, past.laws[-1].mean)
    for outside in (past.begin - 1.01 * REACH_DAYS, past.days[-1] + 1.01 * REACH_DAYS):
        assert not past.knows(outside)
    assert past.knows(past.begin - 0.99 * REACH_DAYS)


@pytest.mark.slow
@pytest.mark.parametrize("fixed", [False, True])
def test_the_last_epoch_is_the_present(fixed: bool) -> None:
    """Of a fixed mount as well, where Q is read from the mean output: in the past from that of each epoch."""
    state = filled(4, fixed=fixed)
    past, now, u = state.past(), state.law(), state.result().standard_uncertainty
    np.testing.assert_allclose(past.laws[-1].mean / u, now.mean / u, rtol=0, atol=2e-3)
    np.testing.assert_allclose(np.sqrt(past.laws[-1].covariance.diagonal()) / u, 1.0, rtol=2e-3)
    if fixed:
        Q = np.array([law.mean[9:] for law in past.laws])
        assert np.abs(Q - Q_TRUE).max() < 4.0 * u[9:].max()


def test_without_windows_there_is_none() -> None:
    past = State(MEAN, U, Priors(), STILL, TemperatureModel(), fixed=False).past()
    assert isinstance(past, Past)
    assert len(past.days) == 0
    assert not past.knows(0.0)
