"""The state of a device that is kept for later runs, and what a later run does with it.

S and Q owe their values to the reference, the mount and the stated uncertainties. So the state is kept as a whole when
the configuration changes: a changed prior is exchanged for the one before, a sensor that was mounted in another way may
have other angles, and what is known of the reference stays with that reference. Only a changed setting by which the
windows themselves were made makes the state invalid; the estimation then begins again from the prior. If the state
cannot be read, it begins again from the calibration in force, with a larger uncertainty because the covariance with the
reference is lost.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from agent.config import Channel
from agent.config.knowledge import Certificate, Prior
from agent.config.pose import Stop
from agent.config.section import Section
from agent.core.driver_filters import DriverFilters, alike
from agent.core.estimation import DAY_S, Estimation
from agent.core.events import CalibrationUpdate
from agent.core.memory import MOST_MEMORIES
from agent.core.outcome import calibration_of
from agent.core.schedule import pose_of
from agent.core.snapshot import pack, unpack
from calib.model import Pose

# Settings on which the meaning of a state depends. Walks (process), gate and drift settings may change at any time.
STATED = frozenset({"prior", "certificate", "uncertainty", "temperature", "gravity_mps2", "band_hz"})  # exchanged
MOUNT = frozenset(
    {"rotation", "rotation_gravity_mps2", "clamp_theta_deg", "poses", "positions", "fixed_mount", "check_rotation"}
)
WINDOWS = frozenset({"coupling", "static_sign"})  # by which windows are made, as is certificate.quantity
# Longest pause between two runs that is believed. A longer one means that a clock was wrong, and counts as no pause.
LONGEST_PAUSE_DAYS = 3650.0
OTHER_FILTERS = "other filters are stated, so that response and lag are found anew"
MALFORMED = (ValueError, KeyError, TypeError, AttributeError, IndexError)  # a state of other fields or shapes


@dataclass(frozen=True, slots=True, eq=False)
class KeptEstimation:
    """The estimation with which a later run begins. `in_force` is None if no calibration was in force. `reason` says
    how much of the kept state is used.

    `day`: the days that the estimation of the kept state had counted.
    `means`: the snapshot of a MeanWatch, of a sensor that had no reference either.
    `moved`: the calibration in force is another one now, because a changed setting changed S, Q or their uncertainty.
    """

    estimation: Estimation
    in_force: CalibrationUpdate | None
    day: float
    t_utc_ns: int
    reason: str
    moved: bool = False
    means: Mapping[str, Any] | None = None

    def first_day(self, t_utc_ns: int, now_s: float) -> float:
        """Days that the estimation has counted when the seconds of this run begin; now, `now_s` of them have passed."""
        pause_days = (t_utc_ns - self.t_utc_ns) * 1e-9 / DAY_S
        pause_days = pause_days if 0.0 <= pause_days <= LONGEST_PAUSE_DAYS else 0.0
        return self.day + pause_days - now_s / DAY_S


def keep(
    filters: DriverFilters,
    device: str,
    estimation: Estimation,
    in_force: CalibrationUpdate | None,
    nominal: float | None,
    day: float,
    t_utc_ns: int,
    means: Mapping[str, Any] | None = None,
) -> bytes:
    """The state for `take_up`, as bytes. `device` is the sensor, see agent.core.identity.device_of.

    `means`: the snapshot of a MeanWatch, of a sensor without a reference. The channel as it is configured and
    `nominal`, the sensitivity by the data sheet, are for `past_of`.
    """
    return pack(
        {
            "in_force": plain(in_force),
            "channel": filters.configured.model_dump_json(),
            "nominal": nominal,
            "basis": _basis(filters.configured),
            "filters": filters.snapshot(),
            "device": device,
            "estimation": estimation.snapshot(),
            "day": day,
            "t_utc_ns": t_utc_ns,
            "means": means,
        }
    )


def of_calibration(update: CalibrationUpdate) -> bytes:
    """The state for `take_up` where nothing but the calibration in force is left of it."""
    return pack({"in_force": plain(update), "device": "", "day": 0.0, "t_utc_ns": update.t_utc_ns})


def take_up(kept: bytes, filters: DriverFilters, nominal: float | None) -> KeptEstimation:
    """The estimation from the bytes of `keep`, as far as it is still valid. Raises ValueError as Estimation does.

    What the drivers stated of devices that have not been opened yet is taken over into `filters`.
    """
    configured = filters.configured
    try:
        state = unpack(kept)
        in_force, day, t_utc_ns = update_of(state["in_force"]), float(state["day"]), int(state["t_utc_ns"])
    except MALFORMED as error:
        reason = f"begun again from the prior: the stored state cannot be read: {_words(error)}"
        return KeptEstimation(Estimation(filters.channel, nominal), None, 0.0, 0, reason)
    if "estimation" not in state:
        return _from_in_force(state, in_force, filters.channel, nominal, day, t_utc_ns, "nothing else was left")
    if isinstance(held := state["estimation"], dict) and held.get("state", held) is None:
        why = "an earlier version of the program kept it"
        return _from_in_force(state, in_force, filters.channel, nominal, day, t_utc_ns, why)
    try:
        were = DriverFilters(_as_before(state["basis"], configured))
        were.load(state["filters"])
        filters.take({**were.by_device, **filters.by_device})
        fresh = Estimation(filters.channel, nominal)
        changed = _changed(state["basis"], configured)
        if configured.watched:
            return _kept_without_reference(state, fresh, in_force, were.channel, filters.channel, day, t_utc_ns)
        if wrong := _changed_settings(changed, state["basis"], configured):
            reason = f"begun again from the prior: windows were made with other settings: {', '.join(wrong)}"
            return KeptEstimation(fresh, None, day, t_utc_ns, reason)
        stated = fresh.state.result()
        fresh.load(state["estimation"])
        if "prior" in changed and (beyond := fresh.gate.anchor_at(stated, fresh.in_force)):
            reason = f"begun again from the prior: the calibration in force contradicts the changed prior: {beyond}"
            return KeptEstimation(Estimation(filters.channel, nominal), None, day, t_utc_ns, reason)
        size = _size(were.channel, filters.channel, fresh.state.reference_frequency_hz)
        gravity = _gravity(changed, state["basis"], configured)
        kept_state = fresh.state.copy()
        moved = fresh.restate(gravity, remounted=bool(MOUNT & changed), size=size)
    except MALFORMED as error:
        why = f"the stored state cannot be read: {_words(error)}"
        return _from_in_force(state, in_force, filters.channel, nominal, day, t_utc_ns, why)
    reason = "restored from the previous run"
    if changed:
        reason += f"; these settings have changed and were exchanged in the state: {', '.join(sorted(changed))}"
    if size is not None:
        reason += f"; {OTHER_FILTERS}"
    if settled := fresh.state.settled_since(kept_state):
        reason += f"; {settled}"
    return KeptEstimation(fresh, in_force, day, t_utc_ns, reason, moved)


def _kept_without_reference(
    state: Mapping[str, Any],
    fresh: Estimation,
    in_force: CalibrationUpdate | None,
    before: Channel,
    channel: Channel,
    day: float,
    t_utc_ns: int,
) -> KeptEstimation:
    """The estimation as it was. What is stated now of the reference, which is away, and of a mount does not matter;
    only other filters of the sensor make S another one."""
    fresh.load(state["estimation"])
    size = _size(before.model_copy(update={"certificate": channel.certificate}), channel,
                 fresh.state.reference_frequency_hz)  # fmt: skip
    if size is None:
        reason = "restored from the previous run"
        return KeptEstimation(fresh, in_force, day, t_utc_ns, reason, means=state.get("means"))
    moved = fresh.restate(None, remounted=False, size=size)
    return KeptEstimation(fresh, in_force, day, t_utc_ns, f"restored from the previous run; {OTHER_FILTERS}", moved)


def _from_in_force(
    state: Mapping[str, Any],
    in_force: CalibrationUpdate | None,
    channel: Channel,
    nominal: float | None,
    day: float,
    t_utc_ns: int,
    why: str,
) -> KeptEstimation:
    """The estimation begun from the calibration in force, because the rest of the state is lost or cannot be read."""
    fresh = Estimation(channel, nominal)
    if in_force is None:
        return KeptEstimation(fresh, None, day, t_utc_ns, f"begun again from the prior: {why}")
    try:
        fresh.gate.load(state["estimation"]["gate"])  # an operator's hold and the anchor stay
    except MALFORMED:
        refused = fresh.gate.rollback(calibration_of(in_force), "").refused
        fresh.gate.release("")
        if refused:
            reason = f"begun again from the prior: {why}; {refused}"
            return KeptEstimation(Estimation(channel, nominal), None, day, t_utc_ns, reason)
    fresh.roll_back(calibration_of(in_force), day)
    return KeptEstimation(fresh, in_force, day, t_utc_ns, f"begun again from the calibration in force: {why}")


def kept_as(kept: Mapping[str, bytes], identity: str, device: str) -> str:
    """The identity of the newest kept state of a sensor, with its present settings or with others of its filters; ""
    where there is none."""
    told = {name: device_and_time(state) for name, state in kept.items()}
    own = [name for name, (of, _) in told.items() if name == identity or of == device]
    return max(own, key=lambda name: told[name][1], default="")


def device_and_time(kept: bytes) -> tuple[str, int]:
    """The device of a kept state, and when it was kept (UTC, ns); "" and 0 where it cannot be read."""
    try:
        state = unpack(kept)
        return str(state["device"]), int(state["t_utc_ns"])
    except MALFORMED:
        return "", 0


def shelved(kept: Mapping[str, bytes], identity: str, memory: bytes) -> dict[str, bytes]:
    """`kept` with the state of one more device. If there are too many, the oldest state is dropped."""
    newest = {name: state for name, state in kept.items() if name != identity} | {identity: memory}
    return dict(list(newest.items())[-MOST_MEMORIES:])


def plain(update: CalibrationUpdate | None) -> dict[str, Any] | None:
    """The update in a form that a snapshot can hold."""
    return None if update is None else dict(msgspec.to_builtins(update))


def update_of(state: dict[str, Any] | None) -> CalibrationUpdate | None:
    """The update from the form that `plain` gave."""
    return None if state is None else msgspec.convert(state, CalibrationUpdate)


def _basis(channel: Channel) -> dict[str, str]:
    included = set(STATED | MOUNT | WINDOWS) - {"poses", "positions", "fixed_mount", "check_rotation"}
    stated = channel.model_dump(
        mode="json", include=included, exclude={"prior": {"calibrated"}}
    )  # a date moves nothing
    whole: dict[str, Any] = stated | {"fixed_mount": channel.fixed_mount}
    if channel.check_reference is not None:
        whole["check_rotation"] = channel.check_reference.rotation
    whole["poses"] = _by_position((pose_of(pose, channel), pose) for pose in channel.poses)
    stops = () if channel.positions == "free" else channel.positions
    whole["positions"] = _by_position(zip(channel.stops, stops, strict=True))
    return {name: msgspec.json.encode(value, order="deterministic").decode() for name, value in whole.items()}


def _changed_settings(changed: Iterable[str], before: Mapping[str, str], channel: Channel) -> list[str]:
    """Changed settings by which windows are made, or that give S another meaning: what was known tells nothing now."""
    found = sorted(WINDOWS.intersection(changed))
    frequency_hz = msgspec.json.decode(before["prior"]).get("reference_frequency_hz", 0.0)
    if frequency_hz != channel.prior.reference_frequency_hz:
        found.append("prior.reference_frequency_hz")
    quantity = msgspec.json.decode(before["certificate"]).get("quantity", channel.certificate.quantity)
    return found if quantity == channel.certificate.quantity else [*found, "certificate.quantity"]


def restated(
    estimation: Estimation, before: Channel, channel: Channel, nominal: float | None, told: str
) -> tuple[Estimation, str, bool]:
    """The estimation where the driver of a device that was opened states other filters than were known `before`.

    Also what the operator is told, besides `told`, and whether the calibration in force changed.
    """
    fresh = Estimation(channel, nominal)
    fresh.load(estimation.snapshot())
    if not fresh.state.windows:
        return fresh, told, fresh.restate(None, remounted=False)
    size = _size(before, channel, fresh.state.reference_frequency_hz)
    changed = fresh.restate(None, remounted=False, size=size)
    return fresh, "; ".join(filter(None, (told, OTHER_FILTERS))), changed


def _as_before(before: Mapping[str, str], channel: Channel) -> Channel:
    """The channel with the sections that state filters as they were in the configuration."""
    prior, certificate = (msgspec.json.decode(before[name]) for name in ("prior", "certificate"))
    stated = {"prior": Prior.model_validate(prior), "certificate": Certificate.model_validate(certificate)}
    return channel.model_copy(update=stated)


def _size(were: Channel, channel: Channel, frequency_hz: float) -> float | None:
    """By how much S at the frequency at which it holds changes where other filters and corners are known than before,
    as a factor; None if the same ones are known of all instruments."""
    if alike(were, channel):
        return None
    return _known_size(channel, frequency_hz) / _known_size(were, frequency_hz)


def _known_size(channel: Channel, frequency_hz: float) -> float:
    """S at a frequency contains the sensor's known filters. Corners are undone: that of a reference makes S smaller."""
    corners_hz = (channel.certificate.corner_hz, channel.prior.corner_hz)
    reference, sensor = (np.hypot(1.0, corner_hz / frequency_hz) if frequency_hz else 1.0 for corner_hz in corners_hz)
    return channel.known_filters.sensor_size(frequency_hz) * float(sensor / reference)


