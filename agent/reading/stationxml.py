"""StationXML by ObsPy: what a station says of its channels: sensitivity, unit, orientation and response."""

from __future__ import annotations

import math
import subprocess
import sys
import warnings
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from agent.config.files import read_file
from agent.config.xml import XmlError, check_xml
from agent.reading.source import Array, TableError

LARGEST = 64 << 20  # bytes of a StationXML
DERIVATIVES = {"M/S**2": 0, "M/S": 1, "M": 2}  # how many times the quantity is differentiated to give an acceleration
LOWEST_HZ, FREQUENCIES = 1e-4, 1000  # at which the response is computed, up to half the rate
LARGEST_TIME_S = 1e11  # later than any end of a channel
SECONDS_ALLOWED = 300.0  # for reading one file
CONSISTENT = 0.02  # relative: the stages of a response and its overall sensitivity


class StationChannel(msgspec.Struct, frozen=True):
    """A channel as its StationXML describes it.

    `seed_id`: network.station.location.channel. `from_s`, `to_s`: when it holds, s since 1970. `unit`: of the ground
    motion, a key of DERIVATIVES. `sensitivity`: counts per unit at `frequency_hz`. `azimuth_deg` from north to east,
    `dip_deg` from the horizontal downwards. `frequencies_hz`, `real`, `imaginary`: the response over its magnitude at
    `frequency_hz`; empty where only the sensitivity is stated. `reason`: why it cannot be used, "" where it can.
    """

    seed_id: str
    from_s: float
    to_s: float
    rate_hz: float = 0.0
    unit: str = ""
    sensitivity: float = 0.0
    frequency_hz: float = 0.0
    azimuth_deg: float = 0.0
    dip_deg: float = 0.0
    frequencies_hz: tuple[float, ...] = ()
    real: tuple[float, ...] = ()
    imaginary: tuple[float, ...] = ()
    inconsistent: float = 0.0
    reason: str = ""

    @property
    def direction(self) -> Array:
        """Unit vector (3,) of what it measures: east, north, up."""
        azimuth, dip = math.radians(self.azimuth_deg), math.radians(self.dip_deg)
        east_north_up = [math.cos(dip) * math.sin(azimuth), math.cos(dip) * math.cos(azimuth), -math.sin(dip)]
        return np.round(east_north_up, 12)  # so that 90 deg have a cosine of 0

    @property
    def derivatives(self) -> int:
        """How many times its quantity is differentiated to give an acceleration."""
        return DERIVATIVES[self.unit]

    @property
    def feels_gravity(self) -> bool:
        """Whether it responds to a constant acceleration."""
        lowest = math.hypot(self.real[0], self.imaginary[0]) if self.real else 1.0
        return self.derivatives == 0 and lowest > 0.5


@dataclass(frozen=True, slots=True)
class StationXml:
    """A StationXML. `components`: of all its channels, each for its time."""

    path: Path
    components: tuple[StationChannel, ...]

    def component(self, seed_id: str, start_s: float, rate_hz: float) -> StationChannel:
        """The channel that holds at the time `start_s`. Raises TableError where there is none that can be used."""
        same = [c for c in self.components if c.seed_id == seed_id]
        found = next((c for c in same if c.from_s <= start_s < c.to_s), None)
        if found is None:
            told = " at the time of the data" if same else f"; it has {self._seed_ids()}"
            raise TableError(f"{self.path}: there is no channel {seed_id}{told}; give the StationXML of this station")
        if found.reason:
            raise TableError(f"{self.path}, channel {seed_id}: {found.reason}")
        if found.rate_hz and abs(found.rate_hz / rate_hz - 1.0) > 0.01:
            raise TableError(
                f"{self.path}, channel {seed_id}: the sample rate is {found.rate_hz:g} Hz, that of the data is "
                f"{rate_hz:g} Hz; give the StationXML of these data"
            )
        return found

    def _seed_ids(self) -> str:
        ids = sorted({c.seed_id for c in self.components})
        return ", ".join(ids[:8]) + (f" and {len(ids) - 8} more" if len(ids) > 8 else "") if ids else "no channels"


def read_stationxml(path: Path) -> StationXml:
    """Read it. ObsPy does so in a process of its own, since its library for responses (evalresp, in C) can end one.

    Raises TableError; ImportError without ObsPy.
    """
    try:
        data = check_xml(read_file(path, LARGEST))
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None
    except XmlError as error:
        raise TableError(f"{path}, {error}") from None
    import_obspy()
    try:
        return StationXml(path, _components(data))
    except subprocess.TimeoutExpired:
        raise TableError(f"{path}: the file was not read in {SECONDS_ALLOWED:g} s; give one station alone") from None
    except ValueError as error:
        raise TableError(f"{path}: the file is no StationXML that can be read: {error}; write it anew") from None


