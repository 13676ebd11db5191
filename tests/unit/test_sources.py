"""The budget of U on-line: it adds up, and each share is how far S and Q move with the errors of its source."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from agent.core.events import CalibrationUpdate
from agent.core.snapshot import pack, unpack
from agent.recording.messages import decode, encode, schema_of, topic_of
from calib.estimate.estimate import estimate
from calib.estimate.nuisances import Priors
from calib.estimate.rows import CORRECTION, LAGS, OFFSETS, TYPE_A, NoiseScores, Rows, TemperatureSpread
from calib.estimate.statements import Statements, Step
from calib.estimate.wander import TemperatureModel
from calib.model import Array, Calibration
from calib.state.state import State
from calib.state.thinning import thinned
from calib.windows.record import Record
from calib.windows.type_a import LEAST_INFLATION
from tests.building_windows import building_window
from tests.clamp_windows import TRUTH, Faults, clamp_points
from tests.unit.results import calibration
from tests.unit.test_estimate import MEAN, STILL, U, many, walking
from tests.unit.test_estimation import OF_Y, estimation, hours, settled


@pytest.fixture(scope="module")
def clamped() -> list[Record]:
    """Four positions beside a uniaxial reference."""
    windows = clamp_points(np.random.default_rng(11), Faults(), repetitions=1).windows
    return [Record.of(window, k * 1e-3) for k, window in enumerate(windows)]


class Linear:
    """The estimate as one dense linear problem: nothing walks, so that all windows have the same unknowns."""

    def __init__(self, records: list[Record], lag_window_s: float = 0.0) -> None:
        stated = Statements(TRUTH, U, {"": Priors(lag_window_s=lag_window_s)}, STILL, TemperatureModel())
        self.records, self.whole = records, estimate(records, stated)
        self.u = self.whole.unknowns.prior[1]
        design = np.vstack([np.diag(1.0 / self.u), *(own[:, :-1] for own in self.whole.rows)])
        self._solve = np.linalg.pinv(design, rcond=1e-15)[:12]
        self._first = np.cumsum([len(self.u), *map(len, self.whole.rows)])

    @property
    def shares(self) -> dict[str, Array]:
        return self.whole.budget(np.eye(12, len(self.u)))

    def variance(self, errors: Iterable[tuple[int, Array]]) -> Array:
        """(12,) of S and Q by independent errors, each of which is what it adds to the rows from a place on."""
        found = np.zeros(12)
        for first, error in errors:
            found += (self._solve[:, first : first + len(error)] @ error) ** 2
        return found

    def seen(self, w: int, name: str, error: Array) -> tuple[int, Array]:
        """What an error of a window's sums adds to its rows."""
        record, x = self.records[w], self.whole.x[w][None]
        whole, day = self.whole, self.whole.days[w : w + 1]
        other = replace(record, **{name: getattr(record, name) + error})
        spread = TemperatureSpread.of(whole.unknowns, whole.seen_degc, x[0])
        rows, moved = (Rows(whole.unknowns, [r], day, [whole.noise[w]], spread).at(x, x)[0] for r in (record, other))
        return int(self._first[w]), moved[:, -1] - rows[:, -1]


def test_the_prior_has_the_share_by_which_its_errors_move_s_and_q(clamped: list[Record]) -> None:
    linear = Linear(clamped)
    own = linear.variance((n, np.ones(1)) for n in range(12))
    np.testing.assert_allclose(linear.shares["prior of S and Q"], own, rtol=1e-6)
    gravity = linear.variance([(list(linear.whole.unknowns.at).index("gravity"), np.ones(1))])
    np.testing.assert_allclose(linear.shares["gravity"], gravity, rtol=1e-6)


def test_offsets_of_windows_have_the_share_by_which_they_move_s_and_q(clamped: list[Record]) -> None:
    linear = Linear(clamped)
    size = Priors().offset_mps2 * linear.whole.unknowns.statements.scale
    own = linear.variance(linear.seen(w, "means", size * axis[None]) for w in range(len(clamped)) for axis in np.eye(3))
    np.testing.assert_allclose(linear.shares[OFFSETS], own, rtol=1e-6)


def test_lags_of_windows_have_a_share_where_they_are_stated(clamped: list[Record]) -> None:
    for lag_window_s in (0.0, 2e-4):
        shares = Linear(clamped, lag_window_s).shares
        assert shares[LAGS].any() == (lag_window_s > 0.0)
        assert not shares[CORRECTION].any()


def test_noise_has_the_share_by_which_it_moves_s_and_q(clamped: list[Record]) -> None:
    linear, errors = Linear(clamped), []
    for w, (record, noise) in enumerate(zip(clamped, NoiseScores.around(clamped), strict=True)):
        of_slopes, of_means = (
            record.noise * np.sqrt(max(ratio / record.independent, LEAST_INFLATION))
            for ratio in (noise.slopes, noise.means)
        )
        for i in range(3):
            errors.append(linear.seen(w, "means", of_means[i] * np.eye(3)[i][None] / np.sqrt(record.count)))
            for entry in range(len(record.slopes)):
                by = np.zeros_like(record.slopes)
                by[entry, i] = of_slopes[i]
                errors.append(linear.seen(w, "slopes", by))
    np.testing.assert_allclose(linear.shares[TYPE_A], linear.variance(errors), rtol=1e-6)


