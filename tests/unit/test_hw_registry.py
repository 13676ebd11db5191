"""The registry with the built-in drivers and with plug-ins that are installed in a directory on the path."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from hw.adxl355 import Adxl355
from hw.sensor import BUILT_IN, ConfigurationError, Options, driver_names, load_driver
from hw.serial_stream import SerialCsv

GOOD = """
from hw.sensor import Options

class Sensor:
    options_model = Options
"""


def install(directory: Path, name: str, source: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the files that an installer leaves of a plug-in: a module and the metadata that name it."""
    module = f"plugin_{name}"
    (directory / f"{module}.py").write_text(source)
    info = directory / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[fieldcal.sensors]\n{name} = {module}:Sensor\n")
    monkeypatch.syspath_prepend(str(directory))


def test_built_in_drivers() -> None:
    assert load_driver("adxl355") is Adxl355
    assert load_driver("serial-csv") is SerialCsv
    assert set(BUILT_IN) <= set(driver_names())
    for name in BUILT_IN:
        assert issubclass(load_driver(name).options_model, Options)


def test_the_package_declares_no_driver_of_hw_twice() -> None:
    declared = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))
    # Part of the agent, which hw does not import: registered as a plug-in
    assert declared["project"]["entry-points"]["fieldcal.sensors"] == {"replay": "agent.recording.device:Replay"}


def test_an_unknown_name_tells_what_there_is() -> None:
    with pytest.raises(
        ConfigurationError, match=r"no driver 'axl355': did you mean 'adxl355'\? available drivers: .*serial-csv"
    ):
        load_driver("axl355")
    with pytest.raises(ConfigurationError, match=r"no driver 'zzz': available drivers: adxl345"):
        load_driver("zzz")


def test_a_plug_in_is_a_driver_like_any(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, "kx134", GOOD, monkeypatch)
    assert "kx134" in driver_names()
    assert "plugin_kx134" not in sys.modules  # listing the names does not import the plug-in
    assert load_driver("kx134").options_model.__name__ == "Options"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("1 / 0", r"driver 'broken' \(plugin_broken:Sensor\) cannot be loaded: ZeroDivisionError"),
        ("import no_such_library", "cannot be loaded: ModuleNotFoundError"),
        ("other = 1", "cannot be loaded: AttributeError"),
        ("class Sensor: pass", "is not a sensor class"),
        ("class Sensor: options_model = dict", "is not a sensor class"),
    ],
)
def test_a_broken_plug_in_is_a_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, message: str
) -> None:
    monkeypatch.delitem(sys.modules, "plugin_broken", raising=False)
    install(tmp_path, "broken", source, monkeypatch)
    with pytest.raises(ConfigurationError, match=message):
        load_driver("broken")


def test_a_plug_in_cannot_take_a_built_in_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, "adxl355", GOOD, monkeypatch)
    assert load_driver("adxl355") is Adxl355
    assert driver_names().count("adxl355") == 1


@pytest.mark.slow
def test_naming_drivers_imports_neither_port_library() -> None:
    code = "import sys, hw.sensor; hw.sensor.driver_names(); print({'serial', 'smbus2', 'numpy'} & set(sys.modules))"
    printed = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert printed.strip() == "{'numpy'}"
