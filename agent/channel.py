"""One sensor with its reference: streams -> windows -> Method 3 -> calibration in force and status."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from typing import Any

import msgspec

from agent.config import Channel
from agent.events import CalibrationUpdate, DeviceChange, Result, StatusChange, Tick, WindowReport
from agent.schedule import Piece, pieces
from agent.stream import DeviceStream
from agent.windows import MARGIN_S, window_of, window_state, windows_in
from calib.method3 import Fit, fit
from calib.model import PARAMETERS, Window
from hw.block import SampleBlock

COVERAGE_FACTOR = 2.0
# Ports and speeds name the way to a device, not the device: they may change without the calibration losing its sense.
WAYS = frozenset({"port", "baud_rate", "bus"})


class ChannelState:
    """All that is known of one channel; changes with events only.

    The first status comes with the first news of the sensor: UNCALIBRATED (nothing known), COLLECTING (windows used,
    not all parameters determined), VALID (a calibration in force) or INVALID (the sensor is silent or lost).
    """

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self.sensor = channel.sensor
        self._origin_ns = 0
        self._streams: dict[str, DeviceStream] = {}
        self._units: dict[str, str] = {}
        self._identity = ""
        self._windows: list[Window] = []
        self._in_force: CalibrationUpdate | None = None
        self._kept: CalibrationUpdate | None = None
        self._status = ""  # nothing said yet
        self._after_s = 0.0  # the schedule is done up to here, seconds since the sensor's first sample
        self._now_ns = 0  # monotonic and UTC of the newest event that carried both
        self._utc_minus_monotonic_ns = 0
        self._upcoming = pieces(channel, 0.0)
        self._piece = next(self._upcoming, None)

    def begin(self, origin_ns: int, kept: CalibrationUpdate | None) -> None:
        """A new run: seconds count from `origin_ns`; `kept` waits for a sensor of its identity."""
        self._origin_ns = origin_ns
        self._now_ns = origin_ns
        self._kept = kept
        for name in self._devices():
            self._streams[name] = DeviceStream(origin_ns)

    def on_block(self, block: SampleBlock) -> list[Result]:
        """A block of the sensor or its reference; others are not this channel's."""
        if block.device not in self._streams:
            return []
        self._clock(block.t_monotonic_ns, block.t_utc_ns)
        self._streams[block.device].update(block)
        results: list[Result] = []
        if block.device == self.sensor and self._status == "INVALID":
            results += self._set_status(self._resting_status(), f"{self.sensor} speaks again")
        return results + list(self._close_windows())

    def on_tick(self, tick: Tick) -> list[Result]:
        """Time passed: late windows are refused, a silent sensor turns the status INVALID."""
        self._clock(tick.t_monotonic_ns, tick.t_utc_ns)
        return list(self._close_windows()) + self._watch_silence()

    def on_device(self, change: DeviceChange) -> list[Result]:
        """A device of this channel was opened or lost."""
        if change.device not in self._streams:
            return []
        self._clock(change.t_monotonic_ns, change.t_utc_ns)
        if change.state == "lost":
            if change.device != self.sensor:
                return []
            return self._set_status("INVALID", f"{self.sensor} is lost: {change.message}")
        self._units[change.device] = json.loads(change.info_json)["unit"]
        return self._identify(change) if change.device == self.sensor else []

    def _devices(self) -> list[str]:
        return [self.sensor] + ([self._channel.reference] if self._channel.reference else [])

    def _clock(self, t_monotonic_ns: int, t_utc_ns: int) -> None:
        # Blocks of two devices may arrive out of order by a read; time here never goes back.
        if t_monotonic_ns >= self._now_ns:
            self._now_ns = t_monotonic_ns
            self._utc_minus_monotonic_ns = t_utc_ns - t_monotonic_ns

    def _utc_ns(self) -> int:
        return self._now_ns + self._utc_minus_monotonic_ns

    def _now_s(self) -> float:
        return (self._now_ns - self._origin_ns) * 1e-9

    # --- identity and status

    def _identify(self, change: DeviceChange) -> list[Result]:
        identity = identity_of(change.info_json)
        results: list[Result] = []
        if self._identity and identity != self._identity:
            self._windows.clear()
            self._in_force = None
            results += self._set_status("UNCALIBRATED", f"{self.sensor} is now {identity}, was {self._identity}")
        self._identity = identity
        if self._kept is not None:
            kept, self._kept = self._kept, None
            if kept.identity == identity:
                self._in_force = msgspec.structs.replace(kept, t_utc_ns=self._utc_ns())
                results += [self._in_force, *self._opened("restored from the run before")]
            else:
                reason = f"the calibration kept belongs to {kept.identity}, this is {identity}"
                results += self._set_status("UNCALIBRATED", reason)
        return results or self._opened(f"{self.sensor} opened")

    def _opened(self, reason: str) -> list[Result]:
        # A port that opens is no sensor that speaks: one that was INVALID stays so until a block comes.
        return [] if self._status == "INVALID" else self._set_status(self._resting_status(), reason)

    def _resting_status(self) -> str:
        """The status of a sensor that speaks."""
        if self._in_force is not None:
            return "VALID"
        return "COLLECTING" if self._windows else "UNCALIBRATED"

    def _set_status(self, status: Any, reason: str) -> list[Result]:
        if status == self._status:
            return []
        before, self._status = self._status, status
        return [
            StatusChange(
                run_id="", sequence=0, sensor=self.sensor, t_utc_ns=self._utc_ns(),
                status=status, before=before, reason=reason,
            )
        ]  # fmt: skip

    def _watch_silence(self) -> list[Result]:
        newest_s = self._streams[self.sensor].newest_arrival_s
        silent_s = self._now_s() - (newest_s if newest_s is not None else 0.0)
        if silent_s <= self._channel.silence_s:
            return []
        return self._set_status("INVALID", f"no block of {self.sensor} for more than {self._channel.silence_s:g} s")

    # --- windows and solution

    def _close_windows(self) -> Iterator[Result]:
        first_s = self._streams[self.sensor].first_sample_s
        while self._piece is not None and first_s is not None and self._due(self._piece, first_s):
            piece = self._piece
            windows = windows_in(piece, first_s, self._channel, self._streams)
            self._after_s = piece.stop_s
            self._piece = next(self._upcoming, None)
            yield from (self._report(window) for window in windows)
            used = [window for window in windows if window.used]
            if used:
                self._windows = [*self._windows, *used][-self._channel.windows :]
                yield from self._solve()
        keep_from_s = self._now_s() - MARGIN_S
        if self._piece is not None and first_s is not None:
            keep_from_s = min(keep_from_s, first_s + self._piece.start_s - MARGIN_S)
        for stream in self._streams.values():
            stream.forget_before(keep_from_s)

    def _due(self, piece: Piece, first_s: float) -> bool:
        """All samples of the piece are there, or they are later than anybody waits for."""
        end_s = first_s + piece.stop_s + MARGIN_S
        if self._now_s() > end_s + self._channel.late_horizon_s:
            return True
        return all(stream.reaches(end_s) for stream in self._streams.values())

    def _report(self, window: Window) -> WindowReport:
        return WindowReport(
            run_id="", sequence=0, sensor=self.sensor, t_utc_ns=self._utc_ns(),
            start_s=window.start_s, stop_s=window.stop_s, position=window.pose.position, used=window.used,
            reason=window.reason, points=window.points, left_out=window.left_out, numbers=dict(window.numbers),
        )  # fmt: skip

    def _solve(self) -> list[Result]:
        solution = fit(self._windows)
        if not solution.calibration.determined.all():
            missing = [p for p, d in zip(PARAMETERS, solution.calibration.determined, strict=True) if not d]
            if self._in_force is not None:
                return []
            reason = f"{len(self._windows)} windows, rank {solution.rank} of 4; not determined: {', '.join(missing)}"
            return self._set_status("COLLECTING", reason)
        self._in_force = self._update(solution)
        return [self._in_force, *self._set_status("VALID", f"{len(self._windows)} windows determine S and Q")]

    def _update(self, solution: Fit) -> CalibrationUpdate:
        calibration = solution.calibration
        return CalibrationUpdate(
            run_id="", sequence=0, sensor=self.sensor, t_utc_ns=self._utc_ns(),
            sensitivity=calibration.sensitivity.tolist(), offset=calibration.offset.tolist(),
            standard_uncertainty=calibration.standard_uncertainty.tolist(),
            covariance=calibration.covariance.tolist(), coverage_factor=COVERAGE_FACTOR,
            determined=calibration.determined.tolist(), method=calibration.method, uncertainty_kind="type A, white",
            windows=len(self._windows), residual_sd=solution.residual_sd.tolist(),
            output_unit=self._units.get(self.sensor, ""), identity=self._identity,
        )  # fmt: skip

    # --- state

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "origin_ns": self._origin_ns,
            "streams": {name: stream.snapshot() for name, stream in self._streams.items()},
            "units": dict(self._units),
            "identity": self._identity,
            "windows": [window_state(window) for window in self._windows],
            "in_force": _plain(self._in_force),
            "kept": _plain(self._kept),
            "status": self._status,
            "after_s": self._after_s,
            "now_ns": self._now_ns,
            "utc_minus_monotonic_ns": self._utc_minus_monotonic_ns,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._origin_ns = state["origin_ns"]
        self._streams = {n: DeviceStream.restore(self._origin_ns, s) for n, s in state["streams"].items()}
        self._units = dict(state["units"])
        self._identity = state["identity"]
        self._windows = [window_of(w) for w in state["windows"]]
        self._in_force = _calibration(state["in_force"])
        self._kept = _calibration(state["kept"])
        self._status = state["status"]
        self._after_s = state["after_s"]
        self._now_ns = state["now_ns"]
        self._utc_minus_monotonic_ns = state["utc_minus_monotonic_ns"]
        self._upcoming = pieces(self._channel, self._after_s)
        self._piece = next(self._upcoming, None)


def identity_of(info_json: str) -> str:
    """Who a device is and how it is set: a calibration holds for this and nothing else."""
    info = json.loads(info_json)
    settings = {k: v for k, v in info["settings"].items() if k not in WAYS}
    held = [info["driver"], info["kind"], info["serial_number"], info["unit"], info["axes"], sorted(settings.items())]
    digest = hashlib.sha256(json.dumps(held).encode()).hexdigest()[:12]
    return " ".join(part for part in (info["kind"], info["serial_number"], digest) if part)


def _plain(update: CalibrationUpdate | None) -> dict[str, Any] | None:
    return None if update is None else msgspec.structs.asdict(update)


def _calibration(state: dict[str, Any] | None) -> CalibrationUpdate | None:
    return None if state is None else CalibrationUpdate(**state)
