"""Whether mean output and sensitivity of the sensor stay the same within a window, apart from what the motion explains.

Each stated uncertainty of an angle or an offset belongs to a whole window or position. If the sensor slips in the
middle of a window, its mean changes, and no angle is right for the whole window. If it slips wherever the motion is
strong, its output is not proportional to the motion, and no S is right for the whole window.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.signal.order_statistics import median, quantile

# The change of the mean is searched at the edges of such blocks. The scatter of the blocks shows how well it is known.
BLOCK_S = 1.0
FEWEST_BLOCKS = 4  # fewer blocks have two differences at most, too few to know their scatter
FEWEST_BLOCKS_TOLD = 8  # of fewer blocks a robust scatter is too uncertain
STRONG = 0.9  # share of the points with less motion than those that are called strong
MODERATE = 0.5  # and of those with less motion than moderate ones, which have as much power as the strong ones
# The median of chi-squared with three degrees of freedom over its mean.
MEDIAN_OF_THREE = 0.789


def step(residual: Array, rate_hz: float) -> tuple[float, float]:
    """The length of the change of the mean between two parts of a window, and the rms that noise gives it without a
    change, both in output unit.

    `residual` (n, 3) of V from its regression on the motion, knocks included: the medians of blocks leave them out, and
    blocks that are full of them have less weight. The window is divided where one step explains most of the scatter of
    the blocks. Their noise is known from the median of the squared differences between neighbours, which one step does
    not change. Both results are 0 if the window has fewer than FEWEST_BLOCKS blocks.
    """
    size = max(round(BLOCK_S * rate_hz), 1)
    blocks = len(residual) // size
    if blocks < FEWEST_BLOCKS:
        return 0.0, 0.0
    # The samples of an axis lie side by side, so that a median is several times faster.
    samples = np.ascontiguousarray(residual[: blocks * size].T).reshape(3, blocks, size)
    level = median(samples)
    spread = median(np.abs(samples - level[..., None])).max(axis=0)
    level = level.T
    weight = 1.0 / np.clip(spread / max(float(median(spread)), np.finfo(float).tiny), 1.0, 1e3) ** 2
    before, total = np.cumsum(weight)[:-1], float(weight.sum())
    per_block = total / (before * (total - before))  # variance of a difference of two means, over that of one block
    centred = weight[:, None] * (level - weight @ level / total)
    change = np.linalg.norm(np.cumsum(centred, axis=0)[:-1], axis=1) * per_block
    at = int(np.argmax(change**2 / per_block))
    variance = 0.5 * float(median(np.sum(np.diff(level, axis=0) ** 2, axis=1))) / MEDIAN_OF_THREE
    return float(change[at]), float(np.sqrt(variance * per_block[at]))


def nonlinearity(V: Array, residual: Array, rate_hz: float) -> dict[str, float]:
    """By how many per cent the sensitivity to the strongest tenth of the motion differs from that of the whole window
    (`nonlinearity_pct`), and the standard uncertainty of this (`u_nonlinearity_pct`).

    `V` (n, 3) in output unit, `residual` (n, 3) from its regression on the motion, knocks included: a sensor that slips
    where the motion is strong looks as if it were knocked there. The uncertainty is that of the points with moderate
    motion, where such a sensor does not slip. Both are 0 if the strong points are in fewer than FEWEST_BLOCKS_TOLD
    blocks. `motion_kurtosis` is 3 for Gaussian motion along one line and 1.5 for a sine.
    """
    moved = V - residual
    moved -= moved.mean(axis=0)
    power = np.einsum("ni,ni->n", moved, moved)
    kurtosis = float(np.mean(power**2)) / max(float(np.mean(power)) ** 2, np.finfo(float).tiny)
    size, least = max(round(BLOCK_S * rate_hz), 1), quantile(power, STRONG)
    strong = np.flatnonzero(power >= least)
    along, in_block = _in_blocks(strong, size, moved, residual, power)
    gain = u = 0.0
    if len(in_block) >= FEWEST_BLOCKS_TOLD:
        gain = float(along.sum() / in_block.sum())
        moderate = np.flatnonzero((power >= quantile(power, MODERATE)) & (power < least))
        others = _in_blocks(moderate, size, moved, residual, power)
        scatter = _scatter(*others) if len(others[1]) >= FEWEST_BLOCKS_TOLD else _scatter(along, in_block)
        u = scatter / float(np.sqrt(in_block.sum()))
    return {"nonlinearity_pct": 100.0 * abs(gain), "u_nonlinearity_pct": 100.0 * u, "motion_kurtosis": kurtosis}


def _in_blocks(at: NDArray[np.intp], size: int, moved: Array, residual: Array, power: Array) -> tuple[Array, Array]:
    """Of the points `at`: the residual along the motion times the motion, and its power, summed up by block of `size`
    points. Blocks without such points are left out."""
    block = at // size
    in_block: Array = np.bincount(block, power[at]).astype(np.float64)
    along: Array = np.bincount(block, np.einsum("ni,ni->n", residual[at], moved[at])).astype(np.float64)
    return along[in_block > 0.0], in_block[in_block > 0.0]


def _scatter(along: Array, in_block: Array) -> float:
    """The standard deviation of the residual along the motion, from its scatter between blocks; a few blocks with
    knocks do not count."""
    gain = float(along.sum() / in_block.sum())
    return 1.4826 * float(median(np.abs(along - gain * in_block) / np.sqrt(in_block)))
