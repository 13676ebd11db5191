"""A channel of the agent whose samples are drawn from a known truth, a window at a time.

What follows from a window is the agent's own code: front end, estimation, gate, drift test, explanations and words.
Motion and noise are drawn for each window; a window costs some 60 ms of CPU time.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta

import msgspec
import numpy as np

from agent.config import Channel, parse_config
from agent.core.channel import ChannelState
from agent.core.estimation import DAY_S
from agent.core.events import DeviceChange, Result
from agent.core.identity import identity_of
from agent.core.schedule import pose_beside
from agent.core.streams import JudgedWindow
from agent.engine import identity
from calib.excitation.front_end import Settings, windows_of
from calib.geometry import STANDARD_GRAVITY_MPS2
from calib.model import Array, Window
from calib.signal.samples import Samples
from calib.signal.timing import ClockFit
from hw.block import DeviceInfo

RATE_HZ, WINDOW_S, MARGIN_S = 50.0, 60.0, 8.0
MOTION_HZ = (0.6, 12.0)
MOTION_MPS2 = np.array([0.08, 0.06, 0.04])  # rms of a footbridge in use
NOISE_MPS2, REFERENCE_NOISE_MPS2 = 2e-3, 7e-4  # rms of one sample
GRAVITY_MPS2 = np.array([0.0, 0.0, -STANDARD_GRAVITY_MPS2])
BESIDE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)  # rotation of the sensor against its reference
TEMPERATURE_DEGC = 20.0
EXPLAIN_AFTER_S = (
    15 * 86400.0
)  # an explanation of held windows costs as much as ten windows, and rounds may be days apart
NOMINAL = 26154.0  # counts per m/s2, of an ADXL355 in its range of 2 g
SENSOR, REFERENCE = "ADXL355", "B12"  # kinds of the devices
CERTIFICATE_AGE = timedelta(days=60)  # of the reference when the first window is made
SITE_REFERENCE = "4711"  # serial number: all sensors of the fleet met one reference, which was carried around


@dataclass(frozen=True, slots=True, eq=False)
class WindowTruth:
    """What is true of a sensor during a window.

    `sensitivity` (3, 3) in counts per m/s2, rows are outputs, in the frame of the reference; `offset` (3,) in counts;
    `gravity_mps2` (3,) in that frame; `noise_mps2` the rms of one sample; `dead`: the output that no longer moves.
    """

    sensitivity: Array
    offset: Array
    gravity_mps2: Array
    noise_mps2: float = NOISE_MPS2
    dead: int | None = None


class SimulatedChannel:
    """One sensor beside a tri-axial AC-coupled reference. Results are numbered by whoever sends them (`number`)."""

    def __init__(self, sensor: str, seed: Sequence[int], t_utc_ns: int) -> None:
        """`seed`: of motion and noise. The run begins at `t_utc_ns`."""
        self._channel = _channel_of(sensor, t_utc_ns)
        self._pose = pose_beside(BESIDE, self._channel)
        self._random = np.random.default_rng(seed)
        self._state = _WindowByWindow(self._channel)
        self._state.begin(t_utc_ns, {})
        self._infos = {sensor: _sensor(""), "ref": _info(REFERENCE, SITE_REFERENCE, "m/s2", 1.0)}

    def opened(self, t_utc_ns: int) -> list[Result]:
        """Both devices are opened."""
        return [result for name, info in self._infos.items()
                for result in self._state.on_device(_change(name, "open", t_utc_ns, info=info))]  # fmt: skip

    def window(self, truth: WindowTruth, t_utc_ns: int) -> list[Result]:
        """A window of WINDOW_S that ends now."""
        return self._state.on_window(self._drawn(truth), t_utc_ns)

    def lost(self, t_utc_ns: int, message: str) -> list[Result]:
        """The sensor does not answer."""
        return self._state.on_device(_change(self._channel.sensor, "lost", t_utc_ns, message=message))

    def number(self, results: Sequence[Result], first_sequence: int, run_id: str) -> list[Result]:
        """The results with their numbers, as the pipeline of a gateway gives them."""
        numbered = [
            msgspec.structs.replace(result, run_id=run_id, sequence=first_sequence + k, engine=identity.name())
            for k, result in enumerate(results)
        ]
        self._state.number(numbered)
        return numbered

    def _drawn(self, truth: WindowTruth) -> Window:
        count = round(RATE_HZ * (WINDOW_S + 2.0 * MARGIN_S))
        motion, white = _motion(self._random, count), self._random.standard_normal((2, count, 3))
        indications = (motion + truth.gravity_mps2 + truth.noise_mps2 * white[0]) @ truth.sensitivity.T + truth.offset
        if truth.dead is not None:
            indications[:, truth.dead] = truth.offset[truth.dead] + NOMINAL * truth.noise_mps2 * white[0, :, truth.dead]
        sensor = Samples(self._channel.sensor, 0, indications, CLOCK, temperature_degc=TEMPERATURE_DEGC)
        reference = Samples("ref", 0, motion + REFERENCE_NOISE_MPS2 * white[1], CLOCK)
        span_s, bands = (0.0, WINDOW_S), Settings(bands=True)
        [window] = windows_of(self._pose, sensor, reference, self._channel.instrument, span_s, settings=bands)
        return window


class _WindowByWindow(ChannelState):
    """The state of a channel that gets its windows made, in place of blocks of samples."""

    def on_window(self, window: Window, t_utc_ns: int) -> list[Result]:
        self._time.update(t_utc_ns, t_utc_ns)
        estimation, day = self._estimation, self._first_day + self._time.now_s / DAY_S
        assert estimation is not None  # the devices were opened
        estimation.date_certificate(day, t_utc_ns)
        explained = self._explain()  # of the windows before, as in the time between two windows
        judged = estimation.judge(window, day, 0.0, TEMPERATURE_DEGC) if window.used else None
        return [*explained, *self._results(JudgedWindow(window, judged, 0.0))]


def identity_with(serial_number: str) -> str:
    """The identity of a simulated sensor with this serial number, as results name it."""
    return identity_of(json.dumps(asdict(_sensor(serial_number))))


def _channel_of(sensor: str, t_utc_ns: int) -> Channel:
    calibrated = datetime.fromtimestamp(t_utc_ns * 1e-9, UTC) - CERTIFICATE_AGE
    devices = [
        {"name": name, "driver": "serial-csv", "options": {"port": name, "rate_hz": RATE_HZ}}
        for name in (sensor, "ref")
    ]
    channel = {
        "sensor": sensor, "reference": "ref", "rotation": BESIDE,
        "rotation_gravity_mps2": GRAVITY_MPS2.tolist(), "band_hz": [1.0, 10.0],
        "prior": {"reference_frequency_hz": 3.0}, "gate": {"explain_after_s": EXPLAIN_AFTER_S},
        "certificate": {"serial_number": SITE_REFERENCE, "calibrated": calibrated.date().isoformat()},
    }  # fmt: skip
    return parse_config({"devices": devices, "channels": [channel]}, "").channels[0]


def _sensor(serial_number: str) -> DeviceInfo:
    return _info(SENSOR, serial_number, "count", NOMINAL)


def _info(kind: str, serial_number: str, unit: str, nominal: float) -> DeviceInfo:
    return DeviceInfo(driver="serial-csv", kind=kind, serial_number=serial_number, unit=unit, axes=3,
                      nominal_rate_hz=RATE_HZ, nominal_sensitivity=nominal)  # fmt: skip


def _change(
    device: str, state: str, t_utc_ns: int, *, message: str = "", info: DeviceInfo | None = None
) -> DeviceChange:
    return DeviceChange(
        device=device, state=state, t_monotonic_ns=t_utc_ns, t_utc_ns=t_utc_ns, message=message,  # type: ignore[arg-type]
        info_json="" if info is None else json.dumps(asdict(info)),
    )  # fmt: skip


def _motion(random: np.random.Generator, count: int) -> Array:
    """(count, 3) motion in m/s2, alike in all of MOTION_HZ."""
    hz = np.fft.rfftfreq(count, 1.0 / RATE_HZ)
    inside = (hz >= MOTION_HZ[0]) & (hz <= MOTION_HZ[1])
    real, imaginary = random.standard_normal((2, inside.sum(), 3))
    lines = np.zeros((len(hz), 3), dtype=complex)
    lines[inside] = real + 1j * imaginary
    drawn = np.fft.irfft(lines, count, axis=0)
    return np.asarray(MOTION_MPS2 * drawn / drawn.std(axis=0))


def _clock() -> ClockFit:
    """Of a device whose first sample was taken MARGIN_S before the window."""
    first, start_s = np.zeros(1), np.array([-MARGIN_S])
    none = np.empty(0, dtype=np.int64)
    return ClockFit(first, start_s, np.array([1.0 / RATE_HZ]), 0, RATE_HZ, 1e-9, -MARGIN_S, 1e-9, none)


CLOCK = _clock()
