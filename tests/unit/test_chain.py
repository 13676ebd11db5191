"""The chain of epochs against one dense least-squares problem with every change as an unknown of its own."""

from __future__ import annotations

import numpy as np
import pytest

from calib.estimate.chain import NearIdentity, Passage, backward, forward, passed, returned, solved, with_rows

N, EPOCHS, CHANGES, ROWS = 6, 9, 3, 4


class Drawn:
    """A random chain, and the design (R, N + K J) of the same problem in [x_0, w_1, .. w_(K-1)]."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        self.prior = np.triu(random.normal(size=(N, N + 1)))
        self.prior[:, :N] += 2.0 * np.eye(N)
        self.rows = [random.normal(size=(ROWS if k % 3 else 0, N + 1)) for k in range(EPOCHS)]
        self.passages, self.maps = [], [np.eye(N, N + (EPOCHS - 1) * CHANGES)]
        self.shifts = [np.zeros(N)]
        for k in range(EPOCHS - 1):
            follows = np.eye(N) + 0.2 * random.normal(size=(N, N))
            gap, noise = random.normal(size=N), random.normal(size=(N, CHANGES))
            self.passages.append(Passage.of(np.linalg.inv(follows).astype(float), gap, noise))
            moved = follows @ self.maps[-1]
            moved[:, N + k * CHANGES : N + (k + 1) * CHANGES] += noise
            self.maps.append(moved)
            self.shifts.append(follows @ self.shifts[-1] + gap)
        design, seen = [self.prior[:, :N] @ self.maps[0]], [self.prior[:, N]]
        design.append(np.eye((EPOCHS - 1) * CHANGES, N + (EPOCHS - 1) * CHANGES, k=N))
        seen.append(np.zeros((EPOCHS - 1) * CHANGES))
        for own, at, shift in zip(self.rows, self.maps, self.shifts, strict=True):
            design.append(own[:, :N] @ at)
            seen.append(own[:, N] - own[:, :N] @ shift)
        self.design, self.seen = np.vstack(design), np.concatenate(seen)
        self.solution = np.linalg.lstsq(self.design, self.seen, rcond=None)[0]
        self.covariance = np.linalg.inv(self.design.T @ self.design)


@pytest.mark.parametrize("seed", range(3))
def test_the_last_epoch_and_all_earlier_ones_are_those_of_the_whole_problem(seed: int) -> None:
    drawn = Drawn(seed)
    root, links = forward(drawn.prior, drawn.rows, drawn.passages)
    d, factor = solved(root)
    last = drawn.maps[-1]
    np.testing.assert_allclose(d, last @ drawn.solution + drawn.shifts[-1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(factor @ factor.T, last @ drawn.covariance @ last.T, rtol=0, atol=1e-9)
    back = backward(root, links)
    for k, (at, shift) in enumerate(zip(drawn.maps, drawn.shifts, strict=True)):
        np.testing.assert_allclose(back[k], at @ drawn.solution + shift, rtol=0, atol=1e-8)
    for k in range(EPOCHS - 2, -1, -1):
        joint = returned(root, links[k])
        changes = np.eye(drawn.design.shape[1])[N + k * CHANGES : N + (k + 1) * CHANGES]
        both = np.vstack([changes, drawn.maps[k]])
        d, factor = solved(joint)
        shift = np.append(np.zeros(CHANGES), drawn.shifts[k])
        np.testing.assert_allclose(d, both @ drawn.solution + shift, rtol=0, atol=1e-8)
        np.testing.assert_allclose(factor @ factor.T, both @ drawn.covariance @ both.T, rtol=0, atol=1e-8)
        root = joint[CHANGES:, CHANGES:]


def test_epoch_by_epoch_it_is_the_same_as_at_once() -> None:
    drawn = Drawn(7)
    whole, _ = forward(drawn.prior, drawn.rows, drawn.passages)
    root = with_rows(drawn.prior, drawn.rows[0])
    for own, passage in zip(drawn.rows[1:], drawn.passages, strict=True):
        root, _ = passed(root, passage)
        root = with_rows(root, own)
    gram = root[:, :N].T @ root[:, :N]
    np.testing.assert_allclose(gram, whole[:, :N].T @ whole[:, :N], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(solved(root)[0], solved(whole)[0], rtol=0, atol=1e-10)


def test_a_passage_keeps_what_differs_from_the_identity_bit_for_bit() -> None:
    matrix = np.eye(40)
    matrix[3, 7], matrix[5, 5], matrix[6, 1] = 1e-300, 0.0, -0.0
    kept = NearIdentity.of(matrix)
    assert kept.whole.tobytes() == matrix.tobytes()
    assert len(kept.at) == len(kept.values) == 3


def test_a_link_keeps_no_larger_array_alive() -> None:
    drawn = Drawn(0)
    for link in forward(drawn.prior, drawn.rows, drawn.passages)[1]:
        assert link.own.base is link.next.base is link.z.base is None
