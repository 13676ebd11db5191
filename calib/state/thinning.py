"""Old records are merged: many windows of one setting become one record, which tells the same of all that is constant.

A walk within the merged stretch is allowed for in the record's weight (calib.estimate.rows). Nothing is merged across a
step, nor what differs in setting, in the directions that moved or in the response that the front end took out. The lag
that each window has by itself is taken out before. A record without a temperature stays apart from those that have one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from calib.model import Array
from calib.windows.condense import regressed
from calib.windows.deviations import Deviations, LeftOpen
from calib.windows.excited import MotionSums
from calib.windows.record import TERMS, TOLD, Record

NEWEST = 48  # records that stay as they are: four times round twelve positions
# (age in days from which on, width in days): an hour for two weeks, then longer ones.
WIDTHS = ((0.0, 1.0 / 24.0), (14.0, 1.0), (60.0, 7.0), (400.0, 14.0), (1200.0, 20.0))
# Records. Each takes at most 3.4 kB of the state with three axes of a DC-coupled reference, and more with an AC-coupled
# one, whose integrals are channels too. Of many positions and references the widths are doubled.
MOST = 650
WIDEST = 4096.0  # times the widths
# Parts of what is open of the lag within windows that a merged record keeps: with two, as of one window, it would seem
# better known after many windows than it is.
BENDS = 12
TURNS = 4  # of the lags of the windows and the slopes that they have in common
BRIEF_DAYS = 1.0  # so long Q is the same at all temperatures of a record
BIN_K = 5.0  # records whose temperatures differ by more stay apart: S may depend on it


def thinned(records: Sequence[Record], now: float, nominal: Array, cuts: Sequence[float] = ()) -> list[Record]:
    """The records, in the order of their days, the old ones merged as WIDTHS says.

    `nominal` (3, 3) is S, only to bring the means of V to one mean of the reference's motion. `cuts`: days of steps.
    """
    records = sorted(records, key=lambda r: r.day)
    old, new = records[:-NEWEST], records[-NEWEST:]
    wider, buckets = 1.0, _buckets(old, now, cuts, 1.0)
    while len(buckets) + len(new) > MOST and wider < WIDEST:
        wider *= 2.0
        buckets = _buckets(old, now, cuts, wider)
    return sorted((merged(own, nominal) for own in buckets), key=lambda r: r.day) + new


def _buckets(records: Sequence[Record], now: float, cuts: Sequence[float], wider: float) -> list[list[Record]]:
    """The records that become one each, with so many times the widths."""
    found: dict[tuple[object, ...], list[Record]] = {}
    for r in records:
        width = wider * max(width for age, width in WIDTHS if now - r.day >= age or age == 0.0)
        degc = np.floor(r.temperature_degc / BIN_K) if np.isfinite(r.temperature_degc) else None
        key = (
            width, int(r.day // width), sum(r.day >= day for day in cuts), r.setting, r.excited.tobytes(), r.response,
            degc, r.motion_hz is None, r.planar,
        )  # fmt: skip
        found.setdefault(key, []).append(r)
    return list(found.values())


def merged(records: Sequence[Record], nominal: Array) -> Record:
    """One record for several of one setting and response."""
    if len(records) == 1:
        return records[0]
    first = records[0]

    def each(name: str) -> list[Any]:
        return [getattr(r, name) for r in records]

    windows = np.array(each("windows"), dtype=float)
    share = windows / windows.sum()

    def mean(name: str) -> Array:
        return np.asarray(sum(w * value for w, value in zip(share, each(name), strict=True)))

    noise = np.sqrt(sum(w * value**2 for w, value in zip(share, each("noise"), strict=True)))
    lag_s, root, slopes, passed = _together(records, noise)
    mean_x = mean("mean_x")
    D = first.pose.direction
    # The means of V at one mean of the reference: its own motion moves them by S as nearly as nominal.
    moved = [r.means - np.outer(r.over_t[:, 0], nominal @ D @ (r.mean_x - mean_x)[: D.shape[1]]) for r in records]
    begun, ended = zip(*each("days"), strict=True)
    days = min(begun), max(ended)
    # Over weeks Q drifts with the seasons, and the temperature within them would take it up: the mean alone is kept.
    rows = 3 if days[1] - days[0] <= BRIEF_DAYS else 1
    over = _triangle(np.hstack([np.vstack(each("over_t")), np.vstack(moved)]), rows)
    power = np.array([(r.root[:, : r.channels] ** 2).sum() for r in records]) + np.finfo(float).tiny

    def by_windows(name: str) -> float:
        return float(share @ each(name))

    def by_power(name: str) -> float:
        return float(power @ each(name) / power.sum())

    motions = [motion for motion in each("motion") if motion is not None]
    return replace(
        first,
        day=by_windows("day"), days=days, windows=int(windows.sum()), lag_s=lag_s,
        u_lag_s=_rms(share, each("u_lag_s")), attenuation=_rms(share, each("attenuation")),
        independent=by_windows("independent"), along=mean("along"),
        along_rate_s=mean("along_rate_s"), root=root, slopes=slopes, passed=passed,
        omega2=by_power("omega2"), noise=noise, scores=np.asarray(sum(each("scores"))),
        mean_x=mean_x, means=over[:, 3:], over_t=over[:, :3],
        temperature_degc=by_power("temperature_degc"), behind_k=by_power("behind_k"), held_mps2=mean("held_mps2"),
        count=float(sum(each("count"))), told=_triangle(np.vstack(each("told")), TOLD),
        deviations=reduce(Deviations.plus, each("deviations"), Deviations()),
        left_open=reduce(LeftOpen.plus, each("left_open"), LeftOpen()), mean_hz=by_windows("mean_hz"),
        motion=reduce(MotionSums.plus, motions) if motions else None,
        to_hz=max(each("to_hz")), bands=None, reference_noise=None, lag_bend=_bends(records, root, noise),
    )  # fmt: skip


def _bends(records: Sequence[Record], root: Array, noise: Array) -> Array | None:
    """(k, 2M, 3) what is open of the lag within the windows, as that of one record with this root and noise: times the
    root of the number of windows, as if all were alike. Of all that they leave open, the BENDS largest parts stay.
    """
    if all(r.lag_bend is None for r in records):
        return None
    told = [(r.root, r.lag_bend / np.sqrt(r.windows)) for r in records if r.lag_bend is not None]
    back = np.linalg.pinv(root.T, rcond=1e-9)
    moved = [back @ (own.T @ (own @ bend)) for own, bend in told]
    parts = np.concatenate(moved) / noise
    _, size, ways = np.linalg.svd(parts.reshape(len(parts), -1), full_matrices=False)
    largest = np.sqrt(sum(r.windows for r in records)) * size[:BENDS, None] * ways[:BENDS]
    return np.asarray(np.linalg.pinv(root, rcond=1e-9) @ (largest.reshape(len(largest), -1, 3) * noise))


def _together(records: Sequence[Record], noise: Array) -> tuple[float, Array, Array, Array]:
    """The lag in s that the windows have in common, and R, R b and R P of all together, each at a lag of its own.

    The clocks leave `u_lag_s` of the lag of each window open. If that stayed in its slopes, it would be an error of the
    merged ones of up to a hundred times their noise: windows move in other directions and at other frequencies, so that
    no lag of them all explains it. So each has the lag that it would have if it were an unknown, with the clocks as its
    prior: the b of all together tell it, and change by it.
    """
    m = records[0].channels
    roots, slopes = np.array([r.root for r in records]), np.array([r.slopes for r in records])
    weights = 1.0 / np.array([r.noise for r in records])[:, None] ** 2
    clocks, independent = np.array([(r.u_lag_s**2 / r.windows, r.independent) for r in records]).T
    at_s = np.array([r.lag_s for r in records])
    common_s = float(at_s[0])
    for _ in range(TURNS):
        root, together, _ = _stacked(records, slopes, noise)
        b = regressed(root, together)
        by_lag = -roots[:, :, m:] @ b[:m]
        square, told = (np.sum(by_lag * own * weights, axis=(1, 2)) for own in (by_lag, slopes - roots @ b))
        if not square.any():
            break
        moving = square > 0.0
        told_s = at_s + np.divide(told, square, out=np.zeros_like(told), where=moving)
        u2 = np.divide(1.0, square * independent, out=np.full_like(square, np.inf), where=moving)
        weight = 1.0 / (clocks + u2)
        common_s = float(weight @ told_s / weight.sum())
        next_s = common_s + clocks * weight * (told_s - common_s)
        slopes = slopes - (next_s - at_s)[:, None, None] * by_lag
        at_s = next_s
    return common_s, *_stacked(records, slopes, noise)


def _stacked(records: Sequence[Record], slopes: Array, noise: Array) -> tuple[Array, Array, Array]:
    """R, R b and R P of all together, with these R b of each.

    A window's rows count by its own noise, as if all had the noise of the merged one.
    """
    half = records[0].channels
    m2 = 2 * half
    by = [float(np.sqrt(np.mean(noise**2 / r.noise**2))) for r in records]
    wide = np.vstack([
        b * np.hstack([r.root, own, r.passed.transpose(1, 0, 2).reshape(m2, -1)])
        for b, r, own in zip(by, records, slopes, strict=True)
    ])  # fmt: skip
    live = np.abs(wide[:, :m2]).max(axis=0, initial=0.0) > 0.0
    triangle = np.asarray(np.linalg.qr(np.hstack([wide[:, :m2][:, live], wide[:, m2:]]), mode="r"))
    k, found = int(live.sum()), np.zeros((m2, wide.shape[1]))
    found[np.ix_(live, live)], found[live, m2:] = triangle[:k, :k], triangle[:k, k:]
    passed = found[:, m2 + 3 :].reshape(m2, TERMS, half).transpose(1, 0, 2)
    return found[:, :m2], found[:, m2 : m2 + 3], passed


def _triangle(rows: Array, most: int) -> Array:
    """The first rows of the R factor, `most` of them, in which columns of zeros stay so."""
    found = np.zeros((min(most, len(rows)), rows.shape[1]))
    live = np.abs(rows).max(axis=0, initial=0.0) > 0.0
    if live.any():
        triangle = np.asarray(np.linalg.qr(rows[:, live], mode="r"))[:most]
        found = np.zeros((len(triangle), rows.shape[1]))
        found[:, live] = triangle
    return found


def _rms(share: Array, values: Sequence[float]) -> float:
    return float(np.sqrt(share @ np.square(values)))
