"""A sensor beside an AC-coupled reference, on what moves in a plane or along a line that is not along the axes: a pump,
a turbine, a floor. Nothing moves along the normal: what the reference shows there is its noise."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from calib.excitation.front_end import Settings
from calib.geometry import along, beside
from calib.model import Array
from calib.recorded.adjusting import adjusted
from calib.recorded.options import Options
from calib.recorded.outcome import Outcome
from calib.recorded.poses import PoseInterval
from calib.recorded.priors import priors_of
from calib.recorded.table import ReferenceTable, SensorTable
from calib.recorded.tables import Making, Tables
from calib.signal.instrument import Instrument

Kind = Literal["ellipse", "tones", "band"]
RATE_HZ, SECONDS = 100.0, 120.0
TONES_HZ, BAND_HZ = {"ellipse": (6.0,), "tones": (1.3, 3.1, 6.0)}, (0.5, 12.0)
ON_S, PERIOD_S = 12.0, 20.0  # of motion that starts and stops
U_ROTATION, U_REFERENCE = np.deg2rad(0.2), 1e-3  # as `fieldcal calibrate` takes them where nothing is stated
GRAVITY = np.array([0.0, 0.0, 9.80665])
OFFSET = np.array([0.1, -0.2, 0.3])
BESIDE = beside(np.eye(3))


@dataclass(frozen=True, slots=True)
class World:
    """`directions` that the motion has at any time, 1 or 2, and how many `planes` (or lines) follow each other.
    `third`: rms of a weak motion along the normal, over the reference's noise. `told`: the reference states its noise.
    `nominal`: S is known to 3 % before. `uniaxial`: the reference shows the motion along one line, which is stated."""

    kind: Kind = "band"
    starts_and_stops: bool = False
    directions: int = 2
    planes: int = 1
    third: float = 0.0
    told: bool = False
    nominal: bool = False
    uniaxial: bool = False
    level_mps2: float = 1.0
    noise_mps2: float = 2e-3
    reference_noise_mps2: float = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Made:
    """The samples of sensor and reference, as arrays and as files, the true S (3, 3) and the axes (3, 3) of the last
    plane: its normal, or for a line the directions across it, come after the directions of the motion."""

    time_s: Array
    V: Array
    u: Array
    files: Tables
    sensitivity: Array
    axes: Array


def signals(random: np.random.Generator, kind: Kind, count: int, n: int) -> Array:
    """(n, count) motion of 1 m/s2 rms in the first direction."""
    t = np.arange(n) / RATE_HZ
    if kind == "ellipse":
        phase = 2.0 * np.pi * (TONES_HZ[kind][0] * t + random.uniform())
        return np.sqrt(2.0) * np.column_stack([np.sin(phase), 0.6 * np.cos(phase)])[:, :count]
    if kind == "tones":
        phases = random.uniform(0.0, 2.0 * np.pi, (count, 3))
        made = [np.sin(2.0 * np.pi * np.outer(t, TONES_HZ[kind]) + own).sum(axis=1) for own in phases]
        return np.column_stack(made) / np.sqrt(1.5)
    lines_hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    inside = (lines_hz >= BAND_HZ[0]) & (lines_hz <= BAND_HZ[1])
    lines = random.normal(size=(count, len(inside))) + 1j * random.normal(size=(count, len(inside)))
    x = np.fft.irfft(lines * inside, n).T
    return np.asarray(x / x.std(axis=0))


def orthonormal(random: np.random.Generator) -> Array:
    """(3, 3) three directions at right angles, any as likely as another."""
    return np.asarray(np.linalg.qr(random.normal(size=(3, 3)))[0])


def made(
    world: World, seed: int, sensitivity: Array | None = None, plane: Array | None = None, noise_seed: int = 0
) -> Made:
    """The files of one draw; the errors of all that is stated are drawn from its standard uncertainties, and S and the
    axes of the plane (3, 3) where none are given. Another `noise_seed` is another recording of the same devices."""
    random, n = np.random.default_rng(seed), round(RATE_HZ * SECONDS)
    drawn = np.eye(3) + 0.03 * random.normal(size=(3, 3))
    S = drawn if sensitivity is None else sensitivity
    t, k = np.arange(n) / RATE_HZ, world.directions
    a, u, poses = np.zeros((n, 3)), np.zeros((n, 1 if world.uniaxial else 3)), list[Any]()
    turn, gain = U_ROTATION * random.normal(size=3), 1.0 + U_REFERENCE * random.normal(size=u.shape[1])
    random = np.random.default_rng([seed, noise_seed, 1])
    ends = np.linspace(0, n, world.planes + 1).round().astype(int)
    for first, stop in itertools.pairwise(ends.tolist()):
        axes = orthonormal(random) if plane is None else plane
        x = world.level_mps2 * signals(random, world.kind, k, stop - first)
        x = np.column_stack([x, np.zeros((stop - first, 3 - k))])
        x[:, 2] += world.third * world.reference_noise_mps2 * signals(random, "band", 1, stop - first)[:, 0]
        if world.starts_and_stops:
            running = np.convolve((t[first:stop] % PERIOD_S < ON_S).astype(float), np.hanning(50), "same")
            x *= running[:, None] / np.hanning(50).sum()
        own = x @ axes.T
        a[first:stop] = own + np.cross(turn, own)  # the sensor is turned against what is stated
        u[first:stop] = x[:, :1] if world.uniaxial else own
        pose = along(axes[:, 0], position=f"line {len(poses)}") if world.uniaxial else BESIDE
        poses.append(PoseInterval(float(t[first]), float(t[stop - 1]), pose))
    u = u * gain + world.reference_noise_mps2 * random.normal(size=u.shape)
    V = (a + GRAVITY) @ S.T + OFFSET + world.noise_mps2 * random.normal(size=a.shape)
    told_mps2 = world.reference_noise_mps2 if world.told else 0.0
    files = Tables(
        SensorTable("sensor.csv", t, V),
        ReferenceTable("reference.csv", t, u, "acceleration", "ax_mps2"),
        poses if world.uniaxial else [PoseInterval(0.0, float(t[-1]), BESIDE)],
        Instrument(noise=told_mps2, ac_coupled=True),
        Making(Settings(bands=True)),
    )
    return Made(t, V, u, files, S, axes)


def calibrated(world: World, of: Made, options: Options | None = None) -> Outcome:
    """What a user gets with these files."""
    stated: dict[str, Any] = {"nominal": 1.0, "u_nominal_pct": 3.0} if world.nominal else {}
    return adjusted(of.files, priors_of(options or Options(reference_coupling="ac", **stated)))
