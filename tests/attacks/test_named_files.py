"""A pipe, a device or a file without end in place of a file that the program reads: one line, at once."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.calibrate.stated import read_prior
from agent.calibrate.tables import read_sensor
from agent.cli.main import run_cli
from agent.commanding.counters import Counters
from agent.config import ConfigError, load_config
from agent.config.files import read_file
from agent.config.key_file import KeyFileError, load_private_key
from agent.delivery.memory import MemoryFileError, load
from agent.delivery.router import open_router
from agent.delivery.session import EndpointError
from agent.keys.files import read_signing_key
from agent.reading.source import TableError
from agent.recording.signing import load_public_key
from agent.report.material import MaterialError, gather
from hw.sensor import ConfigurationError, load_driver
from hw.virtual.playback import PlaybackError, read_track
from tests.scenarios.processes import ROOT

READERS: list[tuple[Callable[[Path], object], type[Exception]]] = [
    (load_config, ConfigError),
    (load_private_key, KeyFileError),
    (load_public_key, KeyFileError),
    (read_signing_key, KeyFileError),
    (read_sensor, TableError),
    (read_prior, TableError),
    (load, MemoryFileError),
    (lambda path: open_router(None, path), EndpointError),
    (lambda path: gather([path], None), MaterialError),
    (read_track, PlaybackError),
]


@pytest.mark.parametrize(("read", "refusal"), READERS)
def test_what_is_no_file_is_refused_at_once(
    tmp_path: Path, read: Callable[[Path], object], refusal: type[Exception]
) -> None:
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    zeros = tmp_path / "zeros.json"
    zeros.symlink_to("/dev/zero")
    for path in (pipe, zeros):
        with pytest.raises(refusal, match=f"{path.name}.*[Nn]ot a regular file"):
            read(path)


def test_a_file_above_the_limit_is_not_read(tmp_path: Path) -> None:
    held = tmp_path / "held"
    held.write_bytes(bytes(11))
    assert len(read_file(held, 11)) == 11
    with pytest.raises(OSError, match="more than 10 bytes"):
        read_file(held, 10)


def test_counters_that_are_no_file_do_not_hang_the_start(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "command-counters.json")
    counters = Counters(tmp_path)
    assert counters.set_aside is not None
    assert counters.last("anna") > 0, "only commands that are signed after now are accepted"


def run(*arguments: str | Path, env: dict[str, str] | None = None, shell: str = "") -> subprocess.CompletedProcess[str]:
    command = ["/bin/sh", "-c", f'exec "$0" -m agent "$@" {shell}', sys.executable, *map(str, arguments)]
    return subprocess.run(
        command, cwd=ROOT, env=os.environ | (env or {}), capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.thorough
def test_a_program_without_standard_streams_runs(tmp_path: Path) -> None:
    data = tmp_path / "data"
    told = run("run", "--data-dir", data, "--duration", "1.5", shell=">&- <&-")
    assert (told.returncode, told.stdout) == (0, "")
    assert "Traceback" not in told.stderr
    recording = next(data.glob("fieldcal-*.mcap")).read_bytes()
    assert recording.startswith(b"\x89MCAP0\r\n"), "what is printed has not reached the recording"


def install(directory: Path, source: str) -> None:
    """Write the files that an installer leaves of a plug-in."""
    (directory / "hostile_plug_in.py").write_text(source)
    info = directory / "hostile-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: hostile\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[fieldcal.sensors]\nhostile = hostile_plug_in:Driver\n")


@pytest.mark.parametrize("raised", ["SystemExit(0)", "GeneratorExit()", "RuntimeError('no')"])
def test_a_plug_in_that_cannot_be_imported_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raised: str
) -> None:
    install(tmp_path, f"raise {raised}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigurationError, match=f"hostile_plug_in.*{raised.partition('(')[0]}"):
        load_driver("hostile")


@pytest.mark.parametrize("raised", ["SystemExit(0)", "RuntimeError('no')"])
def test_a_plug_in_that_fails_on_its_options_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], raised: str
) -> None:
    source = f"""
    from hw.sensor import Options
    class Held(Options):
        def check_installed(self):
            raise {raised}
    class Driver:
        options_model = Held
    """
    install(tmp_path, textwrap.dedent(source))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "hostile_plug_in", raising=False)
    config = tmp_path / "c.toml"
    config.write_text('[gateway]\nsite = "s"\nname = "g"\n[[devices]]\nname = "mems"\ndriver = "hostile"\n')
    assert run_cli(["check", str(config)]) == 2
    told = capsys.readouterr().err
    assert "devices.0.driver" in told
    assert raised.partition("(")[0] in told
