"""`fieldcal visit`: a portable reference is clamped beside one mounted sensor after another."""

from __future__ import annotations

import contextlib
import json
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from agent.config.whole_files import status_of
from agent.terminal.text import say

if TYPE_CHECKING:
    from agent.bench.aside import Aside
    from agent.bench.visit_dialogue import Visited

Say = Callable[[str], None]
Clamp = Callable[[str, str], None]
OWN_GRAVITY = (0.0, 0.0, 0.0)
TURNED_DEG = 5.0  # of the virtual reference by the answer "turned"


@click.command()
@click.argument("config", required=False, type=click.Path(path_type=Path))
@click.option("-d", "--data-dir", type=click.Path(path_type=Path, file_okay=False), default=Path("visits"),
              show_default=True, help="Directory for the samples and results; must not exist.")  # fmt: skip
@click.option("--sensor", "sensors", metavar="NAME", multiple=True, help="Visit this one; can be repeated.")
@click.option("--u-pct", type=Finite(0.001, 50), default=0.5, show_default=True,
              help="Wanted U (k = 2) of the main sensitivities, the reference's own error included.")  # fmt: skip
@click.option("--u-transverse-pct", type=Finite(0.001, 100),
              help="Wanted U (k = 2) of the transverse ones, relative to the main one.")  # fmt: skip
@click.option("--minutes", type=Finite(0.5, 120), default=10.0, show_default=True,
              help="Stay at a sensor for so long at most.")  # fmt: skip
@click.option("--limit-u-pct", type=Finite(0.001, 100), help="Tell when U exceeds this; default: twice --u-pct.")
@click.option("--temperature-off-k", type=Finite(0, 100), default=10.0, show_default=True,
              help="SD by which the temperature differs later from that of the visit.")  # fmt: skip
@click.option("--yes", is_flag=True, help="Ask nothing: a wrong clamp leaves the sensor out.")
@click.option("--stated", type=click.Path(path_type=Path, dir_okay=False), metavar="certificate.toml",
              help="Make a certificate of each sensor (`fieldcal certificate`); what only people know.")  # fmt: skip
@click.option("--json", "json_to", type=click.Path(path_type=Path, allow_dash=True, dir_okay=False),
              help="Write one JSON object to this file; -: print it, and nothing else on standard output.")  # fmt: skip
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=1, show_default=True,
              help="Seed of the virtual structure, without CONFIG.")  # fmt: skip
def visit(config: Path | None, sensors: tuple[str, ...], json_to: Path | None, seed: int, **options: Any) -> int:
    """Calibrate mounted sensors one after another beside a portable reference.

    Each channel of CONFIG names its sensor, the same tri-axial reference, and the rotation in which it is clamped.
    The program says when the clamp is loose or turned, how long to stay at the motion there is, and when to go on;
    at the end, how U grows until the next visit.

    Without CONFIG a virtual structure with three sensors is used. To see what the program notices, answer turned,
    loose or calm.

    Exit status 3 if a sensor has no result, 2 on bad input.
    """
    options["apart"] = json_to == Path("-")  # standard output is for the JSON object
    tell = partial(say, err=options["apart"])
    try:
        with contextlib.ExitStack() as stack:
            if config is None:
                settings, clamp = stack.enter_context(_virtual_structure(seed))
            else:
                settings, clamp = load_config(config), None
            if options["stated"] is not None:
                check_stated(options["stated"])
            told, complete = _visits(settings, _channels(settings, sensors), options, tell, clamp)
        if json_to is not None:
            with click.open_file(str(json_to), "w") as file:
                file.write(json.dumps(told) + "\n")
    except (ConfigError, ValueError, OSError) as error:
        say_fault(error, "visit", options["data_dir"], "--data-dir")
        return status_of(error)
    return 0 if complete else 3


