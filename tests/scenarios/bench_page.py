"""A session of `fieldcal bench` and its view on the page of the monitor, in a browser.

`python -m tests.scenarios.bench_page` writes docs/images/bench*.png.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.scenarios.fleet_page import IMAGES
from tests.scenarios.guided import led
from tests.scenarios.processes import ROOT
from tests.unit.browser import Watched, chromium
from tests.unit.monitor_site import Monitor
from tests.unit.zenoh_site import Site

ANSWERS = ("", "hand 35 60")  # at the second stop the sensor is turned to another position than the one asked for
VIEW = "#view=bench&site=virtual&gateway=bench"
SESSION = ("--u-main-pct", "0.5", "--u-transverse-pct", "1", "--stay-s", "4", "--seed", "3")
# Keeps what the page shows in each second, while the program measures.
RECORD = """() => {
  window.seen = [];
  const note = () => window.seen.push(document.getElementById("bench-stay").textContent);
  new MutationObserver(note).observe(document.getElementById("bench-stay"), { childList: true });
}"""


def session(site: Site, output: Path, page: Any, at_question: Callable[[str], None]) -> tuple[int, str]:
    """The exit status and the output of a session. `at_question` gets what the terminal said since the last question.

    It is called when the page asks the same question as the terminal.
    """
    answers = iter(ANSWERS)

    def answer(told: str) -> str:
        question = told.rstrip(" >").rsplit("\n", 1)[-1].strip()
        page.locator("#bench-now", has_text=question).wait_for()
        at_question(told)
        return next(answers, "")

    stated = ["--stated", str(ROOT / "examples/certificate.toml"), "--connect", site.endpoint]
    return led(["bench", "-o", str(output), *SESSION, *stated], answer)


def write_pictures() -> None:
    """The view after a wrong turn, on a desk, dark and on a phone; and the end."""
    site = Site()
    views = {"bench": (1280, "light"), "bench-dark": (1280, "dark"), "bench-phone": (390, "light")}
    with tempfile.TemporaryDirectory() as directory, chromium() as browser:
        monitor = Monitor(site.endpoint, Path(directory) / "monitor")
        opened = {
            name: Watched(browser, monitor.address, viewport={"width": width, "height": 800}, color_scheme=scheme)
            for name, (width, scheme) in views.items()
        }
        pages = {name: watched.open(VIEW) for name, watched in opened.items()}

        def pictures(told: str) -> None:
            if re.search(r"^stop 3: ", told, re.MULTILINE):
                for name, page in pages.items():
                    page.locator("#bench-now", has_text="Stop 3").wait_for()
                    page.screenshot(path=IMAGES / f"{name}.png", full_page=True)

        status, told = session(site, Path(directory) / "bench", pages["bench"], pictures)
        assert status == 0, told
        pages["bench"].get_by_role("heading", name="Result", exact=True).wait_for()
        pages["bench"].screenshot(path=IMAGES / "bench-end.png", full_page=True)
        for watched in opened.values():
            watched.close()
        monitor.stop()
    site.kill()


if __name__ == "__main__":
    write_pictures()
    sys.exit(0)
