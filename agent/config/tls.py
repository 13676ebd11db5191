"""The files that TLS takes, and whether they fit together."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # only who checks files pays for it
    from cryptography.x509 import Certificate

# Time to make a certificate, travel and put it in place.
SOON = timedelta(days=60)


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """PEM files, see `fieldcal keys`: who is trusted, who we are, and the private key to it."""

    ca: str
    certificate: str
    key: str


def tls_faults(files: TlsFiles) -> list[str]:
    """What is wrong with them, one line each, naming the field, the file and why. Empty where they fit together.

    A certificate whose time is over is none of these (`expiry_warning`): a gateway must go on measuring without one.
    """
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    faults: list[str] = []
    ca, certificate = (_certificate(name, getattr(files, name), faults) for name in ("ca", "certificate"))
    key = None
    text = _text("key", files.key, faults)
    if text is not None:
        try:
            key = load_pem_private_key(text, password=None)
        except (ValueError, TypeError):
            faults.append(f"key: {files.key}: no private key in PEM without a password")
        if Path(files.key).stat().st_mode & (stat.S_IROTH | stat.S_IWOTH):
            faults.append(f"key: {files.key}: everybody can read it: chmod 600")
    if key is not None and certificate is not None and key.public_key() != certificate.public_key():
        faults.append(f"key: {files.key}: not the key of {files.certificate}")
    if ca is not None and certificate is not None:
        try:
            certificate.verify_directly_issued_by(ca)
        except (InvalidSignature, ValueError, TypeError):
            faults.append(f"certificate: {files.certificate}: not signed by {files.ca}")
    return faults


def expiry_warning(files: TlsFiles, now: datetime) -> str:
    """What to say of certificates that are over, or will be within SOON; "" where there is nothing to say."""
    faults: list[str] = []
    for name in ("ca", "certificate"):
        certificate = _certificate(name, getattr(files, name), faults)
        if certificate is not None and (left := certificate.not_valid_after_utc - now) < SOON:
            over = "is over since" if left.total_seconds() < 0 else f"has {left.days} days left, to"
            faults.append(
                f"{name}: {getattr(files, name)}: {over} {certificate.not_valid_after_utc:%Y-%m-%d %H:%M} UTC"
            )
    return "; ".join(faults)


def _certificate(name: str, path: str, faults: list[str]) -> Certificate | None:
    from cryptography.x509 import load_pem_x509_certificate

    text = _text(name, path, faults)
    if text is None:
        return None
    try:
        return load_pem_x509_certificate(text)
    except ValueError:
        faults.append(f"{name}: {path}: no certificate in PEM")
        return None


def _text(name: str, path: str, faults: list[str]) -> bytes | None:
    try:
        with open(path, "rb") as file:
            return file.read(1 << 16)
    except OSError as error:
        faults.append(f"{name}: {path}: cannot be read: {error.strerror}")
        return None