def _channels(settings: Config, sensors: tuple[str, ...]) -> list[Channel]:
    """The channels to visit, in the order of --sensor. Raises ValueError where one cannot be visited."""
    by_name = {channel.sensor: channel for channel in settings.channels}
    if unknown := [name for name in sensors if name not in by_name]:
        raise ValueError(f"--sensor {unknown[0]}: no channel has it; there are {', '.join(by_name)}")
    found = [by_name[name] for name in dict.fromkeys(sensors)] if sensors else list(settings.channels)
    for channel in found:
        where = f"the channel of {channel.sensor}"
        if channel.reference is None or channel.rotation is None:
            raise ValueError(f"{where}: a visit needs reference, with three axes, and rotation (a = R a_ref)")
        if channel.rotation_gravity_mps2 != OWN_GRAVITY:
            raise ValueError(f"{where}: a visit needs a reference that feels gravity; remove rotation_gravity_mps2")
    if len({channel.reference for channel in found}) > 1:
        named = ", ".join(f"{c.sensor} beside {c.reference}" for c in found)
        raise ValueError(f"one portable reference visits all sensors, but these have several: {named}; use --sensor")
    return found


def _visits(
    settings: Config, channels: list[Channel], options: dict[str, Any], tell: Say, clamp: Clamp | None
) -> tuple[dict[str, Any], bool]:
    """Visit all; the JSON object, and whether every sensor has a result."""
    from agent.bench.aside import Aside

    options["data_dir"].mkdir(parents=True)
    results: list[dict[str, Any]] = []
    with Aside() as aside:
        for number, channel in enumerate(channels, start=1):
            tell(f"visit {number} of {len(channels)}: clamp {channel.reference} beside {channel.sensor}")
            result = _visit(settings, channel, options, tell, clamp, aside)
            if result is None:
                break
            results.append(result)
    measured = [r for r in results if r["status"] == "valid"]
    if len(measured) > 1:
        tell(f"the error of {channels[0].reference} is the same in all {len(measured)} results: no mean reduces it")
    shared = {json.dumps(e, sort_keys=True): e for r in measured for e in r.get("shared_errors", [])}
    told = {"reference": channels[0].reference, "visits": results, "shared_errors": list(shared.values())}
    return told, len(measured) == len(channels)


def _visit(
    settings: Config, channel: Channel, options: dict[str, Any], tell: Say, clamp: Clamp | None, aside: Aside
) -> dict[str, Any] | None:
    """One visit with its files and result; None where the person ends all."""
    from agent.bench.capture import Capture
    from agent.bench.kinds import mounted_stop, stated_options, write_prior
    from agent.bench.measuring import Measuring
    from agent.bench.screen import Person
    from agent.bench.visit_dialogue import LEAST_STAY_S, VisitDialogue, VisitStay, forbidden
    from agent.bench.visiting import Visiting
    from agent.calibrate.stated import options_of
    from calib.visit.next_stop import COVERAGE_FACTOR, WantedUncertainty

    assert channel.reference is not None
    output = options["data_dir"] / channel.sensor
    output.mkdir()
    devices = [channel.sensor, channel.reference]
    with Capture(settings, devices) as capture:
        info = wait_for_devices(capture, devices)
        write_prior(channel, info.get("nominal_sensitivity"), output / "prior.json")
        channel = with_filters(channel, capture)
        arguments = [*stated_options(channel, output, info.get("unit", "")), f"--json={output / 'result.json'}"]
        measuring = Measuring(channel, options_of(calibrate_options(arguments)))
        across = options["u_transverse_pct"]
        wanted = WantedUncertainty(options["u_pct"] / 100.0, np.inf if across is None else across / 100.0)
        if why := forbidden(COVERAGE_FACTOR * measuring.priors.reference, wanted.main):
            tell(f"  {why}")
        stay_s = 60.0 * options["minutes"]
        dialogue = VisitDialogue(
            Visiting(measuring, wanted, aside), capture, VisitStay(min(LEAST_STAY_S, stay_s), stay_s),
            Person(_assent() if options["yes"] else partial(ask, err=options["apart"]), tell, progress),
            None if clamp is None else partial(clamp, channel.sensor),
        )  # fmt: skip
        visited = dialogue.run(mounted_stop(channel))
        if visited.taken is not None:
            time.sleep(measuring.margin_s)  # for the samples that filters need after the visit
            measuring.write(capture.record(visited.taken.start_s - measuring.margin_s), [visited.taken], output)
    if visited.ending == "quit":
        return None
    return _result(channel, visited, arguments, options, tell)


