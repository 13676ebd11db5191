"""`fieldcal check` and the start of `fieldcal run`: the same faults of a configuration, each with its line."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from agent.cli.main import run_cli
from agent.cli.stopping import STOP_SIGNALS
from agent.config.broker import broker_faults
from agent.config.endpoints import endpoint_fault
from agent.config.sinks import Mqtt
from agent.config.syntax import syntax_fault

GOOD = """[gateway]
site = "bridge"
[[devices]]
name = "imu"
driver = "serial-csv"
options = { port = "/dev/ttyUSB0", rate_hz = 100, unit = "count" }
[[devices]]
name = "laser"
driver = "serial-csv"
[devices.options]
port = "/dev/ttyUSB1"
rate_hz = 100
axes = 1
[[channels]]
sensor = "imu"
reference = "laser"
poses = [
  { start_s = 10, stop_s = 40, theta_deg = 35, alpha_deg = 0 },
  { start_s = 50, stop_s = 80, theta_deg = 35, alpha_deg = 120 },
  { start_s = 90, stop_s = 120, theta_deg = 35, alpha_deg = 240 },
]
[channels.prior]
sensitivity = 26000
[recording]
keep_days = 30
"""


@pytest.fixture(autouse=True)
def _signals() -> Iterator[None]:
    """`run` takes them over before it reads its configuration."""
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def checked(path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What `check` says of a text, each line without the name of the file; `run` must say the same."""
    path.write_text(text)
    told = []
    for command in (
        ["check", str(path)],
        ["run", str(path), "--log", "plain", "--data-dir", str(path.parent / "data")],
    ):
        assert run_cli(command) == 2
        shown = capsys.readouterr()
        assert shown.out == ""
        told.append(shown.err.splitlines())
    assert told[0] == told[1]
    assert not (path.parent / "data").exists()
    assert all(line.startswith(f"{path}: line ") for line in told[0])
    return [line.removeprefix(f"{path}: ") for line in told[0]]


def test_a_sound_configuration_is_good(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gateway.toml"
    path.write_text(GOOD)
    assert run_cli(["check", str(path)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{path}: good; 2 devices, 1 channel, 3 poses",
        "  imu: the stated positions determine 12 of 12 parameters; U (k = 2) once each was taken: main 1.9 %, "
        "transverse 1.1 %, offset 0.18 m/s2, without the reference's own, with motion of 5 m/s2 rms",
        *(f"  filters of {device}: none stated; its response is estimated with S" for device in ("imu", "laser")),
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[process]\nx = 1\n# a\n[process]\n", "process is there twice, first in line 1; state all its settings in one "
         "place; where there are several, each begins with [[process]]"),
        ("x = 1\ny = 2\n\nx = 3\n", "x is there twice, first in line 1; remove one of them"),
    ],
)  # fmt: skip
def test_what_is_there_twice_is_told_with_the_line_of_the_first(text: str, told: str) -> None:
    with pytest.raises(tomllib.TOMLDecodeError) as refused:
        tomllib.loads(text)
    assert syntax_fault(text, refused.value) == (4, told)


