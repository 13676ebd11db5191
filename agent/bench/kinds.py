"""Which kind of bench a channel of the configuration is, its positions, and its statements for `fieldcal calibrate`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from agent.bench.stops import GRAVITY, BenchStop, on_clamp, on_faces, turned_by_hand
from agent.config import Channel
from agent.config.knowledge import PRIORS
from calib.estimate import quantities
from calib.geometry import beside
from calib.recorded.options import STATED
from calib.recorded.units import unit_name

Kind = Literal["clamp", "triad", "gravity"]


def kind_of(channel: Channel) -> Kind:
    """A clamp on a shaker, rests beside a calibrated triad, or rests under gravity alone."""
    if channel.reference is None:
        return "gravity"
    return "clamp" if channel.rotation is None else "triad"


def stops_of(channel: Channel, thetas_deg: Sequence[float], alphas_deg: Sequence[float]) -> list[BenchStop]:
    """The positions that can be taken. Raises ValueError where an AC-coupled sensor has none."""
    kind = kind_of(channel)
    if kind == "clamp":
        felt = channel.gravity_mps2 if channel.coupling == "dc" else 0.0
        return on_clamp(thetas_deg, alphas_deg, felt, channel.static_sign)
    if channel.coupling == "ac":
        raise ValueError('a sensor with coupling = "ac" does not feel gravity, so that rests tell nothing of it')
    if channel.rotation is None:
        return on_faces(channel.gravity_mps2)
    return turned_by_hand(np.reshape(channel.rotation, (3, 3)), channel.gravity_mps2)


def mounted_stop(channel: Channel) -> BenchStop:
    """A mounted sensor beside a tri-axial reference, which feels gravity and so tells how both stand."""
    assert channel.rotation is not None
    up = np.array([0.0, 0.0, channel.gravity_mps2])  # read again, it only shows that gravity is felt
    felt = np.zeros(3) if channel.coupling == "dc" else None
    pose = beside(np.reshape(channel.rotation, (3, 3)), felt)
    return BenchStop("", channel.sensor, pose, dict(zip(GRAVITY, up.tolist(), strict=True)), np.zeros(3))


def stated_options(channel: Channel, directory: Path, unit: str) -> list[str]:
    """The options of `fieldcal calibrate` that state what the configuration states, with files of `directory`.

    `unit`: of the sensor's output, as its driver states it.
    """
    kind = kind_of(channel)
    options = [f"--sensor={directory / 'sensor.csv'}", f"--poses={directory / 'poses.csv'}"]
    options += [f"--prior={directory / 'prior.json'}", f"--coupling={channel.coupling}"]
    options += [f"--gravity={channel.gravity_mps2!r}", f"--static-sign={channel.static_sign:+d}"]
    if name := unit_name(unit):
        options.append("--columns=time=time_s," + ",".join(f"{axis}=v{axis}:{name}" for axis in "xyz"))
    if kind != "gravity":
        options.append(f"--reference={directory / 'reference.csv'}")
        options += [f"--sensor-filter={line}" for line in channel.prior.filters]
        options += [f"--reference-filter={line}" for line in channel.certificate.filters]
    if channel.rotation is not None:
        options += ["--rotation=" + ",".join(map(repr, channel.rotation)), "--reference-coupling=dc"]
    one_each = {option: name for name, (option, _) in STATED.items() if name in PRIORS}
    for option, name in one_each.items():
        value = PRIORS[name].of(channel)  # in the unit of the option
        if name == "reference":
            value = math.hypot(value, _drifted_pct(channel))
        if value or quantities.PRIORS[name].default:
            options.append(f"--{option.replace('_', '-')}={value!r}")
    return options


def write_prior(channel: Channel, nominal: float | None, path: Path) -> float:
    """Write S and Q as known before, for --prior; gives the nominal sensitivity in output unit per m/s2.

    Raises ValueError where neither configuration nor device tells a sensitivity.
    """
    mean = channel.prior.mean(nominal)
    u = channel.prior.standard_uncertainty(mean)
    known = {"sensitivity": mean[:9].reshape(3, 3).tolist(), "offset": mean[9:].tolist()}
    path.write_text(json.dumps(known | {"covariance": np.diag(u**2).tolist()}) + "\n")
    return float(np.sqrt(np.mean(mean[[0, 4, 8]] ** 2)))


def _drifted_pct(channel: Channel) -> float:
    """What the reference may have drifted by since its certificate; 0 where that has no date."""
    dated = channel.certificate.date
    if dated is None:
        return 0.0
    years = max((datetime.now(UTC) - dated).days, 0) / quantities.YEAR_DAYS
    return channel.certificate.stability_pct * math.sqrt(years)
