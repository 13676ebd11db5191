"""Least squares over a chain of epochs in square-root form: forward, one more epoch, and back.

All rows are in units of their own standard deviation. They act on deviations d (N,) of the unknowns from a point of
linearisation, so that |R d - z|^2 is what is known of an epoch. From one epoch to the next

    d' = F d + gap + G w        w (J,) of unit variance

QR eliminates w, which leaves one link an epoch (Bierman 1977, ch. VI; Paige and Saunders 1977). The triangle is never
squared: normal equations would lose half of the digits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.model import Array


@dataclass(frozen=True, slots=True, eq=False)
class NearIdentity:
    """A matrix (`size`, `size`) of which only the elements are kept that are not those of the identity: `values` (n,)
    at the places `at` (n,) of its rows one after the other. Hundreds of epochs would take tens of MB otherwise."""

    size: int
    at: NDArray[np.intp]
    values: Array

    @classmethod
    def of(cls, matrix: Array) -> NearIdentity:
        """That of a matrix; a zero keeps its sign."""
        other = np.ascontiguousarray(matrix).view(np.int64) != np.eye(len(matrix)).view(np.int64)
        at = np.flatnonzero(other)
        return cls(len(matrix), at, matrix.ravel()[at])

    @property
    def whole(self) -> Array:
        """The matrix, bit for bit."""
        found = np.eye(self.size)
        found.ravel()[self.at] = self.values
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Passage:
    """From an epoch to the next: `returns` (N, N) is the inverse of F, `gap` (N,), `noise` G (N, J)."""

    returns: NearIdentity
    gap: Array
    noise: Array

    @classmethod
    def of(cls, back: Array, gap: Array, noise: Array) -> Passage:
        """That of the whole matrix `back` (N, N)."""
        return cls(NearIdentity.of(back), gap, noise)

    @property
    def back(self) -> Array:
        """(N, N) the inverse of F."""
        return self.returns.whole


@dataclass(frozen=True, slots=True, eq=False)
class EpochLink:
    """What was eliminated: own w + next d' = z, with own (J, J), next (J, N), z (J,), and the passage."""

    own: Array
    next: Array
    z: Array
    passage: Passage


def with_rows(root: Array, rows: Array) -> Array:
    """The triangle (N, N + 1) of [R | z] with rows (r, N + 1)."""
    return np.asarray(np.linalg.qr(np.vstack([root, rows]), mode="r"))[: root.shape[1] - 1]


def passed(root: Array, passage: Passage, rows: Array | None = None) -> tuple[Array, EpochLink]:
    """The triangle of the next epoch, with its own `rows` (r, N + 1) if there are any, and the link to it."""
    size, j = root.shape[1] - 1, passage.noise.shape[1]
    through = root[:, :size] @ passage.back
    own = 0 if rows is None else len(rows)
    wide = np.zeros((j + size + own, j + size + 1))
    wide[:j, :j] = np.eye(j)
    wide[j : j + size, :j] = -through @ passage.noise
    wide[j : j + size, j:-1] = through
    wide[j : j + size, -1] = root[:, size] + through @ passage.gap
    if rows is not None:
        wide[j + size :, j:] = rows
    triangle = np.asarray(np.linalg.qr(wide, mode="r"))
    # Copies, since a view would keep the whole triangle as long as the link.
    link = EpochLink(triangle[:j, :j].copy(), triangle[:j, j:-1].copy(), triangle[:j, -1].copy(), passage)
    return triangle[j : j + size, j:], link


def solved(root: Array) -> tuple[Array, Array]:
    """d (N,), and a factor (N, N) of its covariance, of a triangle (N, N + 1)."""
    inverse = np.asarray(np.linalg.inv(root[:, :-1]), dtype=np.float64)
    return inverse @ root[:, -1], inverse


def forward(root: Array, rows: Sequence[Array], passages: Sequence[Passage]) -> tuple[Array, list[EpochLink]]:
    """All epochs. `root` (N, N + 1) is what is known before the first one, `rows` (r, N + 1) those of each epoch, and
    `passages` those from each one to the next."""
    root, links = with_rows(root, rows[0]), list[EpochLink]()
    for own, passage in zip(rows[1:], passages, strict=True):
        root, link = passed(root, passage, own)
        links.append(link)
    return root, links


def backward(root: Array, links: Sequence[EpochLink]) -> Array:
    """(K, N) d of all epochs by all rows, from the last epoch back to the first."""
    last, _ = solved(root)
    d = np.zeros((len(links) + 1, len(last)))
    d[-1] = last
    for k in range(len(links) - 1, -1, -1):
        link, p = links[k], links[k].passage
        inverse, back = np.linalg.inv(link.own), p.back
        d[k] = back @ (d[k + 1] - p.gap) - back @ p.noise @ (inverse @ (link.z - link.next @ d[k + 1]))
    return d


def returned(root: Array, link: EpochLink) -> Array:
    """The triangle (J + N, J + N + 1) of [w, d] before a link by all rows, where `root` (N, N + 1) is that of the epoch
    after it by all rows. Its last N rows are what all rows say of the epoch before."""
    p, j = link.passage, len(link.z)
    follows = np.linalg.inv(p.back)
    wide = np.vstack([np.column_stack([link.next, link.z]), root])
    of_next, z = wide[:, :-1], wide[:, -1]
    rows = np.column_stack([of_next @ p.noise, of_next @ follows, z - of_next @ p.gap])
    rows[:j, :j] += link.own
    return np.asarray(np.linalg.qr(rows, mode="r"))


def gains(links: Sequence[EpochLink], last: Array) -> Iterator[tuple[Array, Array]]:
    """Of each epoch, from the last one back to the first: covariances of d (N, m), and of the w of the passage to it
    (J, m), with m quantities; `last` (N, m) are those of d at the last epoch. No w comes before the first epoch."""
    for link in reversed(links):
        noise = -np.linalg.inv(link.own) @ link.next @ last
        yield last, noise
        last = link.passage.back @ (last - link.passage.noise @ noise)
    yield last, np.zeros((0, last.shape[1]))
