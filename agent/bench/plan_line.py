"""What a plan of the stated positions says to people, and what is missing for a first calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.bench.planned import Planned, angles_deg, if_in_radians, missing_stops, plan_of, states_positions
from agent.bench.session import START
from agent.bench.stops import GRAVITY, BenchStop
from agent.config import Channel, Config
from agent.config.names import Told
from agent.setup.contradictions import contradictions, nominal_of
from agent.setup.device_checks import loaded_options
from calib.visit.next_stop import MAIN
from hw.sensor import Options

DIRECTION = ("dx", "dy", "dz")  # columns of poses.csv


@dataclass(frozen=True, slots=True, eq=False)
class ChannelPlan:
    """The plan of one channel; `plan` is None where there is none.

    `faults`: why no first calibration comes of it. `unplaced`: that no position is stated, as for `fieldcal bench`.
    `watched`: which calibration is in force where the sensor has neither reference nor position; else "".
    """

    sensor: str
    plan: Planned | None = None
    faults: tuple[Told, ...] = ()
    unplaced: tuple[Told, ...] = ()
    watched: str = ""

    @property
    def line(self) -> str:
        """The plan in a line, or that the sensor is watched; "" where there is neither."""
        if self.plan is None:
            return self.watched
        main, transverse, offset = self._worst(self.plan)
        rest = f" ({', '.join(self.plan.missing)} stay as the prior states them)" if self.plan.missing else ""
        return (
            f"{self.sensor}: the stated positions determine {self.plan.count} of 12 parameters{rest}; U (k = 2) once "
            f"each was taken: main {main:.2g} %, transverse {transverse:.2g} %, offset {offset:.2g} m/s2, without the "
            f"reference's own, with motion of {START.rms_mps2:g} m/s2 rms"
        )

    @property
    def json(self) -> dict[str, Any] | None:
        """The members of the JSON object; None where there is no plan."""
        if self.plan is None:
            return None
        main, transverse, offset = self._worst(self.plan)
        return {
            "sensor": self.sensor, "determined": self.plan.count, "needed": self.plan.needed,
            "missing": self.plan.missing, "expanded_u_main_pct": main, "expanded_u_transverse_pct": transverse,
            "expanded_u_offset_mps2": offset,
        }  # fmt: skip

    @staticmethod
    def _worst(plan: Planned) -> tuple[float, float, float]:
        S, Q = 100.0 * plan.expanded[:9], plan.expanded[9:]
        return float(S[MAIN].max()), float(S[~MAIN].max()), float(Q.max())


def shortcomings(config: Config) -> tuple[list[Told], list[ChannelPlan]]:
    """Why nothing sound is calibrated as it is stated, and the plans of the channels.

    Where statements contradict each other or the devices, nothing is planned.
    """
    options = loaded_options(config)
    if found := list(contradictions(config, options)):
        return found, []
    made = _plans(config, options)
    return [fault for one in made for fault in one.faults], made


def _plans(config: Config, options: Mapping[str, Options]) -> list[ChannelPlan]:
    drivers = {device.name: device.driver for device in config.devices}
    return [
        _plan_of(i, channel, nominal_of(drivers[channel.sensor], channel.sensor, options[channel.sensor]), config)
        for i, channel in enumerate(config.channels)
    ]


def _plan_of(i: int, channel: Channel, nominal: float | None, config: Config) -> ChannelPlan:
    if channel.watched:
        return ChannelPlan(channel.sensor, watched=_watch_line(channel))
    if not states_positions(channel):
        told = channel.positions == "free" or _may_be_turned(config, channel)
        return ChannelPlan(channel.sensor, unplaced=() if told else (_no_position(i, channel),))
    try:
        found = plan_of(channel, nominal)
    except ValueError as error:
        return ChannelPlan(channel.sensor, faults=((("channels", i, "prior", "sensitivity"), str(error)),))
    if found.enough or _may_be_turned(config, channel):
        return ChannelPlan(channel.sensor, found)
    place = next(name for name in ("rotation", "poses", "positions") if getattr(channel, name))
    what = (
        f"determine {found.count} of 12 parameters ({', '.join(found.missing)} are not), and the first calibration of "
        f"{channel.sensor} needs {found.needed}"
    )
    if found.unseen is not None:
        axis = ", ".join(f"{x:.2f}" for x in np.round(found.unseen, 2) + 0.0)
        what += f": nothing is felt to change along ({axis}) of the sensor"
    return ChannelPlan(channel.sensor, found, ((("channels", i, place), f"{what}; {_remedy(channel, nominal)}"),))


def _watch_line(channel: Channel) -> str:
    dated = f"in force is that of {channel.prior.calibrated}, and its U grows from then on"
    undated = "in force is what an earlier run has kept; state that of a visit in prior.file and prior.calibrated"
    return f"{channel.sensor}: no reference: watched; {dated if channel.prior.calibrated else undated}"


def _no_position(i: int, channel: Channel) -> Told:
    return ("channels", i), (
        f"no position of {channel.sensor} is stated, so that `fieldcal run` cannot calibrate it; state poses (with "
        "times) or positions, or rotation beside a reference with three axes; only `fieldcal bench` and `fieldcal "
        "visit` need none"
    )


def _may_be_turned(config: Config, channel: Channel) -> bool:
    """Whether an operator may tell further positions while the agent runs."""
    keys = config.commands.keys if config.commands.enabled and not channel.fixed_mount else ()
    return any("pose" in key.verbs and {channel.sensor, "*"} & set(key.sensors) for key in keys)


def _remedy(channel: Channel, nominal: float | None) -> str:
    """What makes the plan enough."""
    in_degrees = if_in_radians(channel)
    if in_degrees is not None and plan_of(in_degrees, nominal).enough:
        angles = [f"theta_deg = {t:.4g}, alpha_deg = {a:.4g}" for t, a in angles_deg(in_degrees)]
        return f"the angles seem to be in radians; state degrees: {'; '.join(angles[:3])}{' ...' if angles[3:] else ''}"
    if any(one.direction is not None and one.gravity_mps2 is None for one in channel.poses):
        return "state gravity_mps2 beside each direction, or with gate.least_determined how many are enough"
    if stops := missing_stops(channel, nominal):
        return f"add {' and '.join('{ ' + _position_text(stop) + ' }' for stop in stops)}"
    return "state with gate.least_determined how many are enough, or smaller uncertainties in prior"


def _position_text(stop: BenchStop) -> str:
    """A position as the configuration states it, without times."""
    held = stop.columns
    if "theta_deg" in held:
        return f"theta_deg = {held['theta_deg']:g}, alpha_deg = {held['alpha_deg']:g}"
    vectors = {"direction": DIRECTION, "gravity_mps2": GRAVITY}
    told = {name: [f"{held[column]:.6g}" for column in axes] for name, axes in vectors.items() if axes[0] in held}
    return ", ".join(f"{name} = [{', '.join(values)}]" for name, values in told.items())