@pytest.mark.parametrize("calibrated", ["2001-05-01", '"2001-05-01"'])
def test_a_certificate_older_than_its_interval_is_told_and_is_no_fault(
    calibrated: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gateway.toml"
    path.write_text(GOOD + f"[channels.certificate]\ncalibrated = {calibrated}\ninterval_years = 2\n")
    assert run_cli(["check", str(path)]) == 0
    shown = capsys.readouterr()
    assert f"{path}: channels.0.certificate.calibrated: 2001-05-01 is " in shown.err
    assert "more than interval_years 2;" in shown.err
    assert shown.out.startswith(f"{path}: good")


BINARY = (
    'driver = "serial-binary"\noptions = { port = "/dev/none", rate_hz = 100, length = 9, start = "80", '
    "indications = [{ at = 1, type = 'i16' }, { at = 3, type = 'i16' }, { at = 5, type = 'i16' }] }\n"
)
FAST = 'driver = "adxl355"\noptions = { bus = 250, rate_hz = 1000 }\n'


@pytest.mark.one_case
@pytest.mark.parametrize(
    ("device", "advice"),
    [
        (
            BINARY,
            "start is the single byte 80, and nothing else tells where a frame begins; state checksum, end or sequence",
        ),
        (FAST, "rate_hz 1000 is above 800 Hz, the highest rate that the data sheet states for a bus of 400 kHz"),
    ],
)
def test_options_that_are_not_good_are_told_and_are_no_fault(
    device: str,
    advice: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    path = tmp_path / "gateway.toml"
    csv = GOOD[GOOD.index("driver") : GOOD.index("[[devices]]", GOOD.index("driver"))]
    path.write_text(GOOD.replace(csv, device, 1))
    assert run_cli(["check", str(path)]) == 0
    shown = capsys.readouterr()
    assert shown.err.startswith(f"{path}: devices.0.options: {advice}")
    assert shown.out.startswith(f"{path}: good")
    run_cli(["doctor", str(path), "--data-dir", str(tmp_path), "--json", "-"])
    findings = json.loads(capsys.readouterr().out)["findings"]
    (found,) = [finding for finding in findings if finding["check"] == "options"]
    assert found["verdict"] == "advice"
    assert found["says"].startswith(f"imu: {advice}")
    assert run_cli(["run", str(path), "--data-dir", str(tmp_path / "data"), "--duration", "0.1", "--log", "plain"]) == 0
    assert f"imu: {advice}" in caplog.text


SHARED = """[gateway]
site = "bridge"
[[devices]]
name = "mems"
driver = "adxl355"
options = { bus = 250, rate_hz = 500 }
[[devices]]
name = "imu"
driver = "mpu6050"
options = { bus = 251 }
[[channels]]
sensor = "mems"
reference = "imu"
rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]
[channels.prior]
[channels.certificate]
sensitivity = 1670.7
"""


@pytest.mark.parametrize("name", ["notes.txt", "notes.txt/data"])
def test_a_data_directory_that_is_a_file_is_named_with_the_remedy(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "f.toml").write_text(GOOD, "utf-8")
    (tmp_path / "notes.txt").write_text("mine", "utf-8")
    arguments = ["run", str(tmp_path / "f.toml"), "--data-dir", str(tmp_path / name), "--duration", "0.1"]
    assert run_cli([*arguments, "--log", "plain"]) == 2
    told = f"fieldcal run: {tmp_path / name}: is no directory; name another one with --data-dir\n"
    assert told in capsys.readouterr().err
    assert (tmp_path / "notes.txt").read_text("utf-8") == "mine"


@pytest.mark.parametrize("bus", [250, 251])
def test_a_part_that_answers_for_others_and_is_not_alone(
    bus: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "gateway.toml"
    path.write_text(SHARED.replace("bus = 251", f"bus = {bus}"))
    assert run_cli(["check", str(path)]) == 0
    told = capsys.readouterr().err
    shared = "mems shares /dev/i2c-250 with imu: a part whose REVID is below 3 answers"
    assert (f"{path}: {shared}" in told) == (bus == 250)
    run_cli(["doctor", str(path), "--data-dir", str(tmp_path), "--json", "-"])
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert any(shared in finding["says"] for finding in findings) == (bus == 250)


@pytest.mark.parametrize(
    ("said", "instead", "told"),
    [
        (
            "sensitivity = 26000",
            "u_main_pct = 1",
            "line 22: channels.0.prior.sensitivity: is missing: the device 'imu' tells none; state it in its unit per "
            "m/s2, from its data sheet",
        ),
        (
            'sensor = "imu"',
            'sensor = "imo"',
            "line 15: channels.0.sensor: no device is called 'imo'; there is imu, laser",
        ),
        (
            'reference = "laser"',
            'reference = "imu"',
            "line 16: channels.0.reference: a sensor cannot be its own reference; name another device, or leave it out",
        ),
        (
            'name = "laser"',
            'name = "the laser"',
            "line 8: devices.1.name: a name has 1 to 63 letters (A-Z, a-z), digits, '_', '.' or '-', the first a "
            "letter or a digit, not 'the laser'",
        ),
        (
            "keep_days = 30",
            "keep_day = 30",
            "line 25: recording.keep_day: there is no such setting (30); did you mean keep_days?",
        ),
        ("port = \"/dev/ttyUSB1\"\n", "", "line 10: devices.1.options.port: is missing; add it"),
        (
            "axes = 1",
            'axes = 1\nunit = "g"',
            "line 15: channels.0.certificate.sensitivity: is missing for 'laser': it indicates g; state 0.101971621 "
            "(1/9.80665), or its certificate's",
        ),
        (
            "axes = 1",
            'axes = 1\nunit = "mg"',
            "line 14: devices.1.options.unit: must be 'count', 'm/s2', 'g', 'm/s' or 'mV', not 'mg'; of another unit "
            "write 'count', and state the sensitivity in that unit per m/s2",
        ),
        (
            "axes = 1",
            'axes = 1\nunit = "m/s^2"',
            "line 14: devices.1.options.unit: must be 'count', 'm/s2', 'g', 'm/s' or 'mV'; write 'm/s2', not 'm/s^2'",
        ),
        (
            "keep_days = 30",
            'keep_days = 30;',
            "line 25: keep_days = 30;: a line ends with its value; write keep_days = 30",
        ),
        (
            "keep_days = 30",
            "keep_days = ",
            "line 25: keep_days =: a setting without a value is left out; write # keep_days =",
        ),
    ],
)  # fmt: skip
def test_a_fault_names_line_path_and_remedy(
    said: str, instead: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = checked(tmp_path / "f.toml", GOOD.replace(said, instead, 1), capsys)
    assert lines[0] == told
    assert not [line for line in lines if re.search(r"[\[^]\^|\\\$|\{0,", line)], "a regular expression is no help"


@pytest.mark.parametrize(
    ("endpoint", "told"),
    [
        ("tcp://192.0.2.1:7447", "write tcp/192.0.2.1:7447: one slash stands behind the protocol"),
        ("192.0.2.1:7447", "an endpoint is a protocol, a slash and an address, as in tcp/192.0.2.1:7447"),
        ("tcp/192.0.2.1", "the address is a host, a colon and a port of 65535 at most, as in tcp/192.0.2.1:7447"),
        ("tcp/192.0.2.1:74470", "the address is a host, a colon and a port of 65535 at most, as in tcp/192.0.2.1:7447"),
        ("tcp/192.0.2.1:7447/", "the address is a host, a colon and a port of 65535 at most, as in tcp/192.0.2.1:7447"),
        ("tcp/:7447", "the address is a host, a colon and a port of 65535 at most, as in tcp/192.0.2.1:7447"),
        ("TCP/192.0.2.1:7447", "Zenoh has no protocol 'TCP', but tcp, udp, tls, quic, quic_datagram, ws, serial, "
         "unixsock-stream, unixpipe, vsock"),
        ("tcp/[2001:db8::1]:7447?rel=1", ""),
        ("tls/router.example.org:7447#a=b", ""),
        ("unixsock-stream//run/zenoh", ""),
    ],
)  # fmt: skip
def test_an_endpoint_that_would_connect_to_nothing_is_a_fault(endpoint: str, told: str) -> None:
    assert endpoint_fault(endpoint) == told


@pytest.mark.parametrize(
    ("host", "faults"), [("broker.local:1883", 1), ("192.0.2.1:1883", 1), ("::1", 0), ("broker", 0)]
)
def test_a_broker_is_a_host_without_its_port(host: str, faults: int) -> None:
    told = [what for setting, what in broker_faults(Mqtt(enabled=True, host=host)) if setting == "host"]
    assert len(told) == faults
    assert all("the port is a setting of its own" in what for what in told)


COMMA = "a comma stands between two entries of a list; add it at the end"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x = [\n  { a = 1 }\n  { a = 2 },\n]\n", (2, "{ a = 1 }: " + COMMA)),
        ("x = [\n  1, # b\n  2 # c\n\n  3,\n]\ny = 4\n", (3, "2 # c: " + COMMA)),
        ("x = [\n  1,\n  2\ny = 4\n", (1, "x = [: this bracket is not closed; close it")),
    ],
)  # fmt: skip
def test_a_list_without_a_comma_or_its_end(text: str, told: tuple[int, str]) -> None:
    with pytest.raises(tomllib.TOMLDecodeError) as refused:
        tomllib.loads(text)
    assert syntax_fault(text, refused.value) == told


def test_a_device_that_tells_m_per_s2_needs_no_sensitivity(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "f.toml"
    path.write_text(GOOD.replace('unit = "count"', 'unit = "m/s2"').replace("sensitivity = 26000", ""))
    assert run_cli(["check", str(path)]) == 0, capsys.readouterr().err


def test_a_reference_in_counts_states_its_sensitivity(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shake = '{ host = "rs.local", station = "R1234", channels = ["EHZ"] }'
    text = GOOD.replace(
        'name = "laser"\ndriver = "serial-csv"\n[devices.options]', 'name = "laser"\ndriver = "seedlink"'
    )
    text = text.replace('port = "/dev/ttyUSB1"\nrate_hz = 100\naxes = 1\n', f"options = {shake}\n")
    (line,) = checked(tmp_path / "f.toml", text, capsys)
    assert "channels.0.certificate.sensitivity: is missing for 'laser': it indicates counts" in line
    path = tmp_path / "f.toml"
    path.write_text(text + '[channels.certificate]\nquantity = "velocity"\nsensitivity = 4e8\n')
    assert run_cli(["check", str(path)]) == 0, capsys.readouterr().err


@pytest.mark.parametrize(
    ("driver", "options", "module", "extra"),
    [
        ("sound-card", "{}", "sounddevice", "sound"),
        ("ni", '{ channels = ["cDAQ1Mod1/ai0"] }', "nidaqmx", "ni"),
        ("mcc-usb", "{}", "uldaq", "mcc"),
        ("mcc172", "{}", "daqhats", "mcc"),
    ],
)
def test_a_driver_whose_library_is_missing_is_a_fault(
    driver: str,
    options: str,
    module: str,
    extra: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)  # an import of it fails, as where it is not installed
    text = GOOD.replace(
        'name = "laser"\ndriver = "serial-csv"\n[devices.options]', f'name = "laser"\ndriver = "{driver}"'
    )
    text = text.replace('port = "/dev/ttyUSB1"\nrate_hz = 100\naxes = 1\n', f"options = {options}\n")
    [line] = checked(tmp_path / "f.toml", text, capsys)
    assert line.startswith(
        f"line 9: devices.1.driver: driver {driver} needs {module} (fieldcal extras --install {extra})"
    )


def key_of(kind: str, path: Path) -> None:
    """A file that shall hold a signing key."""
    private = (Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    if kind == "sound":
        path.write_bytes(ed25519.Ed25519PrivateKey.generate().private_bytes(*private))
    elif kind == "public":
        path.write_bytes(
            ed25519.Ed25519PrivateKey.generate()
            .public_key()
            .public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
        )
    elif kind == "of another kind":
        path.write_bytes(ec.generate_private_key(ec.SECP256R1()).private_bytes(*private))
    elif kind == "no PEM":
        path.write_bytes(os.urandom(64))
    elif kind == "a directory":
        path.mkdir()


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("missing", "cannot be read: No such file or directory"),
        ("a directory", "cannot be read: Is a directory"),
        ("no PEM", "not a private key in PEM without a password"),
        ("public", "not a private key in PEM without a password"),
        ("of another kind", "a private key, but not an Ed25519 key"),
    ],
)
def test_a_signing_key_that_cannot_sign_is_a_fault(
    kind: str, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = tmp_path / "recording.key"
    key_of(kind, key)
    [line] = checked(tmp_path / "f.toml", f'{GOOD}signing_key = "{key}"\n', capsys)
    assert line.startswith(f"line 26: recording.signing_key: {key}: {why}; ")


def test_a_signing_key_that_can_sign_is_good(tmp_path: Path) -> None:
    key_of("sound", tmp_path / "recording.key")
    (tmp_path / "recording.key").chmod(0o600)
    (tmp_path / "f.toml").write_text(f'{GOOD}signing_key = "{tmp_path}/recording.key"\n')
    assert run_cli(["check", str(tmp_path / "f.toml")]) == 0


def test_names_come_with_all_other_faults(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = GOOD.replace('sensor = "imu"', 'sensor = "imo"').replace('reference = "laser"', 'reference = "lasre"')
    text = text.replace("rate_hz = 100,", "rate_hz = -1,").replace(
        "keep_days = 30", 'keep_days = "x"\nsigning_key = "/no"'
    )
    text += '[[commands.keys]]\nid = "a"\npublic_key = "x"\nverbs = ["hold"]\nsensors = ["other"]\n'
    lines = checked(tmp_path / "f.toml", text, capsys)
    assert sorted(": ".join(line.split(": ")[:2]) for line in lines) == sorted(
        [
            "line 6: devices.0.options.rate_hz",
            "line 15: channels.0.sensor",
            "line 16: channels.0.reference",
            "line 25: recording.keep_days",
            "line 26: recording.signing_key",
            "line 29: commands.keys.0.public_key",
            "line 31: commands.keys.0.sensors.0",
        ]
    )


def test_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gateway.toml"
    path.write_text(GOOD)
    assert run_cli(["check", str(path), "--json", "-"]) == 0
    counts = {"devices": 2, "channels": 1, "poses": 3, "positions": 0}
    filters = [{"sensor": "imu", "device": device, "lines": [], "stated_by": ""} for device in ("imu", "laser")]
    told = json.loads(capsys.readouterr().out)
    (plan,) = told.pop("plans")
    assert len(told.pop("warnings")) == 2  # this machine has none of the ports
    assert told == {"good": True, "faults": [], **counts, "filters": filters, "watched": []}
    assert (plan["sensor"], plan["determined"], plan["needed"], plan["missing"]) == ("imu", 12, 12, [])
    assert plan["expanded_u_main_pct"] == pytest.approx(1.9, abs=0.05)
    path.write_text(GOOD.replace("bridge", "a bridge").replace("axes = 1", "axes = 2"))
    assert run_cli(["check", str(path), "--json", "-"]) == 2
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert (found["good"], len(found["faults"]), said.err) == (False, 2, "")
    assert f"{path}: line 2: gateway.site" in found["faults"][0]
