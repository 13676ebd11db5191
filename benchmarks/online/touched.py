"""A gateway that is touched: restarts with another configuration, other references, operators, slips, shifts, drift.

Each line of the table is one kind of touch, simulated with many seeds. All errors of the installation are drawn from
the uncertainties that the configuration states, once a run; in the lines "off by 1 u" every reference reads 1 u too
high. S is that of the sensor as it stands: after a turn about z, S times this turn.

A constant error of the reference goes into S as it is. So no data can bring u of a main sensitivity below what the
prior of S and the certificates of the references say together (`exact_batch_pct`), however many windows there are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from agent.config import Config
from benchmarks.online import bench as bench_day
from benchmarks.online.clamp import bench_events
from benchmarks.online.config import building_config
from benchmarks.online.coverage import band
from benchmarks.online.life import Gateway, House, Told
from benchmarks.online.node import Node, Stated, Timing, node
from calib.model import Array
from hw.virtual.bench import Bench
from hw.virtual.building import YEAR_S, Building
from hw.virtual.harm import ClockStep, Harm, Lossy, Role, Transformed, Visit
from hw.virtual.motion import sine
from hw.virtual.schedule import rotation

SEED, SEEDS = 70_000, 100
SOUND_WINDOWS = 20_000  # at least, of a line in which nothing is wrong
U_REFERENCE_PCT = 0.3
STATED = Stated(main_pct=3.0, transverse_pct=1.5, offset_mps2=0.5, reference_pct=U_REFERENCE_PCT)
# The limit of max_change for the transverse sensitivities is the default then, so that a turn of 2 deg is beyond it.
STATED_TURN = replace(STATED, transverse_pct=0.5)
STATED_SHIFT = replace(STATED, lag_s=0.02)
TIMING = Timing(20.0, 60.0)
SOUND = 10  # windows before something happens
COVERED = 0.9545  # of a normal distribution within 2 standard deviations
FALSE_HOLDS = 1e-4  # as the gate is set by default
SLIP_DEG = 1.5


@dataclass(frozen=True, slots=True)
class Line:
    """One kind of touch. `run` simulates it with a seed. `references`: how many instruments the windows had in turn,
    None where the reference changes. `sound`: how many windows a run has of which none may be held, since nothing is
    wrong with the data; 0 where something is wrong."""

    name: str
    run: Callable[[int], Told]
    references: int | None = 1
    sound: int = 0

    @property
    def runs(self) -> int:
        """How many runs are simulated: with enough windows to count false holds, where there may be none."""
        return max(SEEDS, math.ceil(SOUND_WINDOWS / self.sound)) if self.sound else SEEDS


# --- buildings


def drawn(seed: int, stated: Stated = STATED, off_u: float | None = None, timing: Timing = TIMING, **more: Any) -> Node:
    """A building with errors from `stated`. `off_u`: by how many u every channel of the reference reads too high."""
    found = node(seed, stated=stated, timing=timing, **{"all_axes": True, **more})
    if off_u is None:
        return found
    return replace(found, building=_with(found.building, reference_sensitivity=_reads(off_u)))


def reconfigured(seed: int, restarts: int, off_u: float | None = None) -> Told:
    """Two windows, then restarts with two windows after each: an uncertainty by 10 %, the order of the temperature, u
    of the reference, in turn, and back again."""
    installation = drawn(seed, off_u=off_u)
    house = House(installation.building, installation.config)
    for touch in range(9):
        if 0 < touch <= restarts:
            house.restart(_configuration(installation, touch))
        house.visit()
        house.visit()
    return house.told()


def _configuration(installation: Node, touch: int) -> Config:
    """After `touch` restarts. Each restart changes one of three settings, or changes it back."""
    changed = [(touch + 2 - k) // 3 % 2 == 1 for k in range(3)]
    keys = installation.stated.keys()
    if changed[0]:
        keys["uncertainty"]["rotation_deg"] *= 1.1
    if changed[1]:
        keys["temperature"]["offset_order"] = 1
    if changed[2]:
        keys["certificate"]["u_sensitivity_pct"] *= 1.1
    return building_config(installation.building, **keys)


def swapped(seed: int, swaps: int = 8, off_u: float | None = None) -> Told:
    """Two windows with each of two references in turn; half of the swaps are made while the program is off."""
    installation = drawn(seed, off_u=off_u)
    random = np.random.default_rng([seed, 11])
    own = np.diag(1 + U_REFERENCE_PCT / 100 * random.standard_normal(3)) if off_u is None else _reads(off_u)
    other = _with(installation.building, reference_sensitivity=own)
    house = House(installation.building, installation.config)
    for touch in range(swaps + 1):
        if touch:
            house.fit((installation.building, other)[touch % 2], "AB"[touch % 2])
            house.restart(installation.config) if touch % 4 < 2 else house.plug()
        house.visit()
        house.visit()
    return house.told()


def turned(seed: int) -> Told:
    """The sensor is turned by 2 to 4 deg about z, and an operator accepts the first estimate after it."""
    random = np.random.default_rng([seed, 12])
    turn = rotation(np.array([0.0, 0.0, 1.0]), np.deg2rad(random.uniform(2.0, 4.0) * random.choice([-1.0, 1.0])))
    installation = drawn(seed, STATED_TURN, harm=Turned("turned", turn), harmed_from=SOUND)
    mount = installation.building.parameters.rotation
    house, accepted = House(installation.building, installation.config), False
    for visit in range(3 * SOUND):
        house.visit(mount @ turn @ mount.T if visit >= SOUND else None)
        if visit >= SOUND and house.gateway.estimate is not None and not accepted:
            house.gateway.accept(house.gateway.estimate)
            accepted = True
    return house.told()


@dataclass(frozen=True, slots=True, eq=False)
class Turned(Harm):
    """The sensor stands in another direction about the vertical; gravity acts on it as before."""

    turn: Array = field(default_factory=lambda: np.eye(3))

    def moved(self, visit: Visit, felt: Array) -> Array:
        return felt @ self.turn.T if visit.role == "sensor" else felt


def shifted(seed: int) -> Told:
    """From one moment on all data of one device come 10 to 40 ms later or earlier."""
    random = np.random.default_rng([seed, 13])
    role: Role = "sensor" if random.random() < 0.5 else "reference"
    step_s = random.uniform(0.010, 0.040) * random.choice([-1.0, 1.0])
    harm = ClockStep("stamps shift", role, "arrival", float(step_s))
    return _through(drawn(seed, STATED_SHIFT, harm=harm, harmed_from=SOUND), 4 * SOUND)


def along_one_axis(seed: int) -> Told:
    """Motion along y, with 0.5 to 1 % of it on each other axis, at a phase that stays."""
    random = np.random.default_rng([seed, 18])
    share = random.uniform(0.005, 0.01, 2) * np.exp(2j * np.pi * random.random(2))
    installation = drawn(seed, all_axes=False)
    building = _with(installation.building, across=(complex(share[0]), complex(share[1])))
    return _through(replace(installation, building=building), 200)


def drifting(seed: int) -> Told:
    """One main sensitivity drifts by 10 % a year; the configuration states 0.005 % in a day, as by default."""
    random = np.random.default_rng([seed, 14])
    windows, every_s = 480, 6 * 3600.0
    installation = drawn(seed, timing=Timing(20.0, every_s))
    p = installation.building.parameters
    change, axis = np.zeros((3, 3)), int(random.integers(3))
    change[axis, axis] = 0.10 * every_s / YEAR_S * random.choice([-1.0, 1.0]) * p.sensitivity[axis, axis]
    building = _with(installation.building, steps=tuple((k * every_s, change) for k in range(1, windows)))
    keys = installation.stated.keys()
    keys["process"]["sensitivity_pct"] = 0.005
    return _through(replace(installation, building=building, config=building_config(building, **keys)), windows)


def reference_steps(seed: int) -> Told:
    """In mid-life the reference begins to read 3 % too high; its stability is stated as 0.5 % a year, as by default."""
    harm = Transformed("reference + 3 %", "reference", 1.03 * np.eye(3))
    installation = drawn(seed, harm=harm, harmed_from=SOUND)
    keys = installation.stated.keys()
    keys["certificate"]["stability_pct"] = 0.5
    return _through(replace(installation, config=building_config(installation.building, **keys)), 4 * SOUND)


def losing(seed: int) -> Told:
    """3 % of the samples of one device are lost one by one, with a level of 0.02 to 0.08 m/s2."""
    role: Role = "sensor" if np.random.default_rng([seed, 15]).random() < 0.5 else "reference"
    installation = drawn(seed, harm=Lossy("3 % lost", role, 0.03, 1, told=True))
    return _through(replace(installation, building=_with(installation.building, level_mps2=(0.02, 0.08))), 200)


def _through(installation: Node, windows: int) -> Told:
    house = House(installation.building, installation.config)
    for _ in range(windows):
        house.visit()
    return house.told()


def _with(building: Building, **parameters: Any) -> Building:
    return Building(replace(building.parameters, **parameters), building.seed, building.harm, building.harmed_from)


def _reads(off_u: float) -> Array:
    return (1 + off_u * U_REFERENCE_PCT / 100) * np.eye(3)


# --- clamps


def slipping(seed: int) -> Told:
    """In the first window the clamp slips by 1.5 deg, in theta or alpha; at the next stop its angles are right.

    Only windows with data from between the slip and the next stop are counted: none may be taken."""
    random = np.random.default_rng([seed, 16])
    world = bench_day.world(seed, 200.0)
    p, schedule = world.parameters, world.parameters.schedule
    name = ("theta_by_position_deg", "alpha_by_position_deg")[int(random.integers(2))]
    slipped = [*getattr(p.clamp, name)]
    slipped[0] += SLIP_DEG * random.choice([-1.0, 1.0])
    at_stop: dict[str, Any] = {name: tuple(slipped)}
    after = Bench(replace(p, clamp=replace(p.clamp, **at_stop)), seed)
    duration_s = schedule.duration_s(bench_day.ROUNDS) + bench_day.AFTER_S
    recording = world.recording(duration_s)
    slip_s = schedule.start_of(0) + random.uniform(0.3, 0.7) * bench_day.HOLD_S
    turn_s = schedule.start_of(1) - schedule.turn_s
    there = (recording.sensor_time_s >= slip_s) & (recording.sensor_time_s < turn_s)
    v = np.where(there[:, None], after.recording(duration_s).v, recording.v)
    gateway = _on_clamp(world)
    gateway.feed(bench_events(world, replace(recording, v=v)))
    return gateway.told([[r] for r in gateway.reports if r.stop_s > slip_s and r.start_s < turn_s])


def slow(seed: int) -> Told:
    """A sine of 0.2 Hz and 1 m/s2 on a clamp whose positions the agent finds itself; a window a stop is expected."""
    p = bench_day.world(seed, 200.0).parameters
    stands = tuple(replace(stand, hold_s=60.0) for stand in p.schedule.stands)
    lateral, vertical = bench_day.KNOWN.transverse_motion_pct / 100 * np.random.default_rng([seed, 17]).normal(size=2)
    motion = sine(0.2, 1.0).with_transverse(lateral, vertical)
    world = Bench(replace(p, motion=motion, schedule=replace(p.schedule, stands=stands)), seed)
    gateway = _on_clamp(world)
    schedule = world.parameters.schedule
    gateway.feed(bench_events(world, world.recording(schedule.duration_s(bench_day.ROUNDS) + bench_day.AFTER_S)))
    stops = [(schedule.start_of(k), schedule.start_of(k + 1)) for k in range(bench_day.ROUNDS * len(stands))]
    return gateway.told([[r for r in gateway.reports if start <= r.start_s < stop] for start, stop in stops])


def _on_clamp(world: Bench) -> Gateway:
    return Gateway(bench_day.config(world), np.append(world.truth.sensitivity.ravel(), world.truth.offset))


# --- table


def _times(count: int, off_u: float | None = None) -> Callable[[int], Told]:
    return lambda seed: reconfigured(seed, count, off_u)


LINES = (
    *(Line(f"configuration changed at {n} restarts", _times(n), sound=18) for n in (0, 1, 2, 4, 8)),
    Line("references A and B in turn, 8 swaps", swapped, references=2, sound=18),
    Line("8 changed configurations, reference off by 1 u", _times(8, 1.0), sound=18),
    Line("8 swaps, both references off by 1 u", lambda seed: swapped(seed, off_u=1.0), references=2, sound=18),
    Line("turned by 2 to 4 deg about z, an operator accepts", turned),
    Line("stamps of one device shift by 10 to 40 ms", shifted),
    Line("motion along one axis, 0.5 to 1 % on the others", along_one_axis, sound=200),
    Line("clamp slips by 1.5 deg in the first window", slipping, references=None),
    Line("drift of 10 % a year, stated 0.1 %", drifting),
    Line("reference + 3 % in mid-life", reference_steps, references=None),
    Line("motion at 0.2 Hz, positions found", slow, references=None, sound=12),
    Line("3 % of the samples lost, level below 0.08 m/s²", losing, sound=200),
)


def one(job: tuple[int, int]) -> Told:
    """The line and the seed of `job`, by their numbers."""
    return LINES[job[0]].run(SEED + job[1])


def exact_batch_pct(references: int) -> float:
    """The smallest standard uncertainty of a main sensitivity, from its prior and the references' certificates."""
    return float((STATED.main_pct**-2 + references * U_REFERENCE_PCT**-2) ** -0.5)


