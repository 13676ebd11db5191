"""A configuration full of faults costs little memory and time, in its own file and in a recording."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.config import ConfigError, load_config, recorded_config

CPU_LIMIT_S = 10.0
HEAD = '[gateway]\nsite = "s"\nname = "g"\n'
POSE = "{a = 1, b = 2, c = 3, d = 4}"
HOSTILE: dict[str, Callable[[], str]] = {
    "unknown settings": lambda: HEAD + "".join(f"a{k} = 1\n" for k in range(120_000)),
    "a day of wrong poses": lambda: f"{HEAD}[[channels]]\nsensor = 'm'\nposes = [{','.join([POSE] * 30_000)}]\n",
    "a few thousand devices": lambda: HEAD + "".join(f'[[devices]]\ndriver = "d{k}"\n' for k in range(6_000)),
}


@pytest.mark.two_cases
@pytest.mark.parametrize("name", HOSTILE)
def test_faults_without_number_are_told_in_bounded_time(tmp_path: Path, name: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(HOSTILE[name]())
    assert path.stat().st_size < 4 << 20
    began_s = time.process_time()
    with pytest.raises(ConfigError) as told:
        load_config(path)
    assert time.process_time() - began_s < CPU_LIMIT_S
    assert len(told.value.faults) <= 101


@pytest.mark.one_case
@pytest.mark.parametrize(
    "text",
    [
        lambda: "[" * 200_000,
        lambda: json.dumps({"channels": [], **{f"a{k}": 1 for k in range(300_000)}}),
        lambda: json.dumps({"channels": [[]] * 300_000}),
    ],
    ids=["depth", "settings", "channels"],
)
def test_a_recorded_configuration_has_the_same_limits(text: Callable[[], str]) -> None:
    with pytest.raises(ValueError, match=r"nested too deep|at most \d+ are allowed"):
        recorded_config(text())
