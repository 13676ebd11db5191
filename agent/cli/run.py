"""`fieldcal run`: runs the agent, on the devices of a configuration or on the virtual bench."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from agent.cli.loading import loading
from agent.cli.rules import check_rules
from agent.cli.stopping import TOLD, StoppableRun, StoppedAtStart, stopped_by_signals
from agent.config import Config, ConfigError, load_config, parse_config
from agent.config.key_file import KeyFileError
from agent.delivery.history import StoreError
from agent.setup.key_checks import signing_key_warnings
from agent.terminal.text import say

if TYPE_CHECKING:
    from agent.acquisition.service import Service

# What a well-known bench states: a second inclination then brings U from 1 % to 0.1 %, and nothing else limits it.
GUIDED: dict[str, dict[str, float]] = {
    "certificate": {"u_sensitivity_pct": 0.02},
    "uncertainty": {"alpha_common_deg": 0.0, "transverse_motion_pct": 0.02, "gravity_mps2": 5e-4},
}
LOOPBACK = "tcp/127.0.0.1:7447"
# The FIFO of the virtual sensor holds 32 ms at 1000 Hz, and a reader comes each 16 ms: this is half of what is left.
TOO_LATE_S, LOOKS, LOOK_S = 0.008, 60, 0.005
TOO_SLOW = (
    "this computer is too slow for the simulation at 1000 Hz: a thread was woken {:.0f} ms late. The virtual devices "
    "have 250 Hz; end other programs to see 1000 Hz"
)


@click.command()
@click.argument("config", required=False, type=click.Path(path_type=Path))
@click.option("--data-dir", type=click.Path(path_type=Path), default=Path("data"), show_default=True,
              help="Where recordings and results are kept.")  # fmt: skip
@click.option("--duration", type=click.FloatRange(min=0, min_open=True), metavar="S", help="End after S seconds.")
@click.option("--preset", type=click.Choice(["plain", "faulty", "guided"]), default="plain", show_default=True,
              help="The kind of virtual bench, without CONFIG.")  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=1, show_default=True,
              help="Seed of the virtual bench's random numbers.")  # fmt: skip
@click.option("--rate-hz", type=click.Choice(["auto", "1000", "250"]), default="1000", show_default=True,
              help="Rate of the virtual devices; auto: 250 Hz on a computer that is too busy for 1000 Hz.")  # fmt: skip
@click.option("--signing-key", type=click.Path(path_type=Path), metavar="FILE.key",
              help="Private key that signs the recordings of the virtual bench, made where it is missing; with CONFIG, "
              "recording.signing_key states the key.")  # fmt: skip
@click.option("--log", type=click.Choice(["plain", "json"]),
              help="Form of the log on standard error; json, one object a line, by default under systemd.")  # fmt: skip
@click.option("--with-router", is_flag=True, help=f"Start a Zenoh router at {LOOPBACK} unless one runs there.")
def run(
    config: Path | None,
    data_dir: Path,
    duration: float | None,
    preset: str,
    seed: int,
    rate_hz: str,
    signing_key: Path | None,
    log: str | None,
    with_router: bool,
) -> int:
    """Read devices, calibrate, record and publish until Ctrl-C. Without CONFIG the virtual bench is used."""
    _check(duration, signing_key, config)
    with loading():
        from agent.acquisition.service import Service
        from agent.supervision.logs import log_as_json, under_journal
        from agent.terminal.watch import RunView
    try:
        with ExitStack() as stack:
            journal = log is None and under_journal(os.environ, sys.stderr.fileno())
            if as_json := journal or log == "json":
                stack.callback(log_as_json().finish)
            said: list[str] = []
            if config is None:
                slow = rate_hz == "250" or (rate_hz == "auto" and _too_slow(said))
                settings, truth = stack.enter_context(virtual_bench(preset, seed, signing_key, slow=slow))
            else:
                settings, truth = load_config(config), None
            stopping = stack.enter_context(stopped_by_signals())  # up to here a signal ends the process at once
            if with_router:
                said.append(stack.enter_context(router(LOOPBACK, stopping)))
            title = f"virtual bench, {preset}" if truth else str(config)
            watch = stack.enter_context(RunView(settings, title, truth, lines=not as_json))
            for line in (*said, *signing_key_warnings(settings, data_dir), *_shortcomings(settings)):
                watch.say(line)
            stopping.service = Service(settings, data_dir, watch)
            return serve(stopping.service, duration)
    except ConfigError as error:
        for fault in error.faults:
            say(fault, err=True)
        return 2
    except KeyFileError as error:
        say(f"fieldcal run: {error}", err=True)
        return 2
    except StoppedAtStart:
        say(TOLD, err=True)
        return 0


def _check(duration: float | None, signing_key: Path | None, config: Path | None) -> None:
    if duration is not None and not math.isfinite(duration):
        raise click.BadParameter(f"{duration} is not a number of seconds", param_hint="--duration")
    of_bench = "--signing-key is for the virtual bench; state recording.signing_key in CONFIG"
    check_rules((signing_key is not None and config is not None, of_bench))


def serve(service: Service, duration_s: float | None) -> int:
    """Run the service until a signal or for `duration_s` seconds; returns the exit status."""
    from agent.recording.owner import OtherGatewayError
    from hw.sensor import ConfigurationError

    try:
        service.run(duration_s)
    except KeyFileError as error:
        say(f"fieldcal run: recording.signing_key: {error}", err=True)
        return 2
    except (OtherGatewayError, ConfigurationError) as error:
        say(f"fieldcal run: {error}", err=True)
        return 2
    except (FileExistsError, NotADirectoryError) as error:
        say(f"fieldcal run: {error.filename}: is no directory; name another one with --data-dir", err=True)
        return 2
    except StoreError as error:
        say(f"fieldcal run: {error}", err=True)
        return 1
    except OSError as error:
        said = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        say(f"fieldcal run: {said}", err=True)
        return 1
    for fault in service.refused:
        say(f"fieldcal run: {fault}", err=True)
    return 2 if service.refused else 0


def _shortcomings(settings: Config) -> Iterator[str]:
    """Why nothing sound will be calibrated as it is stated. The agent runs all the same: it records."""
    from agent.bench.plan_line import shortcomings
    from agent.config.faults import path_text

    faults, plans = shortcomings(settings)
    for place, what in (*faults, *(told for one in plans for told in one.unplaced)):
        yield f"{path_text(place)}: {what}; `fieldcal check` names the line"


def lateness_s() -> float:
    """By how much a thread that sleeps is woken too late on this computer now, at most, in s. It takes 0.3 s."""
    late_s = 0.0
    for _ in range(LOOKS):
        begun = time.monotonic()
        time.sleep(LOOK_S)
        late_s = max(late_s, time.monotonic() - begun - LOOK_S)
    return late_s


def _too_slow(said: list[str]) -> bool:
    """Whether this computer is too busy for 1000 Hz; then `said` gets a line for the user."""
    late_s = lateness_s()
    if late_s > TOO_LATE_S:
        said.append(TOO_SLOW.format(1e3 * late_s))
    return late_s > TOO_LATE_S


@contextmanager
def virtual_bench(
    preset: str, seed: int, signing_key: Path | None = None, *, slow: bool = False
) -> Iterator[tuple[Config, Any]]:
    """Run the paper's bench as virtual devices under the real drivers; yields (configuration, true values).

    `signing_key`: signs the recordings; a missing one is made. `slow`: the devices have 250 Hz. Raises KeyFileError.
    """
    from agent.keys.files import gateway_key
    from hw.virtual import presets
    from hw.virtual.live import LiveBench

    parameters = getattr(presets, preset)(seed)
    if slow:
        parameters = presets.at_rate(parameters, presets.SLOW_HZ)
    known = GUIDED if preset == "guided" else {}
    with LiveBench(parameters, seed) as live:
        poses = [
            {"start_s": p.start_s, "stop_s": p.stop_s, "theta_deg": p.theta_deg, "alpha_deg": p.alpha_deg}
            for p in live.bench.poses
        ]
        number = f"{preset}-{seed}"  # each bench has its own serial number and so its own calibration
        raw = {
            "gateway": {"site": "virtual", "name": "bench"},
            "devices": [
                {"name": "mems", "driver": "adxl355", "options": live.sensor_options | {"serial_number": number}},
                {"name": "reference", "driver": "serial-csv", "options": live.reference_options},
            ],
            "channels": [
                {
                    "sensor": "mems",
                    "reference": "reference",
                    "prior": {},
                    "certificate": {"quantity": parameters.reference.quantity, **known.get("certificate", {})},
                    "uncertainty": known.get("uncertainty", {}),
                    "poses": poses,
                    "poses_repeat_s": parameters.schedule.period_s,
                }
            ],
            "recording": {"signing_key": str(gateway_key(signing_key).private)} if signing_key else {},
        }
        yield parse_config(raw, "virtual bench"), live.bench.truth


@contextmanager
def router(endpoint: str, run: StoppableRun) -> Iterator[str]:
    """Use the router that runs at `endpoint`, or start one as a child of the run; yields a line for the user."""
    from agent.delivery.router import router_running

    if router_running(endpoint):
        yield f"using the Zenoh router that runs already at {endpoint}"
        return
    command = [sys.executable, "-m", "agent", "router", "--listen", endpoint]
    # In a session of its own, so that Ctrl-C does not stop the router before the agent has published its last results.
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True, env=os.environ)
    run.children.append(process)
    try:
        yield f"started a Zenoh router at {endpoint}"
    finally:
        process.terminate()
        try:
            process.wait(2.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