def most_false_holds(windows: int, level: float = 0.999) -> int:
    """So many sound windows may be held, by chance, at this level (Poisson)."""
    mean, k = windows * FALSE_HOLDS, 0
    probability = total = float(np.exp(-mean))
    while total < level:
        k += 1
        probability *= mean / k
        total += probability
    return k


def table(found: Sequence[Sequence[Told]]) -> str:
    """One row a line. Windows are counted over all runs."""
    lines = [
        "| what is done | runs | windows | taken / held / refused | runs ending HELD | u of main S at the end, % "
        "| smallest u / exact batch | rms error / u | within U, % (band) | worst error while VALID, u |",
        "| --- |" + " --- |" * 9,
    ]
    return "\n".join([*lines, *(_row(line, runs) for line, runs in zip(LINES, found, strict=True))])


def _row(line: Line, runs: Sequence[Told]) -> str:
    windows, taken, held = (sum(getattr(told, name) for told in runs) for name in ("windows", "taken", "held"))
    limit = f" (at most {most_false_holds(windows)})" if line.sound else ""
    ending = sum(told.status == "HELD" for told in runs)
    u = _finite(told.u_main_pct for told in runs)
    least = _finite(told.least_u_main_pct for told in runs)
    errors = _finite(told.errors for told in runs)
    low, high = (round(100 * count / len(runs)) for count in band(len(runs), 1, COVERED))
    ratio = f"{least.min() / exact_batch_pct(line.references):.2f}" if line.references and len(least) else ""
    cells = [
        line.name, str(len(runs)), str(windows), f"{taken} / {held}{limit} / {windows - taken - held}", str(ending),
        f"{u.mean():.3f}" if len(u) else "", ratio,
        f"{np.sqrt(np.mean(errors**2)):.2f}" if len(errors) else "",
        f"{100 * np.mean(np.abs(errors) <= 2.0):.1f} ({low}..{high})" if len(errors) else "",
        f"{max(told.worst for told in runs):.1f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def _finite(values: Iterable[Array]) -> Array:
    found = np.array(list(values))
    return found[np.isfinite(found)]