def of_year(*, fixed: bool) -> State:
    """Walks, temperature with windows that have none, a step, a rollback, merged windows, two references, a lag between
    windows, a silent direction, bands that tell a response."""
    random, priors = np.random.default_rng(12), Priors(lag_window_s=1e-4, known_u=1e-3)
    wander = walking(sensitivity=1e-4, offset_mps2=3e-3, offset_rate_mps2=1e-3, tilt_rad=1e-4)
    state = State(MEAN, U, priors, wander, TemperatureModel(1, sensitivity_order=1), fixed=fixed)
    for k in range(24):
        if k == 8:
            state.step({"Syy": 0.05, "lag of A": 1e-3})
        if k == 12:
            now = state.result()
            state.put(Calibration(now.sensitivity, now.offset, now.covariance, now.determined, np.inf, ""))
        level = (0.1, 0.1, 0.0 if k % 4 == 0 else 0.1)
        window = building_window(random, level_mps2=level, reference_noise_mps2=1e-3)
        noisy = replace(window, reference_noise=np.array([[1e-3] * 3, [0.0] * 3]))
        state.meet("A" if k < 18 else "B")
        state.update(Record.of(noisy, 0.2 * k, 0.0, np.nan if k % 7 == 0 else 20.0 + k % 5, state.reference()))
    return state


@pytest.mark.one_case
@pytest.mark.parametrize("fixed", [False, True])
def test_the_squares_add_up_to_the_variances(fixed: bool) -> None:
    state = of_year(fixed=fixed)
    budget = state.budget()
    state.solve()
    variance = state.result().covariance.diagonal()
    np.testing.assert_allclose(budget.standard_uncertainty**2, variance, rtol=1e-9)
    told = set(budget.by_source)
    assert {"prior of S and Q", "walks and steps of S and Q", TYPE_A, OFFSETS, LAGS, "known filters"} <= told
    noise = budget.by_source[TYPE_A]
    freedom = state.result().degrees_of_freedom
    np.testing.assert_allclose(budget.degrees_of_freedom, freedom * (variance / noise**2) ** 2, rtol=1e-9)
    assert budget.coverage_factor == state.coverage_factor


def resting(record: Record) -> Record:
    """The same position without a reference: gravity alone."""
    none = np.zeros((0, 0))
    pose = replace(record.pose, direction=np.zeros((3, 0)), along=None, along_rate_s=None)
    return replace(
        record, pose=pose, along=none, along_rate_s=none, root=none, slopes=np.zeros((0, 3)), mean_x=np.zeros(0),
        passed=np.zeros((len(record.passed), 0, 0)),
    )  # fmt: skip


@pytest.mark.slow
def test_rests_alone_and_merged_records_have_budgets_as_well(clamped: list[Record]) -> None:
    records = thinned(many(np.random.default_rng(13), 90, 0.25), 1e4, np.eye(3))
    walks, before = walking(sensitivity=2e-5, offset_mps2=1e-3), Step(-1.0, {"Syy": 0.05})
    stated = Statements(MEAN, U, {"": Priors()}, walks, TemperatureModel(), steps=(before,))
    assert max(record.windows for record in records) > 10
    for own in (records, [resting(record) for record in clamped]):
        whole = estimate(own, stated)
        total = sum(whole.budget(np.eye(12, len(whole.unknowns))).values())
        np.testing.assert_allclose(total, whole.now.variance[:12], rtol=1e-9)


@pytest.mark.slow
def test_the_first_calibration_of_a_day_and_an_adopted_jump_have_a_budget() -> None:
    """Also after a restart in between; the squares are those of U in force."""
    random = np.random.default_rng(14)
    found = settled()  # ten windows, one an hour
    assert found.budget is None
    went_on = estimation()
    went_on.load(unpack(pack(found.snapshot())))
    windows = [building_window(random) for _ in range(2)] + [building_window(random, S=OF_Y) for _ in range(5)]
    for k, window in enumerate(windows):
        (judged,) = hours(found, [window], first=24 + k)
        assert (found.budget is not None) == (k == 0 or judged.decision.action == "adopt")
        if found.budget is not None:
            u = found.in_force.standard_uncertainty
            np.testing.assert_allclose(found.budget.standard_uncertainty, u, rtol=1e-9)
        if k == 0:
            hours(went_on, [window], first=24)
            assert found.budget is not None
            assert went_on.budget is not None
            for source, u in found.budget.by_source.items():
                np.testing.assert_array_equal(went_on.budget.by_source[source], u)
    assert judged.decision.action == "adopt"


def test_a_recording_keeps_the_budget_of_a_calibration() -> None:
    told = {"type A": [float(k) for k in range(12)], "lag": [0.5] * 12}
    update = msgspec.structs.replace(calibration(5), budget=told, degrees_of_freedom=[10.0] * 11 + [np.inf])
    _, again = decode(schema_of(topic_of(update)), encode(3, update))
    assert isinstance(again, CalibrationUpdate)
    assert (again.budget, again.degrees_of_freedom) == (told, update.degrees_of_freedom)
    _, without = decode(schema_of(topic_of(update)), encode(3, calibration(5)))
    assert isinstance(without, CalibrationUpdate)
    assert (without.budget, without.degrees_of_freedom) == ({}, [])
