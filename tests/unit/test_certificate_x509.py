"""The X.509 signature of a certificate is what openssl verifies, with a chain from an authority."""

from __future__ import annotations

import datetime
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from agent.certificate.x509 import X509Signer
from agent.cli.main import run_cli
from agent.config.key_file import KeyFileError
from tests.unit.certificates import stated, uneven

PARTS = {"certificate.pdf": b"%PDF", "certificate.xml": b"<x/>\r\n"}


def issued(name: str, key: Any, issuer: str, issuer_key: Any, authority: bool) -> x509.Certificate:
    def named(text: str) -> x509.Name:
        return x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, text)])

    begin = datetime.datetime.now(datetime.UTC) - datetime.timedelta(hours=1)
    return (
        x509.CertificateBuilder().subject_name(named(name)).issuer_name(named(issuer)).public_key(key.public_key())
        .serial_number(x509.random_serial_number()).not_valid_before(begin)
        .not_valid_after(begin + datetime.timedelta(days=2))
        .add_extension(x509.BasicConstraints(authority, None), critical=True).sign(issuer_key, SHA256())
    )  # fmt: skip


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """authority.pem; chain.pem of an office and its laboratory; key.pem of the laboratory."""
    keys = [ec.generate_private_key(ec.SECP256R1()) for _ in range(3)]
    names = ["authority", "office", "laboratory"]
    made = [issued(n, k, names[max(i - 1, 0)], keys[max(i - 1, 0)], i < 2)
            for i, (n, k) in enumerate(zip(names, keys, strict=True))]  # fmt: skip
    (tmp_path / "authority.pem").write_bytes(made[0].public_bytes(Encoding.PEM))
    (tmp_path / "chain.pem").write_bytes(made[2].public_bytes(Encoding.PEM) + made[1].public_bytes(Encoding.PEM))
    own: dict[str, ec.EllipticCurvePrivateKey | ed25519.Ed25519PrivateKey]
    own = {"key.pem": keys[2], "ed25519.pem": ed25519.Ed25519PrivateKey.generate()}
    for name, key in own.items():
        (tmp_path / name).write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
        (tmp_path / name).chmod(0o600)
    return tmp_path


def run(directory: Path, *words: str) -> int:
    return subprocess.run(words, cwd=directory, capture_output=True, timeout=60, check=False).returncode


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_openssl_verifies_it_and_notices_every_change(site: Path) -> None:
    written = X509Signer.load(site / "key.pem", site / "chain.pem").files(PARTS)
    assert list(written) == ["certificate.sha256", "certificate.p7s"]
    for name, content in {**PARTS, **written}.items():
        (site / name).write_bytes(content)
    verify = ("openssl", "cms", "-verify", "-binary", "-inform", "DER", "-in", "certificate.p7s",
              "-content", "certificate.sha256", "-CAfile")  # fmt: skip
    check = ("sha256sum", "-c", "certificate.sha256")
    assert (run(site, *verify, "authority.pem"), run(site, *check)) == (0, 0)
    (site / "certificate.xml").write_bytes(b"<y/>\r\n")
    assert run(site, *check) != 0
    (site / "certificate.sha256").write_bytes(written["certificate.sha256"].replace(b"xml", b"XML"))
    assert run(site, *verify, "authority.pem") != 0
    (site / "certificate.sha256").write_bytes(written["certificate.sha256"])
    other = ec.generate_private_key(ec.SECP256R1())
    (site / "other.pem").write_bytes(issued("other", other, "other", other, True).public_bytes(Encoding.PEM))
    assert run(site, *verify, "other.pem") != 0


@pytest.mark.thorough
def test_the_command_writes_it_beside_the_files(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib", reason="the PDF needs the extra `report`")
    (site / "result.json").write_text(json.dumps(uneven()))
    words = ["certificate", str(site / "result.json"), "--stated", str(stated(site)), "-o", str(site / "out")]
    words += ["--x509-key", str(site / "key.pem")]
    assert run_cli(words) == 2
    assert "must be given together" in capsys.readouterr().err
    assert run_cli([*words, "--x509-certificate", str(site / "chain.pem")]) == 0
    assert run(site / "out", "sha256sum", "-c", "certificate.sha256") == 0
    listed = [line.split()[1] for line in (site / "out" / "certificate.sha256").read_text().splitlines()]
    assert listed == ["certificate.pdf", "certificate.html", "certificate.xml", "certificate.json"]
    assert (site / "out" / "certificate.p7s").stat().st_size > 500


def test_keys_and_certificates_that_do_not_fit(site: Path) -> None:
    with pytest.raises(KeyFileError, match=r"ed25519\.pem: CMS needs an RSA or EC key"):
        X509Signer.load(site / "ed25519.pem", site / "chain.pem")
    with pytest.raises(KeyFileError, match=r"authority\.pem: the first certificate is not of the key"):
        X509Signer.load(site / "key.pem", site / "authority.pem")
    with pytest.raises(KeyFileError, match=r"key\.pem: not X\.509 certificates in PEM"):
        X509Signer.load(site / "key.pem", site / "key.pem")
