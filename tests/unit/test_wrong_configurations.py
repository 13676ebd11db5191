"""Wrong configurations and command lines: each is told before the run, and what cannot calibrate is not good.

Each row states a mistake, what `fieldcal check` must say of it, and the remedy, with which the check passes. The kinds
of mistakes are those that users report of programs with such files (named in agent/config/syntax.py), and those that a
person makes with angles, units and axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

from agent.cli.main import run_cli

CLAMP = """[gateway]
site = "bridge"

[[devices]]
name = "mems"
driver = "adxl355"
[devices.options]
bus = 250
rate_hz = 500
range_g = 2

[[devices]]
name = "laser"
driver = "serial-csv"
[devices.options]
port = "/dev/null"
rate_hz = 1000
axes = 1
unit = "m/s2"

[[channels]]
sensor = "mems"
reference = "laser"
coupling = "dc"
gravity_mps2 = 9.80665
poses = [
  { start_s = 10, stop_s = 40, theta_deg = 35, alpha_deg = 0 },
  { start_s = 50, stop_s = 80, theta_deg = 35, alpha_deg = 120 },
  { start_s = 90, stop_s = 120, theta_deg = 35, alpha_deg = 240 },
]
[channels.prior]
u_main_pct = 5
[channels.certificate]
u_sensitivity_pct = 0.5
calibrated = 2026-03-01

