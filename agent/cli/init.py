"""`fieldcal init`: writes a configuration for the devices of this machine."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args

import click

from agent.cli.probe import i2c_buses, i2c_drivers, on_bus
from agent.config import ConfigError
from agent.config.channel import Channel
from agent.config.devices import Gateway
from agent.config.key_file import KeyFileError
from agent.config.knowledge import Certificate, Prior
from agent.config.reading import parse_config
from agent.config.sinks import Recording, Zenoh
from agent.keys.files import KeyPair, gateway_key
from agent.setup import channel as tables
from agent.setup.asking import Interview, SourcedValue, driver_options
from agent.setup.devices import TEXT_LINES, ChosenDevice, ProbedDevice, Role, complete, listen, tables_of
from agent.setup.known_filters import stated_filters
from agent.setup.toml import written
from agent.terminal.text import say
from calib.signal.instrument import QUANTITIES
from hw.fifo_sensor import FifoSensor
from hw.sensor import Options, load_driver
from hw.serial_ports import lasting_name, serial_ports
from hw.units import nominal_sensitivity

ALPHAS_DEG = (0.0, 120.0, 240.0)  # three different ones determine all twelve parameters
POSITIVE = click.FloatRange(min=0, min_open=True)
PERCENT = click.FloatRange(0, 50, min_open=True)


def numbers(value: str | tuple[float, ...]) -> tuple[float, ...]:
    """Numbers between commas; a tuple stays as it is. Raises click.BadParameter."""
    if isinstance(value, tuple):
        return value
    try:
        return tuple(float(part) for part in value.strip("() ").split(","))
    except ValueError:
        raise click.BadParameter(f"{value!r} is not a list of numbers between commas") from None


def nine_numbers(value: str | tuple[float, ...]) -> tuple[float, ...]:
    """A matrix, row by row. Raises click.BadParameter."""
    found = numbers(value)
    if len(found) != 9:
        raise click.BadParameter(f"{len(found)} numbers, 9 are needed")
    return found


@click.command()
@click.argument("config", type=click.Path(path_type=Path), default=Path("gateway.toml"))
@click.option("--site", metavar="NAME", help="Name of the site.")
@click.option("--gateway", metavar="NAME", help="Name of this gateway.")
@click.option("--sensor", metavar="DRIVER", help="Driver of the sensor; default: what the probe finds.")
@click.option(
    "--sensor-port",
    metavar="PORT",
    help="Serial port of the sensor; its driver is then serial-csv by default.",
)
@click.option(
    "--sensor-option",
    "sensor_options",
    multiple=True,
    metavar="NAME=VALUE",
    help="An option of the sensor's driver; repeat it for more.",
)
@click.option("--sensitivity", type=POSITIVE, help="Nominal sensitivity of the sensor, output unit per m/s2.")
@click.option("--u-sensitivity-pct", type=PERCENT, help="Standard uncertainty of the main sensitivities, %.")
@click.option("--reference", metavar="DRIVER", help="Driver of the reference; default: what the probe finds.")
@click.option("--no-reference", is_flag=True, help="There is none: gravity is the excitation, at rests.")
@click.option(
    "--reference-port",
    metavar="PORT",
    help="Serial port of the reference; its driver is then serial-csv by default.",
)
@click.option(
    "--reference-option",
    "reference_options",
    multiple=True,
    metavar="NAME=VALUE",
    help="An option of the reference's driver; repeat it for more.",
)
@click.option("--reference-quantity", type=click.Choice(list(QUANTITIES)), help="What the reference measures.")
@click.option("--reference-sensitivity", type=POSITIVE, help="Indication of the reference per SI unit.")
@click.option("--u-reference-pct", type=PERCENT, help="Standard uncertainty of the sensitivity of the reference, %.")
@click.option("--reference-serial", metavar="TEXT", help="Serial number in the certificate of the reference.")
@click.option("--calibrated", metavar="YYYY-MM-DD", help="Date of this certificate.")
@click.option(
    "--mount",
    type=click.Choice(get_args(tables.Mount)),
    help="clamp: on a slide; beside: fixed beside a tri-axial reference; rests: turned by hand, no reference.",
)
@click.option("--theta-deg", type=click.FloatRange(-90, 90), help="Inclination of the clamp.")
@click.option("--alpha-deg", type=numbers, metavar="A,B,...", help="Turns of the clamp.")
@click.option("--rotation", type=nine_numbers, metavar="R11,...,R33", help="Rotation R of a = R a_ref, row by row.")
@click.option(
    "--gravity",
    type=click.FloatRange(9.7, 9.9, min_open=True, max_open=True),
    help="Local gravity, m/s2.",
)
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="Zenoh router, as tcp/192.0.2.1:7447.")
@click.option("--signing-key", type=click.Path(path_type=Path), metavar="FILE.key",
              help="Private key that signs recordings, made where it is missing; default: "
              "keys/SITE.GATEWAY.signing.key beside CONFIG.")  # fmt: skip
@click.option("--no-signing-key", is_flag=True, help="Sign nothing: nobody can prove who made the recordings.")
def init(config: Path, **given: Any) -> int:
    """Write a configuration to CONFIG (default gateway.toml) that `fieldcal check` passes and `fieldcal run` uses.

    Devices are those that `fieldcal probe` finds, or those of the options. A serial port is listened to for some
    seconds: its lines tell axes, sequence numbers and rate; so is the UDP port of a Raspberry Shake. Each value has a
    comment with unit, default and source. On a terminal, what is not given is asked. An existing file is never
    overwritten.

    Recordings are signed: an Ed25519 key is made, which only its owner may read, and its public key beside it, for
    the auditor. An existing key is used. Where root runs this, a new key belongs to the user of the service, if there
    is one.

    Exit status 2 if something is missing; each line on standard error names an option.
    """
    if config.exists():
        say(f"fieldcal init: {config}: the file exists; remove it, or choose another name", err=True)
        return 2
    asking = Interview()
    devices = _devices(asking, given)
    listen(devices, asking)
    for device in devices:
        complete(device, asking)
    answers = None if asking.faults else _answers(asking, devices, given)
    if asking.faults or answers is None:
        for fault in asking.faults:
            say(f"fieldcal init: {fault}", err=True)
        return 2
    key = None if given["no_signing_key"] else _signing_key(config, answers, given["signing_key"])
    return _write(config, answers, devices, key)


def _signing_key(config: Path, answers: tables.Answers, given: Path | None) -> Path:
    """The file of the key, absolute: the agent may be started in another directory."""
    name = f"{answers.site.value}.{answers.gateway.value}.signing.key"
    return (given or config.parent / "keys" / name).absolute()


def _text(path: Path, answers: tables.Answers, devices: list[ChosenDevice]) -> str:
    """The configuration."""
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    return written(
        f"Written by `fieldcal init` on {today}. `fieldcal check {path}` names every fault at once.",
        [
            tables.gateway_table(answers),
            *(table for device in devices for table in tables_of(device)),
            *tables.channel_tables(answers),
            *tables.sink_tables(answers),
        ],
    )


def _write(path: Path, answers: tables.Answers, devices: list[ChosenDevice], key: Path | None) -> int:
    """Check the configuration as `fieldcal check` does, and write it to a new file; make the key, unless it is None."""
    text = _text(path, answers, devices)
    try:
        made = parse_config(tomllib.loads(text), "what init would write", text)
    except ConfigError as error:
        for fault in error.faults:
            say(f"fieldcal init: {fault}", err=True)
        return 2
    pair: KeyPair | None = None
    try:
        with path.open("x", encoding="utf-8") as file:
            if key is not None:
                pair = gateway_key(key)
                text = _text(path, replace(answers, signing_key=SourcedValue(str(key), "init")), devices)
            file.write(text)
    except OSError as error:
        say(f"fieldcal init: {path}: {error.strerror}", err=True)
        return 2
    except KeyFileError as error:
        path.unlink()
        say(f"fieldcal init: {error}; --signing-key FILE.key states another file, --no-signing-key none", err=True)
        return 2
    for one in stated_filters(made):
        say(one.line)
    if pair is not None:
        _tell_key(pair)
    say(f"{path}: written; read it, then:")
    say(f"  fieldcal check {path}")
    say(f"  fieldcal run {path} --data-dir data")
    return 0


def _tell_key(pair: KeyPair) -> None:
    done = "made; it" if pair.made else "this key exists, and"
    say(f"{pair.private}: {done} signs what this gateway records. Never copy it: who has it can sign as this gateway")
    say(f"{pair.public}: give this public key to the auditor: fieldcal audit DATA --public-key {pair.public.name}")


def _stated_driver(role: Role, given: dict[str, Any]) -> SourcedValue[str]:
    return (
        SourcedValue(given[role], f"option --{role}") if given[role] else SourcedValue(TEXT_LINES, "default for a port")
    )


def _stated_options(role: Role, given: dict[str, Any]) -> dict[str, SourcedValue[Any]]:
    """The options of a device that are stated on the command line."""
    stated = driver_options(given[f"{role}_options"], f"--{role}-option")
    options = {name: SourcedValue(value, f"option --{role}-option") for name, value in stated.items()}
    if port := given[f"{role}_port"]:
        options["port"] = SourcedValue(lasting_name(port), f"option --{role}-port {port}")
    return options


def _devices(asking: Interview, given: dict[str, Any]) -> list[ChosenDevice]:
    """The sensor, and the reference if there is one."""
    roles: list[Role] = ["sensor"] if given["no_reference"] or given["mount"] == "rests" else ["sensor", "reference"]
    open_roles = [role for role in roles if not given[role] and not given[f"{role}_port"]]
    found = _probe_result() if open_roles else []
    used = {lasting_name(port) for port in (given[f"{role}_port"] for role in roles) if port}
    chosen = []
    for role in roles:
        options = _stated_options(role, given)
        if role not in open_roles:
            chosen.append(ChosenDevice(role, _stated_driver(role, given), options))
            continue
        candidates = [device for device in found if device.options.get("port") not in used]
        device = _pick(asking, role, candidates)
        if device is not None:
            found.remove(device)
            chosen.append(_of_probe(role, device, options))
    return chosen


def _of_probe(role: Role, device: ProbedDevice, options: dict[str, SourcedValue[Any]]) -> ChosenDevice:
    """A device that the probe found, with its options as far as others are not stated."""
    source = f"probe: {device.label}"
    of_probe = {name: SourcedValue(value, source) for name, value in device.options.items()}
    return ChosenDevice(role, SourcedValue(device.driver, source), of_probe | options)


def _probe_result() -> list[ProbedDevice]:
    """What the probe finds: chips on I2C, then serial ports of which the system knows something."""
    drivers = i2c_drivers()
    chips = [
        ProbedDevice(answer.drivers[0], {"bus": bus.number, "address": answer.address},
              f"{answer.identity} at 0x{answer.address:02X} on /dev/i2c-{bus.number}")
        for bus in (on_bus(number, drivers, self_test=False) for number in i2c_buses())
        for answer in bus.answers
        if answer.drivers
    ]  # fmt: skip
    ports = [
        ProbedDevice(TEXT_LINES, {"port": port["port"]}, f"{port['port']} ({port['description']})")
        for port in serial_ports()
        if port["description"] not in ("", "n/a")
    ]
    return chips + ports


def _pick(asking: Interview, role: Role, candidates: list[ProbedDevice]) -> ProbedDevice | None:
    """The device of this role among those that were found: the only one, or the answer of the user."""
    stating = f"state --{role} DRIVER, or --{role}-port PORT"
    if role == "reference":
        stating += ", or --no-reference"
    if not candidates:
        asking.faults.append(f"no {role} was found; connect it, or {stating}")
        return None
    if asking.interactive:
        for number, device in enumerate(candidates, 1):
            say(f"  {number}: {device.label}")
        answer = click.prompt(f"Which one is the {role}", type=click.IntRange(1, len(candidates)), default=1)
        return candidates[answer - 1]
    if len(candidates) > 1:
        labels = "; ".join(device.label for device in candidates)
        asking.faults.append(f"several devices may be the {role} ({labels}); {stating}")
        return None
    return candidates[0]


def _answers(asking: Interview, devices: list[ChosenDevice], given: dict[str, Any]) -> tables.Answers:
    sensor = devices[0]
    reference = devices[1] if len(devices) > 1 else None
    mount = _mount(given, reference)
    theta: SourcedValue[Any]
    alphas: SourcedValue[Any]
    theta = alphas = SourcedValue(None, "not used")
    if mount.value == "clamp":
        theta = asking.value("--theta-deg", given["theta_deg"], "inclination theta of the clamp, deg", kind=float)
        question = "turns alpha of the clamp, deg, with commas"
        alphas = asking.value("--alpha-deg", given["alpha_deg"], question, ALPHAS_DEG, kind=numbers)

    def of(model: Any, name: str, option: str) -> SourcedValue[Any]:
        value = given[option]
        return SourcedValue(value, f"option --{option.replace('_', '-')}") if value else _default(model, name)

    return tables.Answers(
        site=asking.value("--site", given["site"], "Name of the site", _default(Gateway, "site").value),
        gateway=asking.value("--gateway", given["gateway"], "Name of this gateway", _default(Gateway, "name").value),
        mount=mount,
        theta_deg=theta,
        alpha_deg=alphas,
        rotation=SourcedValue(given["rotation"], "option --rotation")
        if given["rotation"]
        else SourcedValue(tables.IDENTITY, "init"),
        gravity_mps2=of(Channel, "gravity_mps2", "gravity"),
        sensitivity=_sensitivity(asking, sensor, given["sensitivity"]),
        u_main_pct=of(Prior, "u_main_pct", "u_sensitivity_pct"),
        quantity=_quantity(given["reference_quantity"], reference),
        reference_sensitivity=_reference_sensitivity(asking, given["reference_sensitivity"], reference),
        u_reference_pct=of(Certificate, "u_sensitivity_pct", "u_reference_pct"),
        reference_serial=of(Certificate, "serial_number", "reference_serial"),
        calibrated=of(Certificate, "calibrated", "calibrated"),
        connect=of(Zenoh, "connect", "connect"),
        signing_key=_default(Recording, "signing_key"),
    )


def _default(model: Any, name: str) -> SourcedValue[Any]:
    return SourcedValue(model.model_fields[name].default, "default")


def _mount(given: dict[str, Any], reference: ChosenDevice | None) -> SourcedValue[tables.Mount]:
    """How the sensor stands: as stated, or by the axes of the reference."""
    if given["mount"]:
        return SourcedValue(given["mount"], "option --mount")
    if reference is None:
        return SourcedValue("rests", "option --no-reference")
    if given["rotation"] or (_axes(reference) == 3 and given["theta_deg"] is None):
        return SourcedValue("beside", "the reference has three axes")
    return SourcedValue("clamp", "the reference has one axis")


def _axes(device: ChosenDevice) -> int:
    """Number of axes: as an option states it; otherwise 3 of a chip or of another device with all its axes."""
    if (axes := device.value("axes")) is not None:
        return int(axes)
    if isinstance(channels := device.value("channels"), list):
        return len(channels)
    driver = load_driver(device.driver.value)
    chip = isinstance(driver, type) and issubclass(driver, FifoSensor)
    return 3 if chip or device.driver.value in ("epson", "iio", "mip", "witmotion") else 1


def _sensitivity(asking: Interview, sensor: ChosenDevice, given: float | None) -> SourcedValue[Any]:
    """The sensor's nominal sensitivity; None where its driver knows it."""
    if given is not None:
        return SourcedValue(given, "option --sensitivity")
    options = _options(sensor)
    if options is None:
        return SourcedValue(None, "missing")  # the check of the whole configuration names the fault
    if options.tells_sensitivity:
        return SourcedValue(None, "the driver knows it")
    question = f"nominal sensitivity of the sensor, {sensor.value('unit') or 'output unit'} per m/s2, of its data sheet"
    return asking.value("--sensitivity", None, question + sensor.hint, kind=float)


