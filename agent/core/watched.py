"""A sensor without a reference: which calibration is in force, how its U grows, and the result of an hour."""

from __future__ import annotations

import msgspec
import numpy as np

from agent.config import Channel
from agent.core.estimation import DAY_S, STATED
from agent.core.events import CalibrationUpdate, WatchReport
from agent.core.mean_watch import MeanWatch
from agent.core.outcome import ResultSource, again
from agent.core.watch import HOUR_NS, Hour
from calib.estimate.correction import Law
from calib.model import Array, Calibration, scale_of

DAY_NS = round(DAY_S * 1e9)
MAIN = [0, 4, 8]  # places of the main sensitivities among the parameters
WATCHED = "no reference: watched"
NOT_CALIBRATED = (
    f"{WATCHED}, with no calibration in force; state that of a bench or a visit in prior.file, and its date in "
    "prior.calibrated"
)
SINCE = "walks since the calibration"  # a line of the budget


def date_utc_ns(channel: Channel) -> int:
    """Date of the calibration that the configuration states; 0 if it states no date."""
    stated = channel.prior.date
    return 0 if stated is None else round(stated.timestamp()) * 10**9


def is_newer(channel: Channel, stated: Calibration, in_force: CalibrationUpdate | None) -> bool:
    """Whether the calibration that the configuration states with its date is to replace the one in force.

    One that was stated before is replaced wherever the statement is another one now.
    """
    date_ns = date_utc_ns(channel)
    if not date_ns:
        return False
    if in_force is None or in_force.method != STATED:
        return in_force is None or in_force.date_utc_ns < date_ns
    S, Q = np.array(in_force.sensitivity), np.array(in_force.offset)
    same = np.array_equal(S, stated.sensitivity) and np.array_equal(Q, stated.offset)
    return not same or in_force.date_utc_ns != date_ns


def aged(law: Law, channel: Channel, in_force: CalibrationUpdate, t_utc_ns: int) -> Law:
    """The law in whole hours after the date of the calibration in force: S and Q may have walked, and Q drifted."""
    return law.aged(walked(channel, in_force, t_utc_ns))


def walked(channel: Channel, in_force: CalibrationUpdate, t_utc_ns: int) -> Array:
    """(12,) variance that S and Q gained since."""
    hours = max((t_utc_ns - in_force.date_utc_ns) // HOUR_NS, 0)
    scale = scale_of(np.ravel(in_force.sensitivity))
    drift = np.hypot(in_force.offset_rate or np.zeros(3), in_force.u_offset_rate or np.zeros(3))
    return channel.wander().variance_after(hours / 24.0, scale, 0.0, drift)


def in_force_since(in_force: CalibrationUpdate, law: Law, source: ResultSource) -> CalibrationUpdate:
    """The calibration in force with the U that it has by the law now: the same calibration, with the same date."""
    covariance = law.covariance[:12, :12]
    variance = covariance.diagonal()
    parts = {name: u for name, u in in_force.budget.items() if name != SINCE}
    if parts:
        known = np.sum(np.square(list(parts.values())), axis=0)
        parts[SINCE] = np.sqrt(np.maximum(variance - known, 0.0)).tolist()
    u = {"covariance": covariance.tolist(), "standard_uncertainty": np.sqrt(variance).tolist()}
    now = msgspec.structs.replace(in_force, t_utc_ns=source.t_utc_ns, **u)
    return msgspec.structs.replace(again(now, in_force), budget=parts)


def watch_report(
    source: ResultSource, hour: Hour, in_force: CalibrationUpdate | None, law: Law, means: MeanWatch
) -> WatchReport:
    """The result of an hour, of which `means` takes note."""
    made = ("", 0) if in_force is None else in_force.made
    gravity = means.update(hour, made, law)
    u = np.sqrt(law.covariance.diagonal()[MAIN]) / np.abs(law.mean[MAIN])
    degc, scatter_degc = hour.temperature_degc
    return WatchReport(
        run_id="", sequence=0, sensor=source.sensor, t_utc_ns=source.t_utc_ns, hour_utc_ns=hour.hour_utc_ns,
        duration_s=hour.duration_s, samples=hour.counts["samples"], stuck=hour.counts["stuck"],
        clipped=hour.counts["clipped"], missing=hour.counts["missing"], segments=hour.segments,
        mean_mps2=hour.mean.tolist(), mean_scatter_mps2=hour.mean_scatter.tolist(), temperature_degc=degc,
        temperature_scatter_degc=scatter_degc, noise_psd=hour.noise_psd.tolist(), band_hz=hour.centre_hz.tolist(),
        band_power=hour.power[:3].ravel().tolist(), cross_power=hour.power[3:].ravel().tolist(),
        peak_frequency_hz=_short(hour.frequency_hz), u_peak_frequency_hz=_short(hour.u_frequency_hz),
        calibration_run_id=made[0], calibration_sequence=made[1], u_main_pct=(100.0 * u).tolist(),
        gravity=gravity,
    )  # fmt: skip


def _short(values: Array) -> list[float]:
    """The values to six digits, a tenth of what an hour tells of a frequency: a third of the bytes of all digits."""
    return [float(f"{value:.6g}") for value in values.ravel().tolist()]
