"""Who can write the data directory, but has not the key, changes no calibration that comes into force."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.attacks.store_site import Run, forge_memory, half, states


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Run]:
    """A data directory after a run that ended, and this run."""
    directory = tmp_path_factory.mktemp("ended")
    return directory, Run(directory).feed(half(1)).stop()


@pytest.fixture
def data(ended: tuple[Path, Run], tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(ended[0], tmp_path / "data"))


Begin = Callable[..., Run]


@pytest.fixture
def begin(data: Path) -> Iterator[Begin]:
    """Begins a run on the copy; one that the test does not end is killed."""
    runs: list[Run] = []

    def begun(**options: Any) -> Run:
        runs.append(Run(data, len(runs) + 2, **options))
        return runs[-1]

    yield begun
    for run in runs:
        if run.alive:
            run.kill()


def test_a_run_goes_on_with_the_states_after_the_last_event(ended: tuple[Path, Run], begin: Begin) -> None:
    again = begin()
    assert again.faults == []
    assert states(again.begun_with) == states(ended[1].pipeline.all_memories())


def test_a_state_that_was_changed_is_refused_and_made_anew(ended: tuple[Path, Run], data: Path, begin: Begin) -> None:
    forge_memory(data)
    again = begin()
    assert "is not the one that the gateway signed" in again.faults[0]
    assert states(again.begun_with) == states(ended[1].pipeline.all_memories())
    again.stop()
    third = begin()
    assert (third.faults, states(third.begun_with)) == ([], states(again.begun_with))