def _options(device: ChosenDevice) -> Options | None:
    """The options of a device as its driver takes them; None where it refuses them."""
    model = load_driver(device.driver.value).options_model
    try:
        return model.model_validate({n: held.value for n, held in device.options.items() if held.value is not None})
    except ValueError:
        return None


def _reference_sensitivity(asking: Interview, given: float | None, reference: ChosenDevice | None) -> SourcedValue[Any]:
    """Indication of the reference per SI unit: as stated, or as its unit says."""
    if given is not None:
        return SourcedValue(given, "option --reference-sensitivity")
    if reference is not None and (known := nominal_sensitivity(reference.value("unit"))) is not None:
        return SourcedValue(known, "the unit of the reference is g")
    options = None if reference is None else _options(reference)
    if options is not None and (asked := options.asked_of_certificate):
        return asking.value("--reference-sensitivity", None, f"sensitivity of the reference: {asked}", kind=float)
    return _default(Certificate, "sensitivity")


def _quantity(given: str | None, reference: ChosenDevice | None) -> SourcedValue[str]:
    if given:
        return SourcedValue(given, "option --reference-quantity")
    if reference is not None and reference.value("unit") == "m/s":
        return SourcedValue("velocity", "unit of the reference")
    known = "" if reference is None or (options := _options(reference)) is None else options.quantity
    return SourcedValue(known, "the channels of the reference") if known else _default(Certificate, "quantity")
