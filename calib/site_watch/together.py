"""What the steps of all channels at one day say together: which sensor's sensitivity changed, or which way it turned.

A step of a channel of sensor i in band b is  lambda_b + G_ib theta_i + what belongs to this band alone.  lambda is
the same for all sensors: the level is free, so a change that all sensors share is not seen. theta are relative
changes of the sensitivity of x, y, z and turns about x, y, z; G is 1 for a sensitivity in its own amplitudes, and for
turns follows from the co-spectra M of the sensor in the days since: a small turn changes M by W M + M W^T, with W the
matrix of a small rotation. A turn of 1 deg is not small where one axis moves by less than a twentieth of another: its
amplitude then changes by a third or more. So of a sensor that has turned, M is turned by the angles that were found,
and steps and G are those about this turn (Gauss and Newton).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.site_watch.day import PAIRS

# What is tested of each sensor: one sensitivity, all three alike, a turn about one axis; in terms of theta.
DIRECTIONS = np.array(
    [[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [1, 1, 1, 0, 0, 0],
     [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1]], dtype=float,
)  # fmt: skip
SENSITIVITIES, ALL, TURNS = slice(0, 4), 3, slice(4, 7)
# W of turns about x, y, z: one about x adds a_z to y and takes a_y from z.
W = np.array(
    [[[0, 0, 0], [0, 0, 1], [0, -1, 0]], [[0, 0, -1], [0, 0, 0], [1, 0, 0]], [[0, 1, 0], [-1, 0, 0], [0, 0, 0]]],
    dtype=float,
)  # fmt: skip
MEDIAN_SQUARE = 0.4549  # the median m of the square of a standard normal deviate
# Tests that are worth what all of a site say at one begin of the scatter of its steps. The median of N squares has the
# relative variance 5.44 / N, which is 1 / (N (2 m f)²) with their density f = 0.471 at m. So this prior is the best
# one where the variances at begins differ from what is expected by 30 % (5.44 / 0.3² = 60). The 30 % are assumed.
PRIOR_TESTS = 60.0
# Bands that are worth what is stated of the scatter of a sensor's bands at a begin. The mean of N squares has the
# relative variance 2 / N, so this prior is the best one where the variances of sensors differ from what is stated by
# the same 30 % (2 / 0.3² = 22).
PRIOR_BANDS = 22.0
ALIKE = 0.1  # of a change: how far its bands may differ by themselves
REJECT = 6.0  # standard uncertainties from which a sensor or channel does not say what is common (Tukey's biweight)
ROUNDS = 4
FEWEST_TO_NAME = 3  # sensors with a band, for it to say which one has changed
LARGEST_RATIO = 10.0  # of the amplitudes of two axes, for the cross power to tell that there is a turn
FAR = 4.0  # standard uncertainties from which a turn is not small
PRIOR_TURN = (
    0.1  # rad, standard uncertainty of a turn before any data: about an axis of which bands say nothing it is 0
)


def design(value: Array, level: Array, largest_ratio: float = LARGEST_RATIO) -> Array:
    """G (..., B, 6, 6) from the channels (..., B, 6) and the level (..., B, 3); 0 where a channel is not known.

    Amplitudes of two axes count as if one were at most `largest_ratio` times the other.
    """
    amplitude = value[..., :3] + level
    most = np.log(largest_ratio)
    ratio = np.clip(amplitude[..., :, None] - amplitude[..., None, :], -most, most)
    cross = np.clip(np.nan_to_num(value[..., 3:]), -1.0, 1.0)
    rho = np.zeros((*value.shape[:-1], 3, 3))
    rho[..., [0, 1, 2], [0, 1, 2]] = 1.0
    for c, (j, k) in enumerate(zip(*PAIRS, strict=True)):
        rho[..., j, k] = rho[..., k, j] = cross[..., c]
    # N_jl = M_lk / (a_j a_k): what a part of axis l in output j makes of the normalised co-spectrum j, k
    G = np.zeros((*value.shape[:-1], 6, 6))
    G[..., [0, 1, 2], [0, 1, 2]] = 1.0
    share = np.exp(np.nan_to_num(-ratio))  # (.., j, l): amplitude of l over that of j
    for w in range(3):
        mixed = (W[w] * share) @ rho  # (W M)_jk / (a_j a_k)
        G[..., :3, 3 + w] = amplitudes = mixed[..., [0, 1, 2], [0, 1, 2]]
        for c, (j, k) in enumerate(zip(*PAIRS, strict=True)):
            G[..., 3 + c, 3 + w] = (
                mixed[..., j, k] + mixed[..., k, j] - rho[..., j, k] * (amplitudes[..., j] + amplitudes[..., k])
            )
    return np.where(np.isfinite(value)[..., None], G, 0.0)


def turned(value: Array, level: Array, turn: Array) -> Array:
    """The channels (r, B, 6) of sensors that have turned by `turn` (r, 3), from those before it and the level
    (r, B, 3). No amplitude falls below one over LARGEST_RATIO of what it was."""
    amplitude = value[..., :3] + level
    known = np.isfinite(amplitude)
    top = np.max(np.where(known, amplitude, -np.inf), axis=-1, keepdims=True, initial=-700.0)
    a = np.where(known, np.exp(np.where(known, amplitude - top, 0.0)), 0.0)
    cross = np.clip(np.nan_to_num(value[..., 3:]), -1.0, 1.0)
    M = np.zeros((*a.shape, 3))
    M[..., [0, 1, 2], [0, 1, 2]] = np.square(a)
    M[..., PAIRS[0], PAIRS[1]] = M[..., PAIRS[1], PAIRS[0]] = cross * a[..., PAIRS[0]] * a[..., PAIRS[1]]
    R = _rotation(turn)[:, None]
    M = R @ M @ np.swapaxes(R, -1, -2)
    b = np.sqrt(np.maximum(M[..., [0, 1, 2], [0, 1, 2]], np.square(a / LARGEST_RATIO)))
    with np.errstate(invalid="ignore", divide="ignore"):
        after = np.log(b) + top - level, M[..., PAIRS[0], PAIRS[1]] / (b[..., PAIRS[0]] * b[..., PAIRS[1]])
    return np.where(np.isfinite(value), np.concatenate(after, axis=-1), np.nan)


def _rotation(turn: Array) -> Array:
    """Matrices (r, 3, 3) that turn a sensor by the angles `turn` (r, 3), whose vector is the axis (Rodrigues)."""
    angle = np.sqrt(np.square(turn).sum(axis=-1))[:, None, None]
    own = np.einsum("rw,wjk->rjk", turn, W)
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * own + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * (own @ own))


@dataclass(frozen=True, slots=True, eq=False)
class JointChange:
    """For each begin (k): `size`, `u` (k, n, 7): the change in each of DIRECTIONS by itself. `rest` (k, n, B, 6):
    steps without what is common; `information` (k, n, B, 6): of these, over the variance. `statistic` (k, n, 7): the
    change over its u; of a turn the smaller one of this and the same without the band that says most, since the weak
    axis of one band says much of a turn, and moves by itself when the loads of two modes change. `scatter` (k, 1, 7):
    factor of u by what all sensors of the site differ by. `pair` (k,): no more than two sensors can be compared, so
    that both show a change of either. `squares`, `freedom` (k, n): what no change of sensitivities and no turn explains
    of the bands of a sensor, as in `misfit`."""

    size: Array
    u: Array
    rest: Array
    information: Array
    statistic: Array
    scatter: Array
    pair: NDArray[np.bool_]
    squares: Array
    freedom: NDArray[np.int_]

    @property
    def evidence(self) -> Array:
        """The statistic without the scatter of all sensors, which differs from begin to begin: it dates a change."""
        return self.statistic * self.scatter


def jointly(
    step: Array,
    information: Array,
    value: Array,
    level: Array,
    inflation: Array,
    walk: Array,
    doubt: Array | float = 1.0,
) -> JointChange:
    """All sensors at once, robustly: what a few sensors do differently does not move what is common.

    `step`, `information` (k, n, B, 6); `value` (k, n, B, 6), `level` (k, n, B, 3): the channels and the level that the
    norm expects of the days since, without the step; `inflation` (k, n, 7): variance of each direction over what
    independent channels have; `walk` (k,): standard uncertainty by which a sensitivity may have changed by itself.
    `doubt` (k, n, B, 6): factor of the variance of channels where it is asked whether bands change differently.
    """
    pair, information = _named_only(information)
    inflation = np.where(pair[:, None, None], inflation.max(axis=1, keepdims=True), inflation)
    common, others = _common(step[..., :3], information[..., :3], np.sqrt(inflation[..., ALL]), pair)
    # Each sensor against the others alone: its own part in what is common is taken out.
    rest, alone = step.copy(), information.copy()
    rest[..., :3] = np.where(others > 0.0, step[..., :3] - common, 0.0)
    both = information[..., :3] + others
    alone[..., :3] = information[..., :3] * others / np.where(both > 0.0, both, 1.0)
    G = design(value, level)
    size, u = _sized(*scores(rest, alone, G), inflation, walk)
    far = (np.abs(size[..., TURNS]) > FAR * u[..., TURNS]).any(axis=-1)
    far &= np.sum(alone > 0.0, axis=(-2, -1)) > G.shape[-1]  # more channels than unknowns
    rest[far], G[far] = _about_turns(rest[far], alone[far], value[far], level[far])
    squares, freedom = misfit(rest, alone / doubt, G)
    inflation = _spread(rest, alone, squares, freedom, inflation)
    size, u = _sized(*scores(rest, alone, G), inflation, walk)
    # Of two the level is the mean, so each shows half of what they differ by, and half of its scatter.
    u[pair, :, SENSITIVITIES] *= np.sqrt(2.0)
    scatter = np.where(pair[:, None, None], 1.0, _scatter_of_all(size / u))
    u *= scatter
    statistic = size / u
    apart = _without_loudest(rest, alone, G[..., 3:])
    size_apart, u_apart = _sized(*apart, inflation[..., TURNS], walk)
    least = np.minimum(
        np.abs(statistic[..., TURNS]), np.sign(size[..., TURNS]) * size_apart / u_apart / scatter[..., TURNS]
    )
    statistic[..., TURNS] = np.sign(size[..., TURNS]) * np.maximum(least, 0.0)
    return JointChange(size, u, rest, alone, statistic, scatter, pair, squares, freedom)


def _about_turns(step: Array, information: Array, value: Array, level: Array) -> tuple[Array, Array]:
    """Steps (r, B, 6) and G (r, B, 6, 6) of sensors that have turned, about the turn that explains the steps best."""
    about, turn = step, np.zeros((len(step), 3))
    for _ in range(ROUNDS):
        after = turned(value, level, turn)
        G = design(after, level, np.inf)
        about = step - np.nan_to_num(after - value) + (G[..., 3:] @ turn[:, None, :, None])[..., 0]
        turn = fitted(about, information, G)[:, 3:]
    return about, G


def fitted(step: Array, information: Array, G: Array) -> Array:
    """theta (..., 6) that explains the steps (..., B, 6) of each sensor best, with the prior of turns."""
    flat = (*step.shape[:-2], step.shape[-2] * step.shape[-1])
    r, info, g = step.reshape(flat), information.reshape(flat), G.reshape(*flat, G.shape[-1])
    normal = np.swapaxes(g, -1, -2) @ (info[..., None] * g)
    trace = np.trace(normal, axis1=-2, axis2=-1)
    normal += (1e-9 * trace + 1e-12)[..., None, None] * np.eye(g.shape[-1])
    normal[..., [3, 4, 5], [3, 4, 5]] += PRIOR_TURN**-2
    right = ((info * r)[..., None, :] @ g)[..., 0, :]
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def _named_only(information: Array) -> tuple[NDArray[np.bool_], Array]:
    """Whether only two sensors can be compared at a begin (k,); and the information, where three can only that of bands
    and axes which at least three sensors tell of."""
    tell = np.sum(information[..., :3] > 0.0, axis=1)
    pair = (tell < FEWEST_TO_NAME).all(axis=(1, 2))
    named = information.copy()
    named[..., :3] *= ((tell >= FEWEST_TO_NAME) | pair[:, None, None])[:, None]
    return pair, named


def _sized(score: Array, squares: Array, inflation: Array, walk: Array) -> tuple[Array, Array]:
    """Size and u of changes, from the sums of `scores`; 0 and inf where nothing tells of one."""
    known = squares > 0.0
    squares = np.where(known, squares, 1.0)
    variance = np.where(known, inflation / squares, np.inf)
    return np.where(known, score / squares, 0.0), np.sqrt(variance + walk[:, None, None] ** 2)


def misfit(rest: Array, information: Array, G: Array) -> tuple[Array, NDArray[np.int_]]:
    """The squares (k, n) that the best sensitivities and turns of a sensor leave of its steps, and their degrees of
    freedom. Bands of a change may differ by ALIKE of it."""
    theta = fitted(rest, information, G)
    explained = (G @ theta[:, :, None, :, None])[..., 0]
    own = information / (1.0 + information * np.square(ALIKE * explained))
    squares = np.sum(own * np.square(rest - explained), axis=(-2, -1))
    return squares, np.sum(information > 0.0, axis=(-2, -1)) - theta.shape[-1]


def _spread(rest: Array, information: Array, squares: Array, freedom: NDArray[np.int_], inflation: Array) -> Array:
    """Variance (k, n, 7) of each direction over what independent channels have: `inflation`, or what the bands of a
    sensor say of it by how far they differ, whichever is larger (Birge's ratio). Of a sensitivity the bands of its axes
    count, of a turn what `misfit` leaves.

    A sensitivity moves all bands alike. Where the structure is excited otherwise each band moves by itself, so the
    mean of few bands says little.
    """
    r, info = rest[..., :3], information[..., :3]
    parts = (info > 0.0).sum(axis=2), info.sum(axis=2), (info * r).sum(axis=2), (info * r * r).sum(axis=2)  # (k, n, 3)
    number, total, push, own = (np.concatenate([p, p.sum(axis=-1, keepdims=True)], axis=-1) for p in parts)
    own = own - push**2 / np.where(total > 0.0, total, 1.0)
    turn = [np.repeat(each[..., None], 3, axis=-1) for each in (squares, freedom)]
    left = np.concatenate([own, turn[0]], axis=-1)
    f = np.maximum(np.concatenate([number - 1, turn[1]], axis=-1), 0)
    return np.asarray(np.maximum((PRIOR_BANDS * inflation + left) / (PRIOR_BANDS + f), inflation))


def _scatter_of_all(statistic: Array) -> Array:
    """Factor of u (k, 1, 7), at least 1: what all sensors differ by at a begin, over what they are expected to.

    Of sensitivities, and of turns. A median, since most sensors have not changed; what they all show, such as a frost
    or a storm that the norm does not fit, is scatter. A sensor that changes moves all others alike, which does not
    count. Few sensors say little of it.
    """
    factor = np.ones((len(statistic), 1, len(DIRECTIONS)))
    for own, others in ((slice(0, 3), SENSITIVITIES), (TURNS, TURNS)):
        z = np.where(statistic[..., own] == 0.0, np.nan, statistic[..., own])
        squares = np.square(z - median(z, axis=1)[:, None]).reshape(len(z), -1)
        number = np.sum(np.isfinite(squares), axis=1)
        middle = median(squares, axis=1) / MEDIAN_SQUARE
        variance = (PRIOR_TESTS + number * middle) / (PRIOR_TESTS + number)
        factor[..., others] = np.sqrt(np.maximum(variance, 1.0))[:, None, None]
    return factor


def _without_loudest(rest: Array, information: Array, G: Array) -> tuple[Array, Array]:
    """As `scores` of turns (k, n, 3), without the band that says most of each; `G` (k, n, B, 6, 3)."""
    push = ((information * rest)[..., None, :] @ G)[..., 0, :]
    squares = (information[..., None, :] @ np.square(G))[..., 0, :]
    total = push.sum(axis=2, keepdims=True)
    loudest = np.argmax(push * np.sign(total), axis=2)[:, :, None]
    left = [each.sum(axis=2) - np.take_along_axis(each, loudest, axis=2)[:, :, 0] for each in (push, squares)]
    return left[0], np.where(left[1] > 1e-9 * squares.sum(axis=2), left[1], 0.0)


def scores(values: Array, information: Array, G: Array) -> tuple[Array, Array]:
    """Sum of g I r and of g I g over the channels of each sensor, for each direction: (..., n, 7) each."""
    channels = information.shape[-2] * information.shape[-1]
    g = (G @ DIRECTIONS.T).reshape(*G.shape[:-3], channels, len(DIRECTIONS))
    flat = (*information.shape[:-2], 1, channels)
    weighted = information.reshape(flat)
    return (weighted * values.reshape(flat) @ g)[..., 0, :], (weighted @ np.square(g))[..., 0, :]


def _common(y: Array, info: Array, scale: Array, pair: NDArray[np.bool_]) -> tuple[Array, Array]:
    """What all other sensors share of the amplitudes, for each sensor (k, n, B, 3), and its information.

    Iteratively reweighted: a sensor whose bands differ alike, or a channel that differs by itself, loses its weight. Of
    a `pair` (k,) both differ alike, so both keep it.
    """
    root, scale = np.sqrt(info), scale[:, :, None, None]
    axis = np.sqrt(np.maximum(info.sum(axis=2, keepdims=True), 1e-300)) * scale
    whole = np.sqrt(np.maximum(info.sum(axis=(2, 3), keepdims=True), 1e-300)) * scale
    common = median(np.where(info > 0.0, y, np.nan), axis=1)
    for _ in range(ROUNDS):
        away = y - common[:, None]
        score = info * away
        sensor = np.abs(score.sum(axis=2, keepdims=True)) / axis
        alike = np.abs(score.sum(axis=(2, 3), keepdims=True)) / whole
        trusted = biweight(np.maximum(sensor, alike)) * biweight(away * root / scale)
        weight = info * np.where(pair[:, None, None, None], 1.0, trusted)
        sums, total = np.sum(weight * y, axis=1), np.sum(weight, axis=1)
        common = np.where(total > 0.0, sums / np.where(total > 0.0, total, 1.0), common)
    others = total[:, None] - weight
    others = np.where(others > 1e-9 * total[:, None], others, 0.0)
    return (sums[:, None] - weight * y) / np.where(others > 0.0, others, 1.0), others


def median(values: Array, axis: int) -> Array:
    """Median along an axis without NaN; 0 where there is nothing."""
    ordered = np.sort(values, axis=axis)  # NaN come last
    number = np.isfinite(values).sum(axis=axis, keepdims=True)
    low, high = np.maximum(number - 1, 0) // 2, np.minimum(number // 2, values.shape[axis] - 1)
    both = np.take_along_axis(ordered, low, axis) + np.take_along_axis(ordered, high, axis)
    return np.where(number > 0, 0.5 * both, 0.0).squeeze(axis)


def biweight(z: Array) -> Array:
    """Weight of what lies `z` standard deviations away (Tukey): 1 at 0, 0 from REJECT on."""
    return np.square(np.maximum(1.0 - np.square(z / REJECT), 0.0))
