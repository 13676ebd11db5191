"""`fieldcal bench`: leads a person through positions of the sensor to a wanted uncertainty."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
import numpy as np

from agent.cli.finite import Finite
from agent.cli.leading import (
    ask,
    calibrate_options,
    check_stated,
    make_result,
    progress,
    say_fault,
    wait_for_devices,
    with_filters,
)
from agent.config import Channel, Config, ConfigError, load_config, parse_config
from agent.terminal.text import say

if TYPE_CHECKING:
    from agent.bench.capture import Capture
    from agent.bench.measuring import Measuring
    from agent.bench.screen import BenchScreen
    from agent.bench.session import BenchSession
    from agent.bench.stops import BenchStop
    from agent.delivery.guide import Guide
    from agent.delivery.guide_publication import GuidePublisher
    from calib.visit.next_stop import WantedUncertainty

FIRST_S = 2.0  # of samples that tell how much the shaker moves
THETAS_DEG, ALPHA_STEP_DEG = "35,55", 15
U_MAIN_PCT, U_TRANSVERSE_PCT = 0.05, 0.25
Turn = Callable[["BenchStop"], float]


class _Angles(click.ParamType):  # type: ignore[type-arg]
    name = "angles"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        try:
            found = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} must be angles in degrees, with commas between them", param, ctx)
        if not all(-360.0 <= angle <= 360.0 for angle in found):
            self.fail(f"{value!r}: angles lie between -360 and 360 deg", param, ctx)
        return found


@click.command()
@click.argument("config", required=False, type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path, file_okay=False), default=Path("bench"),
              show_default=True, help="Directory for samples, positions and result; must not exist.")  # fmt: skip
@click.option("--sensor", metavar="NAME", help="The sensor, if the configuration has several.")
@click.option("--u-main-pct", type=Finite(0.001, 10), default=U_MAIN_PCT, show_default=True,
              help="Wanted U (k = 2) of the main sensitivities, apart from the reference's own error.")  # fmt: skip
@click.option("--u-transverse-pct", type=Finite(0.001, 100), default=U_TRANSVERSE_PCT, show_default=True,
              help="Wanted U (k = 2) of the transverse sensitivities, relative to the main one.")  # fmt: skip
@click.option("--thetas", type=_Angles(), default=THETAS_DEG, show_default=True,
              help="Inclinations that the clamp can take, deg.")  # fmt: skip
@click.option("--alphas", type=_Angles(), default=",".join(map(str, range(0, 360, ALPHA_STEP_DEG))),
              help="Rotations on the clamp, deg; default: every 15 deg.")  # fmt: skip
@click.option("--stay-s", type=Finite(2, 600), default=5.0, show_default=True,
              help="Stay at a position for so long at least.")  # fmt: skip
@click.option("--most-s", type=Finite(5, 3600), default=60.0, show_default=True,
              help="Stay at a position for so long at most.")  # fmt: skip
@click.option("--stated", type=click.Path(path_type=Path, dir_okay=False), metavar="certificate.toml",
              help="Make the certificate at the end (`fieldcal certificate`); what only people know.")  # fmt: skip
@click.option("--virtual", type=click.Choice(["clamp", "triad", "gravity"]), default="clamp", show_default=True,
              help="The virtual bench, without CONFIG.")  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=1, show_default=True,
              help="Seed of the virtual bench's random numbers.")  # fmt: skip
@click.option("--connect", "routers", multiple=True, metavar="ENDPOINT", default=["tcp/127.0.0.1:7447"],
              show_default=True, help="Router behind which a monitor shows the session, without CONFIG.")  # fmt: skip
def bench(
    config: Path | None, output: Path, sensor: str | None, virtual: str, seed: int, routers: tuple[str, ...],
    **options: Any,
) -> int:  # fmt: skip
    """Calibrate at a bench, led from position to position to a wanted uncertainty.

    \b
    The channel of CONFIG tells the kind of bench:
    with a uniaxial reference            a clamp on a shaker, theta and alpha (Eqs. 9-11)
    with a tri-axial one and a rotation  rests beside it, turned by hand
    without a reference                  rests on the faces of the sensor, on a level table

    Without CONFIG a virtual bench is used, and the sensor turns by itself when you press Enter.

    Exit status 3 if the data are refused, 2 on bad input.
    """
    try:
        if config is None:
            with _virtual_bench(virtual, seed, routers) as (settings, turn):  # type: ignore[arg-type]
                return _session(_Bench(settings, settings.channels[0], output, options, turn))
        settings = load_config(config)
        return _session(_Bench(settings, _channel(settings, sensor, config), output, options, None))
    except (ConfigError, ValueError, OSError) as error:
        say_fault(error, "bench", output, "-o")
        return 2


def _channel(settings: Config, sensor: str | None, path: Path) -> Channel:
    names = [channel.sensor for channel in settings.channels]
    if sensor is None and len(names) > 1:
        raise ValueError(f"{path} has several sensors: name one with --sensor: {', '.join(names)}")
    found = [channel for channel in settings.channels if sensor in (None, channel.sensor)]
    if not found:
        raise ValueError(f"{path} has no channel with the sensor {sensor!r}, but {', '.join(names)}")
    return found[0]


@dataclass(frozen=True)
class _Bench:
    """What is calibrated, with which options, and where its files go. `turn` turns the sensor of a virtual bench."""

    settings: Config
    channel: Channel
    output: Path
    options: dict[str, Any]
    turn: Turn | None


def _session(bench: _Bench) -> int:
    if bench.output.exists():
        raise FileExistsError
    if bench.options["stated"] is not None:
        check_stated(bench.options["stated"])
    publisher = _publisher(bench.settings)
    if publisher is None:
        return _lead(bench, lambda _: None)
    with publisher:
        return _lead(bench, publisher.show)


def _publisher(settings: Config) -> GuidePublisher | None:
    """What shows the session on the page of the monitor; None where it cannot, which is said."""
    from agent.config.key_file import KeyFileError
    from agent.delivery.guide_publication import GuidePublisher
    from agent.delivery.session import EndpointError
    from agent.recording.signing import Signer

    zenoh, key = settings.zenoh, settings.recording.signing_key
    if not zenoh.enabled:
        return None
    try:
        tls, signer = zenoh.tls.files if zenoh.tls else None, Signer.load(key) if key else None
        return GuidePublisher(settings.gateway.site, settings.gateway.name, zenoh.connect, tls, signer)
    except (EndpointError, KeyFileError) as error:
        say(f"the page of the monitor does not show this bench: {error}", err=True)
        return None


def _lead(bench: _Bench, publish: Callable[[Guide], None]) -> int:
    """Lead through the positions, and make the result."""
    from agent.bench.capture import Capture
    from agent.bench.kinds import stated_options, stops_of, write_prior
    from agent.bench.measuring import Measuring
    from agent.bench.screen import BenchScreen, Person
    from agent.calibrate.stated import options_of
    from calib.visit.next_stop import WantedUncertainty

    channel, output, options = bench.channel, bench.output, bench.options
    stops = stops_of(channel, options["thetas"], options["alphas"])
    devices = [channel.sensor, *([channel.reference] if channel.reference else [])]
    wanted, status = WantedUncertainty(options["u_main_pct"] / 100.0, options["u_transverse_pct"] / 100.0), 1
    screen = BenchScreen(channel.sensor, wanted, Person(ask, say, progress), publish)
    try:
        with Capture(bench.settings, devices) as capture:
            info = wait_for_devices(capture, devices)
            channel = with_filters(channel, capture)
            output.mkdir(parents=True)
            scale = write_prior(channel, info.get("nominal_sensitivity"), output / "prior.json")
            arguments = [*stated_options(channel, output, info.get("unit", "")), f"--json={output / 'result.json'}"]
            told = calibrate_options(arguments)
            measuring = Measuring(channel, options_of(told))
            session = _begin(stops, measuring, wanted, scale, capture)
            if not _measure(bench, session, measuring, capture, screen, arguments):
                (output / "prior.json").unlink()
                output.rmdir()
                say("no stop was taken, so there is no result", err=True)
                status = 3
                return status
        status = make_result(told, output, options["stated"])
        return status
    finally:
        screen.show_end(output, status)


def _begin(
    stops: list[BenchStop], measuring: Measuring, wanted: WantedUncertainty, scale: float, capture: Capture
) -> BenchSession:
    """A session that knows how much the reference moves."""
    from agent.bench.session import START, BenchSession
    from calib.excitation.band_to_keep import LEAST_MOTION_MPS2

    time.sleep(FIRST_S)
    moved = measuring.moved_mps2(capture.record(capture.now_s - FIRST_S))
    expected = replace(START, rms_mps2=moved) if moved > LEAST_MOTION_MPS2 else START
    return BenchSession(stops, measuring.priors, wanted, scale, expected)


def _measure(
    bench: _Bench, session: BenchSession, measuring: Measuring, capture: Capture, screen: BenchScreen,
    arguments: list[str],
) -> bool:  # fmt: skip
    """Whether stops were taken; their samples are then in the directory, also after Ctrl-C."""
    from agent.bench.aside import Aside
    from agent.bench.dialogue import Dialogue, StopStay
    from agent.bench.thinking import Thinking

    stay = StopStay(bench.options["stay_s"], max(bench.options["most_s"], bench.options["stay_s"]))
    with Aside() as aside:
        dialogue = Dialogue(Thinking(session, measuring, aside), capture, stay, screen, bench.turn)
        try:
            dialogue.run()
        finally:
            if dialogue.taken:
                time.sleep(measuring.margin_s)  # for the samples that filters need after a stop
                measuring.write(capture.record(), dialogue.taken, bench.output)
                say("the samples are kept; the result is made by: fieldcal calibrate " + shlex.join(arguments))
    return bool(dialogue.taken)


@contextmanager
def _virtual_bench(
    kind: Literal["clamp", "triad", "gravity"], seed: int, routers: tuple[str, ...]
) -> Iterator[tuple[Config, Turn]]:
    """A bench of virtual devices under the real drivers, and what turns its sensor."""
    from hw.virtual.hand_bench import HandBench
    from hw.virtual.presets import by_hand
    from hw.virtual.schedule import clamped, resting

    with HandBench(by_hand(kind, seed), seed) as live:
        on_clamp, nominal = kind == "clamp", live.bench.parameters.sensor.nominal_sensitivity
        channel: dict[str, Any] = {
            "sensor": "mems",
            "prior": {"sensitivity": nominal},
            "uncertainty": {
                "alpha_common_deg": 0.0, "transverse_motion_pct": 0.0, "rotation_deg": 0.0, "gravity_mps2": 0.0,
                "offset_mps2": 0.05 if on_clamp else 0.0025,
            },
        }  # fmt: skip
        devices = [{"name": "mems", "driver": "serial-csv", "options": live.options["sensor"]}]
        if kind != "gravity":
            devices.append({"name": "reference", "driver": "serial-csv", "options": live.options["reference"]})
            channel["reference"] = "reference"
        if kind == "triad":
            channel["rotation"] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
        raw = {"gateway": {"site": "virtual", "name": "bench"}, "devices": devices, "channels": [channel],
               "zenoh": {"connect": routers}}  # fmt: skip

        def turn(stop: BenchStop) -> float:
            held_s, columns = float("inf"), np.array(list(stop.columns.values()))
            return live.turn(clamped(columns[0], columns[1], held_s) if on_clamp else resting(columns, held_s))

        yield parse_config(raw, "virtual bench"), turn
