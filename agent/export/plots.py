"""A recording as topics that plot programs show at once: accelerations, indications, S and Q."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from agent import __version__
from agent.config.whole_files import new_file
from agent.core.events import CalibrationUpdate
from agent.export.cdr import DEFINITIONS, IMU, JOINT_STATE, imu, joint_state
from agent.export.samples import ExportedSamples, RecordedContent
from calib.model import PARAMETERS, Array

AXES = ("x", "y", "z")
CHUNK_BYTES = 1 << 18
NAMES = (*PARAMETERS, *(f"U_{name}" for name in PARAMETERS))


def write_plots(path: Path, content: RecordedContent, blocks: Iterable[ExportedSamples], rate_hz: float) -> int:
    """Write the topics; each message is the mean of the samples in an interval of 1 / `rate_hz`. Gives their number.

    Raises OSError, also where the file exists.
    """
    device, count = content.device, 0
    with new_file(path) as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start("ros2", f"fieldcal {__version__}")
        schemas = {kind: writer.register_schema(kind, "ros2msg", text.encode()) for kind, text in DEFINITIONS.items()}
        about = {"rate_hz": f"{rate_hz:g}", "of each message": "mean of the samples in its interval"}
        topics: dict[str, int] = {}

        def put(topic: str, kind: str, t_utc_ns: int, data: bytes) -> None:
            nonlocal count
            if topic not in topics:
                topics[topic] = writer.register_channel(f"/{device}/{topic}", "cdr", schemas[kind], about)
            writer.add_message(topics[topic], t_utc_ns, data, t_utc_ns, count)
            count += 1

        for update in content.calibrations:
            at_ns = update.t_utc_ns
            put("calibration", JOINT_STATE, at_ns, joint_state(at_ns, device, NAMES, _numbers(update)))
        names = AXES[: content.axes]
        for t_utc_ns, mean in means(blocks, rate_hz):
            values = mean[: content.axes]
            put("indication", JOINT_STATE, t_utc_ns, joint_state(t_utc_ns, device, names, values.tolist()))
            if len(mean) > content.axes:
                put("acceleration", IMU, t_utc_ns, imu(t_utc_ns, device, mean[content.axes :]))
        writer.finish()
    return count


def means(blocks: Iterable[ExportedSamples], rate_hz: float) -> Iterator[tuple[int, Array]]:
    """Mean time in ns and mean values (axes + 3,) of each interval, counted from 1970: indications, then accelerations.

    Without a calibration there are indications alone.
    """
    length_ns = max(round(1e9 / rate_hz), 1)
    interval, times, total, number = -1, 0, np.zeros(0), 0
    for block in blocks:
        columns = block.values if block.acceleration is None else np.hstack([block.values, block.acceleration])
        intervals = block.t_utc_ns // length_ns
        edges = np.flatnonzero(np.diff(intervals, prepend=intervals[0] - 1))
        for first, stop in zip(edges, [*edges[1:], len(columns)], strict=True):
            if intervals[first] != interval or columns.shape[1] != len(total):
                if number:
                    yield times // number, total / number
                interval, times, total, number = int(intervals[first]), 0, np.zeros(columns.shape[1]), 0
            times += sum(block.t_utc_ns[first:stop].tolist())
            total = total + columns[first:stop].sum(axis=0)
            number += int(stop - first)
    if number:
        yield times // number, total / number


def _numbers(update: CalibrationUpdate) -> list[float]:
    values = np.append(np.ravel(update.sensitivity), update.offset)
    U = update.coverage_factor * np.array(update.standard_uncertainty)
    return [*values.tolist(), *U.tolist()]
