"""The command line: the module of each command, and the exit status of each error.

A command's module is loaded when the command is called.
"""

from __future__ import annotations

import importlib
import os
import sys

import click

from agent import __version__
from agent.cli.loading import loading

INTERRUPTED = 130  # exit status after Ctrl-C: 128 and the number of SIGINT
COMPLETION = "_FIELDCAL_COMPLETE"  # set by the completion files in deploy/completion
COMMANDS = {
    "init": ("agent.cli.init", "Write a configuration for the devices of this machine."),
    "bench": ("agent.cli.bench", "Calibrate at a bench, led from position to position to a wanted uncertainty."),
    "visit": ("agent.cli.visit", "Calibrate mounted sensors one after another beside a portable reference."),
    "run": ("agent.cli.run", "Run the agent: read devices, calibrate, record and publish."),
    "calibrate": ("agent.cli.calibrate", "Calibrate a sensor from recorded files."),
    "convert": ("agent.cli.convert", "Write a recorded file of another format as CSV."),
    "export": (
        "agent.cli.export",
        "Write samples of recordings for other programs: CSV, Parquet, UFF, MiniSEED, plots.",
    ),
    "replay": ("agent.cli.replay", "Run recordings through the same pipeline and print the calibrations."),
    "audit": ("agent.cli.audit", "Check recordings: every byte, and that the results follow from the data."),
    "show": ("agent.cli.show", "Show the calibration in force, status and history of a data directory."),
    "report": ("agent.cli.report", "Make figures and a one-page report of a calibration."),
    "certificate": ("agent.cli.certificate", "Make a calibration certificate: PDF, HTML, DCC XML and JSON."),
    "recall": ("agent.cli.recall", "Correct the results of a reference by its new certificate."),
    "sensors": ("agent.cli.sensors", "List the drivers with their options."),
    "new-driver": ("agent.cli.new_driver", "Write the skeleton of a driver package, with the contract test."),
    "probe": ("agent.cli.probe", "Find and self-test the devices on this machine's buses and ports."),
    "command": ("agent.cli.command", "Send a signed command to an agent: pose, hold, accept, rollback."),
    "keys": ("agent.cli.keys", "Make certificates for Zenoh over TLS, and keys that sign commands."),
    "router": ("agent.cli.router", "Run a Zenoh router, for tests and small sites."),
    "witness": ("agent.cli.witness", "Keep the signed heads of recordings on another machine."),
    "monitor": ("agent.cli.monitor", "Show all sensors of all gateways on one web page."),
    "fleet": ("agent.cli.fleet", "Adjust all devices of a site together, or recompute its recordings."),
    "simulate": (
        "agent.cli.simulate",
        "Serve virtual devices, write a recording with known true values, or act as many gateways.",
    ),
    "doctor": ("agent.cli.doctor", "Check this gateway: clock, devices, disk, certificates; with remedies."),
    "install-service": ("agent.cli.install_service", "Install the systemd unit, its user and rules; or remove them."),
    "engines": ("agent.cli.engines", "List engines, or make an archive for audits in ten years."),
    "backup": ("agent.cli.backup", "Copy a data directory, also while the agent runs."),
    "extras": ("agent.cli.extras", "List the optional parts, and install them, also without network."),
    "check": ("agent.cli.check", "List all faults of a configuration."),
}

EVERYWHERE = ("calibrate", "convert", "report", "certificate", "replay", "audit", "show")  # the others need Linux


class LazyGroup(click.Group):
    """Loads a command's module only when the command is called, so that `fieldcal show` does not load Zenoh."""

    def list_commands(self, _: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, _: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        if sys.platform != "linux" and cmd_name not in EVERYWHERE:
            raise click.ClickException(f"{cmd_name} needs Linux; {', '.join(EVERYWHERE)} work here too")
        with loading():
            module = importlib.import_module(COMMANDS[cmd_name][0])
        command = getattr(module, cmd_name.replace("-", "_"))
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in COMMANDS:
            from difflib import get_close_matches  # an agent never needs its memory

            if meant := get_close_matches(args[0], COMMANDS, n=1):
                ctx.fail(f"there is no command {args[0]!r}: did you mean {meant[0]!r}?")
        return super().resolve_command(ctx, args)

    def format_commands(self, _: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])


def _say_version(ctx: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked:
        from agent.engine import identity

        click.echo(f"fieldcal, version {__version__}, engine {identity.name()}")
        ctx.exit()


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option(
    "--version", is_flag=True, expose_value=False, is_eager=True, callback=_say_version,
    help="Show the version of the program and the name of its engine.",
)  # fmt: skip
def fieldcal() -> None:
    """Recalibrate tri-axial accelerometers in place (Method 3 of D'Emilia et al. 2018)."""


def _discard_output() -> None:
    """Discard what is still in the output buffer, so that Python's flush at exit does not fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def run_cli(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit status: 0 done, 1 internal fault or fault of the machine, 2 bad input, 3 refused,
    INTERRUPTED after Ctrl-C.

    No traceback reaches a user unless FIELDCAL_TRACEBACK is set.
    """
    output = sys.stdout
    try:
        own_process = arguments is None  # else the command line of the process is that of another program
        result = fieldcal.main(args=arguments, prog_name="fieldcal", standalone_mode=False, obj=own_process)
    except click.exceptions.Exit as error:
        return error.exit_code
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted", err=True)
        return INTERRUPTED
    except OSError as error:
        _discard_output()
        click.echo(f"fieldcal: {error}", err=True)
        return 1
    except SystemExit as error:
        if COMPLETION in os.environ:  # click ends so after it has answered the shell
            return int(error.code or 0)
        # The program that reads the output has ended: click then replaces the stream, and rich raises on its own.
        if sys.stdout is not output or isinstance(error.__context__, BrokenPipeError):
            return 1
        # of a plug-in: no command of ours raises it
        click.echo(f"fieldcal: a plug-in or library asked the program to end: SystemExit: {error}", err=True)
        return 1
    except Exception as error:
        if os.environ.get("FIELDCAL_TRACEBACK"):
            raise
        click.echo(f"fieldcal: internal fault: {type(error).__name__}: {error}", err=True)
        click.echo(
            "This is a fault of fieldcal. Please report it, with the output that FIELDCAL_TRACEBACK=1 gives.", err=True
        )
        return 1
    return result if isinstance(result, int) else 0
