"""One run of the agent: readers -> queue -> pipeline -> recording -> store -> network, driven by one main loop."""

from __future__ import annotations

import logging
import os
import time
import uuid
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from agent import __version__
from agent.acquisition.arena import one_arena, return_free
from agent.acquisition.arrival_rates import ArrivalRates
from agent.acquisition.reader import DeviceReader, EventQueue, reader_of
from agent.acquisition.stalls import few_objects
from agent.acquisition.weighing import Weighing
from agent.audit.recalling import memories_of
from agent.commanding.reception import Reception
from agent.config import Channel, Config
from agent.core.events import Acceleration, DeviceChange, Event, Result, RunStart, Tick, WindowReport
from agent.core.memory import Memory
from agent.core.pipeline import Pipeline
from agent.delivery.gateway_key import GatewayKey
from agent.delivery.history import StoredResult, StoreError
from agent.delivery.mqtt import MqttPublisher
from agent.delivery.publication import Publisher
from agent.delivery.retention import keep_results
from agent.delivery.store import Store
from agent.engine import identity
from agent.engine.keeping import keep_engine
from agent.recording.acceleration import encode_acceleration
from agent.recording.files import final_name
from agent.recording.fingerprint import fingerprint, versions
from agent.recording.owner import check_owner
from agent.recording.retention import keep_files
from agent.recording.signing import Signer
from agent.recording.thread import RecordingThread
from agent.recording.writer import Recorder
from agent.supervision.notify import SystemdNotifier
from agent.supervision.plant import Outbox, Plant
from agent.supervision.supervisor import Supervisor
from agent.terminal.watch import RunView
from hw.sensor import boot_id

_log = logging.getLogger(__name__)

TICK_S = 1.0
POLL_S = 0.2  # s after which a stop signal is noticed where no event comes
READER_STOP_S = 0.7  # s to wait for readers at the end; a reader ends within one block unless it hangs in its driver


