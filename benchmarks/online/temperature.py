"""A sensor whose S and Q depend on temperature, beside a reference that does: a window an hour for a week, made from
samples and judged as on-line; all settings are the defaults.

Sensor and reference follow the temperature of their bodies, which may be behind the told one. Coefficients have the
stated size and a drawn sign; the errors of the certificate and of the rotation are drawn from what is stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.config import parse_config
from agent.core.estimation import Estimation
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import Array, Calibration, Pose, Window
from tests.clamp_windows import sums_of

SEED, RUNS, BEFORE_RUNS = 350_000, 20, 3
DAYS, EVERY_H = 7, 1
RATE_HZ, WINDOW_S = 25.0, 60
TONES_HZ = (0.7, 1.3, 2.1, 3.7, 6.1)
LEVEL_MPS2 = (0.05, 0.3)  # rms of each axis, drawn by window
NOISE_MPS2 = 0.005
UP = np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2])
BESIDE = Pose("beside", np.eye(3), UP)
S = np.array([[1.02, 0.01, -0.005], [0.004, 0.98, 0.008], [-0.01, 0.006, 1.01]])
Q = np.array([0.3, -0.1, 0.2])
OFFSET_MPS2_PER_K = 0.005
MEAN_DEGC, COLD_DEGC = 20.0, -10.0


@dataclass(frozen=True, slots=True)
class World:
    """`swing_k` a day; relative coefficients per K of main and transverse sensitivities and of the reference; the body
    is `late_h` behind. `constant`: S is stated not to depend on temperature."""

    name: str
    swing_k: float
    main: float = 0.0
    transverse: float = 0.0
    reference: float = 0.0
    late_h: float = 0.0
    constant: bool = False


WORLDS = (
    World("none", 0.0, 1e-4, 3e-4, 2e-4),
    World("10 K; 0.01 %/K, transverse 0.03, reference 0.02; an hour late", 10.0, 1e-4, 3e-4, 2e-4, 1.0),
    World("25 K; 0.01 %/K", 25.0, 1e-4),
    World("25 K; transverse 0.03 %/K", 25.0, transverse=3e-4),
    World("25 K; reference 0.02 %/K", 25.0, reference=2e-4),
    World("25 K; all three, an hour late", 25.0, 1e-4, 3e-4, 2e-4, 1.0),
    World("25 K; 0.01 %/K, `sensitivity_order = 0`", 25.0, 1e-4, constant=True),
    World("25 K; transverse 0.03 %/K, `sensitivity_order = 0`", 25.0, transverse=3e-4, constant=True),
)


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Of one run: windows that were not taken, drift verdicts, u of the main sensitivities at the temperature of S and
    Q, and errors of S and Q over u (12,) in force at the newest window and at COLD_DEGC."""

    not_taken: int
    verdicts: int
    u_main_pct: float
    error: Array
    cold: Array


class Drawn:
    """The truth of one run: S and Q of the sensor, and what the reference indicates."""

    def __init__(self, world: World, random: np.random.Generator) -> None:
        self.world, self.random = world, random
        self._phase = random.uniform()
        self.zero_degc = float(np.round(self.degc(0.0)))
        sign = random.choice([-1.0, 1.0], (3, 3))
        self._of_S = sign * np.where(np.eye(3) > 0, world.main, world.transverse)
        self._of_Q = OFFSET_MPS2_PER_K * random.standard_normal(3)
        self._of_reference = world.reference * random.choice([-1.0, 1.0], 3)
        self._certificate = 1e-3 * random.standard_normal(3)
        x, y, z = np.deg2rad(0.2) * random.standard_normal(3)
        self._turn = np.eye(3) + np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])

    def degc(self, day: float) -> float:
        """The told temperature."""
        return MEAN_DEGC + 0.5 * self.world.swing_k * float(np.sin(2.0 * np.pi * (day + self._phase)))

    def body_degc(self, day: float) -> float:
        """That of sensor and reference."""
        return self.degc(day - self.world.late_h / 24.0)

    def truth(self, degc: float) -> Array:
        """S and Q (12,) at a temperature of the body."""
        above = degc - self.zero_degc
        return np.append(S + self._of_S * above, Q + self._of_Q * above)

    def window(self, day: float) -> Window:
        """A minute of tones."""
        t, random = np.arange(round(RATE_HZ * WINDOW_S)) / RATE_HZ, self.random
        a, da = np.zeros((len(t), 3)), np.zeros((len(t), 3))
        for k, level in enumerate(np.exp(random.uniform(np.log(LEVEL_MPS2[0]), np.log(LEVEL_MPS2[1]), 3))):
            for hz in TONES_HZ:
                angle = 2.0 * np.pi * hz * t + random.uniform(0.0, 2.0 * np.pi)
                a[:, k] += level * np.sqrt(2.0 / len(TONES_HZ)) * np.sin(angle)
                da[:, k] += level * np.sqrt(2.0 / len(TONES_HZ)) * 2.0 * np.pi * hz * np.cos(angle)
        own, above = self.truth(self.body_degc(day)), self.body_degc(day) - self.zero_degc
        V = (a + UP) @ own[:9].reshape(3, 3).T + own[9:] + NOISE_MPS2 * random.standard_normal(a.shape)
        size = 1.0 + self._certificate + self._of_reference * above
        u, du = (x @ self._turn * size for x in (a, da))
        return Window(0.0, WINDOW_S, BESIDE, sums_of(u, du, V, WINDOW_S), True, "", len(t), 0)


