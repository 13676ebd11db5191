"""What the metadata of a seismic station say of a calibration, and what a calibration says of the metadata."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np

from agent import __version__
from agent.config.files import read_file
from agent.config.whole_files import new_file
from agent.config.xml import check_xml
from agent.reading.source import TableError
from agent.reading.stationxml import LARGEST, StationChannel, import_obspy
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import Array
from calib.recorded.options import Options
from calib.recorded.outcome import Outcome
from calib.recorded.poses import DIRECTION, GRAVITY

IN_DIRECTION = 1e-3  # of a unit vector: what an axis that nobody moved may contribute


def coupling_of(components: Sequence[StationChannel]) -> Literal["dc", "ac"] | None:
    """The coupling of an instrument by its metadata, None without any."""
    if not components:
        return None
    return "dc" if all(c.feels_gravity for c in components) else "ac"


def frame_of(components: Sequence[StationChannel]) -> Array:
    """The axes (3, 3) of a sensor in east, north, up, row by row: a_sensor = F a_enu.

    They are those of its outputs by the metadata, made rectangular (polar decomposition) and right-handed: where the
    outputs are not, the third axis points against the third output. A sensor with one output three times has the axes
    east, north, up.
    """
    directions = np.array([c.direction for c in components])
    left, _, right = np.linalg.svd(directions)
    if len({c.seed_id for c in components}) < 3:
        return np.eye(3)
    frame = np.asarray(left @ right)
    return np.asarray(frame * np.array([[1.0], [1.0], [np.sign(np.linalg.det(frame))]]))


def by_metadata(options: Options, sensor: Sequence[StationChannel], reference: Sequence[StationChannel]) -> Options:
    """The options with the couplings and the rotation as the metadata of both instruments say."""
    rotation = options.rotation
    if rotation is None and sensor and len(reference) == 3:
        rotation = frame_of(sensor)
    coupling = coupling_of(sensor) or options.coupling
    beside = options.reference_coupling or coupling_of(reference)
    return replace(options, coupling=coupling, reference_coupling=beside, rotation=rotation)


def pose_of_station(
    sensor: Sequence[StationChannel], reference: Sequence[StationChannel], options: Options
) -> Mapping[str, float]:
    """The fields of the pose of a sensor beside a reference with three axes or one, from the metadata of both."""
    frame = frame_of(sensor)
    gravity = (frame @ (0.0, 0.0, options.gravity or STANDARD_GRAVITY_MPS2)).tolist()
    felt = dict(zip(GRAVITY, gravity, strict=True))
    if len(reference) == 3:
        return felt
    return dict(zip(DIRECTION, (frame @ reference[0].direction).tolist(), strict=True)) | felt


def compared(outcome: Outcome, components: Sequence[StationChannel]) -> list[dict[str, Any]]:
    """For each output: sensitivity, azimuth and dip as stated and as found with U, and which of them differ.

    Found values are None where the data do not tell them: orientation without motion in three directions, the azimuth
    of a vertical output.
    """
    return [] if outcome.calibration is None else [
        _compared(outcome, components[k], k, frame_of(components)) for k in _first_of_each(components)
    ]  # fmt: skip


def _first_of_each(components: Sequence[StationChannel]) -> list[int]:
    ids = [c.seed_id for c in components]
    return [ids.index(each) for each in dict.fromkeys(ids)]


def _compared(outcome: Outcome, component: StationChannel, k: int, frame: Array) -> dict[str, Any]:
    calibration = outcome.calibration
    assert calibration is not None
    components = slice(3 * k, 3 * k + 3)
    row, covariance = calibration.sensitivity[k], calibration.covariance[components, components]
    stated = {"azimuth_deg": component.azimuth_deg, "dip_deg": component.dip_deg}
    unit = f"counts/({component.unit.lower()})"
    told: dict[str, Any] = {"channel": component.seed_id, "from_s": component.from_s, "unit": unit}
    found: dict[str, tuple[float, float] | tuple[None, None]] = dict.fromkeys(_QUANTITIES, (None, None))
    if np.isfinite(row).all():
        g, C = frame.T @ row, frame.T @ covariance @ frame
        if component.sensitivity < 0.0:
            g = -g
        found |= {name: _with_u(quantity, g, C, outcome.coverage_factor) for name, quantity in _QUANTITIES.items()}
        if math.hypot(g[0], g[1]) < outcome.coverage_factor * math.sqrt(max(C[0, 0], C[1, 1])):
            found["azimuth_deg"] = (None, None)
    else:
        known = np.isfinite(row)
        direction = frame @ component.direction
        if known.any() and np.all(np.abs(direction[~known]) < IN_DIRECTION):
            weight = direction[known] / float(direction[known] @ direction[known])
            u = math.sqrt(weight @ covariance[np.ix_(known, known)] @ weight)
            found["sensitivity"] = (abs(float(row[known] @ weight)), outcome.coverage_factor * u)
    for name, value in {"sensitivity": abs(component.sensitivity), **stated}.items():
        at, expanded = found[name]
        away = 0.0 if at is None else at - value
        if name == "azimuth_deg":
            away = (away + 180.0) % 360.0 - 180.0
        differs = expanded is not None and abs(away) > expanded
        told[name] = {"stated": value, "found": at, "expanded_uncertainty": expanded, "differs": differs}
    return told


def _azimuth_deg(g: Array) -> float:
    return math.degrees(math.atan2(g[0], g[1])) % 360.0


def _dip_deg(g: Array) -> float:
    return -math.degrees(math.atan2(g[2], math.hypot(g[0], g[1])))


def _length(g: Array) -> float:
    return float(np.linalg.norm(g))


_QUANTITIES: dict[str, Callable[[Array], float]] = {
    "sensitivity": _length, "azimuth_deg": _azimuth_deg, "dip_deg": _dip_deg,
}  # fmt: skip


def _with_u(quantity: Callable[[Array], float], g: Array, C: Array, k: float) -> tuple[float, float]:
    """The quantity of `g` (3,) with covariance `C`, and its expanded uncertainty by central differences."""
    step = 1e-4 * _length(g)
    rise = [quantity(g + step * axis) - quantity(g - step * axis) for axis in np.eye(3)]
    slope = np.array([(r + 180.0) % 360.0 - 180.0 if quantity is _azimuth_deg else r for r in rise]) / (2 * step)
    return quantity(g), k * math.sqrt(slope @ C @ slope)


def differences(station: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line for each value of the metadata that differs from what was found by more than U."""
    return [
        f"{each['channel']}: {name} is {each[name]['found']:.6g} with U {each[name]['expanded_uncertainty']:.2g}, the "
        f"metadata say {each[name]['stated']:.6g}"
        for each in station for name in _QUANTITIES if each[name]["differs"]
    ]  # fmt: skip


