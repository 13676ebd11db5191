"""The result of `fieldcal fleet adjust`: one JSON object, a file for each sensor, and text for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from agent import __version__
from agent.config.whole_files import write_whole
from agent.fleet.adjusting import Adjusted
from agent.terminal.text import say
from calib.model import Array
from calib.recorded.outcome import plain
from calib.rounding import plus_minus
from calib.site_adjustment.contradiction import FALSE_ALARM, DeviceVerdict
from calib.site_adjustment.link import GRAVITY_NAME

METHOD = "site adjustment"


def reasons(found: Adjusted) -> list[str]:
    """Why the result is refused; empty if no device contradicts the others."""
    if not found.suspects:
        return []
    bad = found.suspects[0]
    if len(found.suspects) > 1:
        names = " and ".join(v.device for v in found.suspects)
        return [
            f"{names} contradict each other (chi-squared {bad.statistic:.4g}, {bad.degrees_of_freedom:.3g} degrees of "
            f"freedom, probability {bad.probability:.2g}, limit {FALSE_ALARM:g}), and the links do not tell which "
            "of them is wrong; let a sensor that met them meet another reference too"
        ]
    what = "indicates otherwise than its certificate says" if bad.is_reference else "is not the same in all its links"
    what = "is not what was stated" if bad.device == GRAVITY_NAME else what
    return [
        f"{bad.device} contradicts the other devices: it {what}{_size(found, bad)} (chi-squared {bad.statistic:.4g}, "
        f"{bad.degrees_of_freedom:.3g} degrees of freedom, probability {bad.probability:.2g}, limit {FALSE_ALARM:g}); "
        "check it, or leave it out of the site and adjust again"
    ]


def _size(found: Adjusted, bad: DeviceVerdict) -> str:
    if not bad.is_reference or bad.device == GRAVITY_NAME:
        return ""
    worst = int(np.argmax(np.abs(bad.bias[[0, 4, 8]])))
    main = found.site.devices[bad.device].mean[[0, 4, 8]][worst]
    return f", in axis {'xyz'[worst]} by {100.0 * bad.bias[[0, 4, 8]][worst] / main:+.3g} %"


def as_object(found: Adjusted, between: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """The members of the JSON object of docs/site.md."""
    refused = reasons(found)
    return {
        "status": "refused" if refused else "valid",
        "reasons": refused,
        "devices": {name: device_object(found, name) for name in found.linked},
        "gravity_error": _gravity(found),
        "contradicts": [v.device for v in found.suspects],
        "false_alarm_probability": FALSE_ALARM,
        "tests": [_test(verdict) for verdict in found.tests],
        "links": [
            {
                "sensor": m.sensor,
                "reference": m.reference,
                "used": m.found is not None,
                "reasons": list(m.reasons),
                "windows": m.windows,
                "windows_used": m.used,
            }
            for m in found.meetings
        ],
        "between": [
            {"devices": list(pair), "covariance": found.site.covariance(*pair)} for pair in between
        ],
        "version": __version__,
        "method": METHOD,
    }  # fmt: skip


def device_object(found: Adjusted, name: str) -> dict[str, Any]:
    """S and Q of a device, in the shape of a result of `fieldcal calibrate`, so that --prior reads it."""
    site, k = found.site, found.coverage_factor(name)
    told = found.determined(name)
    stated = ~np.any(site.devices[name].root[:, site.devices[name].wide] != 0.0, axis=1)
    known = told | stated
    u = np.where(known, site.standard_uncertainty(name), np.nan)
    return {
        "used_as": [role for role, there in _roles(found, name).items() if there],
        **_parts(np.where(known, site.x[name], np.nan)),
        "standard_uncertainty": _parts(u),
        "expanded_uncertainty": {**_parts(k * u), "coverage_factor": k},
        "covariance": np.where(np.outer(known, known), site.covariance(name, name), np.nan),
        "determined": _parts(told),
    }


def _roles(found: Adjusted, name: str) -> dict[str, bool]:
    used = [m for m in found.meetings if m.found is not None]
    return {"sensor": any(m.sensor == name for m in used), "reference": any(m.reference == name for m in used)}


def _parts(values: Array) -> dict[str, Any]:
    return {"sensitivity": values[:9].reshape(3, 3), "offset": values[9:]}


def _gravity(found: Adjusted) -> dict[str, float] | None:
    if GRAVITY_NAME not in found.site.devices:
        return None
    u = float(found.site.standard_uncertainty(GRAVITY_NAME)[0])
    return {"value_mps2": float(found.site.x[GRAVITY_NAME][0]), "standard_uncertainty_mps2": u}


def _test(verdict: DeviceVerdict) -> dict[str, Any]:
    return {
        "device": verdict.device,
        "as": "reference" if verdict.is_reference else "sensor",
        "axis": verdict.axis or None,
        "chi2": verdict.statistic,
        "degrees_of_freedom": verdict.degrees_of_freedom,
        "probability": verdict.probability,
        "bias": verdict.bias,
    }


def as_json(value: dict[str, Any]) -> str:
    """One JSON object, with null for values that are not known."""
    return msgspec.json.encode(plain(value)).decode()


def write(told: dict[str, Any], directory: Path) -> None:
    """Write site.json, and device-NUMBER.json for each device, in the order of site.json. Raises OSError."""
    directory.mkdir(parents=True, exist_ok=True)
    write_whole(directory / "site.json", f"{as_json(told)}\n".encode())
    for number, (name, device) in enumerate(told["devices"].items(), start=1):
        own = {"device": name, "status": told["status"], "reasons": told["reasons"], **device, "method": METHOD}
        write_whole(directory / f"device-{number}.json", f"{as_json(own)}\n".encode())


def show(found: Adjusted) -> None:
    """Print the meetings that were not used, S and Q of each sensor, and the correction of each reference, with U."""
    for m in found.meetings:
        if m.found is None:
            say(f"not used: {m.sensor} beside {m.reference or 'gravity'}: {m.reasons[0]}", err=True)
    for name in found.linked:
        roles = _roles(found, name)
        if roles["reference"]:
            say(_reference_line(found, name))
        for line in _sensor_lines(found, name) if roles["sensor"] else ():
            say(line)
    if found.tests and found.tests[0].probability < 1.0:
        first = found.tests[0]
        say(
            f"most suspect: {first.device}, probability {first.probability:.2g} that a sound site shows as much "
            f"(below {FALSE_ALARM:g} the device is named)"
        )


def _reference_line(found: Adjusted, name: str) -> str:
    device, x, u = found.site.devices[name], found.site.x[name], found.site.standard_uncertainty(name)
    k, parts = found.coverage_factor(name), []
    for axis, p in zip("xyz", (0, 4, 8), strict=True):
        if device.root[p].any():
            percent = 100.0 / device.mean[p]
            parts.append(f"{axis} {plus_minus((x[p] - device.mean[p]) * percent, k * u[p] * percent)}")
    return f"{name}, reference: sensitivity against what was stated, in %: {', '.join(parts) or 'exact'}"


def _sensor_lines(found: Adjusted, name: str) -> list[str]:
    """S and Q with U, one line for each output; – for a parameter that the data do not determine."""
    x, expanded = found.site.x[name], found.coverage_factor(name) * found.site.standard_uncertainty(name)
    told = zip(x.tolist(), expanded.tolist(), found.determined(name).tolist(), strict=True)
    cells = [plus_minus(value if there else None, u) for value, u, there in told]
    rows = [(*cells[3 * i : 3 * i + 3], cells[9 + i]) for i in range(3)]
    first = (name, "", "")
    return [
        f"{who:<20} {axis} {''.join(f'{cell:>22}' for cell in row)}"
        for who, axis, row in zip(first, "xyz", rows, strict=True)
    ]