[recording]
keep_days = 30
[zenoh]
enabled = false
"""
FIRST, SECOND, THIRD = (f"theta_deg = 35, alpha_deg = {alpha} }}," for alpha in (0, 120, 240))
THREE = CLAMP[CLAMP.index("theta_deg") : CLAMP.index("\n]\n[channels.prior]")]
REFERENCE = 'reference = "laser"'
POSES = CLAMP[CLAMP.index("poses = [") : CLAMP.index("[channels.prior]")]
IDENTITY = "rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
BESIDE = CLAMP.replace(POSES, IDENTITY).replace("axes = 1", "axes = 3")
FACES = ("9.80665, 0, 0", "-9.80665, 0, 0", "0, 9.80665, 0", "0, -9.80665, 0", "0, 0, 9.80665", "0, 0, -9.80665")


def rests(faces: Sequence[str]) -> str:
    return "".join(f"  {{ gravity_mps2 = [{face}] }},\n" for face in faces)


RESTS = CLAMP.replace(POSES, f"positions = [\n{rests(FACES)}]\n").replace(REFERENCE + "\n", "")
RESTS = RESTS[: RESTS.index("[channels.certificate]")] + RESTS[RESTS.index("[recording]") :]
PORT = 'port = "/dev/null"'
OTHER = f'[[devices]]\nname = "other"\ndriver = "serial-csv"\noptions = {{ {PORT}, rate_hz = 10 }}\n'
SERIAL = CLAMP.replace('driver = "adxl355"', 'driver = "serial-csv"').replace(
    "bus = 250\nrate_hz = 500\nrange_g = 2", 'port = "/dev/zero"\nrate_hz = 500\nunit = "g"'
)


def along(gravity: str, *directions: str) -> str:
    poses = [
        f"{{ start_s = {20 * k}, stop_s = {20 * k + 9}, direction = [{one}]{gravity} }}"
        for k, one in enumerate(directions)
    ]
    return f"poses = [\n{', '.join(poses)}\n]\n"


class Wrong(NamedTuple):
    """A mistake: `right` of the sound file is written as `wrong`. `told`: the parts that must be said. `remedy` in the
    place of `wrong` makes the file good."""

    sound: str
    right: str
    wrong: str
    told: tuple[str, ...]
    remedy: str


def row(right: str, wrong: str, *told: str, remedy: str | None = None, sound: str = CLAMP) -> Wrong:
    return Wrong(sound, right, wrong, told, right if remedy is None else remedy)


SYNTAX = {
    "decimal comma": row("u_main_pct = 5", "u_main_pct = 5,0", "line 32: u_main_pct = 5,0: ", "write u_main_pct = 5.0"),
    "decimal comma in a pose": row(FIRST, FIRST.replace("35", "35,5"), "35,5", "theta_deg = 35.5, alpha_deg = 0 },"),
    "mark of thousands": row("rate_hz = 1000", "rate_hz = 1,000", "rate_hz = 1,000", "write rate_hz = 1000"),
    "typographic quotes": row('site = "bridge"', "site = “bridge”", "line 2: ", "“bridge”", 'write site = "bridge"'),
    "low typographic quotes": row('site = "bridge"', "site = „bridge“", 'write site = "bridge"'),
    "a minus of typography": row(
        "alpha_deg = 240", "alpha_deg = −120", "write", "alpha_deg = -120 },", remedy="alpha_deg = -120"
    ),
    "a blank that does not break": row("keep_days = 30", "keep_days =\u00a030", "write keep_days = 30"),
    "a text without quotes": row('driver = "adxl355"', "driver = adxl355", "line 6: ", 'write driver = "adxl355"'),
    "a path without quotes": row(PORT, "port = /dev/null", f"write {PORT}"),
    "an open quote": row('site = "bridge"', 'site = "bridge', 'write site = "bridge"'),
    "two kinds of quotes": row('site = "bridge"', "site = \"bridge'", 'write site = "bridge"'),
    "an open quote of a literal text": row('site = "bridge"', "site = 'bridge", "line 2: ", "write site = 'bridge'"),
    "a Windows path": row(
        "keep_days = 30",
        'keep_days = 30\nsigning_key = "C:\\Users\\me\\a.key"',
        "line 39: ",
        "write signing_key = 'C:\\Users\\me\\a.key'",
        remedy="keep_days = 30",
    ),
    "a Windows path whose code is a tab": row(
        "keep_days = 30",
        'keep_days = 30\nsigning_key = "C:\\temp\\f.key"',
        "signing_key",
        "single quotes",
        remedy="keep_days = 30",
    ),
    "a truth of Python": row("enabled = false", "enabled = False", "write enabled = false"),
    "a truth of YAML": row("enabled = false", "enabled = off", "write enabled = false"),
    "a colon": row("u_main_pct = 5", "u_main_pct: 5", "write u_main_pct = 5"),
    "a colon before a text": row('name = "mems"', "name: mems", 'write name = "mems"'),
    "a unit behind a number": row("u_main_pct = 5", "u_main_pct = 5 %", "5 %: a number has no unit", "u_main_pct = 5"),
    "a frequency with its unit": row(
        "rate_hz = 500", "rate_hz = 500 Hz", "500 Hz: a number has no unit", "rate_hz = 500"
    ),
    "a comment of another language": row(
        "u_main_pct = 5", "u_main_pct = 5 // data sheet", "write u_main_pct = 5 # data"
    ),
    "a comment of an INI file": row("[recording]", "; how long\n[recording]", "write # how long"),
    "no value": row("u_main_pct = 5", "u_main_pct =", "line 32: u_main_pct =: ", "left out", remedy=""),
    "None": row("u_main_pct = 5", "u_main_pct = None", "u_main_pct = None: ", "left out", remedy=""),
    "no digit before the point": row(
        "u_sensitivity_pct = 0.5", "u_sensitivity_pct = .5", "write u_sensitivity_pct = 0.5"
    ),
    "no digit behind the point": row("u_main_pct = 5", "u_main_pct = 5.", "write u_main_pct = 5.0"),
    "a leading zero": row(
        FIRST, FIRST.replace("35", "035"), "line 27: ", "write { start_s = 10, stop_s = 40, theta_deg = 35,"
    ),
    "a German date": row("calibrated = 2026-03-01", "calibrated = 01.03.2026", "write calibrated = 2026-03-01"),
    "a short date": row("calibrated = 2026-03-01", "calibrated = 2026-3-1", "write calibrated = 2026-03-01"),
    "a date of either order": row(
        "calibrated = 2026-03-01", 'calibrated = "03/01/2026"', "'03/01/2026'", "as in 2026-03-01"
    ),
    "a setting twice": row(
        "u_main_pct = 5",
        "u_main_pct = 5\nu_main_pct = 3",
        "line 33: u_main_pct is there twice, first in line 32; remove one",
    ),
    "a section twice": row(
        "[zenoh]", "[recording]\nrotate_s = 60\n[zenoh]", "recording is there twice, first in line 37"
    ),
    "a device in single brackets": row('[[devices]]\nname = "laser"', '[devices]\nname = "laser"', "[[devices]]"),
    "a list of tables in single brackets": row("[[channels]]", "[channels]", "channels", "two brackets: [[channels]]"),
    "an open bracket": row("[recording]", "[recording", "write [recording]"),
    "an open list": row("]\n[channels.prior]", "[channels.prior]", "this bracket is not closed"),
    "a name with a blank": row("keep_days = 30", "keep days = 30", "write keep_days = 30"),
    "no commas in a list": row(
        IDENTITY, IDENTITY.replace(",", ""), "write rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]", sound=BESIDE
    ),
}
VALUES = {
    "a rotation of 8 numbers": row(
        IDENTITY, "rotation = [1, 0, 0, 0, 1, 0, 0, 0]\n", "channels.0.rotation: has 8 numbers, needs 9", sound=BESIDE
    ),
    "a rotation of 10 numbers": row(
        IDENTITY,
        "rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1, 0]\n",
        "channels.0.rotation: has 10 numbers, needs 9",
        sound=BESIDE,
    ),
    "a rotation in rows": row(
        IDENTITY,
        "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n",
        "channels.0.rotation: ",
        "row by row in one list",
        sound=BESIDE,
    ),
    "a rotation with a decimal comma": row(
        IDENTITY, "rotation = [1,0, 0,0, 0,0, 0,0, 1,0, 0,0, 0,0, 0,0, 1,0]\n", "has 18 numbers, needs 9", sound=BESIDE
    ),
    "a left-handed rotation": row(
        IDENTITY,
        "rotation = [1, 0, 0, 0, 1, 0, 0, 0, -1]\n",
        "channels.0.rotation: ",
        "left-handed",
        "sign",
        sound=BESIDE,
    ),
    "a rotation that is not orthogonal": row(
        IDENTITY, "rotation = [1, 0, 0, 0, 1, 0.1, 0, 0, 1]\n", "channels.0.rotation: ", "right angles", sound=BESIDE
    ),
    "a rotation with few digits": row(
        IDENTITY,
        "rotation = [0.7, -0.7, 0, 0.7, 0.7, 0, 0, 0, 1]\n",
        "channels.0.rotation: ",
        "more digits",
        remedy="rotation = [0.70711, -0.70711, 0, 0.70711, 0.70711, 0, 0, 0, 1]\n",
        sound=BESIDE,
    ),
    "a direction of two numbers": row(
        FIRST,
        "direction = [1, 0], gravity_mps2 = [9.8, 0, 0] },",
        "channels.0.poses.0.direction: has 2 numbers, needs 3",
    ),
    "a direction that is no unit vector": row(
        FIRST,
        "direction = [1, 1, 0], gravity_mps2 = [0, 0, 9.80665] },",
        "poses.0",
        "not a unit vector",
        "[0.70711, 0.70711, 0]",
        remedy="direction = [0.70711, 0.70711, 0], gravity_mps2 = [0, 0, 9.80665] },",
    ),
    "a number as a text with its unit": row(
        "u_main_pct = 5", 'u_main_pct = "5 %"', "u_main_pct: a number is needed, without quotes and unit: 5, not '5 %'"
    ),
    "a number as a text with a comma": row(
        "u_main_pct = 5", 'u_main_pct = "5,0"', "a number is needed, without quotes and unit: 5.0, not '5,0'"
    ),
    "a truth in the place of a number": row(
        "keep_days = 30", "keep_days = true", "recording.keep_days: true and false are no numbers", "not True"
    ),
    "a truth as another text": row(
        "enabled = false", 'enabled = "nope"', "zenoh.enabled: true or false is needed, without quotes, not 'nope'"
    ),
    "a name in capital letters": row(
        'coupling = "dc"', 'coupling = "DC"', "must be 'dc' or 'ac'", "write 'dc'", "not 'DC'"
    ),
    "a misspelled setting": row(
        "u_main_pct = 5",
        "u_man_pct = 5",
        "channels.0.prior.u_man_pct: there is no such setting (5); did you mean u_main_pct?",
    ),
    "a setting in capital letters": row("u_main_pct = 5", "U_Main_Pct = 5", "write u_main_pct"),
    "a setting with a hyphen": row("u_main_pct = 5", "u-main-pct = 5", "write u_main_pct"),
    "a setting in another section": row(
        "[channels.prior]\n", "u_main_pct = 5\n[channels.prior]\n", "channels.0.u_main_pct", "channels.prior.u_main_pct"
    ),
    "an option of a driver beside it": row(
        "[devices.options]\nbus",
        "range_g = 2\n[devices.options]\nbus",
        "devices.0.range_g",
        "section options",
        remedy="[devices.options]\nbus",
    ),
    "a misspelled option": row("range_g = 2", "range = 2", "devices.0.options.range: ", "did you mean range_g?"),
    "a section by its singular": row("[[channels]]", "[[channel]]", "did you mean channels?"),
    "a covariance in the prior": row(
        "u_main_pct = 5",
        "u_main_pct = 5\ncovariance = [[1, 0], [0, 1]]",
        "channels.0.prior.covariance: there is no such setting",
        remedy="u_main_pct = 5",
    ),
    "a negative u": row("u_main_pct = 5", "u_main_pct = -5", "u_main_pct: must be above 0, not -5"),
    "a u of 0": row("u_main_pct = 5", "u_main_pct = 0", "u_main_pct: must be above 0, not 0"),
    "a u that is no number": row(
        "u_main_pct = 5", "u_main_pct = nan", "u_main_pct: a finite number is needed, not nan"
    ),
    "an infinite interval": row(
        "keep_days = 30", "keep_days = inf", "recording.keep_days: a finite number is needed, not inf"
    ),
    "a list for a name": row(REFERENCE, 'reference = ["laser"]', "channels.0.reference: a text in quotes is needed"),
    "a unit with a small 2": row('unit = "m/s2"', 'unit = "m/s²"', "options.unit: must be", "write 'm/s2', not 'm/s²'"),
    "one pose as a table": row(POSES, "poses = { theta_deg = 35 }\n", "channels.0.poses: ", "[[channels.poses]]"),
    "S with exchanged axes": row(
        "u_main_pct = 5",
        "u_main_pct = 5\nsensitivity = [0, 26105, 0, 26105, 0, 0, 0, 0, 26105]",
        "channels.0.prior.sensitivity: ",
        "no main sensitivity may be 0",
        remedy="u_main_pct = 5\nsensitivity = [26105, 0, 0, 0, 26105, 0, 0, 0, 26105]",
    ),
    "a number for a text": row('site = "bridge"', "site = 7", "gateway.site: a text in quotes is needed, not 7"),
    "a text for a list": row("range_g = 2", "range_g = 3", "range_g: must be 2, 4 or 8", "not 3"),
    "a table for a number": row(
        "u_main_pct = 5", "u_main_pct = { k = 2 }", "channels.0.prior.u_main_pct: a number is needed"
    ),
    "gravity in g": row(
        "gravity_mps2 = 9.80665", "gravity_mps2 = 1.0", "channels.0.gravity_mps2: must be above 9.7, not 1.0"
    ),
    "a certificate of May": row("calibrated = 2026-03-01", 'calibrated = "May 2026"', "'May 2026'", "as in 2026-03-01"),
    "a misspelled driver": row('driver = "adxl355"', 'driver = "adxl-355"', "did you mean 'adxl355'?"),
    "a sensor that no device is": row(
        'sensor = "mems"', 'sensor = "mens"', "no device is called 'mens'; there is mems, laser"
    ),
    "a pose that ends before it begins": row(
        "start_s = 10, stop_s = 40", "start_s = 40, stop_s = 10", "stop_s 10.0 is not after start_s 40.0"
    ),
    "poses that overlap": row("start_s = 50", "start_s = 30", "poses.1.start_s", "must not overlap"),
    "one sensor in two channels": row(
        "[recording]",
        '[[channels]]\nsensor = "mems"\nprior = {}\n[recording]',
        "'mems' has more than one channel",
        remedy="[recording]",
    ),
    "a sensor that is its own reference": row(REFERENCE, 'reference = "mems"', "cannot be its own reference"),
}
PLANS = {
    "two alphas": row(
        THIRD,
        THIRD.replace("240", "120"),
        "line 26: channels.0.poses: determine 6 of 12",
        "needs 12",
        "add { theta_deg = 55, alpha_deg = ",
        remedy="theta_deg = 55, alpha_deg = 195 },",
    ),
    "three equal alphas": row(THREE, THREE.replace("120 }", "0 }").replace("240 }", "0 }"), "determine 4 of 12"),
    "theta 0": row(THREE, THREE.replace("35", "0"), "along (0.00, 0.00, 1.00)", "Sxz, Syz, Szz"),
    "angles in radians": row(
        THREE,
        THREE.replace("35", "0.611").replace("120 }", "2.094 }").replace("240", "4.189"),
        "radians",
        "theta_deg = 35.01, alpha_deg = 120",
    ),
    "directions without gravity": row(
        POSES, along("", "1, 0, 0", "0, 1, 0", "0, 0, 1"), "Qx, Qy, Qz", "gravity_mps2 beside each direction"
    ),
    "a direction that is missing": row(
        POSES,
        along(", gravity_mps2 = [0, 0, 9.8]", "1, 0, 0", "0, 1, 0"),
        "determine 9 of 12",
        "add { direction = [0, 0, -1], gravity_mps2 = [0, 0, -9.80665] }",
    ),
    "rests without the lower sides": row(
        rests(FACES),
        rests(FACES[::2]),
        "channels.0.positions: determine 6 of 12",
        "add { gravity_mps2 = [",
        sound=RESTS,
    ),
    "rests without signs": row(FACES[1], FACES[1].replace("-", ""), "positions", "differs by 0 deg", sound=RESTS),
    "rests in g": row(FACES[0], "1, 0, 0", "positions.0.gravity_mps2", "in g: state [9.80665, 0, 0]", sound=RESTS),
    "gravity in mm/s2": row(FACES[0], "9806.65, 0, 0", "positions.0.gravity_mps2", "[9.80665, 0, 0]", sound=RESTS),
    "a reference with three axes and poses": row(
        "axes = 1", "axes = 3", "line 23: channels.0.reference: laser has three axes", "rotation"
    ),
    "a reference with one axis and a rotation": row(
        "axes = 3",
        "axes = 1",
        "channels.0.rotation: is for a reference with three axes, and laser has one",
        sound=BESIDE,
    ),
    "sensor and reference exchanged": row(
        'sensor = "mems"\nreference = "laser"',
        'sensor = "laser"\nreference = "mems"\n',
        "laser has one axis",
        "exchange it with mems",
    ),
    "a sensitivity per g": row(
        "u_main_pct = 5",
        "u_main_pct = 5\nsensitivity = 256000",
        "prior.sensitivity: 256000 is 9.81 times what mems indicates per m/s2",
        "per g",
        remedy="u_main_pct = 5\nsensitivity = 26105",
    ),
    "a sensitivity of another range": row(
        "u_main_pct = 5",
        "u_main_pct = 5\nsensitivity = 13052",
        "another range",
        remedy="u_main_pct = 5\nsensitivity = 26105",
    ),
    "a sensor in g with a sensitivity of 1": row(
        "u_main_pct = 5",
        "u_main_pct = 5\nsensitivity = 1.0",
        "per g",
        "0.101972",
        remedy="u_main_pct = 5\nsensitivity = 0.102",
        sound=SERIAL,
    ),
    "counts called m/s2": row(
        'unit = "count"',
        'unit = "m/s2"',
        "the unit of mems in its options (count, mV)",
        sound=SERIAL.replace('unit = "g"', 'unit = "count"').replace(
            "u_main_pct = 5", "u_main_pct = 5\nsensitivity = 26000"
        ),
    ),
    "a reference in counts without its sensitivity": row(
        "u_sensitivity_pct = 0.5",
        "u_sensitivity_pct = 0.5\nsensitivity = 9.80665",
        "certificate.sensitivity: 9.80665 is 9.81 times",
        "per g",
        remedy="u_sensitivity_pct = 0.5",
    ),
    "two devices at one port": row(
        "[[channels]]",
        OTHER + "[[channels]]",
        "laser and other are both at /dev/null",
        remedy="[[channels]]",
    ),
    "a velocity and no gravity": row(
        "u_sensitivity_pct = 0.5",
        'u_sensitivity_pct = 0.5\nquantity = "velocity"',
        "rotation_gravity_mps2",
        "velocity",
        "[0, 0, 9.80665]",
        remedy="u_sensitivity_pct = 0.5",
        sound=BESIDE,
    ),
    "free positions without a reference": row(
        RESTS[RESTS.index("positions") : RESTS.index("[channels.prior]")],
        'positions = "free"\n',
        'positions = "free" is for a clamp, so it needs a reference',
        sound=RESTS,
    ),
    "positions of an AC-coupled sensor": row(
        'coupling = "dc"', 'coupling = "ac"', "does not measure; give poses", sound=RESTS
    ),
    "poses and a rotation": row(POSES, POSES + IDENTITY, "rotation is for a channel", "remove poses", remedy=POSES),
}
DOUBTED = {
    "no position": row(POSES, "", "no position of mems is stated", "state poses"),
    "a fraction in the place of percent": row(
        "u_main_pct = 5",
        "u_main_pct = 0.005",
        "channels.0.prior.u_main_pct: 0.005 % is less",
        "if 0.5 % is meant, state 0.5",
    ),
    "a fraction in a certificate": row(
        "u_sensitivity_pct = 0.5", "u_sensitivity_pct = 0.005", "certificate.u_sensitivity_pct: 0.005 %", "state 0.5"
    ),
}
WARNED = {
    "a certificate of the future": row(
        "calibrated = 2026-03-01",
        "calibrated = 2126-03-01",
        "certificate.calibrated: 2126-03-01 is in the future; correct it",
    ),
    "the port of another computer": row(PORT, 'port = "COM3"', "laser: COM3 does not exist", "fieldcal probe"),
}


def checked(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, bool]:
    """Exit status of `fieldcal check`, all that it says, and whether it calls the file good."""
    status = run_cli(["check", str(path)])
    shown = capsys.readouterr()
    return status, shown.out + shown.err, f"{path}: good;" in shown.out


@pytest.mark.parametrize("sound", [CLAMP, BESIDE, RESTS, SERIAL])
def test_the_sound_ones_are_good(sound: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gateway.toml"
    path.write_text(sound)
    status, said, good = checked(path, capsys)
    assert (status, good) == (0, True), said


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SYNTAX, *VALUES, *PLANS, *DOUBTED, *WARNED])
def test_a_mistake_is_told_and_its_remedy_makes_the_file_good(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = (SYNTAX | VALUES | PLANS | DOUBTED | WARNED)[name]
    path = tmp_path / "gateway.toml"
    assert wrong.right in wrong.sound
    path.write_text(wrong.sound.replace(wrong.right, wrong.wrong, 1))
    status, said, good = checked(path, capsys)
    for part in wrong.told:
        assert part in said, said
    assert "Input should" not in said
    assert good == (name in WARNED), said
    assert status == (0 if name in WARNED | DOUBTED else 2)
    path.write_text(wrong.sound.replace(wrong.right, wrong.remedy, 1))
    status, said, good = checked(path, capsys)
    assert (status, good) == (0, True), said
    assert not any(part in said for part in wrong.told if len(part) > 20), said


FILES = {
    "a byte order mark": (b"\xef\xbb\xbf" + CLAMP.encode(), "line 1: the file begins with a byte order mark (U+FEFF)"),
    "UTF-16": (CLAMP.encode("utf-16"), "line 1: the file begins with the byte order mark of UTF-16; save it as UTF-8"),
    "Latin-1": (CLAMP.replace("bridge", "brücke").encode("latin-1"), "line 2: the byte 0xFC is not UTF-8; save"),
    "a recording": (b"\x89MCAP0\r\n" + bytes(99), "an MCAP recording, so it is no configuration (`fieldcal replay`"),
    "zeros of a power cut": (CLAMP.encode()[:100] + bytes(50), "line 9: the file has bytes of 0, as after a power cut"),
    "nothing": (b"", "devices: is missing; add it"),
    "JSON": (b'{"gateway": {"site": "a"}}', "line 1: not TOML: {"),
    "YAML": (b"gateway:\n  site: bridge\n", "line 1: gateway:: a section stands in brackets; write [gateway]"),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_no_configuration_is_told(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, (data, told) = tmp_path / "gateway.toml", FILES[name]
    path.write_bytes(data)
    status, said, good = checked(path, capsys)
    assert (status, good) == (2, False)
    assert told in said


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["check"], "Missing argument 'CONFIG'"),
        (["check", "missing.toml"], "missing.toml: cannot be read: No such file or directory"),
        (["check", "."], ".: cannot be read: Is a directory"),
        (["check", "gateway.toml", "other.toml"], "unexpected extra argument"),
        (["check", "gateway.toml", "--jsn"], "Did you mean '--json'?"),
        (["chek", "gateway.toml"], "did you mean 'check'?"),
        (
            ["run", "missing.toml", "--data-dir", "d", "--log", "plain"],
            "missing.toml: cannot be read: No such file or directory",
        ),
        (["run", "gateway.toml", "--data-dir", "d", "--duration", "5s"], "'5s' is not a valid float"),
        (["run", "gateway.toml", "--signing-key", "a.key"], "state recording.signing_key in CONFIG"),
        (["run", "gateway.toml", "--preset", "playn"], "'playn' is not one of 'plain', 'faulty', 'guided'"),
    ],
)
def test_a_wrong_command_line_is_told_and_nothing_runs(
    arguments: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gateway.toml").write_text(CLAMP)
    assert run_cli(arguments) == 2
    shown = capsys.readouterr()
    assert told in shown.out + shown.err
    assert [path.name for path in tmp_path.iterdir()] == ["gateway.toml"]


@pytest.mark.slow
def test_a_run_says_what_cannot_calibrate_and_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gateway.toml"
    path.write_text(PLANS["two alphas"].sound.replace(THIRD, FIRST))
    command = ["run", str(path), "--data-dir", str(tmp_path / "data"), "--log", "plain", "--duration", "0.1"]
    assert run_cli(command) == 0
    assert "channels.0.poses: determine 6 of 12 parameters" in capsys.readouterr().out
