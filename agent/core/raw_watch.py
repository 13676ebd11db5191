"""Outputs that are stuck and bursts that are read twice: looked for in the blocks as they came, before any filter."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.core.stream import SATURATED, UNCOUNTED, DeviceStream
from calib.geometry import AXES
from calib.model import Array
from calib.signal.outputs import Outputs, StuckOutput
from hw.block import SampleBlock

AGAIN_S = 600.0  # between two messages on one output
WORTH_S = 60.0  # that an output was held, for a message when it changes again
FEW, WITHIN_S = 3, 600.0  # sticks or repeated bursts within this time that are told: fewer may be chance
# Wrong bits that are told, and their share of all samples that stand alone: of ten knocks, eight are as near to powers
# of two once in five million times.
FEW_FLIPS, FLIPS = 10, 0.8
LEAST_END = 128.0  # of a converter: of one with 8 bits


@dataclass(frozen=True, slots=True)
class OutputFault:
    """What is wrong with a device from one time to another, in s since the run's origin; `held` where it is an output
    that does not change, and `said` for an operator."""

    said: str
    start_s: float
    stop_s: float
    held: StuckOutput | None = None


class RawWatch:
    """Watches the blocks of the devices of a channel. `keep_s`: how long windows may ask for what was found."""

    def __init__(self, keep_s: float) -> None:
        self._keep_s = keep_s
        self._outputs: dict[str, Outputs] = {}
        self._faults: dict[str, list[OutputFault]] = {}
        self._told_s: dict[str, dict[str, float]] = {}  # when the message of a kind was told last, by device
        self._seen: dict[str, list[tuple[float, list[int]]]] = {}  # times and counts of what happens now and then
        self._flipping: set[str] = set()  # devices of which wrong bits are told

    def forget(self, device: str) -> None:
        """Another device has this name now."""
        for kept in (self._outputs, self._faults, self._told_s, self._seen):
            kept.pop(device, None)
        self._flipping.discard(device)

    def motion(self, device: str) -> Array | None:
        """(m, m) covariance of the slow motion that a device shows now, in its own unit; None before any block."""
        return self._outputs[device].motion if device in self._outputs else None

    def update(self, block: SampleBlock, stream: DeviceStream, expected: Array, origin_utc_ns: int) -> list[str]:
        """Take a block that `stream` has taken already; what an operator must know of it.

        `expected` (A,) as in Outputs.held. `origin_utc_ns` is UTC at the run's origin.
        """
        x = np.asarray(block.indications, dtype=np.float64)
        if not len(x):
            return []
        outputs = self._outputs.get(block.device)
        if outputs is None or outputs.axes != x.shape[1]:
            self.forget(block.device)
            outputs = self._outputs[block.device] = Outputs(x.shape[1])
        anew, repeats = bool(int(block.flags) & UNCOUNTED), outputs.repeats
        outputs.update(block.first_index, x, block.nominal_rate_hz, block.burst_count, anew=anew)
        now_s = (block.t_monotonic_ns - stream.origin_ns) * 1e-9
        told, faults = self._going_on(block.device, outputs, now_s, anew=anew)
        known = {fault.held.axis for fault in faults if fault.held is not None and fault.stop_s == np.inf}
        for held in outputs.held(expected):
            if held.axis not in known:
                start_s = float(np.clip(np.nan_to_num(stream.taken_at(held.first)[0], nan=now_s), 0.0, now_s))
                said = f"{block.device}: {_description(held, block)} since {_utc(origin_utc_ns, start_s)}"
                faults.append(OutputFault(said, start_s, np.inf, held))
                told += self._once(block.device, f"held {held.axis}", said, now_s)
        if outputs.repeats > repeats:
            start_s = now_s - 2.0 * len(x) / block.nominal_rate_hz
            faults.append(OutputFault(f"{block.device}: its driver gave the same samples twice", start_s, now_s))
        self._faults[block.device] = faults
        return told + list(self._now_and_then(block.device, outputs, now_s))

    def _going_on(
        self, device: str, outputs: Outputs, now_s: float, *, anew: bool
    ) -> tuple[list[str], list[OutputFault]]:
        """The faults of a device that go on or that windows may still ask for, and messages on outputs that change
        again. `anew`: the counter of the device began anew."""
        told, faults = [], list[OutputFault]()
        for fault in self._faults.get(device, []):
            if fault.stop_s == np.inf and fault.held is not None and (anew or not outputs.goes_on(fault.held)):
                if now_s - fault.start_s >= WORTH_S:
                    told.append(f"{fault.said}; now it changes again")
                faults.append(replace(fault, stop_s=now_s))
            elif fault.stop_s > now_s - self._keep_s:
                faults.append(fault)
        return told, faults

    def reason(self, devices: Iterable[str], start_s: float, stop_s: float) -> str:
        """What is wrong with one of the devices between two times; "" if nothing is."""
        faults = (fault for device in devices for fault in self._faults.get(device, []))
        return next((fault.said for fault in faults if fault.start_s < stop_s and fault.stop_s > start_s), "")

    def suspect(self, device: str) -> NDArray[np.bool_]:
        """(A,) the outputs of which samples are wrong in the block that was taken last: they hold one value, or were
        read twice; wrong bits as long as they are told, since a single one may be a knock."""
        outputs = self._outputs[device]
        found = outputs.stuck_or_repeated.copy()
        for fault in self._faults.get(device, []):
            if fault.held is not None and fault.stop_s == np.inf:
                found[fault.held.axis] = True
        return found | outputs.flips if device in self._flipping else found

    def _once(self, device: str, kind: str, said: str, now_s: float) -> list[str]:
        """The message, unless one of this kind was told a short time ago."""
        before = self._told_s.setdefault(device, {})
        if now_s - before.get(kind, -np.inf) < AGAIN_S:
            return []
        before[kind] = now_s
        return [said]

    def _now_and_then(self, device: str, outputs: Outputs, now_s: float) -> Iterator[str]:
        """Messages on what happened several times within WITHIN_S."""
        counts = [*outputs.sticks.tolist(), outputs.repeats, outputs.flipped, outputs.alone]
        seen = [(at, own) for at, own in self._seen.get(device, []) if now_s - at <= WITHIN_S] or [(now_s, counts)]
        if seen[-1][1] != counts:
            seen.append((now_s, counts))
        self._seen[device] = seen
        *sticks, repeats, flipped, alone = [now - before for now, before in zip(counts, seen[0][1], strict=True)]
        found = [
            (f"{_axis(k, outputs.axes)} sticks: it held one value for a short time", count)
            for k, count in enumerate(sticks)
            if count >= FEW
        ]
        if repeats >= FEW:
            found.append(("its driver gave the same samples twice", repeats))
        self._flipping.discard(device)
        if flipped >= max(FEW_FLIPS, FLIPS * alone):
            self._flipping.add(device)
            found.append(
                ("single samples are off by a power of two (a bit is read wrongly: check cable and bus)", flipped)
            )
        minutes = (now_s - seen[0][0]) / 60.0
        for what, count in found:
            yield from self._once(device, what, f"{device}: {what}, {count} times within {minutes:.1f} min", now_s)

    def snapshot(self) -> dict[str, Any]:
        """State for `load`, bit-exact."""
        return {
            "outputs": {device: outputs.snapshot() for device, outputs in self._outputs.items()},
            "faults": {device: [asdict(fault) for fault in faults] for device, faults in self._faults.items()},
            "told_s": {device: dict(told) for device, told in self._told_s.items()},
            "seen": {device: [[at, list(own)] for at, own in seen] for device, seen in self._seen.items()},
            "flipping": sorted(self._flipping),
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Take the state that `snapshot` gave."""
        self._outputs = {device: Outputs.restore(own) for device, own in state["outputs"].items()}
        self._faults = {device: [_fault(own) for own in faults] for device, faults in state["faults"].items()}
        self._told_s = {device: dict(told) for device, told in state["told_s"].items()}
        self._seen = {device: [(at, list(own)) for at, own in seen] for device, seen in state["seen"].items()}
        self._flipping = set(state.get("flipping", []))


def _fault(state: Mapping[str, Any]) -> OutputFault:
    return OutputFault(**{**state, "held": None if state["held"] is None else StuckOutput(**state["held"])})


def _axis(axis: int, of: int) -> str:
    return AXES[axis] if of == len(AXES) else "its output"


def _description(held: StuckOutput, block: SampleBlock) -> str:
    """In words, with the values as the device gives them."""
    name, low, high = _axis(held.axis, block.indications.shape[1]), f"{held.low:.10g}", f"{held.high:.10g}"
    if held.low != held.high:
        return f"{name} only toggles between {low} and {high}"
    if int(block.flags) & SATURATED or _is_end(held.low):
        return f"{name} is stuck at {low}, an end of its range,"
    return f"{name} is stuck at {low}"


def _is_end(value: float) -> bool:
    """Whether a value is an end of the range of a converter: -2^n, or 2^n - 1 (MPU-6050: -32768 and 32767)."""
    size = -value if value < 0.0 else value + 1.0
    return size >= LEAST_END and float(np.log2(size)).is_integer()


def _utc(origin_utc_ns: int, time_s: float) -> str:
    return datetime.fromtimestamp(origin_utc_ns * 1e-9 + time_s, UTC).strftime("%H:%M UTC")
