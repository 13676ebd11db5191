"""The pictures of docs/report.md: a report in a browser, its residuals, and a refused one on a phone.

`python -m tests.scenarios.report_pictures` writes docs/images/report*.png, from simulated files with knocks.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from tests.scenarios.fleet_page import IMAGES, PHONE, photograph, with_few_colours
from tests.unit.browser import chromium

FILES = ("--sensor", "sensor.csv", "--reference", "reference.csv", "--poses", "poses.csv")
RESIDUALS_PX = 560  # width
DESK = {"width": 900, "height": 825}


def fieldcal(directory: Path, *arguments: str, status: int = 0) -> None:
    """Run a command in a directory."""
    ended = subprocess.run([sys.executable, "-m", "agent", *arguments], cwd=directory, capture_output=True, text=True)
    assert ended.returncode == status, ended.stderr


def write_pictures() -> None:
    """One result with what the adjustment knows, and one of the same files with the sign of gravity reversed."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as made, chromium() as browser:
        directory = Path(made)
        fieldcal(directory, "simulate", "--preset", "faulty", "--csv", ".")
        fieldcal(directory, "calibrate", *FILES, "--json", "result.json")
        fieldcal(directory, "calibrate", *FILES, "--static-sign", "-1", "--json", "refused.json", status=3)
        for name, viewport, status in (("result", DESK, 0), ("refused", PHONE, 3)):
            fieldcal(directory, "report", f"{name}.json", "-o", name, "--unit", "count", status=status)
            page = browser.new_page(viewport=viewport, color_scheme="light")
            page.goto((directory / name / "report.html").as_uri())
            photograph(page, IMAGES / ("report.png" if status == 0 else f"report-{name}.png"))
            page.close()
        with Image.open(directory / "result" / "figures" / "residuals.png") as opened:
            smaller = opened.convert("RGB").resize((RESIDUALS_PX, round(RESIDUALS_PX * opened.height / opened.width)))
        with_few_colours(smaller).save(IMAGES / "report-residuals.png", optimize=True)


if __name__ == "__main__":
    write_pictures()
