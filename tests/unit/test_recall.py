"""`fieldcal recall` as a user runs it: which results rest on a reference, and what they are by its new certificate."""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from agent.certificate.recall import PURPOSE
from agent.cli.main import run_cli
from agent.core.events import CalibrationUpdate, SharedError
from agent.delivery.history import FILE_NAME, History, StoredResult
from agent.delivery.store import Store
from agent.recording.signed_text import SignedText, values_of
from tests.unit.certificates import uneven
from tests.unit.recorded_bench import record

DURATION_S = 55.0
SERIAL = "reference-1"  # of the virtual bench
NEW = {"sensitivity": 1.004, "u_sensitivity_pct": 0.2}


def calibrations_of(directory: Path) -> list[CalibrationUpdate]:
    with History(directory / FILE_NAME) as history:
        found = [record.result for record in history.newest("mems", "calibration", limit=100)]
    return [update for update in found[::-1] if isinstance(update, CalibrationUpdate)]


def toml(path: Path, **values: Any) -> Path:
    path.write_text("[certificate]\n" + "".join(f"{name} = {json.dumps(value)}\n" for name, value in values.items()))
    return path


def recalled(directory: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text())["recall"] for path in sorted(directory.glob("recall-*.json"))]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("recorded")
    record(directory, DURATION_S, certificate={"sensitivity": 1.0, "u_sensitivity_pct": 0.3})
    return directory


@pytest.mark.slow
def test_a_corrected_result_is_that_of_the_same_data_with_the_new_certificate(recorded: Path, tmp_path: Path) -> None:
    before = (recorded / FILE_NAME).read_bytes()
    new, out = toml(tmp_path / "new.toml", **NEW), tmp_path / "out"
    assert run_cli(["recall", "--reference", SERIAL, "--new", str(new), str(recorded), "-o", str(out)]) == 0
    assert (recorded / FILE_NAME).read_bytes() == before
    record(tmp_path / "again", DURATION_S, certificate=NEW)
    expected = calibrations_of(tmp_path / "again")
    found = sorted(recalled(out), key=lambda one: one["sequence"])
    assert len(found) == len(expected) >= 2
    for corrected, update in zip(found, expected, strict=True):
        told, u = corrected["corrected"], np.array(update.standard_uncertainty)
        off = np.append(np.ravel(told["sensitivity"]), told["offset"])
        off -= np.append(np.ravel(update.sensitivity), update.offset)
        assert np.abs(off / u).max() < 0.02
        told_u = np.append(
            np.ravel(told["standard_uncertainty"]["sensitivity"]), told["standard_uncertainty"]["offset"]
        )
        np.testing.assert_allclose(told_u, u, rtol=0.02)
        assert corrected["largest_change_in_u"] > 0.5


@pytest.mark.slow
def test_a_recording_and_a_data_directory_have_the_same_results_and_each_is_corrected_once(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (recording,) = recorded.glob("*.mcap")
    new, out = toml(tmp_path / "new.toml", serial_number=SERIAL, **NEW), tmp_path / "out"
    words = ["recall", "--reference", SERIAL, "--new", new, recorded, recording, "-o", out, "--json", "-"]
    assert run_cli([str(word) for word in words]) == 0
    told, count = json.loads(capsys.readouterr().out), len(calibrations_of(recorded))
    assert (told["results_read"], told["corrected"]) == (2 * count, count)
    assert run_cli([str(word) for word in words]) == 2
    assert "not empty" in capsys.readouterr().err


@pytest.mark.thorough
def test_a_thousand_results_take_seconds_and_each_file_is_signed(recorded: Path, tmp_path: Path) -> None:
    update = calibrations_of(recorded)[-1]
    many = [msgspec.structs.replace(update, run_id="many", sequence=k) for k in range(1, 1001)]
    (tmp_path / "many").mkdir()
    store = Store(tmp_path / "many", 0)
    store.commit([StoredResult.of(r, recorded=False, recording="") for r in many], {})
    store.close()
    key = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
    pem = tmp_path / "key.pem"
    pem.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    pem.chmod(0o600)
    new, out = toml(tmp_path / "new.toml", **NEW), tmp_path / "out"
    words = ["recall", "--reference", SERIAL, "--new", new, tmp_path / "many", "-o", out, "--signing-key", pem]
    start_s = time.process_time()
    assert run_cli([str(word) for word in words]) == 0
    assert time.process_time() - start_s < 10.0
    print(f"{time.process_time() - start_s:.1f} s of CPU")
    files = sorted(out.glob("recall-*.json"))
    assert len(files) == 1000
    for path in (files[0], files[-1], out / "recall.json"):
        body = path.read_bytes().removeprefix(b'{"recall":').partition(b',\n"signature":')
        signed = SignedText.read(body[2].removesuffix(b"}\n"))
        assert signed.fault(key.public_key()) == ""
        assert values_of(signed.text, PURPOSE, ["file", "recall"]) == [path.name, hashlib.sha256(body[0]).hexdigest()]


def shared(derivative: list[list[float]], serial_number: str = "R-9") -> SharedError:
    return SharedError(
        reference="", serial_number=serial_number, certificate_sha256="", sensitivity=[1.0], unknowns=["reference"],
        kinds=["reference sensitivity"], stated=[0.0], u_stated=[1e-3], value=[0.0], own_derivative=[[1.0]],
        derivative=derivative,
    )  # fmt: skip


def test_a_result_of_calibrate_moves_by_its_derivative(tmp_path: Path) -> None:
    told, derivative = uneven(), [10.0] * 9 + [0.0] * 3
    result = tmp_path / "result.json"
    result.write_text(json.dumps(told | {"shared_errors": [msgspec.structs.asdict(shared([derivative]))]}))
    new = toml(tmp_path / "new.toml", sensitivity=1.002, u_sensitivity_pct=0.1)
    assert run_cli(["recall", "--reference", "R-9", "--new", str(new), str(result), "-o", str(tmp_path / "o")]) == 0
    (found,) = recalled(tmp_path / "o")
    np.testing.assert_allclose(found["corrected"]["sensitivity"], np.array(told["sensitivity"]) + 0.02, rtol=1e-12)
    more = 1e-6 * (1.002**2 - 1.0) * np.outer(derivative, derivative)
    np.testing.assert_allclose(found["corrected"]["covariance"], np.array(told["covariance"]) + more, rtol=1e-9)


@pytest.mark.parametrize(
    ("content", "status", "said"),
    [
        ({"shared_errors": []}, 0, "0 of 1 results rest on"),
        ({"shared_errors": [msgspec.structs.asdict(shared([[1.0]]))]}, 0, "0 of 1 results rest on"),
        ({"shared_errors": 3}, 2, "neither a JSON of"),
    ],
)
def test_what_cannot_be_used_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: dict[str, Any], status: int, said: str
) -> None:
    result = tmp_path / "result.json"
    result.write_text(json.dumps(uneven() | content))
    new = toml(tmp_path / "new.toml")
    words = ["recall", "--reference", "R-9", "--new", str(new), str(result), "-o", str(tmp_path / "o")]
    assert run_cli(words) == status
    told = capsys.readouterr()
    assert said in told.out + told.err


def test_another_serial_number_in_the_new_certificate_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = toml(tmp_path / "new.toml", serial_number="R-8")
    assert run_cli(["recall", "--reference", "R-9", "--new", str(new), str(tmp_path), "-o", str(tmp_path / "o")]) == 2
    assert "serial number R-8, not R-9" in capsys.readouterr().err
