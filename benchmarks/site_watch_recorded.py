"""The site watched together, on recorded motion of a bridge: one of two sensors scaled by 1 % from the middle on.

    python -m benchmarks.site_watch_recorded stats_gjemnessund.mat [--percent 1]

The file is of github.com/knutankv/open-bridge-data: standard deviations of the acceleration of two tri-axial sensors
at one section of the Gjemnessund bridge (Norway), one for each recording of half an hour, 2013 to 2015. It is not part
of this project; without it the script says so and ends. There is one band (all frequencies), no temperature and no
noise floor, and recordings are irregular. So RECORDINGS in the order of time are taken as a day, each as an hour. Of
two sensors nobody can say which one has changed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from calib.model import Array
from calib.site_watch.day import Hours, day_of
from calib.site_watch.verdicts import SensorVerdict, examined, result
from calib.site_watch.watch import SiteWatch

RECORDINGS = 12
BAND_HZ = np.array([1.0])


def recorded(path: Path) -> tuple[list[str], Array]:
    """Names of the sensors, and standard deviations (recordings, sensors, 3) in the order of time."""
    from scipy.io import loadmat

    told = loadmat(path, squeeze_me=True, struct_as_record=False)["statistics"]
    sensors = [sensor for sensor in told.sensor if list(sensor.component_names) == ["x", "y", "z"]]
    std = np.stack([sensor.std for sensor in sensors], axis=1)
    order = np.argsort([name[-19:] for name in told.recording])
    return [sensor.sensor_name for sensor in sensors], std[order]


def watched(std: Array, scaled: int | None, factor: float) -> tuple[SiteWatch, list[tuple[int, int, SensorVerdict]]]:
    """The watch after all days, and what it told: day, sensor, verdict. One sensor has another sensitivity from the
    middle on."""
    days = len(std) // RECORDINGS
    watch, told = SiteWatch(np.arange(float(std.shape[1])), BAND_HZ), []
    for day in range(days):
        own = std[day * RECORDINGS : (day + 1) * RECORDINGS].copy()
        if scaled is not None and day >= days // 2:
            own[:, scaled] *= factor
        shape = own.shape[:2]
        power: Array = np.square(np.where(own > 0.0, own, np.nan))[:, :, None, :]
        hours = 24.0 * (day + 1) + np.arange(float(RECORDINGS))
        none, floor = np.full(power.shape, np.nan), np.full((*shape, 3), 1e-12)
        watch.update(day_of(Hours(hours, power, none, floor, np.full(shape, np.nan)), BAND_HZ))
        told += [(day, i, one) for i, one in enumerate(result(watch).sensors) if one.kind not in ("none", "learning")]
    return watch, told


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--percent", type=float, default=1.0)
    given = parser.parse_args()
    if not given.file.exists():
        sys.exit(f"{given.file} is not there. It is stats_gjemnessund.mat of github.com/knutankv/open-bridge-data")
    names, std = recorded(given.file)
    print(f"{len(std)} recordings, {len(std) // RECORDINGS} days of {RECORDINGS}")
    for scaled in (None, *range(len(names))):
        watch, told = watched(std, scaled, 1.0 + given.percent / 100.0)
        name = "nothing scaled" if scaled is None else f"{names[scaled]} by {given.percent:+g} %"
        first = {(i, one.what): (day, one) for day, i, one in reversed(told)}
        said = [
            f"day {day}: {one.kind} at {names[i]}, {one.what} {100 * one.size:+.2f} ± {100 * one.U:.2f} %"
            for (i, _), (day, one) in sorted(first.items(), key=lambda each: each[1][0])
        ]
        tests = examined(watch)
        assert tests is not None
        k = int(np.argmin(np.abs(np.array(tests.begins) - 1 - len(std) // RECORDINGS // 2)))
        at = f"u of one axis from the middle on {100 * np.median(tests.joint.u[k, :, :3]):.2f} %"
        print(f"{name}: {'; '.join(said) or 'nothing told'}; {at}")
