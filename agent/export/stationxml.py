"""Epochs of the past as StationXML 1.2 of the FDSN: the sensitivity of each axis, for programs of seismology.

Written against its schema (fdsn-station-1.2.xsd). An InstrumentSensitivity has no place for an uncertainty. A
coefficient has one (plusError, minusError): so the response has one stage, whose gain is the sensitivity and whose only
coefficient is 1 with U over it. What the format cannot hold, transverse sensitivities and offset, is in comments.
"""

from __future__ import annotations

import datetime as dt
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from agent import __version__
from agent.config.whole_files import new_file
from agent.export.past import Made, SensorPast
from agent.export.samples import ExportError, RecordedContent
from agent.export.seismic import INDICATION, NETWORK, channel_code, station_code
from agent.export.smoothing import smoothing
from agent.terminal.text import one_line
from calib.estimate.correction import Law
from calib.model import PARAMETERS
from calib.output_unit import unit_text
from calib.rounding import plus_minus
from calib.state.past import REACH_DAYS

NAMESPACE, VERSION = "http://www.fdsn.org/xml/station/1", "1.2"
AXES = 3
UNITS = {"m/s2": "m/s**2"}  # as the FDSN writes it; others stand as they are
NO_XML = str.maketrans("", "", "\ufffe\uffff")  # characters that XML does not allow, beside those of `one_line`


@dataclass(frozen=True, slots=True)
class StationPlace:
    """Where the station is: latitude and longitude in degrees, elevation in m."""

    latitude_deg: float
    longitude_deg: float
    elevation_m: float


@dataclass(frozen=True, slots=True, eq=False)
class _Epoch:
    """S and Q of a device at `middle_ns`, by windows there or only around it, and the calibration in force then. It
    holds from `start_us` to `end_us` (us since 1970, UTC); None: until another is known."""

    one: SensorPast
    law: Law
    windows: int
    own: Made
    middle_ns: int
    start_us: int = 0
    end_us: int | None = None


