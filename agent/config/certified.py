"""Fills in what the files state that `prior.file` and `certificate.file` name: the configuration carries the values.

So a recording, which holds the configuration, is replayed without these files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from agent.config.earlier import LARGEST, MAIN, EarlierError, identity_in, read_earlier
from agent.config.files import read_file
from agent.config.names import Told
from calib.model import Array, scale_of

SPREADS = ("sensitivity", "u_sensitivity", "u_main_pct", "u_transverse_pct", "offset_mps2", "u_offset_mps2")
CERTIFIED = ("sensitivity", "u_sensitivity_pct", "u_transverse_pct", "serial_number", "calibrated")


def filled_in(raw: Mapping[str, Any]) -> tuple[Mapping[str, Any], list[Told]]:
    """The values of a TOML file with those of the files that it names, and what is wrong with these files."""
    channels = raw.get("channels")
    if not isinstance(channels, list):
        return raw, []
    faults: list[Told] = []
    filled = []
    for i, channel in enumerate(channels):
        if isinstance(channel, dict):
            channel = channel | _section(channel, "prior", ("channels", i), faults)
            channel = channel | _section(channel, "certificate", ("channels", i), faults)
            if isinstance(beside := channel.get("check_reference"), dict):
                place = ("channels", i, "check_reference")
                channel = channel | {"check_reference": beside | _section(beside, "certificate", place, faults)}
        filled.append(channel)
    return {**raw, "channels": filled}, faults


def _section(
    around: Mapping[str, Any], name: str, place: tuple[str | int, ...], faults: list[Told]
) -> dict[str, Mapping[str, Any]]:
    """The section with what its file states; nothing where it names none, or where the file cannot be used."""
    stated = around.get(name)
    if not isinstance(stated, dict) or not isinstance(stated.get("file"), str) or not stated["file"]:
        return {}
    path = FilePath(stated["file"])
    try:
        sha256 = hashlib.sha256(read_file(path, LARGEST)).hexdigest()
        found = _prior(path) if name == "prior" else _certificate(path)
    except EarlierError as error:
        faults.append(((*place, name, "file"), str(error)))
        return {}
    except OSError as error:
        faults.append(((*place, name, "file"), f"{path}: cannot be read: {error.strerror or error}"))
        return {}
    twice = [key for key in (SPREADS if name == "prior" else CERTIFIED) if key in stated and _says(key, found)]
    faults += [((*place, name, key), f"{path} states it too; remove it here, or remove file") for key in twice]
    if stated.get("file_sha256", sha256) != sha256:
        what = f"{path} has the SHA-256 {sha256}; name the file that was meant, or state this one"
        faults.append(((*place, name, "file_sha256"), what))
    return {name: {**found, **stated, "file_sha256": sha256}}


def _says(key: str, found: Mapping[str, Any]) -> bool:
    return key in found or key in ("u_main_pct", "u_transverse_pct")


def _prior(path: FilePath) -> dict[str, Any]:
    """S, Q and their u; Q and the date only where the file knows them. Raises EarlierError, OSError."""
    values, covariance = read_earlier(path)
    with np.errstate(invalid="ignore"):
        u = np.sqrt(np.diag(covariance))
    if not (np.isfinite(values[:9]).all() and (u[:9] > 0.0).all() and (values[MAIN] != 0.0).all()):
        raise EarlierError(
            f"{path}: not all nine elements of S have a value and an uncertainty above 0; "
            "state sensitivity, u_main_pct and u_transverse_pct instead of file"
        )
    found: dict[str, Any] = {"sensitivity": values[:9].tolist(), "u_sensitivity": u[:9].tolist()}
    if calibrated := identity_in(path)[1]:
        found["calibrated"] = calibrated
    if np.isfinite(values[9:]).all() and (u[9:] > 0.0).all():
        scale = scale_of(values)
        found |= {"offset_mps2": (values[9:] / scale).tolist(), "u_offset_mps2": (u[9:] / scale).tolist()}
    return found


def _certificate(path: FilePath) -> dict[str, Any]:
    """The mean of the main sensitivities; its u has the spread of the three and the largest u of one of them.

    The transverse sensitivities are not corrected for; their u has the values themselves.
    Raises EarlierError, OSError.
    """
    values, covariance = read_earlier(path)
    S, variance = values[MAIN], np.diag(covariance)[MAIN]
    if not (np.isfinite(S).all() and (S > 0.0).all() and (variance > 0.0).all()):
        raise EarlierError(
            f"{path}: a main sensitivity of the reference, or its uncertainty, is not known or not above 0"
        )
    mean = float(S.mean())
    u = float(np.sqrt((variance + (S - mean) ** 2).max()))
    serial_number, calibrated = identity_in(path)
    identity = {"serial_number": serial_number, "calibrated": calibrated}
    found = {"sensitivity": mean, "u_sensitivity_pct": 100.0 * u / mean}
    found["u_transverse_pct"] = 100.0 * u_transverse(values, covariance)
    return found | {k: v for k, v in identity.items() if v}


def u_transverse(values: Array, covariance: Array) -> float:
    """Standard uncertainty of the transverse sensitivities over the main ones, of S and Q (12,) with their covariance
    (12, 12), if nobody corrects for their values."""
    square = (np.diag(covariance) + values**2)[:9].reshape(3, 3) / np.abs(values[MAIN])[:, None] ** 2
    return float(np.sqrt(np.nanmax(np.where(np.eye(3), 0.0, square))))
