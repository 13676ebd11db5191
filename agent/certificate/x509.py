"""The signature of a certificate by an X.509 certificate: a detached CMS over the list of the SHA-256 of its files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agent.config.key_file import KeyFileError, read_key_file, read_private_key

LIST, SIGNATURE = "certificate.sha256", "certificate.p7s"


@dataclass(frozen=True, slots=True)
class X509Signer:
    """A private key (RSA or EC), its certificate, and the certificates between it and the authority."""

    key: Any
    chain: tuple[Any, ...]

    @staticmethod
    def load(key: Path, certificates: Path) -> X509Signer:
        """Read the key, and certificates in PEM, that of the key first. Raises KeyFileError."""
        from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
        from cryptography.hazmat.primitives.asymmetric.rsa import RSAPrivateKey
        from cryptography.x509 import load_pem_x509_certificates

        private, _ = read_private_key(key)
        if not isinstance(private, RSAPrivateKey | EllipticCurvePrivateKey):
            raise KeyFileError(f"{key}: CMS needs an RSA or EC key; `openssl genpkey -algorithm RSA` makes one")
        try:
            chain = tuple(load_pem_x509_certificates(read_key_file(certificates)))
        except ValueError:
            raise KeyFileError(f"{certificates}: not X.509 certificates in PEM") from None
        if chain[0].public_key() != private.public_key():
            raise KeyFileError(f"{certificates}: the first certificate is not of the key {key}; put it first")
        return X509Signer(private, chain)

    def files(self, parts: Mapping[str, bytes]) -> dict[str, bytes]:
        """The list of the parts, as sha256sum writes it, and the signature over it (DER)."""
        from cryptography.hazmat.primitives.hashes import SHA256
        from cryptography.hazmat.primitives.serialization import Encoding
        from cryptography.hazmat.primitives.serialization.pkcs7 import PKCS7Options, PKCS7SignatureBuilder

        told = "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in parts.items()).encode()
        builder = PKCS7SignatureBuilder().set_data(told).add_signer(self.chain[0], self.key, SHA256())
        for certificate in self.chain[1:]:
            builder = builder.add_certificate(certificate)
        return {
            LIST: told,
            SIGNATURE: builder.sign(Encoding.DER, [PKCS7Options.DetachedSignature, PKCS7Options.Binary]),
        }
