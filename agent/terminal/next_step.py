"""What a person at the gateway can do next: one line for each sensor, from the configuration and what has happened."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from agent.config import Channel, Config
from agent.core.channel import REFUSED_IN_A_ROW
from agent.core.events import (
    IN_DRIVER,
    CalibrationUpdate,
    Command,
    DeviceChange,
    Estimate,
    Event,
    Result,
    StatusChange,
    WindowReport,
)
from agent.terminal.held import is_held
from agent.terminal.window_reasons import AS_BEFORE, known
from calib.geometry import AXES
from calib.model import Pose

STAY_S = 20  # in each position: a window then has more than ten seconds between its guards
UPRIGHT = 0.99  # share of gravity on one axis from which on this axis points up or down


@dataclass
class SensorProgress:
    """What has happened at one sensor in this run. `estimate`: number of an estimate that waits, 0 for none."""

    status: str = ""
    used: list[str] = field(default_factory=list)  # positions, each once
    newest: WindowReport | None = None
    refused: int = 0  # windows in a row; held ones are none
    estimate: int = 0
    on_hold: bool = False

    def take(self, result: Result) -> None:
        """Take a result of the sensor."""
        match result:
            case StatusChange():
                self.status = result.status
                # A restart dismisses held windows, so that a run which begins with HELD was put on hold.
                self.on_hold |= result.status == "HELD" and result.before == ""
            case WindowReport():
                self.newest = result
                self.refused = 0 if result.used or is_held(result) else self.refused + 1
                if result.used and result.position not in self.used:
                    self.used.append(result.position)
            case Estimate():
                self.estimate = result.sequence
            case CalibrationUpdate():
                self.estimate = 0

    def obey(self, command: Command, results: Sequence[Result]) -> None:
        """Take a command of an operator that was not refused, with what it led to."""
        if command.verb == "hold":
            self.on_hold = not json.loads(command.arguments_json).get("release", False)
        elif command.verb == "rollback":
            self.on_hold |= any(isinstance(result, CalibrationUpdate) for result in results)


class NextSteps:
    """Follows a run, and says what to do next at each sensor. `turns_itself`: a virtual bench, where nobody turns."""

    def __init__(self, config: Config, *, turns_itself: bool) -> None:
        self._channels = {channel.sensor: channel for channel in config.channels}
        self._seen = {sensor: SensorProgress() for sensor in self._channels}
        self._lost: dict[str, str] = {}  # why, by device
        self._commands, self._turns_itself = config.commands.enabled, turns_itself

    def update(self, event: Event, results: Sequence[Result]) -> dict[str, str]:
        """Take an event and its results. What to do next by sensor; none before a sensor has a status."""
        if isinstance(event, DeviceChange):
            self._lost.pop(event.device, None)
            if event.state == "lost":
                self._lost[event.device] = event.message
        elif isinstance(event, Command) and not event.refused:
            self._seen[event.sensor].obey(event, results)
        for result in results:
            self._seen[result.sensor].take(result)
        return {sensor: self._next(self._channels[sensor], seen) for sensor, seen in self._seen.items() if seen.status}

    def _of_lost(self, channel: Channel, seen: SensorProgress) -> str:
        """What to do about devices that are lost; "" where none is."""
        devices = [channel.sensor, *(c.reference for c in channel.by_reference if c.reference)]
        lost = [name for name in devices if name in self._lost]
        if faulty := [name for name in lost if self._lost[name].startswith(IN_DRIVER)]:
            return f"use another version of the driver of {' and '.join(faulty)}, and tell its author of the fault"
        if not lost and seen.status != "INVALID":
            return ""
        which = " and ".join(lost or devices[:1])
        return (
            f"check power and cable of {which}; its message names the fault. The agent tries again by itself, and "
            "`fieldcal doctor` names faults too"
        )

    def _next(self, channel: Channel, seen: SensorProgress) -> str:
        if lost := self._of_lost(channel, seen):
            return lost
        if seen.on_hold:
            return f"`fieldcal command hold --release --sensor {channel.sensor}` lets the agent use windows again"
        if seen.estimate and (seen.status == "HELD" or channel.gate.policy == "propose"):
            return self._accept(channel, seen.estimate)
        if seen.status == "HELD":
            return (
                f"{AS_BEFORE}; {channel.gate.confirm_windows} windows that "
                f"agree confirm a change, {channel.gate.dismiss_windows} that fit the calibration end HELD"
            )
        if channel.watched and not self._turns_itself:
            return self._watch(seen)
        if seen.refused >= REFUSED_IN_A_ROW:
            return _mend(seen)
        if seen.status == "RECALIBRATING":
            return "leave everything as it is: the next windows make the new calibration"
        if seen.status == "VALID":
            return self._improve(channel)
        return self._turn(channel, seen)

    def _accept(self, channel: Channel, estimate: int) -> str:
        if not self._commands:
            return "estimates wait for an operator: enable [commands] in the configuration to accept one, and restart"
        command = f"fieldcal command accept --sensor {channel.sensor} --sequence {estimate}"
        return f"if this change is real: `{command}`; if not, check mount and reference"

    @staticmethod
    def _watch(seen: SensorProgress) -> str:
        """Without a reference nothing calibrates the sensor here."""
        if seen.status == "VALID":
            return "nothing has to be done; without a reference U grows until the next visit (`fieldcal visit`)"
        return (
            "calibrate it at a bench or by a visit (`fieldcal bench`, `fieldcal visit`), and state its result in "
            "prior.file and the date in prior.calibrated; or name a reference"
        )

    def _improve(self, channel: Channel) -> str:
        if self._turns_itself:
            return "nothing; U becomes smaller with each window. Ctrl-C ends the run, and `fieldcal show` tells S and Q"
        more = "more motion makes" if channel.fixed_mount else "more positions make"
        return f"nothing has to be done; {more} U smaller. `fieldcal certificate` makes the certificate"

    def _turn(self, channel: Channel, seen: SensorProgress) -> str:
        if channel.gate.policy == "observe":
            return 'nothing: with policy = "observe" windows are reported, and no calibration comes into force'
        if self._turns_itself:
            return f"wait: the virtual bench turns by itself; positions used: {len(seen.used)}"
        if channel.rotation is not None:
            return "wait for motion in all three directions; nothing has to be turned"
        if channel.fixed_mount and channel.reference is not None:
            return "wait for motion; the configuration states one position, so nothing has to be turned"
        if channel.positions == "free":
            return f"turn the clamp to another alpha and stay {STAY_S} s; three are needed, {len(seen.used)} are used"
        return _next_stated(channel, seen) or "state further positions: those of the configuration are over"


def _mend(seen: SensorProgress) -> str:
    found = known(seen.newest.reason) if seen.newest else None
    return (
        found.do if found else "mend what the reason of the newest windows names: they are refused one after the other"
    )


def _next_stated(channel: Channel, seen: SensorProgress) -> str | None:
    """Which of the stated positions is next; None if the configuration states no further one."""
    if channel.poses:
        return _next_timed(channel, seen)
    stops = channel.stops
    if not stops:
        return "state positions, or rotation, in the configuration: without them no window tells S or Q"
    left = [stop for stop in stops if stop.position not in seen.used] or stops
    used = len(stops) - len(left) if left is not stops else len(stops)
    return f"{_instruction(left[0])} and stay {STAY_S} s (positions used: {used} of {len(stops)})"


def _next_timed(channel: Channel, seen: SensorProgress) -> str | None:
    """The next pose with times, first one that no window used; None after the last one."""
    after_s = seen.newest.stop_s if seen.newest else 0.0
    period_s = channel.poses_repeat_s
    if period_s is None:
        coming = [p for p in channel.poses if p.stop_s > after_s]
    else:
        coming = sorted(channel.poses, key=lambda p: (p.stop_s - after_s) % period_s)
    if not coming:
        return None
    feels_gravity = channel.coupling == "dc"
    stated = [(p, p.pose(channel.gravity_mps2, channel.static_sign, feels_gravity=feels_gravity)) for p in coming]
    interval, pose = next((each for each in stated if each[1].position not in seen.used), stated[0])
    again = f", and every {period_s:g} s again" if period_s else ""
    return (
        f"{_instruction(pose)}; the configuration states that position from {interval.start_s:g} to "
        f"{interval.stop_s:g} s after the first sample{again}"
    )


def _instruction(pose: Pose) -> str:
    """How a person takes a position: a rest on a face of the housing by the axis that points up, else by its name."""
    length = float(np.linalg.norm(pose.gravity_mps2))
    if pose.direction.shape[1] == 0 and length > 0:
        up = pose.gravity_mps2 / length
        k = int(np.argmax(np.abs(up)))
        if abs(up[k]) > UPRIGHT:
            return f"put the sensor down with its {'+' if up[k] > 0 else '-'}{AXES[k]} axis up"
    return f"turn the sensor to {pose.position}"
