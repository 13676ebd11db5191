"""Two references beside one sensor: one of the three devices makes a step. Which one is named, and is U right?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.core.events import CalibrationUpdate, StatusChange, WindowReport
from benchmarks.online.config import building_config
from benchmarks.online.node import RATE_HZ, Stated, Timing, node
from benchmarks.online.runner import Run, visits
from hw.virtual.building import Building, BuildingDevice
from hw.virtual.harm import Role
from hw.virtual.schedule import rotation
from hw.virtual.timebase import Clock

SEED, RUNS = 80_000, 20  # of each kind
TIMING = Timing(20.0, 60.0, 50)
STEP_BEFORE = 20  # the first window after the step
STEP = 0.03
STABILITY_PCT = 0.5  # as stated
MAX_CHANGE_PCT = 10.0  # the step, and the difference of the sensor from its certificate
MAIN = [0, 4, 8]
KINDS: dict[str, Role | None] = {"none": None, "first reference": "reference", "second": "check", "sensor": "sensor"}
SENTENCES: dict[str, str] = {
    "reference": "the reference reference has changed",
    "check": "the reference check has changed",
    "sensor": "so the sensor has changed",
    "undecided": "whether the sensor or the reference",
}


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A run. `named`: the devices that a status named, "undecided" included. `errors` over u and `u_pct` (3,) are of
    the main sensitivities at the end. `used` of `windows`."""

    named: Sequence[str]
    errors: NDArray[np.float64]
    u_pct: NDArray[np.float64]
    windows: int
    used: int
    status: str


def one(job: tuple[Role | None, int, bool]) -> Judged:
    """A building whose faults are drawn from the stated uncertainties, with the step of one device, and the seed.

    The last part of `job` is whether the second reference is configured.
    """
    stepped, seed, both = job
    stated = Stated()
    drawn = node(seed, all_axes=True, stated=stated, timing=TIMING).building.parameters
    random = np.random.default_rng([seed, 21])
    vector = np.deg2rad(stated.rotation_deg) * random.standard_normal(3)
    angle = float(np.linalg.norm(vector))
    gains = np.diag(1 + stated.reference_pct / 100 * random.standard_normal(3))
    at_s = STEP_BEFORE * TIMING.every_s
    own: dict[str, object] = {"steps": ((at_s, STEP * drawn.sensitivity),)} if stepped == "sensor" else {}
    if stepped in ("reference", "check"):
        own = {"reference_steps": ((stepped, at_s, 1 + STEP),)}
    if both:
        own["check"] = BuildingDevice(0.001, Clock(RATE_HZ, 1e-4 * random.standard_normal(), 0.0007))
        own["check_sensitivity"] = gains @ rotation(vector / angle, angle)
    building = Building(replace(drawn, **own), seed)  # type: ignore[arg-type]
    keys = stated.keys()
    keys["certificate"]["stability_pct"] = STABILITY_PCT
    keys["gate"]["max_change_main_pct"] = MAX_CHANGE_PCT
    if both:
        keys["check_reference"] = {"device": "check", "certificate": keys["certificate"]}
    run = Run(building_config(building, **keys))
    named, windows, used, status = [], 0, 0, ""
    update: CalibrationUpdate | None = None
    for event in visits(building, range(TIMING.windows)):
        for result in run.feed(event):
            if isinstance(result, CalibrationUpdate):
                update = result
            elif isinstance(result, WindowReport):
                windows, used = windows + 1, used + result.used
            elif isinstance(result, StatusChange):
                status = result.status
                named += [name for name, sentence in SENTENCES.items() if sentence in result.reason]
    assert update is not None
    S, u = np.ravel(update.sensitivity)[MAIN], np.array(update.standard_uncertainty)[MAIN]
    true = building.truth(run.now_s).sensitivity.ravel()[MAIN]
    return Judged(named, (S - true) / u, 100 * u / S, windows, used, status)


def table(kinds: Sequence[tuple[str, Sequence[Judged]]]) -> str:
    """One row for each kind."""
    rows = [
        "| step of 3 % | runs | named: first reference, second, sensor, undecided | windows, used | status at the end "
        "| error / u: rms, largest | mean u of the main sensitivities |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, runs in kinds:
        counts = ", ".join(str(sum(run.named.count(device) for run in runs)) for device in SENTENCES)
        errors = np.array([run.errors for run in runs])
        ends = [run.status for run in runs]
        status = ", ".join(f"{end} {ends.count(end)}" for end in sorted(set(ends)))
        windows, used = (sum(each) for each in zip(*((run.windows, run.used) for run in runs), strict=True))
        rms, most = np.sqrt(np.mean(errors**2)), np.abs(errors).max()
        u_pct = float(np.mean([run.u_pct for run in runs]))
        row = (name, len(runs), counts, f"{windows}, {used}", status, f"{rms:.2f}, {most:.2f}", f"{u_pct:.3f} %")
        rows.append(f"| {' | '.join(str(part) for part in row)} |")
    return "\n".join(rows)
