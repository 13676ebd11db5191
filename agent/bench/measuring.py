"""From the samples of a session to windows: of the stop that is being taken, and of all stops together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agent.bench.capture import DeviceSamples
from agent.bench.stops import BenchStop
from agent.config import Channel
from calib.adjustment.adjustment import adjust
from calib.estimate.nuisances import Applied, Priors
from calib.excitation.front_end import Settings, most_margin_s
from calib.excitation.lag_search import without_lag
from calib.excitation.window_verdict import Limits
from calib.model import Array, Window
from calib.recorded.adjusting import adjusted, over_frequency, with_response
from calib.recorded.options import Options
from calib.recorded.outcome import Outcome
from calib.recorded.poses import PoseInterval
from calib.recorded.priors import instrument_of, priors_of
from calib.recorded.table import ReferenceTable, SensorTable
from calib.recorded.tables import Making, Tables

FEWEST = 10  # samples of a device that make a clock
Record = Mapping[str, DeviceSamples]
QUANTITY = {"acceleration": ("a",), "velocity": ("v",), "displacement": ("d",)}


@dataclass(frozen=True, slots=True, eq=False)
class StopInterval:
    """A stop from `start_s` to `stop_s`."""

    stop: BenchStop
    start_s: float
    stop_s: float


class Measuring:
    """The windows of a session's samples. `lag_s` is the sensor's lag behind the reference, as far as it is known."""

    def __init__(self, channel: Channel, options: Options) -> None:
        """`options` are those of `fieldcal calibrate` by which the result will be made."""
        self._channel, self._options = channel, options
        self.priors: Priors = priors_of(options)
        self.lag_s = 0.0

    @property
    def devices(self) -> list[str]:
        """The sensor, and its reference if it has one."""
        return [self._channel.sensor, *([self._channel.reference] if self._channel.reference else [])]

    @property
    def margin_s(self) -> float:
        """How long samples are needed before and after a stop, for filters."""
        return most_margin_s(self._channel.instrument)

    def newest(self, record: Record, taken: StopInterval) -> list[Window]:
        """The windows of the stop that is being taken, used or not; empty where there are too few samples yet."""
        try:
            return self._tables(record, [taken]).windows(self.lag_s)
        except ValueError:
            return []

    def windows_and_priors(self, record: Record, taken: Sequence[StopInterval]) -> tuple[list[Window], Priors]:
        """The used windows of all stops, with their lag taken out, and the priors for them."""
        windows = _used_windows(self.without_lag(record, taken))
        return windows, over_frequency(self.priors, windows, self.lag_s)

    def without_lag(self, record: Record, taken: Sequence[StopInterval]) -> list[Window]:
        """The windows of all stops, used or not, with their lag taken out."""
        applied = Applied.of(self.priors, 0.0)

        def lag_of(windows: Sequence[Window], lag_s: float) -> float:
            priors = with_response(self.priors, windows)
            return adjust(_used_windows(windows), priors, replace(applied, lag_s=lag_s)).common_lag_s or 0.0

        windows, self.lag_s = without_lag(self.lag_s, self._tables(record, taken).windows, _used_windows, lag_of)
        return windows

    def outcome(self, record: Record, taken: Sequence[StopInterval]) -> Outcome:
        """What `fieldcal calibrate` would say of these stops."""
        return adjusted(self._tables(record, taken), self.priors)

    def refusal_reasons(self, record: Record, taken: Sequence[StopInterval]) -> tuple[str, ...]:
        """Why `fieldcal calibrate` would refuse these stops; empty if it would not."""
        return self.outcome(record, taken).reasons

    def moved_mps2(self, record: Record) -> float:
        """The rms of the reference's motion; 0 where there is no reference."""
        if self._channel.reference is None or not len(record[self._channel.reference].values):
            return 0.0
        return float(np.nanstd(self._reference_si(record), axis=0).max())

    def _reference_si(self, record: Record) -> Array:
        assert self._channel.reference is not None
        return np.asarray(record[self._channel.reference].values / self._channel.certificate.sensitivity)

    def _tables(self, record: Record, taken: Sequence[StopInterval]) -> Tables:
        """Raises ValueError where there are too few samples."""
        own, name = record[self._channel.sensor], self._channel.sensor
        sensor = SensorTable(name, own.time_s, own.values)
        instrument, reference = instrument_of(self._options), None
        if self._channel.reference is not None:
            name, quantity = self._channel.reference, self._channel.certificate.quantity
            reference = ReferenceTable(name, record[name].time_s, self._reference_si(record), quantity, name)
            instrument = replace(instrument, quantity=quantity)
        if min(len(samples.time_s) for samples in record.values()) < FEWEST:
            raise ValueError("too few samples")
        intervals = [PoseInterval(each.start_s, each.stop_s, each.stop.pose) for each in taken]
        limits = Limits.of(self._options.u_offset_mps2, math.radians(self._options.u_angle_deg))
        return Tables(sensor, reference, intervals, instrument, Making(Settings(limits, bands=True)))

    def write(self, record: Record, taken: Sequence[StopInterval], directory: Path) -> None:
        """Write sensor.csv, reference.csv and poses.csv for `fieldcal calibrate`. Raises OSError."""
        own = record[self._channel.sensor]
        columns, header = [own.time_s, *own.values.T], "time_s,vx,vy,vz"
        if np.isfinite(own.temperature_degc).all():
            columns, header = [*columns, own.temperature_degc], f"{header},temperature_degc"
        _write(directory / "sensor.csv", header, np.column_stack(columns))
        if self._channel.reference is not None:
            x = self._reference_si(record)
            names = ("ax", "ay", "az") if x.shape[1] == 3 else QUANTITY[self._channel.certificate.quantity]
            rows = np.column_stack([record[self._channel.reference].time_s, x])
            _write(directory / "reference.csv", ",".join(("time_s", *names)), rows)
        poses = np.array([[each.start_s, each.stop_s, *each.stop.columns.values()] for each in taken])
        _write(directory / "poses.csv", ",".join(("start_s", "stop_s", *taken[0].stop.columns)), poses)


def _used_windows(windows: Sequence[Window]) -> list[Window]:
    return [w for w in windows if w.used]


def _write(path: Path, header: str, rows: Array) -> None:
    """Write numbers so that they are read back exactly as they are."""
    with path.open("w") as file:
        file.write(header + "\n")
        for row in rows.tolist():
            file.write(",".join("" if math.isnan(value) else repr(value) for value in row) + "\n")
