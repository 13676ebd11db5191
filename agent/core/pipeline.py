"""The deterministic core: events in, results out. No I/O, no clock, no threads, no randomness.

The events come from devices in a run and from a recording in an audit. A pipeline from `restore(config_json,
snapshot())` gives the same further results as the original, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from agent.config import Config, recorded_config
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
    SelfTestRun,
    StatusChange,
    Tick,
    WindowReport,
)
from agent.core.memory import Memory
from agent.core.snapshot import pack, unpack
from hw.block import SampleBlock


class Pipeline:
    """All channels of one gateway. Events come one at a time, in the order of the recording."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._run_id = ""
        self._engine = ""
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
        """The pipeline of a new run. Results are numbered from `last_sequence` + 1, seconds count from `origin_ns`
        (monotonic).

        `kept` are the memories of previous runs, by sensor and identity of the device. Each is used when this device
        opens.
        """
        pipeline = cls(config)
        pipeline._run_id = run_id
        pipeline._next_sequence = last_sequence + 1
        for channel in pipeline._channels:
            channel.begin(origin_ns, kept.get(channel.sensor, {}))
        return pipeline

    @classmethod
    def restore(cls, config_json: str, snapshot: bytes) -> Pipeline:
        """The pipeline from its `snapshot`. Raises ValueError if the bytes are no snapshot."""
        pipeline = cls(recorded_config(config_json))
        state = unpack(snapshot)
        pipeline._run_id = state["run_id"]
        pipeline._engine = state.get("engine", "")  # earlier states have none; the next RunStart names it
        pipeline._next_sequence = state["next_sequence"]
        for channel in pipeline._channels:
            channel.load(state["channels"][channel.sensor])
        return pipeline

    def snapshot(self) -> bytes:
        """All state."""
        return pack(
            {
                "run_id": self._run_id,
                "engine": self._engine,
                "next_sequence": self._next_sequence,
                "channels": {channel.sensor: channel.snapshot() for channel in self._channels},
            }
        )

    def step(self, event: Event) -> list[Output]:
        """Take the next event and give its results, in order. Results get a number, blocks of acceleration get none."""
        if isinstance(event, RunStart):
            self._engine = event.engine
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
        return msgspec.structs.replace(item, run_id=self._run_id, sequence=self._next_sequence - 1, engine=self._engine)

    def memories(self, results: Sequence[Output]) -> list[Memory]:
        """States for later runs, of every sensor whose state has changed by these results of the last step."""
        found = []
        for channel in self._channels:
            own = [r for r in results if r.sensor == channel.sensor and isinstance(r, Result) and changes_state(r)]
            if own and channel.taught:
                found.append(Memory(channel.sensor, channel.identity, own[-1].sequence, channel.memory()))
        return found

    def all_memories(self) -> list[Memory]:
        """States for later runs after the last event, of every sensor and every device that was used under its name."""
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
        if isinstance(event, SelfTestRun):
            return channel.on_self_test(event)
        if isinstance(event, Command):
            return channel.on_command(event)
        return []  # a Gap is recorded for people; the pipeline sees it in the flags and indices of the blocks


def changes_state(result: Result) -> bool:
    """Whether a result means that a window was taken, a calibration put in force or proposed, or a command executed."""
    if isinstance(result, StatusChange):
        return bool(result.before)  # the first status of a run does not change the state
    return isinstance(result, CalibrationUpdate | Estimate) or (isinstance(result, WindowReport) and result.used)
