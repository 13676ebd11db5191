"""The content of a certificate: what was stated, what was measured, and what follows from both.

`agent/certificate/making.py` makes it.
"""

from __future__ import annotations

from dataclasses import dataclass

from agent.calibrate.origin import SourceFile
from agent.certificate.statements import CertificateStatements
from agent.core.events import CalibrationUpdate
from agent.report.result import CalibrationResult
from agent.report.trace import Residuals
from calib.distributions import NORMAL
from calib.model import Array

COVERAGE_PROBABILITY = NORMAL.cdf(2.0) - NORMAL.cdf(-2.0)  # 95.45 %, for which `coverage_factor` gives k
MAIN = [0, 4, 8]
EQUATION = "V(t) = S a(t − lag) + Q"


class CertificateError(Exception):
    """No certificate can be made with these statements. The message names the field and the remedy."""


@dataclass(frozen=True, slots=True)
class ConformityVerdict:
    """One main sensitivity against the limit: deviation from the nominal one and U, both in %."""

    parameter: str
    deviation_pct: float
    expanded_uncertainty_pct: float
    limit_pct: float
    conforms: bool


@dataclass(frozen=True, slots=True, eq=False)
class ResultCertificate:
    """All that the forms of a certificate show. `relative_pct` (12,): U of S in % of the main sensitivity of its row,
    NaN for Q. `levels_mps2`: least and largest rms of the motion in a used window. `seen`: residuals for the figure."""

    stated: CertificateStatements
    number: str
    sensor: str
    result: CalibrationResult
    reference_file: SourceFile | None
    files: tuple[SourceFile, ...]
    temperature_degc: tuple[float, float] | None
    frequency_hz: tuple[float, ...]
    levels_mps2: tuple[float, float] | None
    positions: tuple[str, ...]
    relative_pct: Array
    verdicts: tuple[ConformityVerdict, ...]
    history: tuple[CalibrationUpdate, ...]
    seen: tuple[Residuals, ...]

    @property
    def statement(self) -> str:
        """Whether the calibration is accredited."""
        accredited = self.stated.accreditation
        if accredited is None:
            return (
                "This is a field calibration: the sensor was calibrated where it is used. It is not accredited. "
                "It does not claim conformity with ISO/IEC 17025."
            )
        return f"The organisation states that {accredited.body} accredited it for this, number {accredited.number}."

    @property
    def method(self) -> str:
        """The method in words."""
        told = str(self.result.fields.get("method") or "3")
        return f"In-place comparison with a reference, method {told} of D'Emilia et al. (2018)"
