"""Statements of a configuration that contradict each other or the devices: with them nothing sound is calibrated.

They are told by `fieldcal check` and `doctor`, and logged by `fieldcal run`, which starts all the same: an agent that
runs does not stay down after an update for what was told too late.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from agent.config import Channel, Config
from agent.config.lines import Path
from agent.config.names import Told
from calib.signal.resampling import BAND, differentiated_band_hz
from hw.fifo_options import FifoOptions
from hw.fifo_sensor import FifoSensor
from hw.sensor import Options, load_driver
from hw.units import STANDARD_GRAVITY_MPS2, nominal_sensitivity

# Data sheets of MEMS accelerometers state the sensitivity to 10 % or better; a wrong range is off by a factor of 2.
AGREES = 1.25
LOOKS_LIKE = 1.05  # times the factor of a mistake
GRAVITY_WITHIN_MPS2 = 0.1  # on the earth, local gravity differs from the standard one by 0.05 m/s2 at most
# PTB (working group 1.71, calibration and measurement capabilities) states U = 0.2 % or more for the sensitivity of
# accelerometers, and 0.1 % or more for their motion (k = 2). What is below u = 0.02 % is a fraction as a rule.
LEAST_U_PCT = 0.02
_FACTORS = {
    STANDARD_GRAVITY_MPS2: "it seems to be stated per g; divide it by 9.80665",
    1.0 / STANDARD_GRAVITY_MPS2: "it seems to be divided by 9.80665 once too often",
    1e3: "it seems to be stated in thousandths of the unit (mV for V, or per km/s2)",
    1e-3: "it seems to be stated in thousands of the unit (V for mV, or per mm/s2)",
}
_RANGES = (2.0, 4.0, 8.0, 0.5, 0.25, 0.125)


def contradictions(config: Config, options: Mapping[str, Options]) -> Iterator[Told]:
    """Where the statements contradict, and what to do. `options` are those of each device, as its driver takes them."""
    yield from _same_place(config, options)
    nominal = {device.name: nominal_of(device.driver, device.name, options[device.name]) for device in config.devices}
    for i, channel in enumerate(config.channels):
        found = [*_axes(channel, options), *_sensitivities(channel, options, nominal), *_gravity(channel)]
        found += _band(channel, options)
        yield from ((("channels", i, *path), what) for path, what in found)


def _band(channel: Channel, options: Mapping[str, Options]) -> Iterator[Told]:
    """Where a stated band of motion reaches above what the rate of a device tells."""
    if channel.band_hz is None:
        return
    instrument, high_hz = channel.instrument, channel.band_hz[1]
    for name in filter(None, (channel.sensor, channel.reference)):
        rate_hz = getattr(options[name], "rate_hz", None)
        if rate_hz is None:
            continue
        differentiated = name == channel.reference and instrument.derivatives
        most_hz = differentiated_band_hz(rate_hz) if differentiated else BAND * rate_hz
        if high_hz > most_hz:
            what = (
                f"{high_hz:g} Hz is above {most_hz:g} Hz, up to which {name} tells the motion with rate_hz "
                f"{rate_hz:g}; end the band there, or let the device send more samples"
            )
            yield ("band_hz",), what


def nominal_of(driver: str, name: str, held: Options) -> float | None:
    """Indication per m/s2 by the data sheet or the unit; None where only the opened device tells it."""
    unit = getattr(held, "unit", None)
    if unit is not None:
        return 1.0 if unit == "m/s2" else nominal_sensitivity(unit)
    if not isinstance(held, FifoOptions):
        return None
    sensor = load_driver(driver)(name, held)
    return sensor.nominal_sensitivity if isinstance(sensor, FifoSensor) else None


def small_uncertainties(config: Config) -> Iterator[Told]:
    """Standard uncertainties so small that a fraction may be meant, where % is stated."""
    for i, channel in enumerate(config.channels):
        stated: list[tuple[Path, float]] = [
            (("prior", "u_main_pct"), channel.prior.u_main_pct),
            (("prior", "u_transverse_pct"), channel.prior.u_transverse_pct),
        ]
        stated = [] if channel.prior.file or channel.prior.u_sensitivity else stated
        if channel.reference and not channel.certificate.file:
            stated.append((("certificate", "u_sensitivity_pct"), channel.certificate.u_sensitivity_pct))
        for path, u_pct in stated:
            if u_pct < LEAST_U_PCT:
                what = (
                    f"{u_pct:g} % is less than laboratories state; if {100 * u_pct:g} % is meant, state {100 * u_pct:g}"
                )
                yield ("channels", i, *path), what


def place_of(held: Options) -> str:
    """Where a device is connected that only one can be at; "" where the options do not tell."""
    if isinstance(held, FifoOptions):
        return held.node if held.over_spi else f"0x{getattr(held, 'address', 0):02X} on {held.node}"
    port = getattr(held, "port", None)
    return os.path.realpath(port) if isinstance(port, str) else ""


def _same_place(config: Config, options: Mapping[str, Options]) -> Iterator[Told]:
    first: dict[str, str] = {}
    for i, device in enumerate(config.devices):
        place = place_of(options[device.name])
        if place and place in first:
            what = f"{first[place]} and {device.name} are both at {place}: only one of them can be opened"
            yield ("devices", i, "options"), f"{what}; correct the options of one of them, or remove it"
        first.setdefault(place, device.name)


def _axes(channel: Channel, options: Mapping[str, Options]) -> Iterator[Told]:
    """Axes of the sensor, and those of the references against rotation and positions."""
    if options[channel.sensor].axis_count == 1:
        exchanged = channel.reference is not None and options[channel.reference].axis_count == 3
        remedy = f"exchange it with {channel.reference}" if exchanged else "name a sensor with x, y and z"
        what = f"{channel.sensor} has one axis, and the sensor of a channel needs three; {remedy}"
        yield ("sensor",), f"{what} (a device with one can be a reference)"
    if channel.reference is None:
        return
    three = options[channel.reference].axis_count == 3
    if channel.rotation is not None and not three:
        what = f"is for a reference with three axes, and {channel.reference} has one"
        yield ("rotation",), f"{what}; remove rotation, and state poses or positions"
    if channel.rotation is None and three:
        what = f"{channel.reference} has three axes, so that rotation is needed and no poses or positions"
        yield ("reference",), f"{what}; state rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1] where its axes are the sensor's"
    check = channel.check_reference
    if check is not None and options[check.device].axis_count != options[channel.reference].axis_count:
        what = f"{check.device} and {channel.reference} must both have one axis, or both three"
        yield ("check_reference", "device"), f"{what}; name another device, or remove check_reference"


def _sensitivities(
    channel: Channel, options: Mapping[str, Options], nominal: Mapping[str, float | None]
) -> Iterator[Told]:
    """Stated sensitivities against those of the devices, by data sheet or unit."""
    by_device, prior = nominal[channel.sensor], channel.prior
    if prior.sensitivity is not None and by_device is not None and not prior.file:
        stated = float(np.sqrt(np.sum(prior.mean(None)[:9] ** 2) / 3.0))
        yield from _contradicts(("prior", "sensitivity"), stated, by_device, channel.sensor, options[channel.sensor])
    for path, beside in zip(((), ("check_reference",)), channel.by_reference, strict=False):
        device, certificate = beside.reference, beside.certificate
        if device is None or certificate.quantity != "acceleration" or (by_device := nominal[device]) is None:
            continue
        place = (*path, "certificate", "file" if certificate.file else "sensitivity")
        yield from _contradicts(place, certificate.sensitivity, by_device, device, options[device])


def _contradicts(path: Path, stated: float, nominal: float, device: str, held: Options) -> Iterator[Told]:
    factor = stated / nominal
    if 1.0 / AGREES <= factor <= AGREES:
        return
    unit = getattr(held, "unit", "")
    by = f"by its unit {unit}" if unit else "by its data sheet and its range"
    remedy = next(
        (words for each, words in _FACTORS.items() if 1.0 / LOOKS_LIKE <= factor / each <= LOOKS_LIKE),
        f"correct it, or the unit of {device} in its options (count, mV)" if unit else "correct it, or the range there",
    )
    if not unit and any(1.0 / LOOKS_LIKE <= factor / each <= LOOKS_LIKE for each in _RANGES):
        remedy = f"it seems to be that of another range; correct it, or the range in the options of {device}"
    what = f"{stated:g} is {factor:.3g} times what {device} indicates per m/s2 {by}"
    yield path, f"{what}; {remedy}: about {nominal:.6g} is right"


def _gravity(channel: Channel) -> Iterator[Told]:
    """What positions state of gravity, against gravity_mps2 and the coupling."""
    field = "poses" if channel.poses else "positions"
    stated = channel.poses or (() if channel.positions == "free" else channel.positions)
    felt = channel.coupling == "dc"
    for k, one in enumerate(stated):
        if one.gravity_mps2 is not None and felt and (what := _wrong_gravity(one.gravity_mps2, channel.gravity_mps2)):
            yield (field, k, "gravity_mps2"), what
    beside, place = channel.rotation_gravity_mps2, ("rotation_gravity_mps2",)
    if channel.rotation is None or beside is None or not felt:
        return
    if any(beside):
        if what := _wrong_gravity(beside, channel.gravity_mps2):
            yield place, what
    elif channel.certificate.quantity != "acceleration":
        what = f"is zero, which is for a reference that feels gravity, and {channel.reference} measures"
        up = f"as [0, 0, {channel.gravity_mps2:g}] where z points up"
        yield place, f"{what} {channel.certificate.quantity}; state what the sensor indicates at rest, {up}"


def _wrong_gravity(stated: Sequence[float], gravity_mps2: float) -> str:
    length = float(np.linalg.norm(stated))
    if abs(length - gravity_mps2) <= GRAVITY_WITHIN_MPS2:
        return ""
    what = f"{list(stated)} has the length {length:.4g} m/s2, and gravity_mps2 is {gravity_mps2:g}"
    if abs(length * STANDARD_GRAVITY_MPS2 - gravity_mps2) <= GRAVITY_WITHIN_MPS2:
        in_mps2 = ", ".join(f"{STANDARD_GRAVITY_MPS2 * x:g}" for x in stated)
        return f"{what}; it seems to be stated in g: state [{in_mps2}]"
    if length == 0.0:
        return f'{what}; state what an ideal sensor indicates at rest there, or coupling = "ac" if it feels no gravity'
    in_mps2 = ", ".join(f"{gravity_mps2 / length * x:g}" for x in stated)
    return f"{what}; along this direction it is [{in_mps2}]"
