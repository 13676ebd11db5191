"""What an operator's commands do to an estimation."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import numpy as np
from pydantic import ValidationError

from agent.config import Channel, PoseInterval
from agent.core.estimation import Estimation
from agent.core.events import CalibrationUpdate, Command
from agent.core.gate import Answer
from agent.core.outcome import calibration_of
from agent.core.schedule import pose_of
from calib.model import Pose


class CommandError(ValueError):
    """A command that makes no sense; the message says why."""


def answer(command: Command, estimation: Estimation, identity: str) -> tuple[Answer, CalibrationUpdate | None]:
    """The gate's answer to hold, accept or rollback, carried out. Raises CommandError on what no gate understands.

    `identity` is the device's that is there now. With a rollback, the update whose calibration is in force again.
    """
    arguments, key = _arguments(command), command.key_id
    if command.verb == "hold":
        return (estimation.gate.release(key) if arguments.get("release") else estimation.gate.hold(key)), None
    earlier = None
    if command.verb == "accept":
        sequence = arguments.get("sequence")
        if not isinstance(sequence, int):
            raise CommandError(f"accept needs the sequence of an estimate, not {sequence!r}")
        found = estimation.gate.accept(sequence, key)
    else:
        earlier = _earlier(command, identity)
        found = estimation.gate.rollback(calibration_of(earlier), key)
    if found.calibration is not None:
        estimation.put(found.calibration)
    return found, earlier


def _earlier(command: Command, identity: str) -> CalibrationUpdate:
    """The update that a rollback carries. Raises CommandError where it is none, or another device's."""
    try:
        update = msgspec.convert(_numbers(json.loads(command.calibration_json)), CalibrationUpdate)
        calibration = calibration_of(update)
    except ValueError as error:  # of json, of msgspec, and of numpy where rows differ in length
        raise CommandError(f"rollback carries no calibration: {error}") from None
    if update.identity != identity:
        raise CommandError(f"calibration {update.sequence} belongs to {update.identity}, this is {identity}")
    shapes = (calibration.sensitivity.shape, calibration.offset.shape, calibration.covariance.shape)
    if shapes != ((3, 3), (3,), (12, 12)) or not np.isfinite(calibration.covariance).all():
        raise CommandError(f"calibration {update.sequence} is not whole: S, Q and a finite covariance of both")
    return update


def commanded_pose(command: Command, channel: Channel) -> Pose:
    """How the sensor stands from now on. Raises CommandError where the arguments are none of a pose."""
    if channel.rotation is not None:
        raise CommandError("a sensor beside a tri-axial reference stands as rotation says; it takes no poses")
    if channel.fixed_mount:
        raise CommandError("the configuration states a single pose, so a mount that never turns; it takes no other")
    arguments = _arguments(command)
    position = arguments.pop("position", None)
    try:
        interval = PoseInterval(start_s=0.0, stop_s=1.0, **arguments)
        pose = pose_of(interval, channel)
    except (ValidationError, ValueError, TypeError) as error:
        raise CommandError(f"not a pose: {str(error).splitlines()[0]}") from None
    if channel.reference is None and pose.direction.shape[1] != 0:
        raise CommandError("a pose with a direction needs a reference, which this channel has not")
    if channel.reference is not None and pose.direction.shape[1] == 0:
        raise CommandError("a rest (gravity_mps2 alone) is for a channel without a reference")
    return pose if position is None else Pose(str(position), *_rest_of(pose))


def _rest_of(pose: Pose) -> tuple[Any, ...]:
    return pose.direction, pose.gravity_mps2, pose.theta_rad, pose.alpha_rad


def _arguments(command: Command) -> dict[str, Any]:
    try:
        held = json.loads(command.arguments_json)
    except ValueError as error:
        raise CommandError(f"arguments are no JSON: {error}") from None
    if not isinstance(held, dict):
        raise CommandError(f"arguments must be an object, not {type(held).__name__}")
    return held


def _numbers(value: Any) -> Any:
    """JSON has null where a number is none."""
    if isinstance(value, dict):
        return {key: _numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    return float("nan") if value is None else value
