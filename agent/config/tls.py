"""The certificate files for TLS, and the check that they belong together."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from agent.config.key_file import KeyFileError, read_key_file, read_private_key

if TYPE_CHECKING:  # loaded only when files are checked, since it is slow
    from cryptography.x509 import Certificate

# A warning is given this long before a certificate expires: time to make a new one, travel and install it.
SOON = timedelta(days=60)


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Paths of PEM files, see `fieldcal keys`.

    `ca`: certificate of the trusted authority. `certificate`: the one that this side shows. `key`: its private key.
    """

    ca: str
    certificate: str
    key: str


def tls_faults(files: TlsFiles) -> list[str]:
    """The faults of the files, one line each with field, file and reason; empty where the files belong together.

    An expired certificate is not a fault but a warning (`expiry_warning`): the gateway must go on measuring without it.
    """
    from cryptography.exceptions import InvalidSignature

    faults: list[str] = []
    ca, certificate = (_certificate(name, getattr(files, name), faults) for name in ("ca", "certificate"))
    key = None
    try:
        key, _ = read_private_key(Path(files.key))
    except KeyFileError as error:
        faults.append(f"key: {error}")
    if key is not None and certificate is not None and key.public_key() != certificate.public_key():
        faults.append(f"key: {files.key}: not the private key of the certificate {files.certificate}")
    if ca is not None and certificate is not None:
        try:
            certificate.verify_directly_issued_by(ca)
        except (InvalidSignature, ValueError, TypeError):
            faults.append(f"certificate: {files.certificate}: not signed by the authority in {files.ca}")
    return faults


def expiry_warning(files: TlsFiles, now: datetime) -> str:
    """A warning about certificates that have expired or expire within SOON of `now`; "" where none does."""
    faults: list[str] = []
    for name in ("ca", "certificate"):
        certificate = _certificate(name, getattr(files, name), faults)
        if certificate is not None and (left := certificate.not_valid_after_utc - now) < SOON:
            over = "expired on" if left.total_seconds() < 0 else f"expires in {left.days} days, on"
            faults.append(
                f"{name}: {getattr(files, name)}: {over} {certificate.not_valid_after_utc:%Y-%m-%d %H:%M} UTC"
            )
    return "; ".join(faults)


def _certificate(name: str, path: str, faults: list[str]) -> Certificate | None:
    from cryptography.x509 import load_pem_x509_certificate

    try:
        return load_pem_x509_certificate(read_key_file(Path(path)))
    except KeyFileError as error:
        faults.append(f"{name}: {error}")
    except ValueError:
        faults.append(f"{name}: {path}: not a certificate in PEM")
    return None
