"""The deterministic core: events in, results out. No I/O, no clock, no threads, no randomness.

Live, devices feed it; in an audit, a recording does. `restore(snapshot())` equals going on, bit for bit.
"""

from __future__ import annotations

import msgspec

from agent.channel import ChannelState
from agent.config import Config
from agent.events import CalibrationUpdate, DeviceChange, Event, Result, RunStart, Tick
from agent.snapshot import pack, unpack
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
        cls, config: Config, run_id: str, origin_ns: int, last_sequence: int, kept: dict[str, CalibrationUpdate]
    ) -> Pipeline:
        """The pipeline of a new run: results count on from `last_sequence`, seconds from `origin_ns` (monotonic).

        `kept` are the calibrations of the run before, by sensor; each comes into force again when its sensor opens with
        the same identity.
        """
        pipeline = cls(config)
        pipeline._run_id = run_id
        pipeline._next_sequence = last_sequence + 1
        for channel in pipeline._channels:
            channel.begin(origin_ns, kept.get(channel.sensor))
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

    def step(self, event: Event) -> list[Result]:
        """Take the next event; what follows from it, in order."""
        results: list[Result] = []
        if isinstance(event, RunStart):
            return results
        for channel in self._channels:
            results += self._dispatch(channel, event)
        numbered = [
            msgspec.structs.replace(result, run_id=self._run_id, sequence=self._next_sequence + i)
            for i, result in enumerate(results)
        ]
        self._next_sequence += len(numbered)
        return numbered

    @staticmethod
    def _dispatch(channel: ChannelState, event: Event) -> list[Result]:
        if isinstance(event, SampleBlock):
            return channel.on_block(event)
        if isinstance(event, Tick):
            return channel.on_tick(event)
        if isinstance(event, DeviceChange):
            return channel.on_device(event)
        return []  # a Gap is visible in the blocks' own flags and indices; it is recorded for people