class Service:
    """One run of the agent. `stop` may be called from a signal handler; `run` returns after all files are closed."""

    def __init__(self, config: Config, data_dir: Path, watch: RunView) -> None:
        self._config = config
        self._data_dir = data_dir
        self._watch = watch
        self._weighing, self._rates = Weighing(config), ArrivalRates()
        self._stopping = False
        self._sequence = 0
        self._run_id = uuid.uuid4().hex
        self.refused: list[str] = []  # why the run ended by itself: transfers that the adapters of all channels refuse
        self.begun = False  # whether the devices are read; before that, a stop is as harmless as a power cut

    def stop(self) -> None:
        """End the run that has begun; `run` returns within two seconds."""
        self._stopping = True  # no event: a handler of signals does this, and another signal may interrupt it

    def run(self, duration_s: float | None) -> None:
        """Read, calibrate, record and publish until `stop` is called or `duration_s` seconds have passed.

        Ends by itself, with the reasons in `refused`, where adapters refuse transfers that every channel needs.
        Where a router, a disk or a device does not respond, a thread that waits for it is left behind.
        Raises StoreError or OSError where the data directory cannot be used, OtherGatewayError where it is another
        gateway's, KeyFileError for an unusable signing key, ConfigurationError for a driver that cannot be made.
        """
        one_arena()
        self._data_dir.mkdir(parents=True, exist_ok=True)
        config = self._config
        name = f"{config.gateway.site}/{config.gateway.name}"
        check_owner(self._data_dir, name)
        recording = config.recording
        signer = Signer.load(recording.signing_key, recording.earlier_keys) if recording.signing_key else None
        self._store = self._opened_store(GatewayKey(name, signer) if signer is not None else None)
        self._recorder = self._new_recorder(signer)
        self._recorder.close_torn()
        events = EventQueue(len(config.devices))
        plans = {channel.sensor: channel.self_test for channel in config.channels}
        readers = [reader_of(device, events, plans.get(device.name)) for device in config.devices]
        self._reception = self._command_reception(events)
        self._publisher = self._publication()
        self._mqtt = self._mqtt_publication()
        self._begin()
        writer = RecordingThread(self._recorder, self._deliver, flush_s=config.recording.flush_s)
        plant = Plant(self._data_dir, events, writer, self._recorder, Outbox(self._store), self._publisher, self._mqtt)
        self._supervisor = Supervisor(config, self._run_id, self._origin_ns, plant, SystemdNotifier(os.environ))
        for channel in config.channels:
            self._supervisor.remember(plant.outbox.drifts(channel.sensor))
        self.begun = True
        try:
            self._begin_file(writer, continuation=False)
            with few_objects():
                for reader in readers:
                    reader.start()
                self._loop(events, writer, readers, duration_s)
        finally:
            self._end(readers, writer)

    def _opened_store(self, key: GatewayKey | None) -> Store:
        """The store, made anew from the recordings as far as it is damaged."""
        recall = partial(memories_of, restore=Pipeline.restore)
        store = Store(self._data_dir, keep=keep_results(self._config.results), recall=recall, key=key)
        if store.set_aside:
            kept = "the state file was corrupt and is kept as %s; a new one is made from the recordings"
            _log.warning(kept, store.set_aside)
        if (found := store.recovered).results or found.memories:
            lacked = "%d results and the states of %d devices that the state file lacked were found in the recordings"
            _log.warning(lacked, found.results, found.memories)
        return store

    def _new_recorder(self, signer: Signer | None) -> Recorder:
        config = self._config
        return Recorder(
            self._data_dir,
            [device.name for device in config.devices],
            [channel.sensor for channel in config.channels],
            max_bytes=int(config.recording.rotate_bytes),
            max_age_s=config.recording.rotate_s,
            keep=keep_files(config.recording),
            ledger=self._store,
            signer=signer,
            tell_head=self._tell_head,
            epoch=self._store.epoch,
        )

    def _end(self, readers: Sequence[DeviceReader], writer: RecordingThread) -> None:
        """End what `run` has begun: first what brings events, last the store."""
        self._supervisor.closing()
        if self._reception is not None:
            self._reception.close()
        for reader in readers:
            reader.stop()
        deadline = time.monotonic() + READER_STOP_S
        for reader in readers:
            if reader.ident is not None:
                reader.join(max(0.0, deadline - time.monotonic()))
        recorded = writer.close()
        for sink in (self._publisher, self._mqtt):
            if sink is not None:
                sink.close()
        if recorded:
            self._end_store(writer.whole)

    def _end_store(self, whole: bool) -> None:
        """Close the store; with the states after the last event, if the recordings hold all events (`whole`)."""
        if whole:
            self._store.end([channel.sensor for channel in self._config.channels], self._pipeline.all_memories())
        self._store.close()

    def _publication(self) -> Publisher | None:
        if not self._config.zenoh.enabled:
            return None
        gateway = self._config.gateway
        zenoh = self._config.zenoh
        publisher = Publisher(
            gateway.site,
            gateway.name,
            zenoh.connect,
            self._store,
            tls=zenoh.tls.files if zenoh.tls else None,
            serve=self._reception.serve if self._reception else None,
            instance=self._run_id,
        )
        publisher.start()
        return publisher

    def _mqtt_publication(self) -> MqttPublisher | None:
        if not self._config.mqtt.enabled:
            return None
        gateway = self._config.gateway
        publisher = MqttPublisher(gateway.site, gateway.name, self._config.mqtt, self._store.history)
        publisher.start()
        return publisher

    def _tell_head(self, head: bytes) -> None:
        """Publish a head; the recording's thread calls this."""
        if self._publisher is not None:
            self._publisher.tell_head(head)

    def _command_reception(self, events: EventQueue) -> Reception | None:
        if not self._config.commands.enabled:
            return None
        return Reception(
            self._config, self._data_dir, self._store.find, lambda command: events.put(command.sensor, command)
        )

    def _begin(self) -> None:
        self._engine_sha256 = keep_engine(self._data_dir)
        self._origin_ns = time.monotonic_ns()
        self._pipeline = Pipeline.begin(
            self._config, self._run_id, self._origin_ns, self._store.last_sequence(), self._earlier_states()
        )

    def _earlier_states(self) -> dict[str, dict[str, bytes]]:
        """The states of the estimation that earlier runs left, by sensor and by identity of the device."""
        kept: dict[str, dict[str, bytes]] = {}
        for memory in self._store.states:
            kept.setdefault(memory.sensor, {})[memory.identity] = memory.state
        return kept

    def _begin_file(self, writer: RecordingThread, *, continuation: bool) -> None:
        start = self._run_start(continuation=continuation)
        writer.put(self._sequence, start, self._pipeline.step(start))

    def _run_start(self, *, continuation: bool) -> RunStart:
        gateway = self._config.gateway
        return RunStart(
            run_id=self._run_id,
            site=gateway.site,
            gateway=gateway.name,
            boot_id=boot_id(),
            t_monotonic_ns=time.monotonic_ns() if continuation else self._origin_ns,
            t_utc_ns=time.time_ns(),
            config_json=self._config.model_dump_json(),
            versions={"fieldcal": __version__, **versions()},
            fingerprint=fingerprint(),
            snapshot=self._pipeline.snapshot(),
            file_sequence=self._recorder.next_file_sequence,
            event_sequence=self._sequence,
            continuation=continuation,
            engine=identity.name(),
            engine_sha256=self._engine_sha256,
        )

    def _loop(
        self, events: EventQueue, writer: RecordingThread, readers: Sequence[DeviceReader], duration_s: float | None
    ) -> None:
        by_device, refused = {reader.device: reader for reader in readers}, dict[str, str]()
        next_tick = time.monotonic() + TICK_S
        end = float("inf") if duration_s is None else time.monotonic() + duration_s
        while not (self._stopping or self.refused) and time.monotonic() < end:
            for gap in events.take_gaps():
                self._step(gap, writer)
            event = events.get(min(POLL_S, next_tick - time.monotonic(), end - time.monotonic()))
            if event is not None:
                self._step(event, writer)
            if isinstance(event, DeviceChange):
                refused[event.device] = by_device[event.device].refused
                self.refused = refusals(self._config.channels, refused)
            if time.monotonic() >= next_tick:
                next_tick += TICK_S
                for reader in readers:
                    reader.watch()
                self._step(Tick(t_monotonic_ns=time.monotonic_ns(), t_utc_ns=time.time_ns()), writer)
                self._watch.health(self._recorder, self._publisher.state() if self._publisher else None)
            if (pruned := writer.take_pruning()) is not None:
                self._step(pruned, writer)
            if writer.wants_rotation:
                self._sequence += 1
                self._begin_file(writer, continuation=True)

    def _step(self, event: Event, writer: RecordingThread) -> None:
        self._sequence += 1
        outputs = self._pipeline.step(event)
        writer.put(self._sequence, event, outputs, self._pipeline.memories(outputs))
        results = [item for item in outputs if isinstance(item, Result)]
        self._watch.update(event, results)
        for told in (*self._weighing.messages(event), *self._rates.messages(event)):
            _log.warning("%s", told)
        if self._publisher is not None:
            for item in outputs:
                if isinstance(item, Acceleration):
                    self._publisher.stream(item.sensor, encode_acceleration(self._sequence, item))
        self._supervisor.on_event(event, results)
        if any(isinstance(result, WindowReport) for result in results):
            return_free()

    def _deliver(
        self, event_sequence: int, results: Sequence[Result], recorded: bool, memories: Sequence[Memory]
    ) -> None:
        """Put results into the store, then give them to the publishers. The recording's thread calls this."""
        path = self._recorder.path if recorded else None
        name, epoch = final_name(path) if path else "", self._store.epoch
        signed = [self._recorder.results.signed(event_sequence, result) for result in results]
        records = [
            StoredResult.of(result, recorded=recorded, recording=name, epoch=epoch, signed=one.data if one else b"")
            for result, one in zip(results, signed, strict=True)
        ]
        try:
            self._store.commit(records, memories)
        except StoreError as error:
            _log.error(
                "the store cannot write the results up to event %d, and tries again with the next: %s",
                event_sequence,
                error,
            )
        if self._publisher is None:
            self._store.mark_published(records[-1].sequence)  # publication is off: no result waits for it
        for sink in (self._publisher, self._mqtt):
            if sink is not None:
                for record in records:
                    sink.publish(record)


def refusals(channels: Sequence[Channel], refused: Mapping[str, str]) -> list[str]:
    """Why no channel can work, a line for each device; empty where one can.

    `refused`: what the adapter refuses, by device; "" where it refuses nothing. A channel can work if its sensor can,
    and a reference if it names any. A device that is only absent may come.
    """
    faults = {device: fault for device, fault in refused.items() if fault}
    for channel in channels:
        references = {beside.reference for beside in channel.by_reference} - {None}
        if channel.sensor not in faults and (not references or references - faults.keys()):
            return []
    return [f"{device}: {faults[device]}" for device in sorted(faults)]
