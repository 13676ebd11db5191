"""The deterministic core: events in, results out. No I/O, no clock, no threads, no randomness.

Live, devices feed it; in an audit, a recording does. `restore(snapshot())` equals going on, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from agent.config import Config
from agent.core.channel import ChannelState
from agent.core.events import (
    Acceleration,
    CalibrationUpdate,
    Command,
    DeviceChange,
    Estimate,
    Event,
    Output,
    Result,
    RunStart,
    StatusChange,
    Tick,
    WindowReport,
)
from agent.core.memory import Memory
from agent.core.snapshot import pack, unpack
from hw.block import SampleBlock


class Pipeline:
    """All channels of one gateway, fed in one total order."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._run_id = ""
        self._next_sequence = 1
        self._channels = [ChannelState(channel) for channel in config.channels]

    @classmethod
    def begin(
        cls,
        config: Config,
        run_id: str,
        origin_ns: int,
        last_sequence: int,
        kept: Mapping[str, Mapping[str, bytes]],
    ) -> Pipeline:
        """The pipeline of a new run: results count on from `last_sequence`, seconds from `origin_ns` (monotonic).

        `kept` are the memories of runs before, by sensor and identity of the device: each is taken up again when its
        very device opens.
        """
        pipeline = cls(config)
        pipeline._run_id = run_id
        pipeline._next_sequence = last_sequence + 1
        for channel in pipeline._channels:
            channel.begin(origin_ns, kept.get(channel.sensor, {}))
        return pipeline

    @classmethod
    def restore(cls, config_json: str, snapshot: bytes) -> Pipeline:
        """The pipeline whose `snapshot` this is. Raises ValueError on what is none."""
        pipeline = cls(Config.model_validate_json(config_json))
        state = unpack(snapshot)
        pipeline._run_id = state["run_id"]
        pipeline._next_sequence = state["next_sequence"]
        for channel in pipeline._channels:
            channel.load(state["channels"][channel.sensor])
        return pipeline

    def snapshot(self) -> bytes:
        """All state."""
        return pack(
            {
                "run_id": self._run_id,
                "next_sequence": self._next_sequence,
                "channels": {channel.sensor: channel.snapshot() for channel in self._channels},
            }
        )

    def step(self, event: Event) -> list[Output]:
        """Take the next event; what follows from it, in order. Results are numbered, blocks of acceleration are not."""
        if isinstance(event, RunStart):
            return []
        found: list[Output] = []
        for channel in self._channels:
            found += self._dispatch(channel, event)
        outputs = [self._numbered(item) for item in found]
        for channel in self._channels:
            channel.number([r for r in outputs if isinstance(r, Result) and r.sensor == channel.sensor])
        return outputs

    def _numbered(self, item: Output) -> Output:
        if isinstance(item, Acceleration):
            return item
        self._next_sequence += 1
        return msgspec.structs.replace(item, run_id=self._run_id, sequence=self._next_sequence - 1)

    def memories(self, results: Sequence[Output]) -> list[Memory]:
        """What must outlive the run, of every sensor whose state these results (of the step just made) have changed."""
        found = []
        for channel in self._channels:
            own = [r for r in results if r.sensor == channel.sensor and isinstance(r, Result) and changes_state(r)]
            if own and channel.known:
                found.append(Memory(channel.sensor, channel.identity, own[-1].sequence, channel.memory()))
        return found

    def all_memories(self) -> list[Memory]:
        """What must outlive the run, of every sensor and every device that it was, as it is after the last event."""
        last = self._next_sequence - 1
        return [
            Memory(c.sensor, identity, last, state) for c in self._channels for identity, state in c.memories().items()
        ]

    @staticmethod
    def _dispatch(channel: ChannelState, event: Event) -> Sequence[Output]:
        if isinstance(event, SampleBlock):
            return channel.on_block(event)
        if isinstance(event, Tick):
            return channel.on_tick(event)
        if isinstance(event, DeviceChange):
            return channel.on_device(event)
        if isinstance(event, Command):
            return channel.on_command(event)
        return []  # a Gap is visible in the blocks' own flags and indices; it is recorded for people


def changes_state(result: Result) -> bool:
    """Whether a result tells of a window taken, of a calibration put in force or proposed, or of an operator's word."""
    if isinstance(result, StatusChange):
        return bool(result.before)  # the first status of a run is no news of the device
    return isinstance(result, CalibrationUpdate | Estimate) or (isinstance(result, WindowReport) and result.used)
