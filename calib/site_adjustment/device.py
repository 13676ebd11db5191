"""A device of a site: what is known of it before any link, and how its errors act on a link.

The parameters of a device are S row by row and Q. A reference indicates m/s2, so its S is the identity and its Q is
zero but for what its certificate leaves open. Beside a reference with errors (S_r, Q_r), whose indications were turned
into m/s2 by S_0 and Q_0, a sensor seems to have

    S_l = S T R (1 + E)^-1 R'      Q_l = Q - S_l R b      E = S_0^-1 S_r - 1      b = S_0^-1 (Q_r - Q_0)

R is the rotation of the reference as stated, a = R a_ref, and T its small error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.estimate.physics import rotation as rotation_of
from calib.model import Array
from calib.site_adjustment.link import GRAVITY_NAME, WIDE, WIDE_OFFSET_MPS2

FIXED = 1e-14  # part of a covariance's largest eigenvalue: below, a direction has no uncertainty
# Of the vector product of each axis with another vector.
CROSS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float
)


@dataclass(frozen=True, slots=True, eq=False)
class SiteDevice:
    """What is known of a device before any link: x = mean + root z with independent z of variance 1.

    `mean` (n,); `root` (n, k). `wide` (k,) are true where nothing was stated: that z has no test.
    """

    name: str
    mean: Array
    root: Array
    wide: Array

    @classmethod
    def with_covariance(cls, name: str, mean: Array, covariance: Array) -> SiteDevice:
        """With a covariance (n, n), as from a certificate; 0 on its diagonal is exact, inf is not known at all.

        The scale of what is not known comes from `mean`, which then only is the point where the adjustment begins.
        """
        u = np.sqrt(np.diag(covariance))
        wide = np.flatnonzero(~np.isfinite(u))
        told = np.flatnonzero(np.isfinite(u) & (u > 0.0))
        part = covariance[np.ix_(told, told)] / np.outer(u[told], u[told])
        values, ways = np.linalg.eigh(part)
        live = values > FIXED * values.max(initial=0.0)
        root = np.zeros((len(mean), int(live.sum()) + len(wide)))
        root[told, : int(live.sum())] = u[told, None] * ways[:, live] * np.sqrt(values[live])
        if len(wide):
            scale = float(np.sqrt(np.mean(mean[[0, 4, 8]] ** 2)))
            root[wide, range(int(live.sum()), root.shape[1])] = scale * np.where(wide < 9, WIDE, WIDE_OFFSET_MPS2)
        return cls(name, mean, root, np.arange(root.shape[1]) >= live.sum())

    @classmethod
    def reference(cls, name: str, relative_u: float, channels: int) -> SiteDevice:
        """A reference with one standard uncertainty for the sensitivity of each of its 1 or 3 channels."""
        u = np.zeros(12)
        u[[0, 4, 8][:channels]] = relative_u
        return cls.with_covariance(name, np.append(np.eye(3).ravel(), np.zeros(3)), np.diag(u**2))

    @classmethod
    def gravity(cls, u_mps2: float) -> SiteDevice:
        """The error of the stated gravity, which all links share."""
        return cls.with_covariance(GRAVITY_NAME, np.zeros(1), np.full((1, 1), u_mps2**2))


def beside(
    sensor: Array, reference: Array, stated: Array, rotation: Array, turn: Array
) -> tuple[Array, Array, Array, Array]:
    """S_l and Q_l (12,) of a sensor beside a reference, and their derivatives by the parameters of both (12, 12) and by
    the rotation (12, 3).

    `sensor`, `reference` (12,) are their true parameters; `stated` (12,) those by which the reference was read; `turn`
    (3,) in rad is the error of `rotation`.
    """
    (S, Q), (S_r, Q_r), (S_0, Q_0) = ((p[:9].reshape(3, 3), p[9:]) for p in (sensor, reference, stated))
    inverse = np.linalg.inv(S_0)
    true = np.linalg.inv(inverse @ S_r)  # (1 + E)^-1
    turned = rotation_of(turn) @ rotation
    seen, offset = turned @ true @ rotation.T, inverse @ (Q_r - Q_0)
    S_l, at = S @ seen, rotation @ offset
    by_sensor, by_reference, by_turn = np.eye(12), np.zeros((12, 12)), np.zeros((12, 3))
    before, after = S @ turned @ true @ inverse, true @ rotation.T
    for i in range(3):
        row = slice(3 * i, 3 * i + 3)
        by_sensor[row, row], by_sensor[9 + i, row] = seen.T, -seen @ at
        for j in range(3):
            column = slice(3 * j, 3 * j + 3)
            by_reference[row, column], by_reference[9 + i, column] = (
                -before[i, j] * after.T,
                before[i, j] * true @ offset,
            )
    by_reference[9:, 9:] = -S_l @ rotation @ inverse
    for k, cross in enumerate(CROSS):
        moved = S @ cross @ seen
        by_turn[:9, k], by_turn[9:, k] = moved.ravel(), -moved @ at
    return np.append(S_l.ravel(), Q - S_l @ at), by_sensor, by_reference, by_turn
