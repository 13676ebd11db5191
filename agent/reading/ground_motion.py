"""MiniSEED with its StationXML: what each channel says of the ground's acceleration."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cached_property
from typing import Literal

import msgspec
import numpy as np

from agent.reading.seismic import MiniSeed
from agent.reading.source import Array, Arrays, Column, Grid, Stretches, TableError
from agent.reading.stationxml import CONSISTENT, StationChannel, StationXml
from calib.model import Slices

Role = Literal["sensor", "reference"]
AXES = ("x", "y", "z")
EAST_NORTH_UP = ((90.0, 0.0), (0.0, 0.0), (0.0, -90.0))  # azimuth and dip of x, y and z, in deg
# Where an instrument attenuates more than this, its response is not taken out further: there is only noise.
MOST_AMPLIFIED = 10.0
LEAST_RANK = 0.1  # smallest singular value of the directions of three channels that tell all of the motion


class GroundMotion(Arrays):
    """The channels of a MiniSEED file, with the response of their StationXML taken out.

    What remains of each channel is proportional to the acceleration. A sensor keeps its counts: for a seismometer,
    which measures velocity, they are differentiated, so that its S is in counts per m/s. A reference comes in m/s2;
    three channels are turned to east, north and up: x, y, z. `components`: what each column measures. `said`: for the
    user. Raises TableError.
    """

    def __init__(self, source: MiniSeed, station: StationXml, role: Role) -> None:
        self.components: dict[Column, StationChannel] = {}
        self.said: list[str] = [*source.said]
        values: dict[Column, Slices] = {}
        faults: list[TableError] = []
        for time in [c for c in source.columns if c not in source.seed_ids]:
            try:
                values |= self._group(source, station, role, time)
            except TableError as error:
                faults.append(error)
        if not values:
            raise faults[0]
        super().__init__(source.path, values)

    def _each(
        self, names: Sequence[str], group: str, found: Sequence[StationChannel], flat: Sequence[DeconvolvedSamples]
    ) -> dict[Column, Slices]:
        """Each channel by itself as an acceleration."""
        samples: dict[Column, Slices] = {}
        for name, component, own in zip(names, found, flat, strict=True):
            column = Column(name, "m/s2", group)
            self.components[column] = component
            samples[column] = Sum([own], [1.0 / component.sensitivity])
        return samples

    def _group(self, source: MiniSeed, station: StationXml, role: Role, time: Column) -> dict[Column, Slices]:
        grid = source.values[time]
        assert isinstance(grid, Grid | Stretches)
        columns = [c for c in source.seed_ids if c.group == time.group]
        found = [station.component(source.seed_ids[c], grid.start_s, grid.rate_hz) for c in columns]
        self.said += _inconsistent(station, found)
        flat = [
            DeconvolvedSamples(source.values[c], grid.rate_hz, each) for c, each in zip(columns, found, strict=True)
        ]
        whole = len(found) == len(AXES)
        if role == "sensor":
            names = _axes(found) if whole else [c.name for c in columns]
            return {time: grid} | self._counts(names, time.group, found, flat)
        if whole:
            return {time: grid} | self._east_north_up(station, time.group, found, flat)
        names = ["a"] if len(found) == 1 else [c.name for c in columns]
        return {time: grid} | self._each(names, time.group, found, flat)

    def _counts(
        self, names: Sequence[str], group: str, found: Sequence[StationChannel], flat: Sequence[DeconvolvedSamples]
    ) -> dict[Column, Slices]:
        """Each channel by itself in counts."""
        columns = [Column(name, "counts", group) for name in names]
        self.components |= dict(zip(columns, found, strict=True))
        return dict(zip(columns, flat, strict=True))

    def _east_north_up(
        self, station: StationXml, group: str, found: Sequence[StationChannel], flat: Sequence[DeconvolvedSamples]
    ) -> dict[Column, Slices]:
        """Three channels as accelerations along east, north and up."""
        turned = _turned(station, found) / [c.sensitivity for c in found]
        samples: dict[Column, Slices] = {}
        for name, weights, (azimuth, dip) in zip(AXES, turned, EAST_NORTH_UP, strict=True):
            column = Column(name, "m/s2", group)
            samples[column] = Sum(flat, weights.tolist())
            self.components[column] = msgspec.structs.replace(found[0], azimuth_deg=azimuth, dip_deg=dip)
        return samples


def _inconsistent(station: StationXml, found: Sequence[StationChannel]) -> list[str]:
    """What is said of channels whose stages do not give the overall sensitivity."""
    return [
        f"{station.path}, channel {component.seed_id}: the stages of the response differ from the overall "
        f"sensitivity by {100.0 * component.inconsistent:.3g} %; the overall sensitivity is used"
        for component in found
        if abs(component.inconsistent) > CONSISTENT
    ]


class DeconvolvedSamples:
    """Samples (n,) with the response taken out, and differentiated to the acceleration; NaN where there are none."""

    def __init__(self, values: Slices, rate_hz: float, component: StationChannel) -> None:
        self._values, self._rate_hz, self._component = values, rate_hz, component

    def __len__(self) -> int:
        return len(self._values)

    def __getitem__(self, rows: slice, /) -> Array:
        return self._whole[rows]

    @cached_property
    def _whole(self) -> Array:
        whole = np.array(self._values[:], dtype=np.float64)
        there = np.concatenate([[False], np.isfinite(whole), [False]])
        edges = np.flatnonzero(np.diff(there.astype(np.int8))).tolist()
        for first, stop in zip(edges[::2], edges[1::2], strict=True):
            whole[first:stop] = flattened(whole[first:stop], self._rate_hz, self._component)
        return whole


class Sum:
    """A weighted sum of samples (n,)."""

    def __init__(self, parts: Sequence[DeconvolvedSamples], weights: Sequence[float]) -> None:
        self._parts, self._weights = parts, weights

    def __len__(self) -> int:
        return len(self._parts[0])

    def __getitem__(self, rows: slice, /) -> Array:
        parts = [w * p[rows] for p, w in zip(self._parts, self._weights, strict=True)]
        return np.asarray(np.sum(parts, axis=0))


def flattened(counts: Array, rate_hz: float, component: StationChannel) -> Array:
    """`counts` (n,) as an instrument of the same sensitivity would give them that responds alike at all frequencies
    and measures acceleration.

    Y(f) = (i 2 pi f)^m X(f) / h(f), with the response h relative to the sensitivity, and m derivatives. 1 / |h| is at
    most MOST_AMPLIFIED. A straight line between the ends is taken out before and, where the instrument feels gravity,
    added again.
    """
    from scipy.fft import irfft, next_fast_len, rfft, rfftfreq  # takes 0.15 s to load

    n = len(counts)
    line = np.linspace(counts[0], counts[-1], n)
    if component.feels_gravity:
        line = np.full(n, float(np.mean(counts)))
    spectrum = rfft(counts - line, next_fast_len(2 * n, real=True))
    f = rfftfreq(next_fast_len(2 * n, real=True), 1.0 / rate_hz)
    spectrum *= _inverse(f, component) * (2j * np.pi * f) ** component.derivatives
    whole = np.asarray(irfft(spectrum, next_fast_len(2 * n, real=True))[:n])
    return whole + line / component.real[0] if component.feels_gravity and component.real else whole


def _inverse(f: Array, component: StationChannel) -> Array:
    """1 / h at the frequencies `f` (n,)."""
    if not component.real:
        return np.ones(len(f), complex)
    known = np.array(component.frequencies_hz)
    response = np.array(component.real) + 1j * np.array(component.imaginary)
    magnitude = np.abs(response)
    at = np.log(np.clip(f, known[0], known[-1]))
    gain = np.interp(at, np.log(known), 1.0 / np.maximum(magnitude, 1.0 / MOST_AMPLIFIED))
    phase = np.interp(at, np.log(known), np.unwrap(np.angle(response)))
    return np.asarray(gain * np.exp(-1j * phase))


def _axes(found: Sequence[StationChannel]) -> list[str]:
    """The names of three channels: x is that which points most to the east or west, y north or south, z up or down."""
    along = np.abs([c.direction for c in found])
    best = max(itertools.permutations(range(3)), key=lambda axes: sum(along[k, axis] for k, axis in enumerate(axes)))
    return [AXES[axis] for axis in best]


def _turned(station: StationXml, found: Sequence[StationChannel]) -> Array:
    """The matrix (3, 3) that turns what three channels measure to east, north and up."""
    directions = np.array([c.direction for c in found])
    if np.linalg.svd(directions, compute_uv=False)[-1] < LEAST_RANK:
        told = ", ".join(f"{c.seed_id} azimuth {c.azimuth_deg:g} dip {c.dip_deg:g}" for c in found)
        raise TableError(f"{station.path}: the channels do not measure three directions ({told}); correct them")
    return np.asarray(np.linalg.inv(directions))
