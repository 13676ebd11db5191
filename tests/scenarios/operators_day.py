"""The processes of an operator's day: `fieldcal run` on serial ports at the golden site, once for each configuration.

The devices run all day, also while the program does not. UTC begins a day after the golden state was written.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from subprocess import Popen
from typing import Any

from click.testing import CliRunner

from agent.cli.keys import keys
from hw.virtual.serial_port import PtyDevice, SampleLines
from tests import golden_site
from tests.faults.clock import step_clock
from tests.golden_site import REFERENCE, SENSOR
from tests.scenarios.processes import results, started, wait_until
from tests.unit.recorded_bench import EPOCH_NS

DAY_S = 86_400
SEED = 2
WINDOW_S = 40.0  # allowed for a window of 6 s, with a start, on a machine under load
NEARLY_S = 600.0
OPERATOR = "anna"


class Site:
    """The devices on their ports, the data directory and the clock of the gateway. `fitted`: serial number of the
    reference that is plugged in."""

    def __init__(self, directory: Path, step: Path) -> None:
        self.directory, self.data_dir = directory, directory / "data"
        self.output = directory / "output"
        self.fitted = "A"
        self._step = step
        self._base_s = EPOCH_NS // 10**9 + DAY_S - int(time.time())
        step_clock(step, self._base_s)
        self._world = golden_site.World(SEED)
        self._began_s = time.monotonic()
        self.ports = {device: self._port(device) for device in (SENSOR, REFERENCE)}
        printed = CliRunner().invoke(keys, ["command", OPERATOR, "--dir", str(directory / "keys")]).stdout
        self._commands = printed
        self.data_dir.mkdir()

    def _port(self, device: str) -> PtyDevice:
        lines = SampleLines(
            lambda first, n: self._world.values(device, first, n, self.fitted),
            lambda t_s: int((t_s - self._began_s) * golden_site.RATE_HZ),
            decimals=golden_site.DECIMALS,
        )
        port = PtyDevice(lines, link=self.directory / device)
        port.start()
        return port

    @property
    def key(self) -> Path:
        """The operator's private key."""
        return self.directory / "keys" / f"{OPERATOR}.command.key"

    def shift_clock(self, seconds: int, by_s: int) -> None:
        """Shift UTC of the gateway against that of the day; wait until two calibrations are about `by_s` apart."""
        since = self.count("calibration") - 1
        step_clock(self._step, self._base_s + seconds)

        def felt() -> bool:
            utc_s = [c["t_utc_ns"] * 1e-9 for c in results(self.data_dir, "calibration")[since:]]
            return any(abs(after - before - by_s) < NEARLY_S for before, after in pairwise(utc_s))

        self.wait(felt, WINDOW_S, f"two calibrations whose UTC is {by_s} s apart")

    def count(self, what: str) -> int:
        """How many results of this kind are stored."""
        return len(results(self.data_dir, what))

    def wait(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """As `wait_until`; a failure shows what the program has said last."""
        try:
            wait_until(condition, timeout_s, what)
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.output.read_text()[-2000:]}") from None

    @property
    def status(self) -> str:
        """The newest status of the sensor."""
        return str(results(self.data_dir, "status")[-1]["status"])

    def wait_for(self, what: str, more: int = 1) -> None:
        """Wait until so many more results of this kind are stored."""
        enough = self.count(what) + more
        self.wait(lambda: self.count(what) >= enough, WINDOW_S * more, f"{more} more of {what}")

    @contextmanager
    def running(self, **channel: Any) -> Iterator[Popen[bytes]]:
        """Run the program with the fitted reference; `channel` as in `golden_site.config`. Yields it as soon as a
        calibration is in force."""
        ports = {device: port.path for device, port in self.ports.items()}
        config = self.directory / "gateway.toml"
        config.write_text(_toml(golden_site.config(ports, self.fitted, **channel)) + self._commands)
        restored = self.count("calibration")
        with started("run", config, "--data-dir", self.data_dir, output=self.output) as process:
            self.wait(lambda: self.count("calibration") > restored, WINDOW_S, "a calibration in force")
            yield process

    def close(self) -> None:
        """Remove the ports."""
        with ExitStack() as stack:
            for port in self.ports.values():
                stack.callback(port.stop)


def _toml(raw: dict[str, Any]) -> str:
    return "".join(f"{name} = {_value(value)}\n" for name, value in raw.items())


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{name} = {_value(item)}" for name, item in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return json.dumps(value)
