"""The command line: which command is where, and what becomes of errors. Commands load when they are called."""

from __future__ import annotations

import importlib
import os
import sys

import click

from agent import __version__

COMMANDS = {
    "run": ("agent.cli.run", "The agent: read, calibrate, record and publish; without CONFIG on the virtual bench."),
    "calibrate": ("agent.cli.calibrate", "Calibrate from files."),
    "replay": ("agent.cli.replay", "Run recordings through the same pipeline and print the calibrations."),
    "audit": ("agent.cli.audit", "Check a recording: every byte, and that its results follow from its data."),
    "show": ("agent.cli.show", "Calibration in force, status and history of a data directory."),
    "report": ("agent.cli.report", "Figures and one page of a calibration."),
    "sensors": ("agent.cli.sensors", "Drivers with their options."),
    "probe": ("agent.cli.probe", "What answers on this machine's buses and ports, with self-test."),
    "command": ("agent.cli.command", "A signed command to an agent: pose, hold, accept, rollback."),
    "keys": ("agent.cli.keys", "Certificates for Zenoh over TLS, and keys that sign commands."),
    "router": ("agent.cli.router", "A Zenoh router, for tests and small sites."),
    "simulate": (
        "agent.cli.simulate",
        "Virtual devices on pseudo-terminals, or a recording with known truth.",
    ),
    "check": ("agent.cli.check", "All faults of a configuration at once."),
}


class LazyGroup(click.Group):
    """Loads a command's module when it is asked for: `fieldcal show` need not pay for Zenoh."""

    def list_commands(self, _: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, _: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command = getattr(importlib.import_module(COMMANDS[cmd_name][0]), cmd_name)
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, _: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="fieldcal")
def fieldcal() -> None:
    """Recalibrate tri-axial accelerometers where they stand (Method 3 of D'Emilia et al. 2018)."""


def _discard_output() -> None:
    """Let what is still in the buffer of our output go nowhere when Python flushes it at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def run_cli(arguments: list[str] | None = None) -> int:
    """Run and return the exit status: 0 done, 1 our or the machine's fault, 2 usage or bad input, 3 refused.

    No traceback reaches a user unless FIELDCAL_TRACEBACK is set.
    """
    try:
        result = fieldcal.main(args=arguments, prog_name="fieldcal", standalone_mode=False)
    except click.exceptions.Exit as error:
        return error.exit_code
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted", err=True)
        return 1
    except BrokenPipeError:
        # The reader of our output went away.
        _discard_output()
        return 1
    except OSError as error:
        _discard_output()
        click.echo(f"fieldcal: {error}", err=True)
        return 1
    except Exception as error:
        if os.environ.get("FIELDCAL_TRACEBACK"):
            raise
        click.echo(f"fieldcal: internal fault: {type(error).__name__}: {error}", err=True)
        click.echo("Set FIELDCAL_TRACEBACK=1 to see where, and please report it.", err=True)
        return 1
    return result if isinstance(result, int) else 0
