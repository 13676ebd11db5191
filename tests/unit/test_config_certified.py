"""`prior.file` and `certificate.file`: the configuration takes over what a certificate states, with its hash."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from agent.cli.main import run_cli
from agent.config import load_config, recorded_config
from tests.unit.certificates import stated, uneven
from tests.unit.test_check import GOOD, checked

PRIOR = "sensitivity = 26000"
TRUE = uneven()
VALUES = np.append(np.ravel(TRUE["sensitivity"]), TRUE["offset"])
U = np.sqrt(np.diag(TRUE["covariance"]))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    (folder / "result.json").write_text(json.dumps(TRUE))
    words = ["certificate", folder / "result.json", "--stated", stated(folder), "-o", folder]
    assert run_cli([str(word) for word in words]) == 0
    return folder


@pytest.mark.one_case
@pytest.mark.parametrize("name", ["certificate.xml", "certificate.json", "result.json"])
def test_the_prior_is_what_the_file_states_and_a_recording_carries_it(made: Path, tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_bytes((made / name).read_bytes())
    path = tmp_path / "gateway.toml"
    path.write_text(GOOD.replace(PRIOR, f'file = "{file}"'))
    config = load_config(path)
    prior = config.channels[0].prior
    mean = prior.mean(None)
    np.testing.assert_allclose(mean, VALUES, rtol=1e-14)
    np.testing.assert_allclose(prior.standard_uncertainty(mean), U, rtol=1e-14)
    assert prior.file_sha256 == hashlib.sha256(file.read_bytes()).hexdigest()
    file.unlink()
    assert recorded_config(config.model_dump_json()) == config


@pytest.mark.slow
@pytest.mark.parametrize("name", ["certificate.xml", "certificate.json"])
def test_the_reference_has_the_mean_main_sensitivity_its_number_and_its_date(
    made: Path, tmp_path: Path, name: str
) -> None:
    path = tmp_path / "gateway.toml"
    second = f'[channels.check_reference]\ndevice = "imu2"\ncertificate.file = "{made / name}"\n'
    device = """[[devices]]\nname = "imu2"\ndriver = "serial-csv"\noptions = { port = "/dev/b", rate_hz = 100 }\n"""
    path.write_text(f'{GOOD}[channels.certificate]\nfile = "{made / name}"\nstability_pct = 0.25\n{second}{device}')
    channel = load_config(path).channels[0]
    S, variance = VALUES[[0, 4, 8]], U[[0, 4, 8]] ** 2
    assert channel.check_reference is not None
    for certificate in (channel.certificate, channel.check_reference.certificate):
        assert certificate.sensitivity == pytest.approx(S.mean(), rel=1e-14)
        u_pct = 100.0 * np.sqrt((variance + (S - S.mean()) ** 2).max()) / S.mean()
        assert certificate.u_sensitivity_pct == pytest.approx(u_pct, rel=1e-12)
        assert (certificate.serial_number, certificate.calibrated) == ("A-0042", "2026-11-20")
    assert channel.certificate.stability_pct == 0.25


@pytest.mark.slow
def test_faults_have_their_lines(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, xml = tmp_path / "gateway.toml", made / "certificate.xml"
    (tmp_path / "bad.xml").write_bytes(b"<!DOCTYPE x>" + xml.read_bytes())
    (tmp_path / "partly.json").write_text(json.dumps(TRUE | {"sensitivity": [[1, None, 0], [0, 1, 0], [0, 0, 1]]}))
    cases = {
        'file = "missing.xml"': "prior.file: missing.xml: cannot be read: No such file or directory",
        f'file = "{tmp_path}/bad.xml"': "line 1: the XML has a document type (DOCTYPE) or an entity",
        f'file = "{tmp_path}/partly.json"': "state sensitivity, u_main_pct and u_transverse_pct instead of file",
        f'u_main_pct = 1\nfile = "{xml}"': f"prior.u_main_pct: {xml} states it too; remove it here, or remove file",
        f'file_sha256 = "{"0" * 64}"\nfile = "{xml}"': "name the file that was meant, or state this one",
        "file = 3": "prior.file: a text in quotes is needed, not 3",
    }
    for lines, words in cases.items():
        faults = checked(path, GOOD.replace(PRIOR, lines), capsys)
        assert len(faults) == 1, faults
        assert faults[0].startswith("line 23: channels.0.prior."), faults
        assert any(words in fault for fault in faults), faults
    text = f'{GOOD}[channels.certificate]\nfile = "{xml}"\nsensitivity = 1.0\n'
    assert checked(path, text, capsys) == [
        f"line 28: channels.0.certificate.sensitivity: {xml} states it too; remove it here, or remove file"
    ]
