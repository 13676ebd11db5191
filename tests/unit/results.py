"""Results of one sensor, as a pipeline would give them."""

from __future__ import annotations

import math

from agent.core.events import CalibrationUpdate, ClockReport, StatusChange, WindowReport


def window(sequence: int, *, used: bool = True, reason: str = "", left_out: int = 0) -> WindowReport:
    """A window of 6 s at 30 deg."""
    return WindowReport(
        run_id="r",
        sequence=sequence,
        sensor="mems",
        t_utc_ns=1_700_000_000_000_000_000 + sequence,
        start_s=7.0 * sequence,
        stop_s=7.0 * sequence + 6,
        position="30 deg",
        used=used,
        reason=reason,
        points=6000,
        left_out=left_out,
        numbers={"coherence": 0.99},
    )


def calibration(
    sequence: int, *, sxx: float = 26154.0, qz_known: bool = True, identity: str = "A"
) -> CalibrationUpdate:
    """S near 26000 counts per m/s2 with U = 12, Q = 250 with U = 80; what is not known is NaN."""
    s = [[sxx, 120.0, 50.0], [-195.0, 26123.0, 67.0], [-81.0, 87.0, 26295.0]]
    u = [6.0] * 9 + [40.0, 40.0, 40.0 if qz_known else math.inf]
    return CalibrationUpdate(
        run_id="r",
        sequence=sequence,
        sensor="mems",
        t_utc_ns=1_700_000_000_000_000_000 + sequence,
        sensitivity=s,
        offset=[250.0, 250.0, 250.0 if qz_known else math.nan],
        standard_uncertainty=u,
        covariance=[[u[i] ** 2 if i == j else 0.0 for j in range(12)] for i in range(12)],
        coverage_factor=2.0,
        determined=[True] * 11 + [qz_known],
        method="3 (recursive adjustment)",
        uncertainty_kind="type A, white",
        windows=8,
        residual_sd=[10.0] * 3,
        output_unit="count",
        identity=identity,
    )


def status(sequence: int, value: str = "VALID", reason: str = "8 windows") -> StatusChange:
    """A change of status."""
    return StatusChange(
        run_id="r",
        sequence=sequence,
        sensor="mems",
        t_utc_ns=1_700_000_000_000_000_000 + sequence,
        status=value,  # type: ignore[arg-type]
        before="COLLECTING",
        reason=reason,
    )


def clock(sequence: int, *, device: str = "mems") -> ClockReport:
    """A clock 0.03 % slow, 2.5 ms behind the reference's."""
    sensor = device == "mems"
    return ClockReport(
        run_id="r",
        sequence=sequence,
        sensor="mems",
        t_utc_ns=1_700_000_000_000_000_000 + sequence,
        device=device,
        role="sensor" if sensor else "reference",
        nominal_rate_hz=1000.0,
        rate_hz=999.7123,
        u_rate_hz=0.0021,
        offset_s=3.1e-4,
        u_offset_s=1.2e-5,
        jitter_s=2.2e-4,
        lag_s=2.5e-3 if sensor else math.nan,
        u_lag_s=1.5e-4 if sensor else math.nan,
        arrivals=3000,
    )
