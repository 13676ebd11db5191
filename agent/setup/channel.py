"""The tables of a new configuration besides its devices: gateway, channel, recording, network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel

from agent.config.channel import Channel
from agent.config.devices import Gateway
from agent.config.knowledge import Certificate, Prior, Uncertainty
from agent.config.sinks import Recording, Zenoh
from agent.setup.asking import SourcedValue
from agent.setup.toml import TomlSetting, TomlTable
from calib.geometry import u_of_gravity_mps2

Mount = Literal["clamp", "beside", "rests"]
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
# MEMS accelerometers: data sheets state an offset of at most 75 mg; as a uniform distribution, u is 0.42 m/s2. With the
# default of 20 m/s2 (nothing is known) gravity could not tell two positions apart.
U_OFFSET = SourcedValue(
    0.5, "init; data sheets of MEMS accelerometers state 75 mg at most, and gravity tells the positions"
)


@dataclass(frozen=True, slots=True)
class Answers:
    """What a configuration states besides its devices. Each has its source."""

    site: SourcedValue[str]
    gateway: SourcedValue[str]
    mount: SourcedValue[Mount]
    theta_deg: SourcedValue[float | None]
    alpha_deg: SourcedValue[tuple[float, ...] | None]
    rotation: SourcedValue[tuple[float, ...]]
    gravity_mps2: SourcedValue[float]
    sensitivity: SourcedValue[float | None]
    u_main_pct: SourcedValue[float]
    quantity: SourcedValue[str]
    reference_sensitivity: SourcedValue[float]
    u_reference_pct: SourcedValue[float]
    reference_serial: SourcedValue[str]
    calibrated: SourcedValue[str]
    connect: SourcedValue[tuple[str, ...]]
    signing_key: SourcedValue[str | None]


def gateway_table(answers: Answers) -> TomlTable:
    """The names of site and gateway."""
    says = "the Zenoh keys of all results begin with fieldcal/v1/SITE/NAME"
    return TomlTable(
        "[gateway]",
        [
            _setting(Gateway, "site", answers.site, f"name of the site; {says}"),
            _setting(Gateway, "name", answers.gateway, "name of this gateway"),
        ],
    )


def channel_tables(answers: Answers) -> Iterator[TomlTable]:
    """The channel: geometry, and what is known beforehand."""
    rests = answers.mount.value == "rests"
    settings = [_given("sensor", "sensor", "device that is calibrated")]
    if not rests:
        settings.append(_given("reference", "reference", "device whose acceleration is known"))
    says = "local gravity; it differs from standard gravity by up to 0.3 %"
    settings.append(_setting(Channel, "gravity_mps2", answers.gravity_mps2, says, "m/s2"))
    says = "a longer interval is cut into windows of this length"
    settings.append(_setting(Channel, "window_s", _default(Channel, "window_s"), says, "s"))
    yield TomlTable("[[channels]]", [*settings, *_geometry(answers)])
    yield _prior(answers)
    if not rests:
        yield _certificate(answers)
    yield _uncertainty(answers)


def sink_tables(answers: Answers) -> Iterator[TomlTable]:
    """Recording and network."""
    says = "recordings older than this are deleted; without it they are kept until the disk is nearly full"
    yield TomlTable(
        "[recording]",
        [
            _setting(Recording, "rotate_s", _default(Recording, "rotate_s"), "a new file after this time", "s"),
            _setting(Recording, "keep_days", _default(Recording, "keep_days"), says, "days"),
            _setting(Recording, "signing_key", answers.signing_key, "private key that signs recordings and results"),
        ],
    )
    says = "Zenoh routers to which results go; without a router they wait in the store"
    yield TomlTable("[zenoh]", [_setting(Zenoh, "connect", answers.connect, says)])


def _geometry(answers: Answers) -> Iterator[TomlSetting]:
    mount = answers.mount.value
    if mount == "beside":
        says = "a = R a_ref, R row by row; 1 0 0, 0 1 0, 0 0 1: the axes of sensor and reference are parallel"
        yield _setting(Channel, "rotation", answers.rotation, says)
        if answers.quantity.value != "acceleration":
            yield _up(answers)
        return
    source = answers.mount.source
    if mount == "clamp":
        says = "1: z of the sensor points into the clamp, as Eqs. (9)-(11) are printed; -1: it points out of the clamp"
        yield _setting(Channel, "static_sign", _default(Channel, "static_sign"), says)
        says = (
            "positions of the clamp: inclination theta, turn alpha. Turn the clamp to each of them, in any order, and "
            "stay for 20 s or longer: the agent finds position and time from gravity"
        )
        theta = answers.theta_deg.value
        stops: list[dict[str, Any]] = [
            {"theta_deg": theta, "alpha_deg": alpha} for alpha in answers.alpha_deg.value or ()
        ]
        source = f"{answers.theta_deg.source}, {answers.alpha_deg.source}"
        yield TomlSetting("positions", stops, says, source, None, "deg")
        return
    g = answers.gravity_mps2.value
    stops = [{"gravity_mps2": _along(axis, sign * g)} for axis in range(3) for sign in (1, -1)]
    says = (
        "what an ideal sensor indicates at rest in each position: once each axis up, once down. Put the sensor on each "
        "of its sides, in any order, for 20 s or longer: the agent finds position and time from gravity"
    )
    yield TomlSetting("positions", stops, says, source, None, "m/s2")


def _up(answers: Answers) -> TomlSetting:
    """Gravity beside a reference that does not feel it; of a seismometer, the third axis (Z) points up."""
    up = [answers.gravity_mps2.value * along for along in answers.rotation.value[2::3]]
    says = (
        "what an ideal sensor indicates at rest; the reference does not feel gravity. Here its third axis points up; "
        "where another one does, change this"
    )
    return _setting(Channel, "rotation_gravity_mps2", SourcedValue(up, "gravity_mps2 and rotation"), says, "m/s2")


def _along(axis: int, value: float) -> list[float]:
    vector = [0.0, 0.0, 0.0]
    vector[axis] = value
    return vector


def _prior(answers: Answers) -> TomlTable:
    says = "output unit per m/s2, of the data sheet; without it the driver's nominal value is used"
    return TomlTable(
        "[channels.prior]",
        [
            _setting(Prior, "sensitivity", answers.sensitivity, says),
            _setting(Prior, "u_main_pct", answers.u_main_pct, "standard uncertainty of the main sensitivities", "%"),
            _setting(
                Prior, "u_transverse_pct", _default(Prior, "u_transverse_pct"),
                "standard uncertainty of the transverse sensitivities, of the main one", "%",
            ),
            _setting(Prior, "u_offset_mps2", U_OFFSET, "standard uncertainty of the offset", "m/s2"),
        ],
    )  # fmt: skip


def _certificate(answers: Answers) -> TomlTable:
    settings = [
        _setting(Certificate, "quantity", answers.quantity, "what the reference measures"),
        _setting(
            Certificate, "sensitivity", answers.reference_sensitivity,
            "indication of the reference per SI unit of its quantity",
        ),
        _setting(
            Certificate, "u_sensitivity_pct", answers.u_reference_pct,
            "standard uncertainty of this sensitivity, of the reference's certificate (half of its U with k = 2)", "%",
        ),
        _setting(Certificate, "serial_number", answers.reference_serial, "serial number in the certificate"),
        _setting(Certificate, "calibrated", answers.calibrated, "date of the certificate; the reference drifts since"),
        _setting(
            Certificate, "stability_pct", _default(Certificate, "stability_pct"),
            "standard uncertainty of the sensitivity that a year adds", "%",
        ),
    ]  # fmt: skip
    return TomlTable("[channels.certificate]", settings)


def _uncertainty(answers: Answers) -> TomlTable:
    stated: Sequence[tuple[str, str, str]] = {
        "clamp": (
            ("theta_deg", "standard uncertainty of theta", "deg"),
            ("angle_deg", "standard uncertainty of alpha, of each position by itself", "deg"),
            ("alpha_common_deg", "standard uncertainty of the part of alpha that all positions share", "deg"),
        ),
        "beside": (
            ("rotation_deg", "standard uncertainty of the rotation between sensor and reference", "deg"),
            ("tilt_deg", "standard uncertainty of how the mount leans against gravity", "deg"),
        ),
        "rests": (("angle_deg", "standard uncertainty of the direction of gravity, of each position", "deg"),),
    }[answers.mount.value]
    gravity = _default(Uncertainty, "gravity_mps2")
    if answers.gravity_mps2.source != "default":
        u_mps2, why = u_of_gravity_mps2(answers.gravity_mps2.value)
        gravity = SourcedValue(float(f"{u_mps2:.2g}"), f"init, by the digits of gravity_mps2: {why}")
    settings = [_setting(Uncertainty, name, _default(Uncertainty, name), says, unit) for name, says, unit in stated]
    says = "standard uncertainty of gravity_mps2"
    return TomlTable(
        "[channels.uncertainty]", [*settings, _setting(Uncertainty, "gravity_mps2", gravity, says, "m/s2")]
    )


def _default(model: type[BaseModel], name: str) -> SourcedValue[Any]:
    return SourcedValue(model.model_fields[name].default, "default")


def _given(name: str, value: Any, says: str) -> TomlSetting:
    return TomlSetting(name, value, says, "init")


def _setting(model: type[BaseModel], name: str, stated: SourcedValue[Any], says: str, unit: str = "") -> TomlSetting:
    default = model.model_fields[name].default
    value = None if stated.value == "" and default == "" else stated.value
    return TomlSetting(name, value, says, stated.source, default, unit)
