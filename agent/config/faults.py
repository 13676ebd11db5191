"""The faults of a configuration, each with its place, in words that say what to do."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path as FilePath
from typing import Any

from pydantic import BaseModel, ValidationError

from agent.config.broker import broker_faults
from agent.config.certified import filled_in
from agent.config.endpoints import endpoint_fault
from agent.config.filters import FiltersError, filters_of
from agent.config.key_file import KeyFileError, load_private_key
from agent.config.known_keys import read_known_keys
from agent.config.lines import Path
from agent.config.names import Told, name_faults
from agent.config.sinks import Mqtt, Tls
from agent.config.tls import tls_faults
from agent.config.whole import Config
from agent.config.words import in_words, length_fault, may_be_truth, remedy
from hw.sensor import DeviceError, Options, load_driver

MOST_DEVICES = 100  # whose options are checked; more are a fault of their own
SHOWN_FAULTS = 100
SHOWN_CHARACTERS = 100  # of a value or a path in a fault
_SPOILT = re.compile(r"[A-Za-z]:[^\x00-\x1f]*([\x00-\x1f])")
_PATH = re.compile(r"([a-z_]\w*(?:\.\w+)*): ")  # with which a check of several settings begins


def faults_of(raw: Mapping[str, Any]) -> tuple[Config | None, list[Told]]:
    """The configuration, None where it is none, and all faults: what the sections say, names, drivers and files."""
    config: Config | None = None
    raw, faults = filled_in(raw)
    named = list(name_faults(raw))
    try:
        config = Config.model_validate(raw)
    except ValidationError as error:
        # The model looks at its names only when all else is sound; they are named here, and only once.
        faults += model_faults(error, raw, Config, but_of_the_whole=bool(named))
    faults += named
    options = list(_options(raw, faults))
    faults += _unknown_sensitivities(raw, dict(options))
    faults += _uncertified_references(raw, dict(options))
    faults += _no_self_tests(raw, dict(options))
    faults += _endpoint_faults(raw)
    faults += _file_faults(raw)
    faults += _misread(raw, (), Config)
    return config, faults


def path_text(path: Path) -> str:
    """A path as faults name it."""
    return _short(".".join(str(part) for part in path))


def _options(raw: Mapping[str, Any], faults: list[Told]) -> Iterator[tuple[str, Options]]:
    """The options of each device by its name, as its driver takes them; those that it refuses are faults."""
    for i, device in enumerate(_entries(raw, "devices")[:MOST_DEVICES]):
        driver, options = device.get("driver"), device.get("options", {})
        if not isinstance(driver, str) or not isinstance(options, dict):
            continue  # the section's own check names it
        try:
            model = load_driver(driver).options_model
            faults += [(("devices", i, "options", *path), what) for path, what in _misread(options, (), model)]
            held = model.model_validate(options)
            held.check_installed()
            filters_of(held.known_filters)
        except DeviceError as error:
            faults.append((("devices", i, "driver"), str(error)))
        except FiltersError as error:
            faults.append((("devices", i, "options", "filters"), str(error)))
        except ValidationError as error:
            faults += [(("devices", i, "options", *path), what) for path, what in model_faults(error, options, model)]
        except (Exception, SystemExit) as error:  # of a plug-in
            fault = f"driver {driver!r} fails on its options: {type(error).__name__}: {error}"
            faults.append((("devices", i, "driver"), fault))
        else:
            yield str(device.get("name")), held


def _unknown_sensitivities(raw: Mapping[str, Any], options: Mapping[str, Options]) -> Iterator[Told]:
    """Channels whose sensor tells no sensitivity and whose prior states none: nothing could be calibrated."""
    for i, channel in enumerate(_entries(raw, "channels")):
        prior, sensor = channel.get("prior"), str(channel.get("sensor"))
        if not isinstance(prior, Mapping) or sensor not in options:
            continue
        if prior.get("sensitivity") is not None or prior.get("file"):  # what is wrong with the file is a fault already
            continue
        if not options[sensor].tells_sensitivity:
            what = f"is missing: the device {sensor!r} tells none; state it in its unit per m/s2, from its data sheet"
            yield ("channels", i, "prior", "sensitivity"), what


def _no_self_tests(raw: Mapping[str, Any], options: Mapping[str, Options]) -> Iterator[Told]:
    """Channels that state a self-test of a sensor that has none."""
    for i, channel in enumerate(_entries(raw, "channels")):
        sensor = str(channel.get("sensor"))
        if channel.get("self_test") is not None and sensor in options and not options[sensor].tests_itself:
            yield ("channels", i, "self_test"), f"the driver of {sensor!r} knows no self-test; remove it"


def _uncertified_references(raw: Mapping[str, Any], options: Mapping[str, Options]) -> Iterator[Told]:
    """References that do not indicate SI units, without the sensitivity in their certificate: it would be 1; and those
    that measure another quantity than their certificate says."""
    for i, channel in enumerate(_entries(raw, "channels")):
        beside = channel.get("check_reference")
        places: list[tuple[Path, Any, Any]] = [((), channel.get("reference"), channel.get("certificate"))]
        if isinstance(beside, Mapping):
            places.append((("check_reference",), beside.get("device"), beside.get("certificate")))
        for path, device, certificate in places:
            if not isinstance(device, str) or device not in options:
                continue  # the section's own check names it
            held, driver = certificate if isinstance(certificate, Mapping) else {}, options[device]
            stated = held.get("sensitivity") or held.get("file")
            if stated is None and (asked := driver.asked_of_certificate):
                yield ("channels", i, *path, "certificate", "sensitivity"), f"is missing for {device!r}: {asked}"
            if driver.quantity and held.get("quantity", "acceleration") != driver.quantity:
                what = f'must be "{driver.quantity}": that is what {device!r} measures'
                yield ("channels", i, *path, "certificate", "quantity"), what


def _file_faults(raw: Mapping[str, Any]) -> Iterator[Told]:
    """Files that are named and cannot be used."""
    recording, zenoh = raw.get("recording"), raw.get("zenoh")
    key = recording.get("signing_key") if isinstance(recording, Mapping) else None
    if isinstance(key, str):
        try:
            load_private_key(FilePath(key))
        except KeyFileError as error:
            yield ("recording", "signing_key"), str(error)
    commands = raw.get("commands")
    revoked = commands.get("revoked_keys") if isinstance(commands, Mapping) else None
    if isinstance(revoked, str):
        try:
            read_known_keys(FilePath(revoked))
        except KeyFileError as error:
            yield ("commands", "revoked_keys"), str(error)
    yield from _mqtt_faults(raw.get("mqtt"))
    try:
        files = Tls.model_validate(zenoh.get("tls") if isinstance(zenoh, Mapping) else None).files
    except ValidationError:
        return  # the section's own check names it, if it is there at all
    for fault in tls_faults(files):
        field, _, what = fault.partition(": ")
        yield ("zenoh", "tls", field), what


def _endpoint_faults(raw: Mapping[str, Any]) -> Iterator[Told]:
    """Endpoints of routers that have the form of one, and would connect to nothing."""
    zenoh = raw.get("zenoh")
    stated = zenoh.get("connect") if isinstance(zenoh, Mapping) else None
    for i, endpoint in enumerate(stated if isinstance(stated, list) else []):
        if isinstance(endpoint, str) and all(endpoint.partition("/")) and (fault := endpoint_fault(endpoint)):
            yield ("zenoh", "connect", i), f"{fault}, not {_value(endpoint.partition('#')[0])}"


def _mqtt_faults(raw: object) -> Iterator[Told]:
    try:
        settings = Mqtt.model_validate(raw)
    except ValidationError:
        return  # the section's own check names it, if it is there at all
    if settings.enabled:
        yield from ((("mqtt", field), what) for field, what in broker_faults(settings))


def _misread(value: Any, path: Path, kind: type[BaseModel]) -> Iterator[Told]:
    """Values that are silently taken for others: true for 1, and a path of Windows in double quotes, in which TOML took
    a backslash and a letter for a control character."""
    if isinstance(value, bool) and not may_be_truth(kind, path):
        yield path, f"true and false are no numbers; state a number, not {value}"
    elif isinstance(value, str) and (found := _SPOILT.match(value)):
        what = f"{_value(value)} has {found[1]!r} in it: in double quotes \\ begins a code; write it in single quotes"
        yield path, what
    elif isinstance(value, Mapping | list):
        for name, item in value.items() if isinstance(value, Mapping) else enumerate(value):
            if name not in ("poses", "options"):  # of poses there may be 86,400; options have a model of their own
                yield from _misread(item, (*path, name), kind)


def _entries(raw: Mapping[str, Any], section: str) -> list[Mapping[str, Any]]:
    held = raw.get(section)
    return [entry if isinstance(entry, Mapping) else {} for entry in held] if isinstance(held, list) else []


def _of_length(path: Path, raw: Any, kind: type[BaseModel]) -> Told | None:
    """The innermost list on the way to a fault whose length is wrong, and how; None where there is none."""
    for length in range(len(path), 0, -1):
        value = _at(raw, path[:length])
        if isinstance(value, list | tuple) and (what := length_fault(value, path[:length], kind)):
            return path[:length], what
    return None


def model_faults(
    error: ValidationError, raw: Any, kind: type[BaseModel], *, but_of_the_whole: bool = False
) -> Iterator[Told]:
    """The faults that a model of this kind found in the values of a TOML file: where, and what is wrong."""
    faults = [fault for fault in error.errors() if fault["loc"] or not but_of_the_whole]
    # A list that is too short only because what is in it was refused is no fault of its own.
    around = {fault["loc"][:n] for fault in faults for n in range(len(fault["loc"]))}
    said: set[Path] = set()
    for fault in faults:
        if fault["type"] == "too_short" and fault["loc"] in around:
            continue
        path = _path(fault["loc"], raw)
        if len(said) >= SHOWN_FAULTS:
            yield path, ""  # only counted: to word tens of thousands takes minutes
            continue
        path, what = _of_length(path, raw, kind) or _fault_of(fault, path, kind)
        if path in said and fault["type"] not in ("value_error", "extra_forbidden"):
            continue  # of alternatives that all do not fit, and of a list whose length is wrong, one fault is told
        said.add(path)
        yield path, what


def _fault_of(fault: Mapping[str, Any], path: Path, kind: type[BaseModel]) -> Told:
    """Where a fault of a model is, and what is wrong, with the value."""
    value, what = fault.get("input"), in_words(fault, path)
    if fault["type"] == "value_error" and (named := _PATH.match(what)) is not None:
        path, what = (*path, *named[1].split(".")), what[named.end() :]
    # A whole section as "the offending value" would bury the message.
    whole = isinstance(value, dict | BaseModel | list | tuple) or fault["type"] == "missing"
    if fault["type"] == "extra_forbidden":
        return path, f"there is no such setting{'' if whole else f' ({_value(value)})'}; {remedy(kind, path)}"
    if isinstance(value, str) and fault["type"] == "literal_error" and repr(value) not in what and _is_number(value):
        what += " as a number without quotes"
    return path, what if whole or (isinstance(value, str) and repr(value) in what) else f"{what}, not {_value(value)}"


def _at(raw: Any, path: Path) -> Any:
    """The value at a path; None where there is none."""
    for part in path:
        held = isinstance(raw, Mapping) and part in raw
        if not held and not (isinstance(raw, list | tuple) and isinstance(part, int) and part < len(raw)):
            return None
        raw = raw[part]
    return raw


def _path(location: tuple[str | int, ...], raw: Any) -> Path:
    """Where the fault is in the file: without the names of alternatives that pydantic puts between."""
    path: list[str | int] = []
    for k, part in enumerate(location):
        held = isinstance(raw, Mapping) and part in raw
        if held or (isinstance(raw, list | tuple) and isinstance(part, int) and part < len(raw)):
            path.append(part)
            raw = raw[part]
        elif isinstance(raw, Mapping) and k == len(location) - 1:
            path.append(part)  # what is missing
    return tuple(path)


def _is_number(text: str) -> bool:
    try:
        int(text, 0)
    except ValueError:
        return False
    return True


def _value(value: Any) -> str:
    if isinstance(value, int) and value.bit_length() > 64:
        return f"a number of {value.bit_length()} bits"  # Python refuses to write one of thousands of digits
    return _short(repr(value))


def _short(text: str) -> str:
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[:SHOWN_CHARACTERS]}..."
