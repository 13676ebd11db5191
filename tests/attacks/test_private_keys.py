"""A private key that another user may read or write is refused, whatever it is used for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from agent.cli.keys import keys
from agent.config.key_file import KeyFileError
from agent.config.tls import TlsFiles, tls_faults
from agent.delivery.router import open_router
from agent.delivery.session import EndpointError, session_config
from agent.keys.files import read_signing_key
from agent.recording.signing import Signer, load_public_key
from tests.attacks.chain_site import KEY, public_pem


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a key of each kind."""
    directory = tmp_path_factory.mktemp("site")
    for arguments in (["authority"], ["consumer", "tls"], ["command", "anna"]):
        result = CliRunner().invoke(keys, [*arguments, "--dir", str(directory)], standalone_mode=False)
        assert (result.exception, result.return_value) == (None, 0)
    signing = Ed25519PrivateKey.generate().private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    (directory / "signing.key").write_bytes(signing)
    (directory / "signing.key").chmod(0o600)
    return directory


def tls(directory: Path) -> TlsFiles:
    return TlsFiles(*(str(directory / name) for name in ("ca.pem", "tls.pem", "tls.key")))


def tls_check(directory: Path) -> None:
    if faults := tls_faults(tls(directory)):
        raise KeyFileError("; ".join(faults))


def authority(directory: Path) -> None:
    new = directory / "new.pem"
    result = CliRunner().invoke(keys, ["consumer", "new", "--dir", str(directory)], standalone_mode=False)
    made = new.exists()
    for path in directory.glob("new.*"):
        path.unlink()
    if not made:
        raise KeyFileError(result.output)


def router(directory: Path) -> None:
    config = directory / "router.json5"
    held = f'{{listen: {{endpoints: ["tls/127.0.0.1:0"]}}, transport: {{link: {{tls: {{listen_private_key: "{directory}/tls.key", listen_certificate: "{directory}/tls.pem"}}}}}}}}'  # noqa: E501
    config.write_text(held)
    session, _ = open_router(None, config)
    session.close()


USES: list[tuple[str, Callable[[Path], object]]] = [
    ("signing.key", lambda directory: Signer.load(directory / "signing.key")),
    ("anna.command.key", lambda directory: read_signing_key(directory / "anna.command.key")),
    ("tls.key", tls_check),
    ("tls.key", lambda directory: session_config("client", tls=tls(directory))),
    ("tls.key", router),
    ("ca.key", authority),
]


@pytest.mark.parametrize(("name", "use"), USES)
def test_only_the_owner_may_have_rights_on_a_private_key(site: Path, name: str, use: Callable[[Path], object]) -> None:
    key = site / name
    use(site)  # with the rights that it has, the key is good
    try:
        for mode in (0o604, 0o640, 0o620, 0o602, 0o601, 0o644):
            key.chmod(mode)
            with pytest.raises((KeyFileError, EndpointError), match=f"mode {mode:04o}.*chmod 600") as told:
                use(site)
            assert str(key) in str(told.value)
            assert "PRIVATE" not in str(told.value)
        target, key_link = key.rename(site / "elsewhere"), key
        key_link.symlink_to(target)
        with pytest.raises((KeyFileError, EndpointError), match="mode 0644"):
            use(site)
        key_link.unlink()
        target.rename(key)
    finally:
        key.chmod(0o600)


def test_a_file_with_two_public_keys_is_refused_whichever_is_the_first(tmp_path: Path) -> None:
    both = [public_pem(KEY), public_pem(Ed25519PrivateKey.from_private_bytes(bytes(range(1, 33))))]
    for pems in (both, both[::-1]):
        path = tmp_path / "gateway.pub"
        path.write_bytes(b"".join(pems))
        with pytest.raises(KeyFileError, match="2 keys, of which one would be taken"):
            load_public_key(path)
    path.write_bytes(both[0])
    assert load_public_key(path).public_bytes_raw() == KEY.public_key().public_bytes_raw()
