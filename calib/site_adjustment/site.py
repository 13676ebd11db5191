"""All sensors and references of a site in one sparse least-squares adjustment; each device's errors enter once.

The unknowns are the parameters of each device (calib.site_adjustment.device), the error of each stated rotation, and
gravity. The observations are the links: a sensor beside a reference (calib.site_adjustment.link). A device may be the
sensor of one link and the reference of another one. Errors of rotations, and sensors that are no reference, are
eliminated one by one (Schur complement, by QR factors). The rest, the core, is solved by a sparse factorisation
(SuperLU). Covariances between any two devices are solved for on demand; no dense matrix of the site is ever made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.model import Array
from calib.site_adjustment.device import SiteDevice, beside
from calib.site_adjustment.link import Link

Index = NDArray[np.intp]
MAX_STEPS = 10
CONVERGED = 1e-3  # of the standard uncertainty that the priors state


@dataclass(frozen=True, slots=True, eq=False)
class EliminatedRows:
    """What the links of one eliminated sensor, or one link within the core, tell of the core: rows z = told.

    `index` (c,) are the unknowns of the core; the rows have the identity as covariance. `left`: sum of squares that no
    value of the core changes. `by_reference` (c,): the column is that of a device in its use as a reference.
    """

    index: Index
    rows: Array
    told: Array
    left: float
    by_reference: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """Unknowns that were eliminated, given the core: `at` + `by_core` z_core, with the covariance `half` half'.

    The first `own` are the z of a sensor that is no reference; then follow the rotations of the links, three each.
    `observed`: rows of the links, less those that unknowns of the sensor without a prior take up.
    """

    message: EliminatedRows
    at: Array
    by_core: Array
    half: Array
    own: int
    observed: float


class Site:
    """The adjustment of all links. Raises ValueError for a device that is not known, or is its own reference."""

    def __init__(self, devices: Sequence[SiteDevice], links: Sequence[Link]) -> None:
        self.devices = {d.name: d for d in devices}
        self._links = links
        of: dict[str, list[int]] = {}
        for k, each in enumerate(links):
            _check_link(each, self.devices)
            of.setdefault(each.sensor, []).append(k)
        core = {name for each in links for name in _core_of(each)}
        self.core = [d.name for d in devices if d.name in core]
        self._leaf_links = {name: own for name, own in of.items() if name not in core}
        self._core_links = [k for k, each in enumerate(links) if each.sensor in core]
        self._turns = np.zeros((len(links), 3))  # rotation vectors, rad
        self._at: dict[str, NDArray[np.intp]] = {}
        self._owner: list[str] = []  # the device of each unknown
        for name in self.core:
            first, n = len(self._owner), self.devices[name].root.shape[1]
            self._at[name] = np.arange(first, first + n, dtype=np.intp)
            self._owner += n * [name]
        self._size = len(self._owner)
        self.x = {d.name: d.mean.copy() for d in devices}
        self.steps = 0
        self._solve()

    # --- reading

    @property
    def leaves(self) -> list[str]:
        """Sensors that are no reference of another one."""
        return list(self._leaf_links)

    def z(self, name: str) -> Array:
        """The change of a device from what was known before, in the unit of its `root`."""
        if name in self._leaf:
            return self._given_core(self._leaf[name])[: self._leaf[name].own]
        return self._z[self._at[name]] if name in self._at else np.zeros(self.devices[name].root.shape[1])

    def covariance(self, name: str, other: str) -> Array:
        """The covariance (n, m) of the parameters of two devices, or of one with itself."""
        (index, rows), (other_index, other_rows) = self._by_core(name), self._by_core(other)
        found = self.core_covariance(rows, index, other_rows, other_index)
        if name == other:
            alone = self._alone(name)
            found = found + alone @ alone.T
        return np.asarray(self.devices[name].root @ found @ self.devices[other].root.T)

    def standard_uncertainty(self, name: str) -> Array:
        """(n,) of a device's parameters."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance(name, name)), 0.0)))

    def core_covariance(self, rows: Array, index: Index, other_rows: Array, other_index: Index) -> Array:
        """rows C other_rows' for rows (k, c) and (m, d) over unknowns of the core, where C is their covariance."""
        if not (len(index) and len(other_index)):
            return np.zeros((len(rows), len(other_rows)))
        wanted = np.zeros((self._size, len(other_rows)))
        wanted[other_index] = other_rows.T
        return np.asarray(rows @ self._factor.solve(wanted)[index])

    def messages(self) -> list[EliminatedRows]:
        """All that is known of the core beside its priors."""
        return [each.message for each in (*self._leaf.values(), *self._within)]

    def core_of(self, message: EliminatedRows) -> list[str]:
        """The devices of the core that a message is about."""
        return list(dict.fromkeys(self._owner[k] for k in message.index))

    def leaf(self, name: str) -> Eliminated:
        """A sensor of `leaves`, given the core."""
        return self._leaf[name]

    def place(self, name: str) -> Index:
        """The unknowns of a device of the core, in the indices of messages."""
        return self._at[name]

    @property
    def z_core(self) -> Array:
        """(size,) unknowns of the core."""
        return self._z

    # --- solving

    def _solve(self) -> None:
        """Gauss-Newton from the priors' means. Links without rotation are linear."""
        self._z = np.zeros(self._size)
        self._now = {name: np.zeros(d.root.shape[1]) for name, d in self.devices.items()}
        for self.steps in range(1, MAX_STEPS + 1):
            self._leaf = {name: self._eliminated(own, name) for name, own in self._leaf_links.items()}
            self._within = [self._eliminated([k], None) for k in self._core_links]
            self._solve_core()
            self._turn()
            before, self._now = self._now, {name: self.z(name) for name in self.devices}
            self.x = {name: d.mean + d.root @ self._now[name] for name, d in self.devices.items()}
            if all(np.abs(z - before[name]).max(initial=0.0) < CONVERGED for name, z in self._now.items()):
                break

    def _by_core(self, name: str) -> tuple[Index, Array]:
        """How z of a device (k,) follows from the core: the unknowns (c,) and the rows (k, c)."""
        if name in self._leaf:
            leaf = self._leaf[name]
            return leaf.message.index, leaf.by_core[: leaf.own]
        index = self._at.get(name, np.zeros(0, dtype=np.intp))
        return index, np.eye(self.devices[name].root.shape[1], len(index))

    def _alone(self, name: str) -> Array:
        """(k, ...) factor of the covariance of z that a device has given the core."""
        if name in self._leaf:
            return self._leaf[name].half[: self._leaf[name].own]
        k = self.devices[name].root.shape[1]
        return np.zeros((k, k)) if name in self._at else np.eye(k)

    def _given_core(self, each: Eliminated) -> Array:
        return np.asarray(each.at + each.by_core @ self._z[each.message.index])

    def _turn(self) -> None:
        """The errors of the rotations at the present solution."""
        pairs = zip((*self._leaf_links.values(), *([k] for k in self._core_links)),
                    (*self._leaf.values(), *self._within), strict=True)  # fmt: skip
        for links, each in pairs:
            turns = self._given_core(each)[each.own :].reshape(-1, 3)
            for k, turn in zip(links, turns, strict=True):
                self._turns[k] = turn * self._links[k].u_rotation_rad

    def _solve_core(self) -> None:
        """The normal equations of the core: its priors, and what the eliminated unknowns tell."""
        if not self._size:
            return
        from scipy.sparse import coo_matrix
        from scipy.sparse.linalg import splu

        every = np.arange(self._size)
        i, j, values = [every], [every], [np.ones(self._size)]  # the priors
        right = np.zeros(self._size)
        for message in self.messages():
            block = message.rows.T @ message.rows
            i.append(np.repeat(message.index, len(block)))
            j.append(np.tile(message.index, len(block)))
            values.append(block.ravel())
            np.add.at(right, message.index, message.rows.T @ message.told)
        shape = (self._size, self._size)
        normal = coo_matrix((np.concatenate(values), (np.concatenate(i), np.concatenate(j))), shape).tocsc()
        self._factor: Any = splu(
            normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        self._z = np.asarray(self._factor.solve(right))

    def _rows(self, k: int) -> tuple[dict[str, Array], Array, Array]:
        """Jacobian of the rows of link k by z of each device, by its rotation, and rows z = told there."""
        one = self._links[k]
        if one.rotation is not None:
            sensor, reference, stated = self.x[one.sensor], self.x[one.reference], self.devices[one.reference].mean
            predicted, by_sensor, by_reference, by_turn = beside(
                sensor, reference, stated, one.rotation, self._turns[k]
            )
            moves = {one.sensor: by_sensor, one.reference: by_reference}
        else:
            # The unknown of a link is the error of the reference's sensitivity, or of gravity.
            errors = [self.x[name][p] - self.devices[name].mean[p] for name, p in one.shared]
            predicted, by_turn = np.append(self.x[one.sensor], errors), np.zeros((12 + len(errors), 0))
            moves = {one.sensor: np.eye(len(predicted), 12)}
            for column, (name, p) in enumerate(one.shared, start=12):
                by = moves.setdefault(name, np.zeros((len(predicted), len(self.devices[name].mean))))
                by[column, p] = 1.0
        told = one.told - one.rows @ predicted
        rows = {name: one.rows @ by @ self.devices[name].root for name, by in moves.items()}
        for name, by in rows.items():
            told = told + by @ self._now[name]
        turn = one.rows @ by_turn * one.u_rotation_rad
        if turn.size:
            told = told + turn @ (self._turns[k] / (one.u_rotation_rad or 1.0))
        return rows, turn, told

    def _eliminated(self, links: Sequence[int], leaf: str | None) -> Eliminated:
        """The rotations of these links and their sensor, if that is no reference, by a QR factor of their rows.

        Its columns: z of the sensor, the rotations, z of the core, told.
        """
        parts = [self._rows(k) for k in links]
        core = sorted({n for rows, _, _ in parts for n in rows if n != leaf}, key=lambda n: int(self._at[n][0]))
        index = np.concatenate([np.zeros(0, dtype=np.intp), *(self._at[n] for n in core)])
        at = {n: np.searchsorted(index, self._at[n]) for n in core}
        own = 0 if leaf is None else self.devices[leaf].root.shape[1]
        local, c, height = own + 3 * len(parts), len(index), sum(len(told) for *_, told in parts)
        stacked = np.zeros((max(local + height, local + c + 1), local + c + 1))
        stacked[range(local), range(local)] = 1.0  # the priors
        top = local
        for place, (rows, turn, told) in enumerate(parts):
            block = stacked[top : top + len(told)]
            block[:, own + 3 * place : own + 3 * place + turn.shape[1]] = turn
            block[:, -1] = told
            for n, by in rows.items():
                block[:, slice(own) if n == leaf else local + at[n]] = by
            top += len(told)
        factor = np.asarray(np.linalg.qr(stacked, mode="r"), dtype=np.float64)
        half, tail = np.asarray(np.linalg.inv(factor[:local, :local]), dtype=np.float64), factor[local:, local:]
        by_reference = np.ones(c, dtype=bool)
        if leaf is None:
            by_reference[at[self._links[links[0]].sensor]] = False
        observed = 0.0
        if leaf is not None:
            wide = np.flatnonzero(self.devices[leaf].wide)
            observed = height - len(wide) + float(np.sum(half[wide] ** 2))
        return Eliminated(
            EliminatedRows(index, tail[:c, :c], tail[:c, c], float(tail[c, c] ** 2), by_reference),
            half @ factor[:local, -1], -half @ factor[:local, local:-1], half, own, observed,
        )  # fmt: skip


def _check_link(link: Link, devices: Mapping[str, SiteDevice]) -> None:
    """Raise ValueError for a link with a device that is not there, or of a device with itself."""
    for name in (link.sensor, *_core_of(link)):
        if name not in devices:
            raise ValueError(f"{name} is in a link, but there is no such device")
    if link.sensor == link.reference:
        raise ValueError(f"{link.sensor} cannot be its own reference")


def _core_of(one: Link) -> list[str]:
    """The devices of a link that it does not call its sensor."""
    return [one.reference] if one.rotation is not None else list(dict.fromkeys(name for name, _ in one.shared))