def write_proposed(metadata: Path, to: Path, compared: Sequence[Mapping[str, Any]]) -> None:
    """Write the StationXML `metadata` to the new file `to` with sensitivity, first gain, azimuth and dip as found.

    A comment at each channel says what was stated before, and U. Raises TableError where `to` exists or cannot be made.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        obspy = import_obspy()
        inventory = obspy.read_inventory(BytesIO(check_xml(read_file(metadata, LARGEST))), format="STATIONXML")
        found = {(each["channel"], each["from_s"]): each for each in compared}
        for network in inventory:
            for station in network:
                for channel in station:
                    seed_id = f"{network.code}.{station.code}.{channel.location_code}.{channel.code}"
                    from_s = channel.start_date.timestamp if channel.start_date else 0.0
                    if told := found.get((seed_id, from_s)):
                        _propose(obspy, channel, told)
        try:
            with new_file(to) as file:
                inventory.write(file, format="STATIONXML")
        except FileExistsError:
            raise TableError(f"{to}: the file exists; remove it, or choose another name") from None
        except OSError as error:
            raise TableError(f"{to}: {error.strerror}") from None


def _propose(obspy: Any, channel: Any, told: Mapping[str, Any]) -> None:
    """Put what was found into a channel, and say in a comment what was there."""
    words = [
        f"{name} {each['found']:.9g}, U {each['expanded_uncertainty']:.2g}, before {each['stated']:.9g}"
        for name, each in ((name, told[name]) for name in _QUANTITIES) if each["found"] is not None
    ]  # fmt: skip
    sensitivity, azimuth, dip = (told[name]["found"] for name in _QUANTITIES)
    if sensitivity is not None:
        ratio = sensitivity / told["sensitivity"]["stated"]
        channel.response.instrument_sensitivity.value *= ratio
        if channel.response.response_stages:
            channel.response.response_stages[0].stage_gain *= ratio
    channel.azimuth = channel.azimuth if azimuth is None else azimuth
    channel.dip = channel.dip if dip is None else dip
    text = f"Proposed by fieldcal {__version__}: {'; '.join(words) or 'nothing was found'}"
    channel.comments.append(obspy.core.inventory.Comment(text))
