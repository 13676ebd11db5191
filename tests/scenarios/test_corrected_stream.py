"""The corrected stream from the virtual bench to a recording and to a Zenoh client."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import zenoh

from agent.core.events import Acceleration, CalibrationUpdate
from agent.delivery.publication import Publisher
from agent.delivery.router import open_router
from agent.delivery.store import Store
from agent.recording.acceleration import decode_acceleration, encode_acceleration
from agent.recording.reading import RecordingReader
from hw.block import SampleBlock
from hw.virtual.bench import Truth
from tests.scenarios.processes import fieldcal
from tests.unit.recorded_bench import record

DURATION_S = 44.0  # three positions: all twelve are determined


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    directory = tmp_path_factory.mktemp("stream")
    return directory, record(directory, DURATION_S, acceleration="record")


def test_each_block_is_what_its_calibration_makes_of_the_raw_one(recorded: tuple[Path, Truth]) -> None:
    directory, truth = recorded
    in_force: CalibrationUpdate | None = None
    blocks: list[tuple[SampleBlock, Acceleration, CalibrationUpdate | None]] = []
    for step in RecordingReader(directory / "fieldcal-000001.mcap").steps():
        for result in step.results:
            if isinstance(result, Acceleration):
                assert isinstance(step.event, SampleBlock)
                blocks.append((step.event, result, in_force))
            elif isinstance(result, CalibrationUpdate):
                in_force = result
    assert len(blocks) > 80
    first, last = blocks[0][1], blocks[-1][1]
    assert (first.calibration_sequence, first.determined.any()) == (0, False)  # corrected with the prior
    assert in_force is not None
    assert (last.calibration_sequence, last.calibration_run_id) == (in_force.sequence, in_force.run_id)
    for raw, corrected, used in blocks:
        assert corrected.calibration_sequence == (0 if used is None else used.sequence)
        assert corrected.first_index == raw.first_index
    raw, corrected, used = blocks[-1]
    assert used is not None
    by_hand = np.linalg.solve(np.array(used.sensitivity), (raw.indications - np.array(used.offset)).T).T
    np.testing.assert_allclose(corrected.acceleration, by_hand, rtol=0, atol=1e-9)
    true = np.linalg.solve(truth.sensitivity, (raw.indications - truth.offset).T).T
    away = (corrected.acceleration - true).mean(axis=0)
    assert np.all(np.abs(away) < 3.0 * np.sqrt(np.diag(corrected.covariance)))
    assert np.sqrt(np.diag(corrected.covariance)).max() < 0.2
    np.testing.assert_allclose(corrected.noise, 3.5e-3, rtol=0.1)  # the ADXL355's 22.5 ug over 250 Hz
    # The last sample of a block was taken just before the block arrived.
    end_ns = corrected.t_utc_ns + (raw.n - 1) / corrected.rate_hz * 1e9
    assert 0 <= raw.t_utc_ns - end_ns < 40e6


def test_replay_makes_the_very_same_blocks(recorded: tuple[Path, Truth]) -> None:
    audited = fieldcal("audit", recorded[0] / "fieldcal-000001.mcap")
    assert audited.returncode == 0, audited.stdout


def test_a_client_gets_blocks_while_it_listens(tmp_path: Path, recorded: tuple[Path, Truth]) -> None:
    block = next(
        result
        for step in RecordingReader(recorded[0] / "fieldcal-000001.mcap").steps()
        for result in step.results
        if isinstance(result, Acceleration)
    )
    router, endpoints = open_router("tcp/127.0.0.1:0")
    store = Store(tmp_path)
    publisher = Publisher("site", "gateway", endpoints, store)
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoints[0]}"]')
    try:
        with zenoh.open(config) as client:
            got = client.declare_subscriber(
                "fieldcal/v1/site/gateway/mems/acceleration", zenoh.handlers.FifoChannel(64)
            )
            publisher.start()
            end_s, sample = time.monotonic() + 60, None
            while sample is None and time.monotonic() < end_s:
                publisher.stream("mems", encode_acceleration(5, block))
                time.sleep(0.1)  # blocks come one after the other
                sample = got.try_recv()
            assert sample is not None
            number, back = decode_acceleration(sample.payload.to_bytes())
            assert number == 5
            np.testing.assert_array_equal(back.acceleration, block.acceleration)
            assert sample.encoding == zenoh.Encoding.APPLICATION_PROTOBUF
            got.undeclare()
    finally:
        publisher.close()
        store.close()
        router.close()
