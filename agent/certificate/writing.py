"""The files of a certificate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from agent.certificate.content import ResultCertificate
from agent.certificate.dcc import dcc
from agent.certificate.html import page
from agent.certificate.making import as_object
from agent.certificate.pdf import pdf
from agent.certificate.schema import check_schema
from agent.certificate.signing import CertificateSigner, as_json
from agent.certificate.x509 import X509Signer
from agent.config.whole_files import write_together

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

NAME = "certificate"


def write(
    c: ResultCertificate,
    directory: Path,
    key: Ed25519PrivateKey | None,
    xsd: Path | None = None,
    x509: X509Signer | None = None,
) -> list[Path]:
    """Write the certificate in all forms into `directory`, which is created if needed, and its signatures.

    With `xsd`, the schema of the DCC, the XML must be valid. Raises OSError, CertificateError and SchemaError; with the
    latter two nothing is written. A disk that is full leaves what was there before.
    """
    signer = CertificateSigner(key, c.number)
    xml = dcc(c, signer)  # the only form that can refuse a content, so it is made first
    if xsd is not None:
        check_schema(xml, xsd)
    files = {
        f"{NAME}.pdf": pdf(c, signer.words),
        f"{NAME}.html": page(c, signer.words).encode(),
        f"{NAME}.xml": xml,
        f"{NAME}.json": as_json(msgspec.json.encode(as_object(c)), signer),
    }
    if (signature := signer.sign(files)) is not None:
        files[f"{NAME}.sig"] = signature + b"\n"
    if x509 is not None:
        files |= x509.files(files)
    directory.mkdir(parents=True, exist_ok=True)
    write_together(directory, files)
    return [directory / name for name in files]