def write_stationxml(
    path: Path, content: RecordedContent, found: Sequence[SensorPast], *, site: str, rate_hz: float, place: StationPlace
) -> int:
    """Write a channel for each axis and each epoch of the past of a sensor; `found`: that of its devices. Returns how
    many epochs there are. Raises ExportError where there are none, OSError.

    `site`: the name of the place, `rate_hz`: of the samples, which decides the channel's code as in MiniSEED.
    """
    epochs = _timed([epoch for one in found for epoch in _epochs(one)])
    if not epochs:
        why = "; ".join(one.why for one in found) or "no state is kept of it"
        raise ExportError(f"{path}: {content.device} has no past: {why}")
    ET.register_namespace("", NAMESPACE)
    root = ET.Element(_tag("FDSNStationXML"), schemaVersion=VERSION)
    _add(root, "Source", "fieldcal")
    _add(root, "Module", f"fieldcal {__version__}")
    _add(root, "Created", _time(max(one.known.last_window_utc_ns for one in found if one.known is not None) // 1000))
    start = _time(epochs[0].start_us)
    station = _add(_add(root, "Network", code=NETWORK), "Station", code=station_code(content.device), startDate=start)
    _comment(station, f"sensor {content.device}: each epoch by all windows before and after it")
    for one in found:
        if one.known is not None:
            _comment(station, f"smoothing of {one.identity}: {smoothing(one.known)}")
    _placed(station, place)
    _add(_add(station, "Site"), "Name", site)
    for axis in range(AXES):
        for epoch in epochs:
            _channel(station, axis, epoch, content.unit, rate_hz, place)
    ET.indent(root)
    with new_file(path) as file:
        file.write(ET.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n")
    return len(epochs)


def _epochs(one: SensorPast) -> list[_Epoch]:
    if one.known is None:
        return []
    known, past = one.known, one.known.past
    times = [known.utc_ns(day) for day in past.days.tolist()]
    return [_Epoch(one, *own) for own in zip(past.laws, past.windows, one.in_force, times, strict=True)]


def _timed(epochs: Sequence[_Epoch]) -> list[_Epoch]:
    """Those of all devices in order, each until the middle between it and the next one: none overlap, and there is no
    gap. An epoch without a window between windows of another device is left out."""
    epochs = sorted(epochs, key=lambda epoch: epoch.middle_ns)
    seen = [(epoch.middle_ns, epoch.one) for epoch in epochs if epoch.windows]
    times = [t for t, _ in seen]
    kept = []
    for epoch in epochs:
        k = bisect_left(times, epoch.middle_ns)
        if epoch.windows or all(one is epoch.one for _, one in seen[max(k - 1, 0) : k + 1]):
            kept.append(epoch)
    if not kept:
        return []
    ends = [(one.middle_ns + other.middle_ns) // 2000 for one, other in pairwise(kept)]
    first = kept[0].one.known
    assert first is not None
    starts = [first.utc_ns(first.past.begin - REACH_DAYS) // 1000, *ends]
    timed = (replace(e, start_us=a, end_us=b) for e, a, b in zip(kept, starts, [*ends, None], strict=True))
    return [epoch for epoch in timed if epoch.start_us != epoch.end_us]


def _channel(station: ET.Element, axis: int, epoch: _Epoch, unit: str, rate_hz: float, place: StationPlace) -> None:
    ends = {} if epoch.end_us is None else {"endDate": _time(epoch.end_us)}
    channel = _add(
        station, "Channel", code=channel_code(rate_hz, axis), startDate=_time(epoch.start_us), **ends,
        locationCode=INDICATION,
    )  # fmt: skip
    law, known = epoch.law, epoch.one.known
    assert known is not None
    k, main = known.past.coverage_factor, AXES * axis + axis
    _comment(channel, _parameters(axis, law, unit, k))
    force = "none was" if epoch.own is None else f"number {epoch.own[1]} of run {epoch.own[0]}"
    told = f"{epoch.windows} windows" if epoch.windows else "no window then, those before and after it"
    _comment(channel, f"by {told}; calibration in force then: {force}")
    _placed(channel, place)
    _add(channel, "Depth", "0.0")
    _add(channel, "SampleRate", repr(rate_hz))
    _add(_add(channel, "Sensor"), "Description", epoch.one.identity)
    S, u = float(law.mean[main]), float(np.sqrt(law.covariance[main, main]))
    response = _add(channel, "Response")
    if law.determined[main] and S:
        output = UNITS.get(unit, unit or unit_text(unit))
        _sensitivity(response, S, k * u / abs(S), known.reference_frequency_hz, rate_hz, output)


def _parameters(axis: int, law: Law, unit: str, k: float) -> str:
    """S and Q of an axis with U, also what no element can hold."""
    name, own = unit_text(unit), [*range(AXES * axis, AXES * axis + AXES), 9 + axis]
    u = np.sqrt(law.covariance.diagonal())
    units = [f"{name}/(m/s2)"] * AXES + [name]
    told = [
        f"{PARAMETERS[p]} = {plus_minus(float(law.mean[p]), k * float(u[p]))} {of}"
        if law.determined[p] else f"{PARAMETERS[p]} is not known"
        for p, of in zip(own, units, strict=True)
    ]  # fmt: skip
    x = "xyz"[axis]
    terms = " + ".join(f"S{x}{other} a{other}" for other in "xyz")
    return (
        f"V{x} = {terms} + Q{x}; {', '.join(told)}; U with k = {k:.3g}, at {law.reference_degc:g} degC; plusError and "
        f"minusError are U of S{x}{x} over S{x}{x}"
    )


def _sensitivity(response: ET.Element, S: float, U: float, at_hz: float, rate_hz: float, unit: str) -> None:
    """S at a frequency in `unit` per m/s2, and one stage with it; `U`: relative."""
    total = _add(response, "InstrumentSensitivity")
    stage = _add(response, "Stage", number="1")
    coefficients = _add(stage, "Coefficients")
    for of in (total, coefficients):
        if of is total:
            _gain(of, S, at_hz)
        for name, text in (("InputUnits", UNITS["m/s2"]), ("OutputUnits", unit)):
            _add(_add(of, name), "Name", text)
    _add(coefficients, "CfTransferFunctionType", "DIGITAL")
    _add(coefficients, "Numerator", "1.0", plusError=repr(U), minusError=repr(U))
    decimation = _add(stage, "Decimation")
    _add(decimation, "InputSampleRate", repr(rate_hz))
    for name, text in (("Factor", "1"), ("Offset", "0"), ("Delay", "0.0"), ("Correction", "0.0")):
        _add(decimation, name, text)
    _gain(_add(stage, "StageGain"), S, at_hz)


def _gain(of: ET.Element, S: float, at_hz: float) -> None:
    _add(of, "Value", repr(S))
    _add(of, "Frequency", repr(at_hz))


def _placed(of: ET.Element, place: StationPlace) -> None:
    _add(of, "Latitude", repr(place.latitude_deg))
    _add(of, "Longitude", repr(place.longitude_deg))
    _add(of, "Elevation", repr(place.elevation_m))


def _comment(of: ET.Element, text: str) -> None:
    _add(_add(of, "Comment"), "Value", text)


def _add(of: ET.Element, name: str, text: str = "", **attributes: str) -> ET.Element:
    made = ET.SubElement(of, _tag(name), attributes)
    made.text = one_line(text).translate(NO_XML) or None
    return made


def _tag(name: str) -> str:
    return f"{{{NAMESPACE}}}{name}"


def _time(t_us: int) -> str:
    """UTC, to a microsecond."""
    return f"{dt.datetime(1970, 1, 1) + dt.timedelta(microseconds=t_us):%Y-%m-%dT%H:%M:%S.%f}Z"
