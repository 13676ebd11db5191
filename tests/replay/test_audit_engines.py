"""Whether results follow from the data is answered by the engine that made them; whoever forges cannot hide behind one.

0: passed, 3: a check failed, 4: not decided, for the engine is not here or not trusted.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from click.testing import CliRunner

from agent.cli.audit import audit
from agent.core.events import CalibrationUpdate, Output, RunStart, StatusChange, WindowReport
from agent.engine import identity
from agent.engine.identity import ROOT, source_files
from agent.engine.known import known_engines
from agent.engine.wheel import PROCESS, file_name, wheel_of
from agent.recording.reading import RecordingReader
from agent.recording.signing import Signer
from agent.recording.writer import Recorder
from tests.replay.forgery import with_sums
from tests.replay.golden_files import FORMATS, GOLDEN, PRESENT, PUBLIC_KEY, RECORDING, engine_of, engine_wheel

Forge = Callable[[Output], Output]
UNKNOWN = "12-00000000deadbeef"
RELEASE = f"{known_engines()[0].number}-{known_engines()[0].id}"


def audited(*arguments: object) -> tuple[int, dict[str, Any]]:
    ran = CliRunner().invoke(audit, [*map(str, arguments), "--json", "-"], standalone_mode=False)
    assert ran.exception is None, ran.exception
    return ran.return_value, json.loads(ran.stdout)


def engines_of(directory: Path, engines: Path) -> Path:
    """A directory with the wheel of the engine that made a golden recording."""
    known, wheel = engine_wheel(directory)
    (engines / file_name(known.id)).write_bytes(wheel)
    return engines


def same(result: Output) -> Output:
    return result


def scaled(**factors: float) -> Forge:
    def forge(result: Output) -> Output:
        if not isinstance(result, CalibrationUpdate):
            return result
        values: dict[str, Any] = {}
        if "s" in factors:
            values["sensitivity"] = [[factors["s"] * x for x in row] for row in result.sensitivity]
        if "u" in factors:
            values["standard_uncertainty"] = [factors["u"] * u for u in result.standard_uncertainty]
            values["covariance"] = [[factors["u"] ** 2 * c for c in row] for row in result.covariance]
        return msgspec.structs.replace(result, **values)

    return forge


def changed(kind: type, **values: Any) -> Forge:
    return lambda result: msgspec.structs.replace(result, **values) if isinstance(result, kind) else result  # type: ignore[type-var]


def forged(directory: Path, engine: str, forge: Forge, signer: Signer | None = None) -> Path:
    """The golden recording written again under the name of an engine, with other results and every sum right."""
    directory.mkdir()
    steps = list(RecordingReader(PRESENT / RECORDING).steps())
    start = steps[0].event
    assert isinstance(start, RunStart)
    config = json.loads(start.config_json)
    sensors = [channel["sensor"] for channel in config["channels"]]
    recorder = Recorder(directory, [device["name"] for device in config["devices"]], sensors, signer=signer)
    for step in steps:
        event = msgspec.structs.replace(start, engine=engine) if step is steps[0] else step.event
        results = [forge(result) for result in step.results]
        results = [msgspec.structs.replace(r, engine=engine) if hasattr(r, "engine") else r for r in results]  # type: ignore[type-var]
        assert recorder.record(step.event_sequence, event, results), recorder.fault
    recorder.close()
    return directory / RECORDING


@pytest.mark.two_cases
@pytest.mark.parametrize("directory", [*FORMATS, GOLDEN / "engine-8"], ids=lambda path: path.name)
def test_an_earlier_recording_is_undecided_without_its_engine_and_passes_with_it(
    directory: Path, tmp_path: Path
) -> None:
    key = ["--public-key", directory / PUBLIC_KEY] if (directory / PUBLIC_KEY).exists() else []
    status, said = audited(directory / RECORDING, *key)
    (file,) = said["files"]
    assert (status, file["reasons"], said["ok"], said["undecided"]) == (4, [], False, 1)
    assert "does not name its engine" in file["undecided"][0]
    assert file["replay"]["departure"]["largest_in_u"] <= 0.04
    status, said = audited(directory / RECORDING, *key, "--engines", engines_of(directory, tmp_path))
    (file,) = said["files"]
    assert (status, file["undecided"], file["replay"]["departure"]) == (0, [], None)
    assert file["replay"]["replayed_by"].startswith(f"{engine_of(directory)}-")


def test_a_changed_byte_fails_whatever_engine_made_the_file(tmp_path: Path) -> None:
    directory = GOLDEN / "engine-8"
    data = bytearray((directory / RECORDING).read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / RECORDING).write_bytes(data)
    assert audited(tmp_path / RECORDING)[0] == 3
    at = data.index(b"previous_sha256")
    data[len(data) // 2] ^= 1
    (tmp_path / RECORDING).write_bytes(with_sums(bytes(data[:at] + b"P" + data[at + 1 :])))
    assert audited(tmp_path / RECORDING, "--public-key", directory / PUBLIC_KEY)[0] == 3


def test_forged_results_fail_by_the_engine_that_they_name(tmp_path: Path) -> None:
    assert audited(forged(tmp_path / "true", identity.name(), same))[0] == 0
    status, said = audited(forged(tmp_path / "forged", identity.name(), scaled(s=1 + 1e-12)))
    assert status == 3
    assert "do not follow from the data" in said["files"][0]["reasons"][0]


FORGERIES: dict[str, Forge] = {
    "S 3 % off": scaled(s=1.03),
    "S 0.3 % off, U x 100": scaled(s=1.003, u=100.0),
    "U x 100": scaled(u=100.0),
    "U / 2": scaled(u=0.5),
    "windows refused": changed(WindowReport, used=False),
    "more points": changed(WindowReport, points=10**6),
    "windows of a year later": changed(WindowReport, start_s=3e7, stop_s=3.1e7),
    "another unit": changed(CalibrationUpdate, output_unit="mV"),
    "another device": changed(CalibrationUpdate, identity="ADXL355 0815"),
    "in force a day later": changed(CalibrationUpdate, t_utc_ns=1_790_086_400_000_000_000),
    "nothing determined": changed(CalibrationUpdate, determined=[False] * 12),
    "always VALID": changed(StatusChange, status="VALID"),
    "another sensor": changed(CalibrationUpdate, sensor="other"),
    "another number": changed(CalibrationUpdate, sequence=77),
}


@pytest.mark.parametrize(
    ("engine", "forgeries"),
    [
        (RELEASE, list(FORGERIES)),
        *((engine, list(FORGERIES)[:4]) for engine in (UNKNOWN, "")),
        *(pytest.param(engine, list(FORGERIES)[4:], marks=pytest.mark.thorough) for engine in (UNKNOWN, "")),
    ],
)
def test_no_forgery_passes_under_the_name_of_another_engine(engine: str, forgeries: list[str], tmp_path: Path) -> None:
    passed = []
    for number, name in enumerate(forgeries):
        path = forged(tmp_path / str(number), engine, FORGERIES[name])
        status, said = audited(path)
        assert status == 4, (name, said)
        passed += [name] if said["ok"] else []
    assert passed == []


def test_what_only_another_engine_can_read_is_not_decided(tmp_path: Path) -> None:
    """A status that this version does not have; of this version's own engine it would be a fault."""
    newer = changed(StatusChange, status="RESTING")
    status, said = audited(forged(tmp_path / "newer", UNKNOWN, newer))
    assert (status, said["files"][0]["reasons"]) == (4, [])
    assert f"made by engine {UNKNOWN}" in said["files"][0]["undecided"][0]
    assert "this program cannot read it" in said["files"][0]["undecided"][0]
    assert audited(forged(tmp_path / "own", identity.name(), newer))[0] == 3