def _assent() -> Callable[[str], str]:
    """Answers for --yes: the reference is clamped; a clamp that is wrong leaves the sensor out."""
    answers = iter([""])
    return lambda _: next(answers, "s")


def _result(
    channel: Channel, visited: Visited, arguments: list[str], options: dict[str, Any], tell: Say
) -> dict[str, Any]:
    """Make the result as `fieldcal calibrate` does, and say how its U grows."""
    from agent.bench.growth import growth

    output = options["data_dir"] / channel.sensor
    told: dict[str, Any] = {"sensor": channel.sensor, "reached": visited.reached, "clamp": visited.clamp}
    if visited.taken is None:
        reasons = [sentence for _, sentence in visited.found] or ["this sensor was left out"]
        return told | {"status": "refused", "reasons": reasons}
    tell(f"  the samples are kept; the result is made by: fieldcal calibrate {shlex.join(arguments)}")
    to_error = contextlib.redirect_stdout(sys.stderr) if options["apart"] else contextlib.nullcontext()
    with to_error:
        make_result(calibrate_options(arguments), output, options["stated"])
    if not (output / "result.json").exists():  # the samples themselves could not be read; calibrate has said why
        return told | {"status": "refused", "reasons": [f"fieldcal calibrate does not take the samples in {output}"]}
    result = json.loads((output / "result.json").read_text())
    stayed_s = visited.taken.stop_s - visited.taken.start_s
    told |= result | {"stayed_s": stayed_s, "promised_s": visited.promised_s}
    if result["status"] == "valid":
        later = growth(channel, result, options["temperature_off_k"])
        limit_pct = options["limit_u_pct"] or 2.0 * options["u_pct"]
        told["growth"] = later.as_object(limit_pct, datetime.now(UTC))
        _say_growth(told["growth"], tell)
    return told


def _say_growth(told: dict[str, Any], tell: Say) -> None:
    after = ", ".join(
        f"{a['u_main_pct']:.2g} % after {a['months']} month{'s' * (a['months'] > 1)}" for a in told["after"][1:]
    )
    tell(f"  without another visit U (main) will be: {after}")
    when = told["exceeded_on"]
    tell(
        f"  U exceeds {told['limit_pct']:.3g} % "
        + ("not within 20 years" if when is None else f"on {when}: visit it again before then")
        + f" (temperature off by {told['temperature_off_k']:g} K)"
    )


@contextlib.contextmanager
def _virtual_structure(seed: int) -> Iterator[tuple[Config, Clamp]]:
    """A structure of virtual devices under the real drivers, and what clamps its reference."""
    from hw.virtual.visits import REFERENCE, Clamped, LiveStructure, Structure, StructureParameters

    with LiveStructure(Structure(StructureParameters(u_turned_deg=0.2, u_reference=0.001), seed)) as live:
        devices = [{"name": name, "driver": "serial-csv", "options": o} for name, o in live.options.items()]
        channels = [
            {
                "sensor": name, "reference": REFERENCE, "rotation": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
                "prior": {"sensitivity": 1.0, "u_main_pct": 2.0, "u_transverse_pct": 1.0, "u_offset_mps2": 0.05},
            }
            for name in live.sensors
        ]  # fmt: skip
        raw = {"gateway": {"site": "virtual", "name": "bridge"}, "devices": devices, "channels": channels}

        def clamp(sensor: str, answer: str) -> None:
            turned = np.array([0.0, 0.0, TURNED_DEG if answer == "turned" else 0.0])
            live.clamp(Clamped(live.sensors.index(sensor), turned, answer == "loose", answer == "calm"))

        yield parse_config(raw, "virtual structure"), clamp
