"""What the tests of certificates share: a result whose numbers need all their digits, statements, the command."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.certificate.making import as_object, certificate_of
from agent.certificate.statements import CertificateStatements
from agent.cli.main import run_cli
from agent.config.reading import load_model
from agent.report.material import gather
from agent.report.writing import left_over
from tests.unit.test_report_numbers import fields

STATED = Path(__file__).parents[2] / "examples" / "certificate.toml"
BANDS = [
    {"low_hz": low, "high_hz": 1.26 * low, "sensitivity_re": (np.eye(3) * (10.0 + low / 7.0)).tolist(),
     "sensitivity_im": (np.eye(3) * low / 3.0).tolist(), "standard_uncertainty": np.full((3, 3), 0.1 / 3.0).tolist()}
    for low in (1.0, 1.26)
]  # fmt: skip


def uneven(seed: int = 5) -> dict[str, Any]:
    """A result whose numbers need all their digits."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(12, 12)) * 1e-3
    covariance = A @ A.T
    u, k = np.sqrt(np.diag(covariance)), 2.0 + 1.0 / 3.0
    return fields(
        sensitivity=(10.0 * np.eye(3) + rng.normal(size=(3, 3)) / 3.0).tolist(), offset=rng.normal(size=3).tolist(),
        covariance=covariance.tolist(), degrees_of_freedom=121.0 / 7.0, method="3 (adjustment)", response=BANDS,
        standard_uncertainty={"sensitivity": u[:9].reshape(3, 3).tolist(), "offset": u[9:].tolist()},
        expanded_uncertainty={"sensitivity": (k * u[:9]).reshape(3, 3).tolist(), "offset": (k * u[9:]).tolist(),
                              "coverage_factor": k},
        reference_frequency_hz=2.7, valid_band_hz=[0.9, 8.1],
    )  # fmt: skip


def stated(folder: Path, **changes: str) -> Path:
    """The example's statements; each change is a section of lines that replaces or adds to it."""
    text = STATED.read_text().replace("nominal = 26104.7", "nominal = 10.0")
    for section, lines in changes.items():
        text = re.sub(rf"\[{section}\]\n(?:[^\[\n].*\n|\n)*", "", text) + (f"\n[{section}]\n{lines}\n" if lines else "")
    path = folder / "certificate.toml"
    path.write_text(text)
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str]:
    status = run_cli(["certificate", *map(str, arguments)])
    return status, capsys.readouterr().err


def content(inputs: Sequence[Path], path: Path) -> dict[str, Any]:
    """What certificate.json would hold, without drawing."""
    material = gather(inputs, None)
    found = certificate_of(material, load_model(path, CertificateStatements), path.parent, left_over(material))
    held: dict[str, Any] = json.loads(msgspec.json.encode(as_object(found)))
    return held