def test_near_results_pass_by_the_name_of_a_release_alone_and_are_told(tmp_path: Path) -> None:
    near = scaled(s=1 + 1e-6)
    status, said = audited(forged(tmp_path / "release", RELEASE, near))
    assert status == 0
    assert f"made by engine {RELEASE}" in said["files"][0]["notes"][0]
    assert "no decision differs" in said["files"][0]["notes"][0]
    assert any("which engine made these results" in line for line in said["end"]["unproven"])
    assert audited(tmp_path / "release" / RECORDING, "--strict")[0] == 4
    for name in (UNKNOWN, "", f"99-{RELEASE.partition('-')[2]}"):
        assert audited(forged(tmp_path / f"unknown{name}", name, near))[0] == 4


def test_a_wheel_that_is_no_release_runs_where_it_is_trusted_alone(tmp_path: Path) -> None:
    """The engine of this program, whose results are forged, under another name."""
    sources = {member: path.read_bytes() for member, path in source_files()}
    sources |= {member: (ROOT / member).read_bytes() for member in PROCESS}
    wheel = wheel_of(12, UNKNOWN[3:], sources)
    home = tmp_path / "data"
    path = forged(home, UNKNOWN, same)
    (home / "engines").mkdir()
    (home / "engines" / file_name(UNKNOWN[3:])).write_bytes(wheel)
    status, said = audited(path)
    sha256 = hashlib.sha256(wheel).hexdigest()
    assert status == 4
    assert f"--trust-engine {sha256}" in said["files"][0]["undecided"][0]
    assert audited(path, "--trust-engine", sha256)[0] == 0
    assert audited(path, "--trust-engine", sha256[:16])[0] == 0
    assert audited(path, "--trust-engine", "0" * 16)[0] == 4
    worse = forged(tmp_path / "forged", UNKNOWN, scaled(s=1 + 1e-12))
    assert audited(worse, "--trust-engine", sha256, "--engines", home / "engines")[0] == 3
