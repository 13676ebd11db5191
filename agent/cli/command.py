"""`fieldcal command`: signs a command and sends it to an agent, over Zenoh or on the gateway itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import msgspec

from agent.cli.tls_options import TlsOptions, tls_options
from agent.commanding.arguments import Arguments, Verb, parse_arguments
from agent.commanding.desk import LONGEST_VALIDITY_S
from agent.commanding.envelope import Order, as_line, seal
from agent.commanding.local import LocalAgent
from agent.commanding.refusal import Refused
from agent.commanding.sending import send
from agent.config.key_file import KeyFileError
from agent.delivery.keys import CHUNK, gateway_key
from agent.delivery.session import EndpointError
from agent.keys.files import SigningKey, read_signing_key
from agent.terminal.text import say

VALID_S = 60.0  # s; a command takes effect when it arrives, or not at all


@dataclass(frozen=True, kw_only=True)
class _CommonOptions:
    """The values of the options that all commands have."""

    sensor: str
    key_file: Path
    data_dir: Path
    connect: tuple[str, ...]
    gateway: str | None
    printed: bool
    tls: TlsOptions
    valid_s: float


class _CommandAnswer(msgspec.Struct):
    taken: bool
    reason: str = ""


_OPTIONS: list[Callable[[Callable[..., Any]], Callable[..., Any]]] = [
    click.option("--sensor", required=True, help="The sensor that the command is for."),
    click.option("--key", "key_file", required=True, metavar="F", type=click.Path(path_type=Path),
                 help="Private key that signs the command, made by `fieldcal keys command`."),
    click.option("--data-dir", type=click.Path(path_type=Path), default=Path("data"), show_default=True,
                 help="Data directory of this machine's agent; unused with --connect."),
    click.option("--connect", multiple=True, metavar="ENDPOINT", help="Zenoh router that passes the command on."),
    click.option("--gateway", metavar="SITE/NAME",
                 help="The gateway that the command is for; needed with --connect and --print."),
    click.option("--print", "printed", is_flag=True,
                 help="Print the signed command as one line, to paste into the fleet page, instead of sending it."),
    tls_options,
    click.option("--valid", "valid_s", type=click.FloatRange(1, LONGEST_VALIDITY_S), default=VALID_S,
                 show_default=True, metavar="S", help="Seconds in which the command must arrive; later it is refused."),
]  # fmt: skip


def common_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that all commands have."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


@click.group()
def command() -> None:
    """Sign a command and send it to an agent. Exit status: 0 taken, 3 refused (with the reason), 1 no answer."""


@command.command()
@click.option("--theta-deg", type=float, help="Clamp angle theta (with --alpha-deg).")
@click.option("--alpha-deg", type=float, help="Rotation alpha about the clamp's axis.")
@click.option(
    "--direction", type=float, nargs=3, metavar="X Y Z", help="Unit vector of the motion in the sensor's frame."
)
@click.option("--gravity", "gravity_mps2", type=float, nargs=3, metavar="X Y Z",
              help="What an ideal sensor reads at rest there, m/s2. Given alone: the sensor is at rest.")  # fmt: skip
@click.option("--position", help="A name for the position.")
@common_options
def pose(
    theta_deg: float | None,
    alpha_deg: float | None,
    direction: tuple[float, float, float] | None,
    gravity_mps2: tuple[float, float, float] | None,
    position: str | None,
    **options: Any,
) -> int:
    """Tell the agent the sensor's position from now on."""
    given = {"theta_deg": theta_deg, "alpha_deg": alpha_deg, "direction": direction, "gravity_mps2": gravity_mps2,
             "position": position}  # fmt: skip
    return _run("pose", {name: value for name, value in given.items() if value is not None}, _CommonOptions(**options))


@command.command()
@click.option("--release", is_flag=True, help="End the hold.")
@common_options
def hold(release: bool, **options: Any) -> int:
    """Keep the calibration in force unchanged until `hold --release`."""
    return _run("hold", {"release": True} if release else {}, _CommonOptions(**options))


@command.command()
@click.option("--sequence", type=int, required=True, help="Sequence number of the estimate.")
@common_options
def accept(sequence: int, **options: Any) -> int:
    """Bring an estimate into force."""
    return _run("accept", {"sequence": sequence}, _CommonOptions(**options))


@command.command()
@click.option("--sequence", type=int, required=True, help="Sequence number of the calibration, see `fieldcal show`.")
@common_options
def rollback(sequence: int, **options: Any) -> int:
    """Bring an earlier calibration into force again."""
    return _run("rollback", {"sequence": sequence}, _CommonOptions(**options))


def _run(verb: Verb, given: dict[str, Any], options: _CommonOptions) -> int:
    if not CHUNK.fullmatch(options.sensor):
        raise click.BadParameter(
            f"{options.sensor!r} cannot be the name of a sensor: 1 to 63 ASCII letters, digits, '-', '_', '.'",
            param_hint="--sensor",
        )
    try:
        arguments = parse_arguments(verb, msgspec.json.encode(given))
        key = read_signing_key(options.key_file)
    except (Refused, KeyFileError) as error:
        raise click.UsageError(str(error)) from None
    if options.printed and options.connect:
        raise click.UsageError("--print sends nothing; leave --connect out")
    files = options.tls.files(options.connect)

    def sealed(to: str) -> bytes:
        return _seal(key, to, options.sensor, verb, arguments, options.valid_s)

    if options.printed:
        say(as_line(sealed(_gateway_name(options.gateway))))
        return 0
    address = f"{options.sensor}/command/{verb}"
    try:
        if options.connect:
            name = _gateway_name(options.gateway)
            said = send(options.connect, files, f"{gateway_key(*name.split('/'))}/{address}", sealed(name))
        else:
            with LocalAgent(options.data_dir) as agent:
                said = agent.send(address, sealed(options.gateway or agent.gateway))
        answer = msgspec.json.decode(said, type=_CommandAnswer)
    except EndpointError as error:
        raise click.UsageError(str(error)) from None
    except (OSError, msgspec.DecodeError, ValueError) as error:
        say(f"fieldcal command: {error}", err=True)
        return 1
    if not answer.taken:
        say(f"refused: {answer.reason}", err=True)
        return 3
    say(f"taken: {verb} of {options.sensor}")
    return 0


def _gateway_name(gateway: str | None) -> str:
    if gateway is None:
        raise click.UsageError("--connect and --print need --gateway SITE/NAME, since a command is for one gateway")
    site, _, name = gateway.partition("/")
    if not (CHUNK.fullmatch(site) and CHUNK.fullmatch(name)):
        raise click.BadParameter(f"{gateway!r} does not have the form SITE/NAME", param_hint="--gateway")
    return gateway


def _seal(key: SigningKey, gateway: str, sensor: str, verb: Verb, arguments: Arguments, valid_s: float) -> bytes:
    now_ns = time.time_ns()
    return seal(Order.of(gateway, sensor, verb, arguments, now_ns, now_ns + int(valid_s * 1e9)), key.key_id, key.key)
