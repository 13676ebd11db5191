"""Carries out the commands of an operator on an estimation."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import numpy as np
from pydantic import ValidationError

from agent.config import Channel, PoseInterval
from agent.core.estimation import Estimation
from agent.core.events import CalibrationUpdate, Command
from agent.core.gate import CommandEffect
from agent.core.outcome import calibration_of
from agent.core.schedule import pose_of
from calib.model import Pose


class CommandError(ValueError):
    """A command that cannot be carried out. The message says why."""


def answer(command: Command, estimation: Estimation, identity: str) -> tuple[CommandEffect, CalibrationUpdate | None]:
    """Carry out hold, accept or rollback: the answer of the gate and, after a rollback, the update whose calibration is
    in force again.

    `identity` is the identity of the device that is connected now. Raises CommandError if the arguments are wrong.
    """
    arguments, key = _arguments(command), command.key_id
    if command.verb == "hold":
        return (estimation.gate.release(key) if arguments.get("release") else estimation.gate.hold(key)), None
    earlier = None
    if command.verb == "accept":
        sequence = arguments.get("sequence")
        if not isinstance(sequence, int):
            raise CommandError(f"accept needs the sequence number of an estimate, not {sequence!r}")
        found = estimation.gate.accept(sequence, key)
    else:
        earlier = _earlier(command, identity)
        found = estimation.gate.rollback(calibration_of(earlier), key)
    if found.calibration is not None:
        (estimation.accept if earlier is None else estimation.roll_back)(found.calibration)
    return found, earlier


def _earlier(command: Command, identity: str) -> CalibrationUpdate:
    """The update in a rollback command. Raises CommandError if there is none, or if it belongs to another device."""
    try:
        update = msgspec.convert(_numbers(json.loads(command.calibration_json)), CalibrationUpdate)
        calibration = calibration_of(update)
    except ValueError as error:  # of json, of msgspec, and of numpy where rows differ in length
        raise CommandError(f"the command holds no calibration that can be read: {error}") from None
    if update.identity != identity:
        raise CommandError(f"calibration {update.sequence} belongs to {update.identity}, but this device is {identity}")
    shapes = (calibration.sensitivity.shape, calibration.offset.shape, calibration.covariance.shape)
    if shapes != ((3, 3), (3,), (12, 12)) or not np.isfinite(calibration.covariance).all():
        raise CommandError(
            f"calibration {update.sequence} is not complete: it must hold S, Q and a finite covariance of both"
        )
    return update


def commanded_pose(command: Command, channel: Channel) -> Pose:
    """The new pose of the sensor.

    Raises CommandError if the arguments do not describe a pose that the channel allows.
    """
    if channel.rotation is not None:
        raise CommandError(
            "the channel has a rotation to a tri-axial reference, so it takes no poses; change rotation instead"
        )
    if channel.fixed_mount:
        raise CommandError(
            "the configuration states a single pose, so the mount never turns; "
            "state further poses there to allow this one"
        )
    arguments = _arguments(command)
    position = arguments.pop("position", None)
    try:
        interval = PoseInterval(start_s=0.0, stop_s=1.0, **arguments)
        pose = pose_of(interval, channel)
    except (ValidationError, ValueError, TypeError) as error:
        raise CommandError(f"not a pose: {str(error).splitlines()[0]}") from None
    if channel.reference is None and pose.direction.shape[1] != 0:
        raise CommandError("a pose with a direction of motion needs a reference, but this channel has none")
    if channel.reference is not None and pose.direction.shape[1] == 0:
        raise CommandError(
            "gravity_mps2 alone states a rest, which is for a channel without a reference; add the direction of motion"
        )
    return pose if position is None else Pose(str(position), *_rest_of(pose))


def _rest_of(pose: Pose) -> tuple[Any, ...]:
    return pose.direction, pose.gravity_mps2, pose.theta_rad, pose.alpha_rad


def _arguments(command: Command) -> dict[str, Any]:
    try:
        held = json.loads(command.arguments_json)
    except ValueError as error:
        raise CommandError(f"the arguments are not JSON: {error}") from None
    if not isinstance(held, dict):
        raise CommandError(f"the arguments must be a JSON object, not {type(held).__name__}")
    return held


def _numbers(value: Any) -> Any:
    """Replaces null by NaN, which JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    return float("nan") if value is None else value
