"""Meetings in recordings of gateways: each channel beside its reference, the devices known by their identity.

The configuration in a recording states what `fieldcal calibrate` gets by options. Recordings of one sensor beside one
reference with the same statements are one mounting, so they become one link.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.calibrate.faults import as_table_error
from agent.config import Channel
from agent.config.recorded import recorded_config
from agent.core.driver_filters import DriverFilters
from agent.core.events import DeviceChange, RunStart
from agent.core.identity import identity_of, nominal_of, not_certified
from agent.core.schedule import pose_beside, pose_of
from agent.fleet.meeting import Meeting, meeting
from agent.reading.formats import open_source
from agent.reading.recording import end_of
from agent.reading.source import TableError
from agent.recording.reading import RecordingReader, first_event
from agent.terminal.text import say
from calib.estimate.nuisances import Priors
from calib.estimate.quantities import YEAR_DAYS
from calib.excitation.front_end import Settings
from calib.excitation.window_verdict import Limits
from calib.model import Array
from calib.recorded.poses import PoseInterval
from calib.recorded.table import ReferenceTable, SensorTable
from calib.recorded.tables import Making, Tables
from calib.site_adjustment.device import SiteDevice

YEAR_S = YEAR_DAYS * 86400.0


@dataclass(frozen=True, slots=True, eq=False)
class RecordedChannel:
    """A channel of a recording: identities, tables, priors with what is known of S and Q, and why it is not used."""

    sensor: str
    reference: str
    channels: int  # of the reference
    priors: Priors
    gravity_mps2: float
    tables: Tables | None
    reason: str = ""


def _starts(paths: Sequence[Path]) -> Iterator[tuple[Path, RunStart]]:
    """The recordings with their first events. Raises TableError, also where one is given twice."""
    starts: dict[tuple[str, int], Path] = {}
    for path in paths:
        start = first_event(path)
        if start is None:
            raise TableError(f"{path}: this is no recording of fieldcal")
        other = starts.setdefault((start.run_id, start.file_sequence), path)
        if other is not path:
            raise TableError(f"{path}: this is the same recording as {other}; give each recording once")
        yield path, start


def meetings_in(paths: Sequence[Path]) -> tuple[list[SiteDevice], list[Meeting]]:
    """The devices and meetings of recordings. Raises TableError."""
    found = [one for path, start in _starts(paths) for one in _channels(path, start)]
    together: dict[tuple[str, str], list[RecordedChannel]] = {}
    for one in found:
        together.setdefault((one.sensor, one.reference), []).append(one)
    _check_gravity(found)
    meetings, devices = [], dict[str, SiteDevice]()
    sensors = {one.sensor for one in found if one.tables is not None}
    for (sensor, reference), own in together.items():
        usable = [one for one in own if one.tables is not None]
        tables = [one.tables for one in usable if one.tables is not None]
        first = next(iter(usable), own[0])
        reason = first.reason
        if reference in sensors:
            reason = f"{reference} is a sensor of another channel too; describe such a site in a TOML file"
        if reason:
            meetings.append(Meeting(sensor, reference, None, (reason,), 0, 0, 0, 0.0))
            continue
        meetings.append(meeting(sensor, reference, tables, first.priors))
        mean, covariance = first.priors.parameters, first.priors.covariance
        assert mean is not None
        assert covariance is not None
        devices.setdefault(sensor, SiteDevice.with_covariance(sensor, mean, covariance))
        devices.setdefault(reference, SiteDevice.reference(reference, first.priors.reference, first.channels))
    return list(devices.values()), meetings


def _check_gravity(found: Sequence[RecordedChannel]) -> None:
    """Raise TableError where the recordings state several values."""
    if len(gravities := {one.gravity_mps2 for one in found}) > 1:
        raise TableError(
            f"the recordings state different gravity ({', '.join(f'{g:g}' for g in sorted(gravities))} m/s2), so they "
            "are not of one site; adjust them apart"
        )


def _channels(path: Path, start: RunStart) -> Iterator[RecordedChannel]:
    try:
        config = recorded_config(start.config_json)
    except (ValueError, OverflowError) as error:
        raise TableError(f"{path}: its configuration cannot be read: {error}") from None
    reader = RecordingReader(path)
    infos = {
        step.event.device: step.event.info_json
        for step in reader.steps()
        if isinstance(step.event, DeviceChange) and step.event.info_json
    }
    for line in end_of(reader):
        say(line, err=True)
    for channel in config.channels:
        filters = DriverFilters(channel)
        for device, info_json in infos.items():
            filters.hear(device, json.loads(info_json))
        for beside in filters.channel.by_reference:
            yield _recorded(path, start, beside, infos)


def _recorded(path: Path, start: RunStart, channel: Channel, infos: dict[str, str]) -> RecordedChannel:
    names = [identity_of(infos[n]) if n in infos else n or "" for n in (channel.sensor, channel.reference)]
    priors = channel.priors(fixed_mount=channel.fixed_mount)
    reason = _unusable(start, channel, infos)
    if reason:
        return RecordedChannel(names[0], names[1], 0, priors, channel.gravity_mps2, None, f"{path}: {reason}")
    assert channel.reference is not None
    mean = channel.prior.mean(nominal_of(json.loads(infos[channel.sensor])))
    u = channel.prior.standard_uncertainty(mean)
    u_reference = float(np.hypot(priors.reference, _drifted(start, channel)))
    stated = priors.with_values({"reference": u_reference, "reference_drift": 0.0})
    stated = replace(stated, parameters=mean, covariance=np.diag(u**2))
    sensor, reference = (_table(path, name) for name in (channel.sensor, channel.reference))
    settings = Settings(Limits.of(priors.offset_mps2, priors.angle_rad, channel.window_s), bands=True)
    name, quantity = str(path), channel.instrument.quantity
    with as_table_error():
        tables = Tables(
            SensorTable(name, sensor[:, 0], sensor[:, 1:4]),
            ReferenceTable(name, reference[:, 0], reference[:, 1:], quantity, channel.reference),
            list(_intervals(channel, sensor[:, 0])),
            channel.instrument,
            Making(settings, guard_s=channel.guard_s),
        )
    return RecordedChannel(names[0], names[1], reference.shape[1] - 1, stated, channel.gravity_mps2, tables)


def _unusable(start: RunStart, channel: Channel, infos: dict[str, str]) -> str:
    """Why no link is made of a channel; "" where one is."""
    if channel.reference is None:
        return f"{channel.sensor} has no reference"
    missing = [name for name in (channel.sensor, channel.reference) if name not in infos]
    if missing:
        return f"{missing[0]} was not opened in this recording; give the recording in which its run began too"
    if channel.positions:
        return f"the positions of {channel.sensor} were found from gravity; only stated poses, or a rotation, are used"
    if channel.poses and start.continuation:
        return f"the poses of {channel.sensor} count from the begin of the run; give the first recording of the run"
    return not_certified(infos[channel.reference], channel.certificate)


def _drifted(start: RunStart, channel: Channel) -> float:
    """Standard uncertainty by which the reference may have drifted since its certificate."""
    dated = channel.certificate.date
    years = 0.0 if dated is None else max(start.t_utc_ns * 1e-9 - dated.timestamp(), 0.0) / YEAR_S
    return float(channel.certificate.stability_pct / 100.0 * np.sqrt(years))


def _table(path: Path, device: str) -> Array:
    """Time and axes (n, 2 or 4) of a device."""
    with open_source(path) as source:
        columns = [c for c in source.columns if c.group == device and c.name != "temperature_degc"]
        if not columns:
            raise TableError(f"{path}: there are no samples of {device}")
        return np.concatenate(list(source.pieces(columns, None)))


def _intervals(channel: Channel, time_s: Any) -> Iterator[PoseInterval]:
    first_s, last_s = float(time_s[0]), float(time_s[-1])
    if channel.rotation is not None:
        yield PoseInterval(first_s, last_s, pose_beside(channel.rotation, channel))
        return
    for cycle in itertools.count() if channel.poses_repeat_s else (0,):
        base_s = first_s + cycle * (channel.poses_repeat_s or 0.0)
        if base_s >= last_s:
            return
        for pose in channel.poses:
            if base_s + pose.start_s < last_s:
                stop_s = min(base_s + pose.stop_s, last_s)
                yield PoseInterval(base_s + pose.start_s, stop_s, pose_of(pose, channel))