def estimation(*, constant: bool) -> Estimation:
    """All defaults; `constant`: S does not depend on temperature."""
    names = "sensor", "reference"
    devices = [{"name": n, "driver": "serial-csv", "options": {"port": n, "rate_hz": RATE_HZ}} for n in names]
    channel: dict[str, Any] = {
        "sensor": "sensor", "reference": "reference", "rotation": np.eye(3).ravel().tolist(),
        "rotation_gravity_mps2": UP.tolist(), "prior": {"sensitivity": 1.0},
        "temperature": {"sensitivity_order": 0} if constant else {},
    }  # fmt: skip
    return Estimation(parse_config({"devices": devices, "channels": [channel]}, "").channels[0], None)


def one(job: tuple[World, int]) -> Outcome:
    """One run: a world and a seed."""
    world, seed = job
    drawn, found = Drawn(world, np.random.default_rng(seed)), estimation(constant=world.constant)
    not_taken = verdicts = 0
    days = np.arange(0, 24 * DAYS, EVERY_H) / 24.0
    for day in days.tolist():
        judged = found.judge(drawn.window(day), day, 0.0, drawn.degc(day))
        not_taken += judged.decision.action != "take"
        verdicts += sum(verdict.verdict != "stable" for verdict in judged.drift)
    newest = float(days[-1])
    error = over_u(found.law.at(drawn.degc(newest)), drawn.truth(drawn.body_degc(newest)))
    cold = over_u(found.law.at(COLD_DEGC), drawn.truth(COLD_DEGC))
    u_main = found.in_force.standard_uncertainty[[0, 4, 8]]
    return Outcome(not_taken, verdicts, float(100.0 * u_main.mean()), error, cold)


def over_u(calibration: Calibration, truth: Array) -> Array:
    """Errors of S and Q (12,) over their standard uncertainties."""
    values = np.append(calibration.sensitivity, calibration.offset)
    return np.asarray((values - truth) / calibration.standard_uncertainty)


def jobs(runs: int) -> list[list[tuple[World, int]]]:
    """Those of each line; a line with S constant, which is held most of the time, has fewer."""
    return [[(world, SEED + k) for k in range(min(runs, BEFORE_RUNS) if world.constant else runs)] for world in WORLDS]


def table(lines: Sequence[Sequence[Outcome]]) -> str:
    """A line for each world."""
    rows = [
        "| swing of a day; dependence | seeds | not taken | drift verdicts | u of main S at T0, % "
        f"| error over u: rms, most | at {COLD_DEGC:g} °C: rms, most |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for world, outcomes in zip(WORLDS, lines, strict=True):
        windows = len(outcomes) * 24 * DAYS // EVERY_H
        not_taken, verdicts = (sum(getattr(o, name) for o in outcomes) for name in ("not_taken", "verdicts"))
        u = np.mean([o.u_main_pct for o in outcomes])
        error, cold = (np.array([getattr(o, name) for o in outcomes]) for name in ("error", "cold"))
        told = [f"{np.sqrt(np.mean(e**2)):.2f}, {np.abs(e).max():.1f}" for e in (error, cold)]
        rows.append(
            f"| {world.name} | {len(outcomes)} | {not_taken} of {windows} | {verdicts} | {u:.4f} | {told[0]} "
            f"| {told[1]} |"
        )
    return "\n".join(rows)
