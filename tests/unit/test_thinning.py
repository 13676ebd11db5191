"""Merged records: how many there are at most, and what neither a drift nor the order of records may change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.estimate.estimate import estimate
from calib.estimate.nuisances import Priors
from calib.estimate.statements import Statements
from calib.estimate.unknowns import Unknowns
from calib.estimate.wander import TemperatureModel, Wander
from calib.model import Pose
from calib.state.thinning import MOST, merged, thinned
from tests.drawn_records import UP, Truth, template, told

S, Q = np.eye(3), np.array([0.2, -0.1, 0.4])
MEAN, U = np.append(S.ravel(), Q), np.append(np.full(9, 0.02), np.full(3, 1.0))
STILL = dict.fromkeys(Wander.none().values, 0.0)
BESIDE = template(Pose("p", np.eye(3), UP), noise=1e-3)


def test_there_are_never_more_records_than_a_state_may_have() -> None:
    """Two references and twelve positions at three temperatures, each hour of two weeks and each day of a year."""
    poses = [replace(BESIDE, pose=replace(BESIDE.pose, position=str(k))) for k in range(12)]
    days = [*(-365.0 + np.arange(350)), *(-15.0 + np.arange(15 * 24) / 24.0)]
    records = [
        told(poses[k % 12], Truth(S, Q), float(day), degc=5.0 + 10.0 * (k // 12 % 3), reference="AB"[k // 36 % 2])
        for k, day in enumerate(days)
    ]
    few = thinned(records, 0.0, S)
    assert len(records) > MOST >= len(few) > MOST // 4
    assert sum(record.windows for record in few) == len(records)


def test_a_drift_of_q_over_a_season_is_not_taken_for_its_temperature() -> None:
    """0.1 m/s2 in a hundred days in which it gets 8 K warmer: the windows tell nothing of Q over temperature."""
    random, per_k = np.random.default_rng(1), 0.002
    records = []
    for day in np.arange(0.0, 100.0, 2.0):
        above = 0.08 * day
        Q_then = Q + 1e-3 * day + per_k * above
        noise = 1e-3 * random.normal(size=3)
        records.append(told(BESIDE, Truth(S, Q_then), float(day), degc=21.0 + above, mean_noise=noise))
    walks = Wander(STILL | {"offset_mps2": 1e-3, "offset_rate_mps2": 2e-3})
    model = TemperatureModel(1, 0, 20.0, (0.005, 0.0))
    stated = Statements(MEAN, U, {"": Priors.none().with_values({"offset_mps2": 1e-3})}, walks, model)
    now = estimate([merged(records[:-2], S), *records[-2:]], stated).now
    for name in ("Qx_T1", "Qy_T1", "Qz_T1"):
        k = now.index(name)
        assert abs(now.mean[k] - per_k) < 3.0 * np.sqrt(now.variance[k])


def test_an_unknown_begins_with_the_first_window_that_has_it_however_windows_were_merged() -> None:
    """Of two merged records the one whose middle is later has the first window: the reference drifts from there on."""
    early, late = (told(BESIDE, Truth(S, Q), day) for day in (50.0, 60.0))
    records = [replace(early, days=(40.0, 60.0), windows=2), replace(late, days=(0.0, 120.0), windows=2)]
    stated = Statements(
        MEAN, U, {"": Priors.none().with_values({"reference_drift": 0.005})}, Wander(STILL), TemperatureModel(),
        certified={"A": 0.0},
    )  # fmt: skip
    drift = next(own for own in Unknowns(stated, records).all if own.key == "reference_drift_x of A")
    assert drift.since == 0.0
    assert estimate(records, stated).days[0] == 0.0


def test_windows_with_lags_of_their_own_tell_together_what_they_tell_apart() -> None:
    """Each of 30 windows moves another way and has its own lag, of which the clocks leave 1 ms open. S by the merged
    record is that of least squares over all slopes with a lag for each window, within 0.3 of its u, and its rows have
    no more scatter than noise. With the lag of the first window for all it was 5 u off."""
    random, omega, noise, count = np.random.default_rng(7), 4.0, 1e-3, 30
    windows, columns, observed = [], [], []
    for w in range(count):
        root = np.triu(random.normal(size=(6, 6))) + 2.0 * np.eye(6)
        root[:, 3:] *= omega
        lag_s = 1e-3 * random.normal()
        slopes = root @ np.vstack([S, -lag_s * S]) + noise * random.normal(size=(6, 3))
        taken_s = lag_s if w % 2 else 0.0  # from half of them the front end took it out
        slopes += taken_s * root[:, 3:] @ S
        windows.append(replace(told(BESIDE, Truth(S, Q), 0.0), root=root, slopes=slopes, lag_s=taken_s, u_lag_s=1e-3))
        own = np.zeros((18, 9 + count))
        own[:, :9] = np.kron(root[:, :3], np.eye(3))
        own[:, 9 + w] = (-root[:, 3:] @ S).ravel()
        columns.append(own)
        observed.append(slopes.ravel())
    exact, covariance = _least_squares(np.vstack(columns), np.concatenate(observed), noise)
    for one in (merged(windows, S), merged([merged(windows[:9], S), merged(windows[9:], S)], S)):
        by_one_lag = np.column_stack([np.kron(one.root[:, :3], np.eye(3)), (-one.root[:, 3:] @ S).ravel()])
        found, _ = _least_squares(by_one_lag, one.slopes.ravel(), noise)
        u = np.sqrt(np.diag(covariance)[:9])
        np.testing.assert_array_less(np.abs(found[:9] - exact[:9]) / u, 0.3)
        left = (one.slopes.ravel() - by_one_lag @ found) / noise
        assert left @ left < 25.0  # of 18 rows and 10 unknowns


def _least_squares(columns: np.ndarray, observed: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    found, *_ = np.linalg.lstsq(columns, observed, rcond=None)
    return found, noise**2 * np.linalg.inv(columns.T @ columns)


def test_what_is_open_of_the_lag_within_windows_is_that_of_their_common_slopes() -> None:
    """The slopes of a merged record differ from those of windows at their true lag by what the bends of its windows
    move them, as least squares over all of them says. Of two parts in each of six windows nothing is lost, also where
    they are merged in two steps; two parts for all would be half of it."""
    random = np.random.default_rng(4)
    bends = 1e-3 * random.normal(size=(6, 2, 6, 3))
    roots = np.triu(random.normal(size=(6, 6, 6))) + 3.0 * np.eye(6)
    windows = [
        replace(told(BESIDE, Truth(S, Q), 0.0), root=root, lag_bend=bend)
        for root, bend in zip(roots, bends, strict=True)
    ]
    power = [one.root.T @ one.root for one in windows]
    moved = [np.linalg.solve(sum(power), P @ part) for P, bend in zip(power, bends, strict=True) for part in bend]
    scatter = sum(np.outer(m.ravel(), m.ravel()) for m in moved)
    for both in (merged(windows, S), merged([merged(windows[:2], S), merged(windows[2:], S)], S)):
        assert both.lag_bend is not None
        parts = both.lag_bend.reshape(len(both.lag_bend), -1) / np.sqrt(6.0)
        np.testing.assert_allclose(parts.T @ parts, scatter, atol=1e-9 * float(np.max(scatter)))
    np.testing.assert_allclose(windows[0].by_bend[1], (windows[0].root @ bends[0, 1] / windows[0].noise).ravel())
