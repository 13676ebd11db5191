"""`fieldcal new-driver`: writes the skeleton of a driver package, with the contract test."""

from __future__ import annotations

import re
from pathlib import Path

import click

from agent.terminal.text import say
from hw.sensor import driver_names

TEMPLATES = Path(__file__).parents[1] / "setup" / "driver"
_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


@click.command(name="new-driver")
@click.argument("name")
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="DIR",
              help="Directory to write; it must not exist. Default: fieldcal-NAME.")  # fmt: skip
def new_driver(name: str, output: Path | None) -> int:
    """Write the skeleton of a driver NAME as a package of its own, which fieldcal finds once it is installed.

    It holds a driver for a serial device with frames, a simulated device, and the contract test, which passes as it is.

    Exit status 2 if NAME is taken or no name, or if the directory exists.
    """
    if not _NAME.fullmatch(name):
        fault = f"{name!r} is no name: small letters, digits and single hyphens, the first a letter, as in my-imu"
    elif name in driver_names():
        fault = f"there is a driver {name!r} already; choose another name"
    else:
        fault = ""
    target = output or Path(f"fieldcal-{name}")
    if not fault and target.exists():
        fault = f"{target}: it exists; name another directory with --output"
    if fault:
        say(f"fieldcal new-driver: {fault}", err=True)
        return 2
    module, class_name = f"fieldcal_{name.replace('-', '_')}", name.title().replace("-", "")
    target.mkdir(parents=True)
    for template in sorted(TEMPLATES.glob("*.txt")):
        text = template.read_text("utf-8")
        for mark, value in (("@NAME@", name), ("@MODULE@", module), ("@CLASS@", class_name)):
            text = text.replace(mark, value)
        path = target / template.name.removesuffix(".txt").replace("driver.py", f"{module}.py")
        path.write_text(text, "utf-8")
        say(str(path))
    say(f"next: edit {target}/{module}.py, then: cd {target} && python -m pytest")
    return 0
