"""Reads the certificate of a reference: TOML as in a configuration, or a certificate of `fieldcal certificate`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from agent.calibrate.origin import source_file
from agent.config.certified import u_transverse
from agent.config.earlier import MAIN, EarlierError, identity_in, read_earlier
from agent.config.knowledge import Certificate
from agent.config.reading import ConfigError, load_model
from agent.config.section import Section
from agent.reading.source import TableError
from calib.recorded.certificate import ReferenceCertificate


class _Toml(Section):
    certificate: Certificate


def read_reference_certificate(path: Path) -> ReferenceCertificate:
    """Read it. Raises TableError."""
    try:
        sha256 = source_file(path).sha256
        if path.suffix != ".toml":
            return _of_ours(path, sha256)
        stated = load_model(path, _Toml).certificate
    except (ConfigError, EarlierError) as error:
        raise TableError(str(error)) from None
    except OSError as error:
        raise TableError(f"{path}: {error.strerror or error}") from None
    return ReferenceCertificate(
        str(path),
        sha256,
        stated.serial_number,
        np.array([stated.sensitivity]),
        np.array([stated.u_sensitivity_pct / 100.0]),
        stated.u_transverse_pct / 100.0,
        (stated.corner_hz, stated.u_corner_hz) if stated.u_corner_hz else None,
        stated.known_filters,
    )


def _of_ours(path: Path, sha256: str) -> ReferenceCertificate:
    """A certificate by `fieldcal certificate`, of the main sensitivities of a tri-axial reference."""
    values, covariance = read_earlier(path)
    sensitivity, variance = values[MAIN], np.diag(covariance)[MAIN]
    if not np.isfinite([sensitivity, variance]).all() or (sensitivity <= 0.0).any():
        raise TableError(f"{path}: a main sensitivity of the reference is not known or not above 0")
    return ReferenceCertificate(
        str(path), sha256, identity_in(path)[0], sensitivity, np.sqrt(variance) / sensitivity,
        u_transverse(values, covariance),
    )  # fmt: skip