@lru_cache(maxsize=1)  # one file often describes both instruments
def _components(data: bytes) -> tuple[StationChannel, ...]:
    """The channels in a StationXML. Raises ValueError and subprocess.TimeoutExpired."""
    command = [sys.executable, "-m", "agent.reading.stationxml"]
    done = subprocess.run(command, input=data, capture_output=True, check=False, timeout=SECONDS_ALLOWED)
    if done.returncode:
        raise ValueError(done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2] or "its reader failed")
    return tuple(msgspec.json.decode(done.stdout, type=list[StationChannel]))


def import_obspy() -> Any:
    """The library. Raises ImportError."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ObsPy's own, about packages that it uses
        import obspy
    return obspy


def main() -> None:
    """Write the channels of the StationXML on standard input to standard output, as JSON."""
    warnings.simplefilter("ignore")
    try:
        inventory = import_obspy().read_inventory(BytesIO(sys.stdin.buffer.read()), format="STATIONXML")
        found = [
            _component(f"{network.code}.{station.code}.{channel.location_code}.{channel.code}", channel)
            for network in inventory for station in network for channel in station
        ]  # fmt: skip
    except Exception as error:  # ObsPy raises many kinds for broken files
        sys.exit(str(error).partition("\n")[0] or type(error).__name__)
    sys.stdout.buffer.write(msgspec.json.encode(found))


def _component(seed_id: str, channel: Any) -> StationChannel:
    from_s = channel.start_date.timestamp if channel.start_date else 0.0
    to_s = channel.end_date.timestamp if channel.end_date else LARGEST_TIME_S
    nothing = StationChannel(seed_id, from_s, to_s)
    try:
        return _described(nothing, channel)
    except ValueError as error:
        return _unusable(nothing, str(error))
    except Exception as error:
        return _unusable(nothing, f"the response cannot be computed: {str(error).partition(chr(10))[0]}")


def _unusable(component: StationChannel, reason: str) -> StationChannel:
    """The component, which cannot be used for this reason."""
    return msgspec.structs.replace(component, reason=reason)


def _described(component: StationChannel, channel: Any) -> StationChannel:
    """The component with what the channel states. Raises ValueError with the reason where it states too little."""
    total = channel.response.instrument_sensitivity if channel.response else None
    if total is None or not total.value or not math.isfinite(total.value):
        raise ValueError("it states no sensitivity (InstrumentSensitivity); a response of polynomials is not read")
    unit = str(total.input_units).upper().replace(" ", "").replace("^", "**").replace("M/S/S", "M/S**2")
    unit = {"M/(S**2)": "M/S**2", "M/S2": "M/S**2"}.get(unit, unit)
    if unit not in DERIVATIVES:
        raise ValueError(f"the unit of its input is {total.input_units!r}; known are {', '.join(DERIVATIVES)}")
    if channel.azimuth is None or channel.dip is None:
        raise ValueError("it states no azimuth or no dip; add both")
    rate_hz, frequency_hz = float(channel.sample_rate or 0.0), float(total.frequency or 1.0)
    stated = msgspec.structs.replace(
        component, rate_hz=rate_hz, unit=unit, sensitivity=float(total.value), frequency_hz=frequency_hz,
        azimuth_deg=float(channel.azimuth), dip_deg=float(channel.dip),
    )  # fmt: skip
    if not channel.response.response_stages or not rate_hz:
        return stated
    frequencies = np.geomspace(LOWEST_HZ, rate_hz / 2.0, FREQUENCIES)
    at = np.append(frequencies, frequency_hz)
    response = channel.response.get_evalresp_response_for_frequencies(at, output="DEF")
    overall = abs(response[-1])
    if not np.isfinite(response).all() or not overall > 0.0:
        raise ValueError(f"its response at {frequency_hz:g} Hz is {overall:g}; correct its stages")
    relative = response[:-1] / overall
    return msgspec.structs.replace(
        stated,
        frequencies_hz=tuple(frequencies.tolist()),
        real=tuple(relative.real.tolist()),
        imaginary=tuple(relative.imag.tolist()),
        inconsistent=float(overall / abs(stated.sensitivity) - 1.0),
    )


if __name__ == "__main__":
    main()
