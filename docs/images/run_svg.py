"""Makes run.svg, the README's picture: a real run on the virtual bench, as the terminal shows it after a minute.

`.venv/bin/python -m docs.images.run_svg`
"""

from __future__ import annotations

import os
import tempfile
from contextlib import ExitStack
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"

from rich.console import Console

from agent.acquisition.service import Service
from agent.cli.run import LOOPBACK, router, virtual_bench
from agent.cli.stopping import StoppableRun
from agent.terminal.screen import ScreenPicture
from agent.terminal.watch import RunView

HERE = Path(__file__).parent


def main() -> None:
    """Run for a minute, draw the last state."""
    with ExitStack() as stack:
        os.chdir(stack.enter_context(tempfile.TemporaryDirectory()))
        said = stack.enter_context(router(LOOPBACK, StoppableRun()))
        config, truth = stack.enter_context(virtual_bench("plain", 1))
        watch = stack.enter_context(RunView(config, "virtual bench, plain", truth))
        watch.say(said)
        Service(config, Path("data"), watch).run(56.0)
        nowhere = stack.enter_context(open(os.devnull, "w"))
        console = Console(record=True, width=100, height=30, file=nowhere, force_terminal=True)
        console.print(ScreenPicture(watch.state))
        console.save_svg(str(HERE / "run.svg"), title="make run")


if __name__ == "__main__":
    main()
