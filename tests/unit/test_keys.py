"""`fieldcal keys`: certificates that hold together, private files that stay private, nothing written over."""

from __future__ import annotations

import os
import tomllib
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from cryptography import x509
from cryptography.x509.oid import NameOID
from cryptography.x509.verification import PolicyBuilder, Store, VerificationError

from agent.cli.keys import keys
from agent.config import Commands
from agent.config.key_file import KeyFileError
from agent.config.tls import TlsFiles, expiry_warning, tls_faults
from agent.keys.certificates import issue, make_authority
from agent.keys.files import read_signing_key


def run(directory: Path, *arguments: str) -> Result:
    result = CliRunner().invoke(keys, [*arguments, "--dir", str(directory)], standalone_mode=False)
    assert result.exception is None, result.exception
    return result


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with all keys of a site, made under a lax umask."""
    directory = tmp_path_factory.mktemp("site") / "keys"
    before = os.umask(0)
    try:
        assert run(directory, "authority").return_value == 0
        assert run(directory, "router", "--host", "localhost", "--host", "127.0.0.1").return_value == 0
        assert run(directory, "gateway", "workshop", "gateway-1").return_value == 0
        assert run(directory, "consumer", "dashboard").return_value == 0
        assert run(directory, "commander", "operator").return_value == 0
    finally:
        os.umask(before)
    return directory


def certificate(site: Path, name: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((site / f"{name}.pem").read_bytes())


def common_name(of: x509.Certificate) -> str:
    return str(of.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)


def test_private_keys_are_their_owners_alone(site: Path) -> None:
    private = sorted(site.glob("*.key"))
    assert [path.name for path in private] == [
        "ca.key", "dashboard.key", "operator.key", "router.key", "workshop.gateway-1.key",
    ]  # fmt: skip
    assert {path.stat().st_mode & 0o777 for path in private} == {0o600}
    assert site.stat().st_mode & 0o777 == 0o700
    for path in site.glob("*.pem"):
        assert b"PRIVATE" not in path.read_bytes()


def test_certificates_carry_their_names_and_hold_against_the_authority_alone(site: Path) -> None:
    names = {name: common_name(certificate(site, name)) for name in ("workshop.gateway-1", "dashboard", "operator")}
    assert names == {"workshop.gateway-1": "workshop/gateway-1", "dashboard": "dashboard", "operator": "operator"}
    verifier = PolicyBuilder().store(Store([certificate(site, "ca")])).time(datetime.now(UTC))
    verifier.build_server_verifier(x509.DNSName("localhost")).verify(certificate(site, "router"), [])
    for host, name in (("example.org", "router"), ("localhost", "dashboard")):
        with pytest.raises(VerificationError):
            verifier.build_server_verifier(x509.DNSName(host)).verify(certificate(site, name), [])
    other = make_authority("fieldcal authority", 10, datetime.now(UTC))
    with pytest.raises(VerificationError):
        PolicyBuilder().store(Store([other.certificate])).build_server_verifier(x509.DNSName("localhost")).verify(
            certificate(site, "router"), []
        )


def test_the_files_of_one_certificate_fit_together_and_others_do_not(site: Path, tmp_path: Path) -> None:
    ca, gateway = str(site / "ca.pem"), str(site / "workshop.gateway-1")
    files = TlsFiles(ca, f"{gateway}.pem", f"{gateway}.key")
    assert tls_faults(files) == []
    now = datetime.now(UTC)
    assert expiry_warning(files, now + timedelta(days=1760)) == ""
    assert "certificate: " in expiry_warning(files, now + timedelta(days=1770))
    assert " 5" in expiry_warning(files, now + timedelta(days=1770)).split(": ")[2], "days left"
    assert "expired on" in expiry_warning(files, now + timedelta(days=1830))
    assert tls_faults(TlsFiles(ca, f"{gateway}.pem", str(site / "dashboard.key"))) == [
        f"key: {site}/dashboard.key: not the private key of the certificate {gateway}.pem"
    ]
    foreign = issue(make_authority("fieldcal authority", 9, now), "workshop/gateway-1", 9, now)
    (tmp_path / "f.pem").write_bytes(foreign.certificate_pem)
    (tmp_path / "f.key").write_bytes(foreign.key_pem)
    (tmp_path / "f.key").chmod(0o644)
    assert tls_faults(TlsFiles(ca, str(tmp_path / "f.pem"), str(tmp_path / "f.key"))) == [
        f"key: {tmp_path}/f.key: other users can read or write this private key (mode 0644); run chmod 600 on it",
        f"certificate: {tmp_path}/f.pem: not signed by the authority in {ca}",
    ]
    assert tls_faults(TlsFiles(str(tmp_path / "no"), f"{gateway}.key", f"{gateway}.pem")) == [
        f"ca: {tmp_path}/no: cannot be read: No such file or directory",
        f"certificate: {gateway}.key: not a certificate in PEM",
        f"key: {gateway}.pem: not a private key in PEM without a password",
    ]


@pytest.mark.parametrize("arguments", [("authority",), ("consumer", "dashboard"), ("command", "anna")])
def test_nothing_is_written_over(site: Path, arguments: tuple[str, ...]) -> None:
    run(site, *arguments)
    before = {path: path.read_bytes() for path in site.iterdir()}
    result = run(site, *arguments)
    assert result.return_value == 2
    assert "never overwritten" in result.stderr
    assert {path: path.read_bytes() for path in site.iterdir()} == before


def test_without_an_authority_nothing_is_signed(tmp_path: Path) -> None:
    result = run(tmp_path / "new", "gateway", "workshop", "gateway-1")
    assert result.return_value == 2
    assert "ca.pem: No such file or directory; run `fieldcal keys authority` first" in result.stderr
    result = CliRunner().invoke(keys, ["gateway", "work/shop", "x", "--dir", str(tmp_path)])
    assert result.exit_code == 2
    assert run_long_name(tmp_path) == 2


def run_long_name(directory: Path) -> int:
    run(directory, "authority")
    result = run(directory, "gateway", "s" * 40, "g" * 40)
    assert "a common name may have 64 at most" in result.stderr
    return int(result.return_value)


def test_a_command_key_comes_with_the_configuration_that_lets_it_in(tmp_path: Path) -> None:
    printed = run(tmp_path, "command", "bert").stdout
    commands = Commands.model_validate(tomllib.loads(printed)["commands"])
    path = tmp_path / "bert.command.key"
    signing = read_signing_key(path)
    assert signing.key_id == commands.keys[0].id == "bert"
    assert signing.key.public_key().public_bytes_raw() == commands.keys[0].public_bytes
    assert commands.keys[0].may("hold", "any")
    path.chmod(0o640)
    with pytest.raises(KeyFileError, match="other users can read or write this private key"):
        read_signing_key(path)


@pytest.mark.parametrize("content", [b"", b"fieldcal command key x\n", b"\xff" * 99, b"-----BEGIN PRIVATE KEY-----\n"])
def test_a_file_that_is_no_command_key_is_one_clear_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "k"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(KeyFileError, match="not a command key"):
        read_signing_key(path)
