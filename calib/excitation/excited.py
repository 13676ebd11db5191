"""Which channels of a reference were excited in a window, and what its own noise did to the sums.

A channel that holds noise alone, or noise beside what it has in common with a stronger one, would be taken for a motion
that the sensor does not feel, and pull its column of S to zero; what moves along with another adds to what the sensor
feels. So silent channels leave the basis, and the directions of the others take up what of them moved along.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.model import Array, Window, WindowSums, own_channels

# Power over that of the channel's own noise: with less, what is left of the noise's attenuation after its correction
# (a tenth of it) is above 1 %.
OVER_NOISE = 10.0
OF_STRONGEST = 1e-4  # of the strongest channel's power: 1 % of its amplitude
MOST_NOISE = 0.5  # of a segment's power, that may be taken for noise
CORRECTION_SHARE = 0.1  # to which the noise's power is known: a spectrum of some hundred lines


@dataclass(frozen=True, slots=True, eq=False)
class Excitation:
    """`window` with silent channels taken out and the noise's power out of the others; `directions` (3, k) orthonormal,
    of what was excited, in the sensor's frame; `attenuation` relative uncertainty that the correction leaves."""

    window: Window
    directions: Array
    attenuation: float


def excited(window: Window) -> Excitation:
    """See the module. A window at rest, or of a uniaxial reference without known noise, is as it was."""
    m = own_channels(window.sums.reference_channels)
    if m == 0:
        return Excitation(window, np.zeros((3, 0)), 0.0)
    power = window.sums.scatter.sum(axis=0)[:m, :m] / window.sums.count.sum()
    noise = np.zeros((2, m)) if window.reference_noise is None else window.reference_noise**2
    own = _own_power(power, noise[0])
    live = own > 0.0
    share = float(np.max(noise[0][live] / own[live], initial=0.0))
    along = _along(power, live)
    # What a silent channel shows of another's motion turns the direction where it is more than noise and trifles.
    shown = along**2 @ np.where(live, power.diagonal(), 0.0)
    askew = shown > np.maximum(OF_STRONGEST * power.diagonal().max(initial=0.0), OVER_NOISE * noise[0])
    direction = window.pose.direction[:, :m]
    turned = direction + direction @ np.where(askew[:, None], along, 0.0)
    basis, _ = np.linalg.qr(turned[:, np.flatnonzero(live)])
    return Excitation(_reduced(window, live, along, noise), basis, CORRECTION_SHARE * share)


def _own_power(power: Array, noise: Array) -> Array:
    """(m,) of each channel what the stronger ones do not tell, 0 of a silent one; of the (m, m) power of all.

    A motion in one direction askew to the channels is on all of them, yet it is one: the strongest channel stands for
    it, and what the others show beside it is their noise (m,).
    """
    own, rest, strongest = np.zeros(len(power)), power.copy(), power.diagonal().max(initial=0.0)
    for _ in own:
        left = np.where(own > 0.0, 0.0, rest.diagonal())
        k = int(np.argmax(left))
        if left[k] <= max(OF_STRONGEST * strongest, OVER_NOISE * noise[k]):
            break
        own[k] = left[k]
        rest -= np.outer(rest[:, k], rest[k]) / left[k]
    return own


def _along(power: Array, live: NDArray[np.bool_]) -> Array:
    """(m, m) how much of each live channel (column) every silent one (row) moves along with."""
    along = np.zeros_like(power)
    if live.any():
        along[np.ix_(~live, live)] = np.linalg.solve(power[np.ix_(live, live)], power[np.ix_(live, ~live)]).T
    return along


def _reduced(window: Window, live: NDArray[np.bool_], along: Array, noise: Array) -> Window:
    sums, pose, m = window.sums, window.pose, len(live)
    channels = sums.reference_channels  # of the reference; where a corner is to be found, their integrals behind them
    every = np.tile(live, channels // m)
    both = np.concatenate([every, every, [True] * 3])
    scatter = np.where(np.outer(both, both), sums.scatter, 0.0)
    for power, at in zip(noise, (0, channels), strict=True):
        for k in np.flatnonzero(live):
            own = scatter[:, at + k, at + k]
            scatter[:, at + k, at + k] = own - np.minimum(sums.count * power[k], MOST_NOISE * own)
    if live.all():
        return replace(window, sums=replace(sums, scatter=scatter))
    moving = np.asarray(np.kron(np.eye(channels // m), np.diag(live.astype(float)) + along), dtype=np.float64)
    # What silent channels did from segment to segment must not come back as scatter between them; their mean over the
    # window (gravity, where the reference feels it) is still felt.
    mean = sums.count @ sums.mean / sums.count.sum()
    return replace(
        window,
        # Stated directions stay: what moved along with a live channel was measured by the silent one, with its error.
        pose=replace(pose, along=moving),
        sums=WindowSums(channels, sums.count, np.where(both, sums.mean, mean), scatter),
    )
