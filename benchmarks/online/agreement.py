"""The same recordings through `fieldcal calibrate` and through the agent: both must say the same.

    python -m benchmarks.online agreement

Half of them are bench days (positions stated with their times), half are buildings that move on all axes. Every random
walk of the agent is 0, since `fieldcal calibrate` knows none; both get the same priors and cut the same pieces.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.config import Channel, Config
from agent.core.events import CalibrationUpdate, Event, StatusChange
from agent.core.schedule import pose_of
from benchmarks.online import bench
from benchmarks.online.clamp import bench_events
from benchmarks.online.node import Timing, node
from benchmarks.online.runner import Run, tick, visits
from calib.estimate.nuisances import Priors
from calib.excitation.front_end import Settings
from calib.excitation.window_verdict import Limits
from calib.geometry import beside
from calib.model import PARAMETERS, Array
from calib.recorded.adjusting import adjusted
from calib.recorded.outcome import Outcome
from calib.recorded.poses import PoseInterval
from calib.recorded.table import ReferenceTable, SensorTable
from calib.recorded.tables import Making, Tables
from hw.block import SampleBlock

SEED, RUNS = 1, 20  # of each kind
LIMIT_U = 0.06
STILL: dict[str, Any] = {
    "sensitivity_pct": 0.0, "offset_mps2": 0.0, "offset_rate_mps2": 0.0, "offset_rate_walk_mps2": 0.0,
    "tilt_deg": 0.0,
}  # fmt: skip
TIMING = Timing(20.0, 60.0, 12)
FREQUENCY_HZ = 3.0  # at which S holds: files would take the middle of all windows, the agent that of the first one


@dataclass(frozen=True, slots=True, eq=False)
class Both:
    """S and Q (12,) of the agent and of files, the latter's u, and which parameters both determined."""

    online: Array
    offline: Array
    u: Array
    determined: np.ndarray[Any, np.dtype[np.bool_]]
    windows: tuple[int, int]

    @property
    def apart(self) -> Array:
        """(12,) differences over u, NaN where not both determine the parameter."""
        return np.where(self.determined, np.abs(self.online - self.offline) / self.u, np.nan)


def bench_day(seed: int) -> Both:
    """A bench day whose positions are told with their times."""
    world = bench.world(seed, 200.0)
    duration_s = world.parameters.schedule.duration_s(bench.ROUNDS) + bench.AFTER_S
    recording = world.recording(duration_s)
    poses = [
        {"start_s": p.start_s, "stop_s": p.stop_s, "theta_deg": p.theta_deg, "alpha_deg": p.alpha_deg}
        for p in recording.poses
    ]
    config = bench.config(world, positions=(), poses=poses, process=STILL, gate={"least_determined": 1})
    return both(config, list(bench_events(world, recording)))


def building(seed: int) -> Both:
    """A building that moves on all axes, twelve visits of 20 s."""
    drawn = node(seed, all_axes=True, timing=TIMING)
    (channel,) = drawn.config.channels
    prior = channel.prior.model_copy(update={"reference_frequency_hz": FREQUENCY_HZ})
    config = drawn.config.model_copy(update={"channels": (channel.model_copy(update={"prior": prior}),)})
    return both(config, list(visits(drawn.building, range(TIMING.windows))))


def both(config: Config, events: Sequence[Event]) -> Both:
    """The same events through the pipeline and, as files, through the adjustment."""
    (channel,) = config.channels
    update, used = _online(config, events)
    sensor, reference = (_table(events, name) for name in (channel.sensor, channel.reference or ""))
    outcome = _offline(channel, sensor, reference)
    if outcome.calibration is None:
        raise ValueError("; ".join(outcome.reasons))
    found = outcome.calibration
    return Both(
        np.append(np.ravel(update.sensitivity), update.offset),
        np.append(found.sensitivity.ravel(), found.offset),
        found.standard_uncertainty,
        np.array(update.determined) & found.determined,
        (used, sum(w.used for w in outcome.windows)),
    )


def _online(config: Config, events: Iterable[Event]) -> tuple[CalibrationUpdate, int]:
    run, updates, said = Run(config), list[CalibrationUpdate](), ""
    used = 0
    for event in [*events, tick(1e5)]:
        for result in run.feed(event):
            if isinstance(result, CalibrationUpdate):
                updates.append(result)
                used = result.windows
            elif isinstance(result, StatusChange):
                said = result.reason
    run.close()
    if not updates:
        raise ValueError(f"no calibration: {said}")
    return updates[-1], used


def _table(events: Iterable[Event], device: str) -> tuple[Array, Array, float]:
    """Stamps (n,) as they arrived, values (n, m), and the time of the first sample as the agent has it."""
    blocks = [e for e in events if isinstance(e, SampleBlock) and e.device == device]
    stamps = np.concatenate([
        np.repeat(b.burst_t_monotonic_ns * 1e-9, np.diff(b.burst_count, prepend=0)) for b in blocks
    ])  # fmt: skip
    first = blocks[0]
    first_s = first.burst_t_monotonic_ns[0] * 1e-9 - int(first.burst_count[0]) / first.nominal_rate_hz
    return stamps, np.concatenate([b.indications for b in blocks]), float(first_s)


def _offline(channel: Channel, sensor: tuple[Array, Array, float], reference: tuple[Array, Array, float]) -> Outcome:
    """As `fieldcal calibrate` does once it has read its files."""
    stamps, values, first_s = sensor
    if channel.rotation is not None:
        rows = [channel.rotation[i : i + 3] for i in (0, 3, 6)]
        pose, starts = (
            beside(rows, channel.rotation_gravity_mps2),
            first_s + channel.every_s * np.arange(TIMING.windows),
        )
        poses = [PoseInterval(s, s + channel.window_s + 2.0 * channel.guard_s, pose) for s in starts.tolist()]
    else:
        poses = [PoseInterval(first_s + p.start_s, first_s + p.stop_s, pose_of(p, channel)) for p in channel.poses]
    mean = channel.prior.mean(1.0)
    u = channel.prior.standard_uncertainty(mean)
    priors = Priors(channel.priors(fixed_mount=channel.fixed_mount).values, mean, np.diag(u**2))
    settings = Settings(Limits.of(priors.offset_mps2, priors.angle_rad, channel.window_s), bands=True)
    files = Tables(
        SensorTable("sensor", stamps, values, None),
        ReferenceTable("reference", reference[0], reference[1], "acceleration", "a"),
        poses, channel.instrument, Making(settings, guard_s=channel.guard_s),
    )  # fmt: skip
    return adjusted(files, priors)


def table(found: Sequence[Both], kind: str) -> str:
    """The worst of all recordings of a kind, and whether it is within the limit."""
    apart = np.array([one.apart for one in found])
    told = int(np.isfinite(apart).sum())
    worst = np.unravel_index(int(np.nanargmax(apart)), apart.shape)
    windows = np.array([one.windows for one in found])
    return (
        f"| {kind} | {len(found)} | {windows[:, 0].sum()} / {windows[:, 1].sum()} | {told} "
        f"| {np.nanmax(apart):.3f} ({PARAMETERS[worst[1]]}) | {np.sqrt(np.nanmean(apart**2)):.3f} |"
    )


HEADER = (
    "| recordings | number | windows used, agent / files | parameters compared | worst difference / u | rms / u |\n"
    "| --- | --- | --- | --- | --- | --- |"
)
