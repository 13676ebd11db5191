"""A person turning a real sensor into six static positions: Method 3 against the result that imucal stored."""

from __future__ import annotations

import json

import numpy as np

from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Priors
from calib.geometry import at_rest
from calib.model import Window, WindowSums
from tests.realdata.datasets import dataset

GRAVITY_MPS2 = 9.81  # as imucal takes it
UP = {f"{axis}_{way}": sign * np.eye(3)[i] for i, axis in enumerate("xyz") for way, sign in (("p", 1.0), ("a", -1.0))}


def _windows() -> tuple[list[Window], np.ndarray]:
    folder = dataset("imucal_ferraris")
    table = np.genfromtxt(folder / "annotated_session.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    windows = []
    for position, up in UP.items():
        V = np.stack([table[f"acc_{axis}"] for axis in "xyz"], axis=1)[table["part"] == position].astype(float)
        parts = np.array_split(V, max(len(V) // 200, 2))
        mean = np.array([p.mean(axis=0) for p in parts])
        scatter = np.array([(p - m).T @ (p - m) for p, m in zip(parts, mean, strict=True)])
        sums = WindowSums(0, np.array([float(len(p)) for p in parts]), mean, scatter)
        pose = at_rest(GRAVITY_MPS2 * up, position=position)
        windows.append(Window(0.0, 1.0, pose, sums, True, "", len(V), 0))
    stored = json.loads((folder / "example_cal.json").read_text())
    return windows, np.array(stored["K_a"]) @ np.array(stored["R_a"])


def test_six_positions_equal_imucal() -> None:
    windows, S = _windows()
    # imucal weighs the six means alike, whatever their number of points: so does this.
    equal = [
        Window(
            w.start_s, w.stop_s, w.pose,
            WindowSums(0, w.sums.count * 1000.0 / w.points, w.sums.mean, w.sums.scatter * 1000.0 / w.points),
            True, "", 1000, 0,
        )
        for w in windows
    ]  # fmt: skip
    found = adjust(equal, Priors.none())
    np.testing.assert_allclose(found.mean[:9].reshape(3, 3), S, rtol=0, atol=1e-12 * np.abs(S).max())


def test_six_positions_with_hand_placed_angles_are_honest() -> None:
    """Hands place to about 1 deg: u of the transverse elements must say so, that of the main ones hardly feels it."""
    windows, S = _windows()
    found = adjust(windows, Priors(angle_rad=np.deg2rad(1.0), gravity_mps2=0.0))
    assert found.reasons == ()
    assert found.calibration.determined.all()
    difference = np.abs(found.calibration.sensitivity - S)
    u = found.calibration.standard_uncertainty[:9].reshape(3, 3)
    assert np.all(difference < 2.0 * u)
    transverse = ~np.eye(3, dtype=bool)
    size = np.abs(np.diag(S)).mean()
    np.testing.assert_allclose(u[transverse] / size, np.deg2rad(1.0) / np.sqrt(2.0), rtol=0.35)  # two positions an axis
