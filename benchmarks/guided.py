"""Simulated users at the guided bench: how many stops to a wanted U, is the promise kept, are wrong turns noticed?

    python -m benchmarks.guided [--users 200] [--write]

Each user has a sensor, a clamp and a reference of his own: all errors are drawn from their stated uncertainties. The
guide of `fieldcal bench` tells each the next stop, and the adjustment makes S of the windows. The reference is exact,
since its error is the same at every stop.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from agent.bench.session import BenchSession
from agent.bench.stops import BenchStop, on_clamp, turned_by_hand
from benchmarks.page import machine, write_part
from calib.estimate.nuisances import Priors
from calib.geometry import STANDARD_GRAVITY_MPS2, clamp
from calib.model import Window
from calib.visit.next_stop import MAIN, Expected, WantedUncertainty
from calib.visit.stop_order import StopSets
from calib.windows.sums import window_sums

ALPHAS_DEG = tuple(range(0, 360, 15))
FREQUENCY_HZ, AMPLITUDE_MPS2, RATE_HZ, STAY_S, NOISE_MPS2 = 3.0, 10.0, 200.0, 10.0, 0.02
SEGMENT_S = 0.5
ANGLE_DEG, OFFSET_MPS2, TRIAD_OFFSET_MPS2 = 0.2, 0.05, 0.0025
U_NOMINAL, U_TRANSVERSE = 0.1, 0.03
WRONG_DEG = (-90.0, -45.0, -30.0, -15.0, 15.0, 30.0, 45.0, 90.0, 180.0)
MOST_STOPS = 30


def priors(offset_mps2: float, **stated: float) -> Priors:
    """What the bench knows: a data sheet, and the stated uncertainties of the figure that is measured."""
    sd = np.where(MAIN, U_NOMINAL, U_TRANSVERSE)
    known = np.diag(np.append(sd**2, np.full(3, np.inf)))
    none = Priors.none().values
    return Priors(
        {**none, "offset_mps2": offset_mps2, **stated}, np.append(np.eye(3).ravel(), np.zeros(3)), known
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class User:
    """A sensor and the errors of its stops, all drawn."""

    random: np.random.Generator
    S: np.ndarray
    Q: np.ndarray
    theta_deg: float
    alpha_deg: dict[str, float]
    offset_mps2: float

    @classmethod
    def drawn(cls, seed: int, offset_mps2: float) -> User:
        """The user of this number."""
        random = np.random.default_rng([17, seed])
        S = np.eye(3) + np.where(np.eye(3), U_NOMINAL, U_TRANSVERSE) * random.normal(size=(3, 3))
        return cls(random, S, random.normal(scale=0.5, size=3), ANGLE_DEG * random.normal(), {}, offset_mps2)

    def on_clamp(self, told: BenchStop, alpha_off_deg: float = 0.0) -> Window:
        """The window of a stop on the clamp; `alpha_off_deg`: turned wrong by so much."""
        theta, alpha = told.columns["theta_deg"] + self.theta_deg, told.columns["alpha_deg"] + alpha_off_deg
        key = f"{told.columns['theta_deg']:g} {alpha % 360.0:g}"
        alpha += self.alpha_deg.setdefault(key, ANGLE_DEG * self.random.normal())
        true = clamp(float(np.deg2rad(theta)), float(np.deg2rad(alpha)))
        t = np.arange(round(STAY_S * RATE_HZ)) / RATE_HZ
        omega = 2.0 * np.pi * FREQUENCY_HZ
        u, du = AMPLITUDE_MPS2 * np.sin(omega * t)[:, None], AMPLITUDE_MPS2 * omega * np.cos(omega * t)[:, None]
        return self._window(told, u, du, u @ true.direction.T + true.gravity_mps2, "motion")

    def beside_triad(self, told: BenchStop) -> Window:
        """The window of a rest beside the triad, put down within some degrees of what was told."""
        n = round(STAY_S * RATE_HZ)
        felt = told.reference_mps2 + STANDARD_GRAVITY_MPS2 * np.deg2rad(5.0) * self.random.normal(size=3)
        felt *= STANDARD_GRAVITY_MPS2 / np.linalg.norm(felt)
        u = felt + NOISE_MPS2 * self.random.normal(size=(n, 3))
        return self._window(told, u, np.zeros((n, 3)), np.tile(felt, (n, 1)), "rest")

    def _window(self, told: BenchStop, u: np.ndarray, du: np.ndarray, a: np.ndarray, kind: str) -> Window:
        n = len(u)
        V = a @ self.S.T + self.Q + self.offset_mps2 * self.random.normal(size=3)
        V = V + NOISE_MPS2 * self.random.normal(size=(n, 3))
        sums = window_sums(u, du, V, np.arange(0, n + 1, round(SEGMENT_S * RATE_HZ)))
        noise = np.zeros((2, u.shape[1])) if kind == "motion" else np.vstack([np.full(3, NOISE_MPS2), np.zeros(3)])
        return Window(0.0, STAY_S, told.pose, sums, True, "", n, 0, kind, reference_noise=noise)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, eq=False)
class Ended:
    """A session at its end: stops to U of main and of all, errors of S and the U promised, before and after."""

    main_stops: int
    all_stops: int
    error: np.ndarray
    promised: np.ndarray
    told: np.ndarray
    refused: bool


def guided(session: BenchSession, user: User, measure: Callable[[BenchStop], Window]) -> Ended:
    """One user follows the guide until all is as wanted, or for MOST_STOPS stops."""
    main_stops, promised = 0, session.joint.expanded
    while not session.reached and len(session.windows) < MOST_STOPS:
        best = session.suggestion()
        promised = best.expanded
        session.take([*session.windows, measure(session.stops[best.stop])])
        if not main_stops and session.joint.expanded[MAIN].max() <= session.wanted.main:
            main_stops = len(session.windows)
    assert session.found is not None
    error = (session.found.calibration.sensitivity - user.S) / np.diag(user.S)[:, None]
    reached = len(session.windows) if session.reached else 0
    return Ended(
        main_stops, reached, error.ravel(), promised, session.joint.expanded, bool(session.found.reasons)
    )  # fmt: skip


def _session(stops: Sequence[BenchStop], stated: Priors, wanted: WantedUncertainty) -> BenchSession:
    """A session whose motion is known beforehand, as the reference shows it before the first stop."""
    return BenchSession(
        stops, stated, wanted, expected=Expected(AMPLITUDE_MPS2 / np.sqrt(2.0), NOISE_MPS2, STAY_S * RATE_HZ)
    )  # fmt: skip


def wrong_turns(seed: int, stops: Sequence[BenchStop], stated: Priors) -> tuple[int, int, int, int]:
    """A user whose clamp is turned wrong once.

    Whether a right stop was called wrong, and whether the wrong one was noticed at once, was named, or was found at a
    later stop only.
    """
    user, session = User.drawn(seed, OFFSET_MPS2), _session(stops, stated, WantedUncertainty())
    wrong_at, off = int(user.random.integers(0, 6)), float(user.random.choice(WRONG_DEG))
    refused = noticed = named = later = 0
    for k in range(8):
        best = session.suggestion().stop
        window = user.on_clamp(stops[best], off if k == wrong_at else 0.0)
        fit = session.fit(best, window)
        if k == wrong_at and not fit.fits:
            noticed = 1
            if fit.instead is not None:
                away = stops[fit.instead].columns["alpha_deg"] - stops[best].columns["alpha_deg"] - off
                named = int(abs((away + 180.0) % 360.0 - 180.0) < 1.0)
            window = user.on_clamp(stops[best])
        elif not fit.fits:
            hidden = k > wrong_at and not noticed  # the wrong one is among those that were taken
            refused += not hidden
            if hidden and fit.earlier is not None:
                later = 1
                break
        session.take([*session.windows, window])
    return refused, noticed, named, later


def _line(name: str, ended: Sequence[Ended], group: np.ndarray, wanted_pct: float) -> str:
    error, told, promised = (np.array([getattr(e, f) for e in ended])[:, group] for f in ("error", "told", "promised"))
    twice = 200.0 * float(np.sqrt(np.mean(error**2)))
    after, before = (100.0 * float(np.sqrt(np.mean(u**2))) for u in (told, promised))
    stops = np.array([e.main_stops if group is MAIN else e.all_stops for e in ended])
    reached = f"{stops.min()} to {stops.max()}" if stops.all() else f"not by {np.sum(stops == 0)} users"
    return (
        f"| {name} | {wanted_pct:g} | {reached} | {before:.4f} | {after:.4f} | {twice:.4f} | "
        f"{before / twice:.2f} | {after / twice:.2f} |"
    )


def figures(users: int) -> list[str]:
    """The lines of the page."""
    angle = float(np.deg2rad(ANGLE_DEG))
    stated = priors(OFFSET_MPS2, theta_rad=angle, angle_rad=angle, lag_s=0.02)
    lines = [
        "| bench | wanted U, % | stops | promised, % | told, % | twice the RMS error, % | promised / it | told / it |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    two = on_clamp((35.0, 55.0), ALPHAS_DEG, STANDARD_GRAVITY_MPS2, 1)
    wanted = WantedUncertainty()
    ended: dict[str, list[Ended]] = {"main": [], "all": []}
    for seed in range(users):
        for name, target in (("main", WantedUncertainty(wanted.main, 1.0)), ("all", wanted)):
            user = User.drawn(seed, OFFSET_MPS2)
            ended[name].append(guided(_session(two, stated, target), user, user.on_clamp))
    lines.append(_line("clamp, theta 35 and 55: main", ended["main"], MAIN, 0.05))
    lines.append(_line("clamp, theta 35 and 55: all; the transverse ones", ended["all"], ~MAIN, 0.25))
    lines.append(_line("the same; the main ones", ended["all"], MAIN, 0.05))
    triad, main = turned_by_hand(np.eye(3), STANDARD_GRAVITY_MPS2), WantedUncertainty(wanted.main, 1.0)
    at_triad = []
    for seed in range(users):
        user = User.drawn(seed, TRIAD_OFFSET_MPS2)
        session = _session(triad, priors(TRIAD_OFFSET_MPS2), main)
        at_triad.append(guided(session, user, user.beside_triad))
    lines.append(_line("rests beside a triad, offsets 2.5 mm/s²: main", at_triad, MAIN, 0.05))
    every = [*ended["main"], *ended["all"], *at_triad]
    five = [sum(0 < e.all_stops <= 5 for e in some) for some in (ended["main"], at_triad)]
    lines.append(
        f"\nFor the main sensitivities {five[0]} of {users} users needed 5 stops at most on the clamp, "
        f"{five[1]} beside the triad."
    )
    said, needed = _session(triad, priors(TRIAD_OFFSET_MPS2), main).outlook(), [e.all_stops for e in at_triad]
    assert said.stops is not None
    assert said.mostly is not None
    enough = [sum(0 < stops <= most for stops in needed) for most in (said.stops, said.mostly)]
    lines.append(
        f"\nBeside the triad the guide says beforehand: about {said.stops} stops; {said.mostly} are enough in 19 of 20 "
        f"sessions. {said.stops} were enough for {enough[0]} of {users} users, {said.mostly} for {enough[1]}."
    )
    lines.append(f"\nRefused by the adjustment: {sum(e.refused for e in every)} of {len(every)} sessions.")
    turned = np.array([wrong_turns(seed, two, stated) for seed in range(users)]).sum(axis=0)
    lines.append(
        f"\nOne wrong turn of 15 to 180 deg a user, among eight stops: {turned[1]} of {users} noticed at once, "
        f"{turned[2]} of them with the position that was taken; {turned[3]} more found by later stops; "
        f"{turned[0]} right turns called wrong."
    )
    return lines


def outlooks() -> list[str]:
    """What the guide says beforehand, where what is wanted cannot be reached."""
    angle = float(np.deg2rad(ANGLE_DEG))
    one = on_clamp((35.0,), ALPHAS_DEG, STANDARD_GRAVITY_MPS2, 1)
    two = on_clamp((35.0, 55.0), ALPHAS_DEG, STANDARD_GRAVITY_MPS2, 1)
    triad = turned_by_hand(np.eye(3), STANDARD_GRAVITY_MPS2)
    clamped = {"theta_rad": angle, "angle_rad": angle}
    cases = (
        ("one inclination, theta 35", one, priors(OFFSET_MPS2, **clamped), WantedUncertainty()),
        (
            "common alpha known to 0.1 deg",
            two,
            priors(OFFSET_MPS2, **clamped, alpha_common_rad=float(np.deg2rad(0.1))),
            WantedUncertainty(),
        ),
        ("rests beside a triad, offsets 2.5 mm/s²", triad, priors(0.0025), WantedUncertainty(5e-4, 1.0)),
        ("rests beside a triad, offsets 5 mm/s²", triad, priors(0.005), WantedUncertainty(5e-4, 1.0)),
        ("rests beside a triad, offsets 50 mm/s²", triad, priors(0.05), WantedUncertainty(5e-4, 1.0)),
    )
    lines = [
        "\n| what the guide says beforehand | stops | U then, % main / transverse | never below, % | because of |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, stops, stated, wanted in cases:
        told = _session(stops, stated, wanted).outlook()
        best, floor = (" / ".join(f"{100.0 * u:.3f}" for u in pair) for pair in (told.best, told.floor))
        count = "not in 100" if told.stops is None else str(told.stops)
        lines.append(f"| {name} | {count} | {best} | {floor} | {told.because or '-'} |")
    return lines


def bounds() -> list[str]:
    """The best of all sets of so many stops, by trying each, beside the set that the guide finds."""
    angle = float(np.deg2rad(ANGLE_DEG))
    two = on_clamp((35.0, 55.0), ALPHAS_DEG, STANDARD_GRAVITY_MPS2, 1)
    clamped = priors(OFFSET_MPS2, theta_rad=angle, angle_rad=angle, lag_s=0.02)
    triad = turned_by_hand(np.eye(3), STANDARD_GRAVITY_MPS2)
    lines = [
        "\n| stops | sets | U (main) after the best of all sets, % | after the set of the guide, % |",
        "| --- | --- | --- | --- |",
    ]
    for name, stops, stated in (("clamp", two, clamped), ("triad", triad, priors(TRIAD_OFFSET_MPS2))):
        session = _session(stops, stated, WantedUncertainty(WantedUncertainty().main, 1.0))
        together = StopSets(session.plan, session.joint, session.expected, session.wanted)
        for count in (4, 5):
            every = itertools.combinations(range(len(stops)), count)
            best, found = (100.0 * u[MAIN].max() for _, u in (together.of(every), together.best(range(count))))
            sets = math.comb(len(stops), count)
            lines.append(f"| {name}, {count} of {len(stops)} | {sets:,} | {best:.4f} | {found:.4f} |")
    return lines


def main() -> None:
    """Measure and print, with --write into docs/bench-evidence.md."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--users", type=int, default=200)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    text = "\n".join(
        [f"{options.users} simulated users, {machine()}.\n", *figures(options.users), *outlooks(), *bounds()]
    )
    if options.write:
        write_part("guided", text)
    else:
        print(text)


if __name__ == "__main__":
    main()
