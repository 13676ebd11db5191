"""Simulated visits of a portable reference: is the promised U kept, and the time, and is each wrong clamp named?

    python -m benchmarks.visits [--visits 40] [--write]

Each visit has a sensor, a clamping and a reference of its own: S, the rotation of the clamp and the reference's
sensitivity are drawn from their stated uncertainties.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from agent.bench.capture import DeviceSamples
from agent.bench.clamp_words import findings
from agent.bench.kinds import mounted_stop, stated_options, write_prior
from agent.bench.measuring import Measuring, Record, StopInterval
from agent.bench.visiting import look_at
from agent.calibrate.stated import options_of
from agent.cli.leading import calibrate_options
from agent.config import Channel, parse_config
from benchmarks.page import machine, write_part
from calib.visit.next_stop import MAIN, WantedUncertainty
from hw.virtual.visits import RATE_HZ, REFERENCE, Clamped, Structure, StructureParameters

SENSOR = "sensor-1"
BURST = 32
U_MAIN, U_TRANSVERSE, U_TURNED_DEG, U_REFERENCE, U_OFFSET_MPS2 = 0.02, 0.01, 0.2, 0.001, 0.05
LEVELS_MPS2 = (0.3, 0.03)
LOOKED_S, MOST_S = 30.0, 180.0
WANTED_PCT = {0.3: 0.21, 0.03: 0.4}  # by level: reached after some minutes
TURNED_DEG = 5.0
EDGE_S = 1.0  # at both ends of a record


@cache
def _channel(u_transverse_pct: float) -> Channel:
    channel: dict[str, Any] = {
        "sensor": SENSOR, "reference": REFERENCE, "rotation": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        "prior": {
            "sensitivity": 1.0, "u_main_pct": 100.0 * U_MAIN, "u_transverse_pct": u_transverse_pct,
            "u_offset_mps2": U_OFFSET_MPS2,
        },
    }  # fmt: skip
    options = {"port": "none", "axes": 3, "rate_hz": RATE_HZ, "unit": "m/s2"}
    devices = [{"name": name, "driver": "serial-csv", "options": options} for name in (SENSOR, REFERENCE)]
    return parse_config({"devices": devices, "channels": [channel]}, "simulated visit").channels[0]


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """A structure with one sensor and a reference beside it, with what `fieldcal visit` measures by."""

    structure: Structure
    channel: Channel
    measuring: Measuring

    @classmethod
    def drawn(cls, seed: int, way: Clamped, level_mps2: float = 0.3, u_transverse: float = U_TRANSVERSE) -> Visit:
        """The visit of this number, clamped in this way."""
        parameters = StructureParameters(
            1, level_mps2, u_main=U_MAIN, u_transverse=u_transverse, u_offset_mps2=U_OFFSET_MPS2,
            u_turned_deg=U_TURNED_DEG, u_reference=U_REFERENCE,
        )  # fmt: skip
        channel = _channel(100.0 * u_transverse)
        with tempfile.TemporaryDirectory() as name:
            directory = Path(name)
            write_prior(channel, None, directory / "prior.json")
            measuring = Measuring(channel, options_of(calibrate_options(stated_options(channel, directory, ""))))
        return cls(Structure(parameters, seed, way), channel, measuring)

    def record(self, seconds: float) -> Record:
        """The samples of both devices as bursts bring them."""
        found = {}
        for k, name in enumerate((SENSOR, REFERENCE)):
            n = int(seconds * RATE_HZ) // BURST * BURST
            arrived = self.structure.clocks[k].times(0, n)[BURST - 1 :: BURST]
            found[name] = DeviceSamples(np.repeat(arrived, BURST), self.structure.values(k, 0, n), np.full(n, 20.0))
        return found

    def taken(self, seconds: float) -> StopInterval:
        """All of it but the ends."""
        return StopInterval(mounted_stop(self.channel), EDGE_S, seconds - EDGE_S)

    def relative_error(self, sensitivity: np.ndarray) -> np.ndarray:
        """(9,) errors of S over the main sensitivities."""
        S = self.structure.sensitivity[0]
        return ((sensitivity - S) / np.diag(S)[:, None]).ravel()


def kept(visits: int, level_mps2: float) -> str:
    """U over twice the RMS error, and the promised time over the time that it took, for clamps that are fine."""
    wanted = WantedUncertainty(WANTED_PCT[level_mps2] / 100.0, np.inf)
    errors, told, times = [], [], []
    for seed in range(visits):
        visit, seconds = Visit.drawn(seed, Clamped(), level_mps2), LOOKED_S
        first = look_at(visit.measuring, wanted, visit.record(seconds), visit.taken(seconds)).ahead
        while first is None:  # refused, since so short a record does not tell the response
            seconds += LOOKED_S
            first = look_at(visit.measuring, wanted, visit.record(seconds), visit.taken(seconds)).ahead
        later = first
        while later.needed_s > seconds - 2.0 * EDGE_S and seconds < MOST_S:
            seconds = min(1.15 * seconds, MOST_S)
            later = look_at(visit.measuring, wanted, visit.record(seconds), visit.taken(seconds)).ahead or later
        if seconds < MOST_S and later is not first:
            times.append(first.needed_s / (seconds - 2.0 * EDGE_S))
        outcome = visit.measuring.outcome(visit.record(seconds), [visit.taken(seconds)])
        assert outcome.calibration is not None
        errors.append(visit.relative_error(outcome.calibration.sensitivity))
        told.append(later.now)
    cells = []
    for group in (MAIN, ~MAIN):
        u = float(np.sqrt(np.mean(np.array(told)[:, group] ** 2)))
        twice = 2.0 * float(np.sqrt(np.mean(np.array(errors)[:, group] ** 2)))
        cells += [f"{100.0 * u:.3f}", f"{100.0 * twice:.3f}", f"{u / twice:.2f}"]
    span = f"{min(times):.2f} to {max(times):.2f} ({len(times)})" if times else "-"
    return f"| {1e3 * level_mps2:g} | {WANTED_PCT[level_mps2]:g} | " + " | ".join([*cells, span]) + " |"


def named(visits: int, u_transverse: float) -> list[str]:
    """How often each way to clamp was named as it was, and as something else."""
    axes = np.vstack([np.eye(3), -np.eye(3)])
    ways: dict[str, tuple[str, Clamped]] = {
        "fine": ("", Clamped()),
        f"turned {TURNED_DEG:g} deg": ("turned", Clamped()),
        "loose": ("loose", Clamped(loose=True)),
        "hardly any motion": ("little motion", Clamped(calm=True)),
    }
    lines = []
    for name, (kind, way) in ways.items():
        said: Counter[str] = Counter()
        for seed in range(visits):
            this = replace(way, turned_deg=TURNED_DEG * axes[seed % 6]) if kind == "turned" else way
            visit = Visit.drawn(seed, this, u_transverse=u_transverse)
            look = look_at(
                visit.measuring, WantedUncertainty(0.005, np.inf), visit.record(LOOKED_S), visit.taken(LOOKED_S)
            )
            said[", ".join(sorted(findings(look.clamp, SENSOR))) if look.clamp else "nothing seen"] += 1
        right = said.pop(kind, 0)
        rest = ", ".join(f"{count} {what or 'nothing'}" for what, count in said.items()) or "-"
        lines.append(f"| {100.0 * u_transverse:g} | {name} | {right} of {visits} | {rest} |")
    return lines


def figures(visits: int) -> Sequence[str]:
    """The lines of the page."""
    return [
        f"{visits} simulated visits in each line, {machine()}.\n",
        "| motion, mm/s² rms | wanted U, % | told, main, % | twice the RMS error | told / it | transverse, % "
        "| twice the RMS error | told / it | promised time / time taken (visits) |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        *(kept(visits, level) for level in LEVELS_MPS2),
        "",
        f"| transverse S known to, % | clamp | named so after {LOOKED_S:g} s | said otherwise |",
        "| --- | --- | --- | --- |",
        *named(visits, 0.01),
        *named(visits, 0.03),
    ]


def main() -> None:
    """Print the figures, or write them into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--visits", type=int, default=40)
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    text = "\n".join(figures(arguments.visits))
    if arguments.write:
        write_part("visits", text)
    else:
        print(text)


if __name__ == "__main__":
    main()