def _gravity(changed: Iterable[str], before: Mapping[str, str], channel: Channel) -> tuple[float, float] | None:
    """The stated local gravity before and now, if it changed."""
    if "gravity_mps2" not in changed:
        return None
    return float(msgspec.json.decode(before["gravity_mps2"])), channel.gravity_mps2


def _by_position(stances: Iterable[tuple[Pose, Stop]]) -> dict[str, list[str]]:
    """The stated orientations of the sensor, by the name of the position; their times do not matter."""
    found: dict[str, set[str]] = {}
    for pose, stop in stances:
        found.setdefault(pose.position, set()).add(stop.model_dump_json(exclude={"start_s", "stop_s"}))
    return {name: sorted(stated) for name, stated in found.items()}


def _changed(before: dict[str, str], channel: Channel) -> set[str]:
    """Settings that are not as they were. What a state of an earlier version does not name is taken as unchanged."""
    now = _basis(channel)
    return {
        name
        for name in before.keys() & now.keys()
        if before[name] != now[name]
        and not _same_mount(name, before, now)
        and not _same_section(before[name], getattr(channel, name, None))
    }


def _same_section(before: str, section: object) -> bool:
    """Whether a section is as it was; a field that an earlier version did not have counts with its default."""
    if not isinstance(section, Section):
        return False
    fields = type(section).model_fields.items()
    defaults = {name: field.default for name, field in fields if not field.is_required()}
    were = {**defaults, **msgspec.json.decode(before)}
    return bool(msgspec.json.decode(msgspec.json.encode(were)) == section.model_dump(mode="json"))


def _same_mount(name: str, before: dict[str, str], now: dict[str, str]) -> bool:
    """Whether positions were only added or removed: at least one is in both, and all that are in both are equal."""
    if name not in ("poses", "positions"):
        return False
    were, are = msgspec.json.decode(before[name]), msgspec.json.decode(now[name])
    stayed = were.keys() & are.keys()
    return bool(stayed) and all(were[position] == are[position] for position in stayed)


def _words(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
