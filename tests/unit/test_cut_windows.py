"""Samples that are missing in the middle of a position: every whole part is a window, and its numbers say what is not
there."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.config import Config
from agent.core.events import Event, WindowReport
from agent.core.pipeline import Pipeline
from hw.block import BlockFlags, SampleBlock
from tests.unit.mounted_site import begun, said, site_config
from tests.unit.mounted_site import windows as of_site
from tests.unit.test_positions import FACES, OFFSET_MPS2, RATE_HZ, blocks, configured, opened, played

HOLE_S, HOLE_AT_S = 3.0, 30.0
UNCOUNTED = [BlockFlags.RESTART, BlockFlags.OVERRUN, BlockFlags.RESTART | BlockFlags.OVERRUN]


POSES_OF_8_S = [{"start_s": 8 * k, "stop_s": 8 * k + 8, "gravity_mps2": FACES[1].tolist()} for k in range(3)]


def told() -> Config:
    """One pose from 0 to 50 s."""
    poses = [{"start_s": 0, "stop_s": 50, "gravity_mps2": FACES[1].tolist()}]
    return configured(positions=[], poses=poses, window_s=60)


def found() -> Config:
    return configured(window_s=60)


def stay() -> np.ndarray:
    """55 s in one position, 20 s in the next."""
    values = np.repeat([FACES[1], FACES[2]], [round(55 * RATE_HZ), round(20 * RATE_HZ)], axis=0) + OFFSET_MPS2
    return np.asarray(values + 0.01 * np.random.default_rng(1).normal(size=values.shape))


def holed(made: Sequence[SampleBlock], flags: BlockFlags, hole_s: float = HOLE_S) -> list[SampleBlock]:
    """Blocks without those from HOLE_AT_S on; the first one afterwards has the flags. GAP alone counts on."""
    before = [b for b in made if b.first_index < HOLE_AT_S * RATE_HZ]
    after = [b for b in made if b.first_index >= (HOLE_AT_S + hole_s) * RATE_HZ]
    shift = 0 if flags == BlockFlags.GAP else before[-1].first_index + before[-1].n - after[0].first_index
    after = [replace(b, first_index=b.first_index + shift) for b in after]
    return [*before, replace(after[0], flags=flags), *after[1:]]


def closed(config: Config, events: Sequence[Any]) -> list[WindowReport]:
    results = played(Pipeline.begin(config, "run", 0, 0, {}), [opened(), *events])
    return [r for r in results if isinstance(r, WindowReport)]


@pytest.mark.slow
@pytest.mark.parametrize("flags", UNCOUNTED)
@pytest.mark.parametrize("config", [told, found])
@pytest.mark.parametrize("hole_s", [0.5, HOLE_S])
def test_where_samples_are_counted_anew_both_parts_are_windows(config: Any, flags: BlockFlags, hole_s: float) -> None:
    windows = closed(config(), holed(blocks(stay()), flags, hole_s))
    assert [w.used for w in windows] == [True, True]
    before, after = windows
    assert before.start_s < 1.0
    assert HOLE_AT_S - 1.5 < before.stop_s < HOLE_AT_S
    assert HOLE_AT_S + hole_s < after.start_s < HOLE_AT_S + hole_s + 1.5
    assert after.stop_s > 48.0
    assert before.numbers["restarts"] == 1.0
    np.testing.assert_allclose(
        [before.points, after.points], [RATE_HZ * (w.stop_s - w.start_s) for w in windows], rtol=0.01
    )


@pytest.mark.parametrize("config", [told, found])
def test_a_gap_is_counted_in_the_numbers(config: Any) -> None:
    windows = closed(config(), holed(blocks(stay()), BlockFlags.GAP))
    assert all(w.used for w in windows)
    assert windows[0].numbers["missing_samples"] == HOLE_S * RATE_HZ
    assert "restarts" not in windows[0].numbers
    assert windows[-1].stop_s > 48.0


def test_a_window_without_holes_says_nothing_of_them() -> None:
    [window] = closed(told(), blocks(stay()))
    assert not {"missing_samples", "restarts"} & set(window.numbers)


def test_a_device_that_starts_anew_all_the_time_is_one_refused_window() -> None:
    made = [replace(b, flags=BlockFlags.RESTART) for b in blocks(stay())]
    [window] = closed(told(), made)
    assert not window.used
    assert window.numbers["restarts"] > 50


@pytest.mark.slow
def test_the_state_between_two_runs_of_samples_is_in_the_snapshot() -> None:
    for config in (told(), found()):
        events: list[Event] = [opened(), *holed(blocks(stay()), BlockFlags.RESTART)]
        going_on, restored = (Pipeline.begin(config, "run", 0, 0, {}) for _ in range(2))
        for event in events:
            restored = Pipeline.restore(config.model_dump_json(), restored.snapshot())
            assert restored.step(event) == going_on.step(event)
        assert restored.snapshot() == going_on.snapshot()


@pytest.mark.slow
@pytest.mark.parametrize("device", ["s", "r"])
@pytest.mark.parametrize("flags", [BlockFlags.RESTART, BlockFlags.GAP])
def test_beside_a_tri_axial_reference_too(device: str, flags: BlockFlags) -> None:
    site = begun(site_config(window_s=60))
    hole_at_s, hole_s = 28, 4 if flags == BlockFlags.RESTART else 2
    original, numbers = site.step, {"shift": 0}

    def step(event: Any) -> Any:
        if isinstance(event, SampleBlock) and event.device == device:
            if event.first_index == hole_at_s * 50:
                numbers["shift"] = hole_s * 50
                event = _without_first(event, hole_s * 50, flags)
                if event is None:
                    return []
            elif event.first_index == (hole_at_s + 4) * 50 and flags == BlockFlags.RESTART:
                event = replace(event, flags=flags)
        return original(event)

    site.step = step  # type: ignore[method-assign]  # the way of the blocks, not what is tested
    site.play(6)
    of = "" if device == "s" else "reference_"
    windows = of_site(site.results)
    assert all(w.used for w in windows), [w.reason for w in windows]
    if flags == BlockFlags.GAP:
        assert windows[0].numbers[f"{of}missing_samples"] == hole_s * 50
        assert sum(w.points for w in windows if w.stop_s < 61) > 50 * (60 - hole_s - 5)
    else:
        assert windows[0].numbers[f"{of}restarts"] == 1.0
        assert windows[0].stop_s < hole_at_s + 0.1
        assert hole_at_s + hole_s <= windows[1].start_s < hole_at_s + hole_s + 1.5
    assert "INVALID" not in {status for status, _ in said(site.results)}


def _without_first(block: SampleBlock, n: int, flags: BlockFlags) -> SampleBlock | None:
    if n >= block.n:
        return None
    kept = block.burst_count > n
    return replace(
        block, first_index=block.first_index + n, indications=block.indications[n:], flags=flags,
        burst_t_monotonic_ns=block.burst_t_monotonic_ns[kept], burst_count=block.burst_count[kept] - np.int32(n),
    )  # fmt: skip


@pytest.mark.one_case
@pytest.mark.parametrize("positions", [False, True])
def test_sample_numbers_that_jump_at_will_cost_their_windows_and_the_agent_goes_on(positions: bool) -> None:
    """Numbers 0, 1, 0, 1, ... make no clock."""
    made = [replace(b, first_index=k % 2) for k, b in enumerate(single(stay()[: round(25 * RATE_HZ)]))]
    config = configured(window_s=8) if positions else configured(positions=[], poses=POSES_OF_8_S)
    assert not any(w.used for w in closed(config, made))
    beside = begun(site_config())
    original = beside.step

    def step(event: Any) -> Any:
        if isinstance(event, SampleBlock) and event.device == "s":
            return [r for k, b in enumerate(split(event)) for r in original(replace(b, first_index=k % 2))]
        return original(event)

    beside.step = step  # type: ignore[method-assign]
    beside.play(2)
    refused = of_site(beside.results)
    assert refused
    assert not any(w.used for w in refused)
    assert {w.fault for w in refused} == {""}


def single(values: np.ndarray) -> list[SampleBlock]:
    return [part for block in blocks(values) for part in split(block)]


def split(block: SampleBlock) -> list[SampleBlock]:
    """A block for each burst, of one sample each."""
    edges = [0, *block.burst_count.tolist()]
    return [
        replace(
            block, first_index=block.first_index + a, indications=block.indications[b - 1 : b],
            burst_t_monotonic_ns=block.burst_t_monotonic_ns[k : k + 1], burst_count=np.ones(1, dtype=np.int32),
        )
        for k, (a, b) in enumerate(itertools.pairwise(edges))
    ]  # fmt: skip
