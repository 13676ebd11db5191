"""A small site with known truth, and its adjustment from all samples at once: dense, by numerical derivatives.

It shares no code with calib: each sample is predicted from V = S a + Q, with every unknown of the site in one vector.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from calib.model import Pose, Window
from tests.clamp_windows import frame, sums_of

Array = np.ndarray
G_MPS2, RATE_HZ, SEGMENTS = 9.81, 50.0, 8
SAMPLES = 100
THETA_RAD = float(np.deg2rad(35.0))
ALPHAS_RAD = np.deg2rad([0.0, 90.0, 200.0, 300.0])
SWINGS_HZ = (1.0, 2.5, 4.0)


@dataclass(frozen=True)
class Stated:
    """Standard uncertainties of a site: relative, m/s2, rad, and m/s2 between windows."""

    sensor: float = 0.05
    sensor_offset_mps2: float = 5.0
    reference: float = 3e-3
    gravity_mps2: float = 0.01
    rotation_rad: float = 2e-3
    offset_mps2: float = 0.005


@dataclass
class Meeting:
    """A sensor beside a reference, or on the clamp of a uniaxial one: windows, and their samples.

    `felt` (n, 3) of each window is what a tri-axial reference indicates, or (n, 1) along the clamp's motion. `rotation`
    is as stated, `turn` its error.
    """

    sensor: str
    reference: str
    clamped: bool
    rotation: Array
    turn: Array
    windows: list[Window] = field(default_factory=list)
    felt: list[Array] = field(default_factory=list)
    output: list[Array] = field(default_factory=list)
    alpha_rad: list[float] = field(default_factory=list)


def turned(vector: Array) -> Array:
    """Rotation matrix of a small rotation vector, to third order."""
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / 2.0 + cross @ cross @ cross / 6.0


def motion(random: np.random.Generator, axes: int) -> tuple[Array, Array]:
    """(n, axes) acceleration and its rate: three tones with drawn phases, about 1 m/s2 each."""
    t = np.arange(SAMPLES) / RATE_HZ
    a, da = np.zeros((SAMPLES, axes)), np.zeros((SAMPLES, axes))
    for k in range(axes):
        for f in SWINGS_HZ:
            phase = random.uniform(0.0, 2.0 * np.pi)
            a[:, k] += np.sin(2.0 * np.pi * f * t + phase)
            da[:, k] += 2.0 * np.pi * f * np.cos(2.0 * np.pi * f * t + phase)
    return a, da


class SimulatedSite:
    """The truth of a site, drawn from what is stated; `meet` adds windows.

    `gain` (3,) of each reference is what it indicates over the true acceleration, less one.
    """

    def __init__(self, seed: int, sensors: int, references: int, stated: Stated | None = None) -> None:
        self.random = random = np.random.default_rng(seed)
        self.stated = stated or Stated()
        self.S = {f"s{k}": np.eye(3) + self.stated.sensor * random.normal(size=(3, 3)) for k in range(sensors)}
        self.Q = {f"s{k}": random.normal(size=3) for k in range(sensors)}
        self.gain = {f"r{k}": self.stated.reference * random.normal(size=3) for k in range(references)}
        self.gravity_error = self.stated.gravity_mps2 * random.normal()
        self.noise_mps2 = 1e-4
        self.offset_mps2 = 0.0  # SD between windows
        self.meetings: list[Meeting] = []

    def meet(self, sensor: str, reference: str, windows: int = 5, rotation: Array | None = None) -> Meeting:
        """A sensor turned through drawn positions beside a tri-axial reference, or beside another sensor."""
        R = np.eye(3) if rotation is None else rotation
        meeting = Meeting(sensor, reference, False, R, turned(self.stated.rotation_rad * self.random.normal(size=3)))
        true = meeting.turn @ R
        for _ in range(windows):
            a, da = motion(self.random, 3)
            down = self.random.normal(size=3)
            a = a + G_MPS2 * down / np.linalg.norm(down)
            if reference in self.S:  # read as if its S were the identity and its Q zero
                u, du = a @ self.S[reference].T + self.Q[reference], da @ self.S[reference].T
            else:
                u, du = a * (1.0 + self.gain[reference]), da * (1.0 + self.gain[reference])
            V = a @ true.T @ self.S[sensor].T + self.Q[sensor] + self._noise()
            self._add(meeting, Pose("beside", R, np.zeros(3)), u, du, V)
        self.meetings.append(meeting)
        return meeting

    def clamp(self, sensor: str, reference: str) -> Meeting:
        """A sensor on the clamp of a uniaxial reference, in four positions; gravity is as stated but for its error."""
        meeting = Meeting(sensor, reference, True, np.eye(3), np.eye(3))
        for alpha in ALPHAS_RAD:
            a, da = motion(self.random, 1)
            d, e = frame(THETA_RAD, alpha)
            felt = a * d + (G_MPS2 + self.gravity_error) * e
            V = felt @ self.S[sensor].T + self.Q[sensor] + self._noise()
            pose = Pose(f"alpha {alpha:g}", d[:, None], G_MPS2 * e, THETA_RAD, float(alpha))
            gain = 1.0 + self.gain[reference][0]
            meeting.alpha_rad.append(float(alpha))
            self._add(meeting, pose, a * gain, da * gain, V)
        self.meetings.append(meeting)
        return meeting

    def _noise(self) -> Array:
        noise = self.noise_mps2 * self.random.normal(size=(SAMPLES, 3))
        return noise + self.offset_mps2 * self.random.normal(size=3)

    def _add(self, meeting: Meeting, pose: Pose, u: Array, du: Array, V: Array) -> None:
        window = Window(0.0, SAMPLES / RATE_HZ, pose, sums_of(u, du, V, SEGMENTS), True, "", SAMPLES, 0)
        meeting.windows.append(window)
        meeting.felt.append(u)
        meeting.output.append(V)


@dataclass(frozen=True)
class Dense:
    """All unknowns at once: `x` and `covariance`, and where each unknown stands."""

    x: Array
    covariance: Array
    where: dict[tuple[str, ...], slice]

    def of(self, *name: str) -> Array:
        """The values of one device."""
        return self.x[self.where[name]]

    def between(self, name: tuple[str, ...], other: tuple[str, ...]) -> Array:
        """The covariance of two devices."""
        return self.covariance[self.where[name], self.where[other]]


def dense(site: SimulatedSite) -> Dense:
    """Least squares of all samples of a site and of all that is stated, by Gauss-Newton."""
    stated, start, u = site.stated, list[float](), list[float]()
    where: dict[tuple[str, ...], slice] = {}

    def unknown(name: tuple[str, ...], values: Array, uncertainty: Array | float) -> None:
        where[name] = slice(len(start), len(start) + len(values))
        start.extend(values)
        u.extend(np.broadcast_to(uncertainty, len(values)))

    for name in site.S:
        known = np.append(np.full(9, 4.0 * stated.sensor), np.full(3, stated.sensor_offset_mps2))
        unknown((name,), np.append(np.eye(3).ravel(), np.zeros(3)), known)
    for name in site.gain:
        unknown((name,), np.zeros(3), stated.reference)
    unknown(("gravity",), np.zeros(1), stated.gravity_mps2)
    for m, meeting in enumerate(site.meetings):
        if not meeting.clamped:
            unknown(("rotation", f"{m}"), np.zeros(3), stated.rotation_rad)
    mean, sd = np.array(start), np.array(u)

    def residuals(x: Array) -> Array:
        return np.concatenate([*_left(site, x, where), (mean - x) / sd])

    x = mean.copy()
    for _ in range(3):
        jacobian = _derivatives(residuals, x, sd)
        x = x - np.linalg.lstsq(jacobian, residuals(x), rcond=None)[0]
    jacobian = _derivatives(residuals, x, sd)
    return Dense(x, np.linalg.inv(jacobian.T @ jacobian), where)


def _left(site: SimulatedSite, x: Array, where: dict[tuple[str, ...], slice]) -> Iterator[Array]:
    for m, meeting in enumerate(site.meetings):
        own = x[where[meeting.sensor,]]
        S, Q = own[:9].reshape(3, 3), own[9:]
        for w, (felt, V) in enumerate(zip(meeting.felt, meeting.output, strict=True)):
            if meeting.clamped:
                d, e = frame(THETA_RAD, meeting.alpha_rad[w])
                gravity = G_MPS2 + x[where["gravity",]]
                a = felt / (1.0 + x[where[meeting.reference,]][0]) * d + gravity * e
            else:
                a = felt
                if meeting.reference in site.S:
                    other = x[where[meeting.reference,]]
                    a = (felt - other[9:]) @ np.linalg.inv(other[:9].reshape(3, 3)).T
                else:
                    a = felt / (1.0 + x[where[meeting.reference,]])
                a = a @ (turned(x[where["rotation", f"{m}"]]) @ meeting.rotation).T
            left = V - a @ S.T - Q
            # Noise and one offset for the window: the mean of the samples gets its own, smaller weight.
            offset = site.stated.offset_mps2  # of a sensor whose scale is 1 by what was known of it beforehand
            share = 1.0 / np.sqrt(1.0 + len(V) * (offset / site.noise_mps2) ** 2)
            yield ((left - (1.0 - share) * left.mean(axis=0)) / site.noise_mps2).ravel()


def _derivatives(function: Callable[[Array], Array], x: Array, sd: Array) -> Array:
    columns = []
    for k, step in enumerate(1e-4 * sd):
        ahead, behind = x.copy(), x.copy()
        ahead[k] += step
        behind[k] -= step
        columns.append((function(ahead) - function(behind)) / (2.0 * step))
    return np.array(columns).T
