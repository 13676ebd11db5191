"""All devices of a site together: does it name a bad reference, does U cover, and what does it cost?

    python -m benchmarks.site [--runs 100] [--large] [--write]

Each run is a site of 200 sensors and 5 references; each sensor is turned through three positions beside two of the
references. Sensors, noise, and errors of references (0.3 %) and rotations (2 mrad) are drawn from what is stated. A bad
reference is off by 3 u, with drawn sign. Sensors and noise are drawn for ten runs together, because their windows cost
the time; errors of references and rotations for each run. `--large`: 2,000 sensors with 100 windows each, beside two of
50 references.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import resource
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.page import machine, write_part
from calib.estimate.nuisances import Priors
from calib.model import Pose, Window, WindowSums
from calib.site_adjustment.contradiction import FALSE_ALARM, suspects, verdicts
from calib.site_adjustment.device import SiteDevice
from calib.site_adjustment.link import Link, link
from calib.site_adjustment.site import Site
from tests.dense_site import RATE_HZ, SAMPLES, SimulatedSite, Stated, turned

NOMINAL = np.append(np.eye(3).ravel(), np.zeros(3))
PRIOR = np.diag(np.append(np.full(9, 0.2), np.full(3, 5.0)) ** 2)
SENSORS, REFERENCES, POSITIONS = 200, 5, 3
BAD_U = 3.0
LARGE_SENSORS, LARGE_REFERENCES, LARGE_WINDOWS, SEGMENTS = 2000, 50, 50, 10
EVERY_S = 60.0  # between the begins of two windows of a large site
TOGETHER = 10  # runs with the same windows
DRAWS = 200_000  # of the bounds; 95 % of them is known to 0.1 %
NAMED = 0.95
MATCHES = 100  # pairs of sensors a run, whose differences are compared with the truth


def priors_of(stated: Stated) -> Priors:
    """What is stated of a link."""
    known = {"rotation_rad": stated.rotation_rad, "offset_mps2": stated.offset_mps2}
    return Priors({**Priors.none().values, **known}, NOMINAL, PRIOR)


def simulated(seed: int) -> tuple[SimulatedSite, list[Link]]:
    """A sound site and its links; the meetings of the site have no windows any more."""
    site = SimulatedSite(seed, SENSORS, REFERENCES)
    site.noise_mps2, site.offset_mps2 = 0.02, site.stated.offset_mps2
    links = []
    for k in range(SENSORS):
        for reference in site.random.choice(REFERENCES, 2, replace=False):
            made = site.meet(f"s{k}", f"r{reference}", windows=POSITIONS)
            links.append(link(made.sensor, made.reference, made.windows, priors_of(site.stated)))
            site.meetings[-1] = replace(made, windows=[], felt=[], output=[])
    return site, links


def devices_of(sensors: int, references: int, u: float) -> list[SiteDevice]:
    """What is known of them."""
    return [SiteDevice.reference(f"r{k}", u, 3) for k in range(references)] + [
        SiteDevice.with_covariance(f"s{k}", NOMINAL, PRIOR) for k in range(sensors)
    ]


def drawn_again(random: np.random.Generator, site: SimulatedSite, links: Sequence[Link]) -> list[Link]:
    """The same windows, as they would be with other errors of the rotations, and beside references without errors.

    The seen S is S T (1 + E)^-1 with the rotation T and the errors E of the reference.
    """
    turns = [turned(site.stated.rotation_rad * random.normal(size=3)) for _ in links]
    again = []
    for each, meeting, turn in zip(links, site.meetings, turns, strict=True):
        again.append(seen_by(each, np.diag(1.0 + site.gain[each.reference]) @ meeting.turn.T @ turn))
    return again


def seen_by(each: Link, factor: np.ndarray) -> Link:
    """The link whose seen S is that of this link times `factor` (3, 3)."""
    changed = each.mean.copy()
    changed[:9] = (each.mean[:9].reshape(3, 3) @ factor).ravel()
    return replace(each, told=each.told + each.rows @ (changed - each.mean), mean=changed)


def beside(links: Sequence[Link], gain: dict[str, np.ndarray]) -> list[Link]:
    """Links beside references without errors, as they are beside references with these."""
    return [seen_by(each, np.diag(1.0 / (1.0 + gain[each.reference]))) for each in links]


def one(seed: int, site: SimulatedSite, links: Sequence[Link]) -> dict[str, float]:
    """One run: coverage, and who is named if all are sound, if one reference is bad, and if one of its axes is."""
    random, u = np.random.default_rng([seed, 1]), site.stated.reference
    devices = devices_of(SENSORS, REFERENCES, u)
    perfect = drawn_again(random, site, links)
    gain = {f"r{k}": u * random.normal(size=3) for k in range(REFERENCES)}
    sound = Site(devices, beside(perfect, gain))
    bad, sign = f"r{random.integers(REFERENCES)}", random.choice((-1.0, 1.0))
    told: dict[str, float] = {"false alarms": float(bool(suspects(verdicts(sound))))}
    for case, axes in (("three axes", np.ones(3)), ("one axis", np.array([1.0, 0.0, 0.0]))):
        off = np.where(axes > 0.0, sign * BAD_U * u, gain[bad])
        found = verdicts(Site(devices, beside(perfect, gain | {bad: off})))
        who = [verdict.device for verdict in suspects(found)]
        told[f"{case} off by 3 u: named alone"] = float(who == [bad])
        told[f"{case} off by 3 u: another named alone"] = float(len(who) == 1 and who != [bad])
        told[f"{case} off by 3 u: most suspect"] = float(next(v for v in found if v.is_reference).device == bad)
    truth = {f"s{k}": np.append(site.S[f"s{k}"].ravel(), site.Q[f"s{k}"]) for k in range(SENSORS)}
    alone, between = [], []
    for a, b in zip(*(random.permutation(SENSORS)[:MATCHES].tolist() for _ in "ab"), strict=True):
        if a == b:
            continue
        p, q = f"s{a}", f"s{b}"
        own, cross = sound.covariance(p, p), sound.covariance(p, q)
        alone.append(np.abs(sound.x[p] - truth[p]) <= 2.0 * np.sqrt(np.diag(own)))
        both = np.diag(own + sound.covariance(q, q) - cross - cross.T)
        between.append(np.abs(sound.x[p] - sound.x[q] - truth[p] + truth[q]) <= 2.0 * np.sqrt(both))
    told["U of a sensor covers"], told["U of a difference covers"] = float(np.mean(alone)), float(np.mean(between))
    told["U of a difference of S covers"] = float(np.mean([b[:9] for b in between]))
    return told


def bounds() -> list[str]:
    """What the best test can reach where the data tell exactly how the references differ. Rows of the table.

    The error of a reference is then known by the mean of the others, whose own errors stay. One axis of one reference
    is off by so many u, to either side. The device with the largest likelihood ratio is named, if this ratio exceeds
    what sound sites show with the false-alarm probability: no other test names the bad device more often (Neyman and
    Pearson 1933, Phil. Trans. A 231).
    """
    error = np.random.default_rng(1).normal(size=(DRAWS, 3, REFERENCES))

    def named(off_u: float, axes: int) -> tuple[float, float]:
        bad = error[:, :axes].copy()
        bad[:, 0, 0] = off_u
        limit = np.quantile(_odds(error[:, :axes], off_u).max(axis=(1, 2)), 1.0 - FALSE_ALARM)
        found = _odds(bad, off_u).max(axis=1)
        most = found.argmax(axis=1) == 0
        return float(np.mean(most & (found[:, 0] > limit))), float(np.mean(most))

    needed_u = next(off_u for off_u in np.arange(BAD_U, 10.0, 0.1).tolist() if named(off_u, 3)[0] >= NAMED)
    (three, _), (one, most) = named(BAD_U, 3), named(BAD_U, 1)
    return [
        f"| one axis off by 3 u: the best test names it | {three:.1%} |",
        f"| one axis off by 3 u: the best test names it, if somebody knows which axis | {one:.1%} |",
        f"| one axis off by 3 u: most suspect by the best test, if somebody knows which axis | {most:.1%} |",
        f"| the best test names one axis in {NAMED:.0%} from this on | {needed_u:.1f} u |",
    ]


def _odds(error: np.ndarray, off_u: float) -> np.ndarray:
    """Logarithm of the likelihood ratio of each axis of each reference (..., R) to be off by `off_u`, errors in u."""
    others = 1.0 / (error.shape[-1] - 1.0)  # variance of their mean
    away = (error - error.mean(axis=-1, keepdims=True)) * (1.0 + others)
    either = np.logaddexp(-0.5 * (away - off_u) ** 2 / others, -0.5 * (away + off_u) ** 2 / others)
    return np.asarray(either + 0.5 * away**2 / (1.0 + others))


def summary(told: Sequence[dict[str, float]]) -> str:
    """The table of the runs."""
    lines = ["| | share of runs |", "| --- | --- |"]
    lines += [f"| {name} | {np.mean([t[name] for t in told]):.1%} |" for name in told[0]]
    return "\n".join(lines + bounds())


def base_windows(random: np.random.Generator) -> list[WindowSums]:
    """Sums of u, du/dt and noise of 1: what any sensor's windows are made of."""
    from tests.clamp_windows import sums_of
    from tests.dense_site import motion

    made = []
    for _ in range(LARGE_WINDOWS):
        a, da = motion(random, 3)
        down = random.normal(size=3)
        a = a + 9.81 * down / np.linalg.norm(down)
        made.append(sums_of(a, da, random.normal(size=a.shape), SEGMENTS))
    return made


def windows_of(base: Sequence[WindowSums], S: np.ndarray, Q: np.ndarray, noise: float, gain: float) -> list[Window]:
    """The windows of one sensor: V = S a + Q + noise, and u = gain a."""
    matrix = np.zeros((9, 9))
    matrix[:6, :6] = gain * np.eye(6)
    matrix[6:, :3], matrix[6:, 6:] = S, noise * np.eye(3)
    shift = np.append(np.zeros(6), Q)
    pose = Pose("beside", np.eye(3), np.zeros(3))
    found = []
    for k, sums in enumerate(base):
        moved = WindowSums(3, sums.count, sums.mean @ matrix.T + shift, matrix @ sums.scatter @ matrix.T)
        at_s = EVERY_S * k
        found.append(Window(at_s, at_s + SAMPLES / RATE_HZ, pose, moved, True, "", int(sums.count.sum()), 0))
    return found


def large() -> str:
    """Seconds and memory of a large site: links from the sums of windows, and all of them together."""
    random, stated = np.random.default_rng(7), Stated()
    base, gains = base_windows(random), stated.reference * random.normal(size=LARGE_REFERENCES)
    links, links_s = [], 0.0
    for k in range(LARGE_SENSORS):
        S, Q = np.eye(3) + 0.05 * random.normal(size=(3, 3)), random.normal(size=3)
        for r in random.choice(LARGE_REFERENCES, 2, replace=False).tolist():
            windows = windows_of(base, S, Q, 0.02, 1.0 + gains[r])
            began_s = time.process_time()
            links.append(link(f"s{k}", f"r{r}", windows, priors_of(stated)))
            links_s += time.process_time() - began_s
    began_s = time.process_time()
    site = Site(devices_of(LARGE_SENSORS, LARGE_REFERENCES, stated.reference), links)
    for name in site.devices:
        site.standard_uncertainty(name)
    site_s = time.process_time() - began_s
    began_s = time.process_time()
    verdicts(site)
    tests_s = time.process_time() - began_s
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return (
        f"{LARGE_SENSORS:,} sensors with {2 * LARGE_WINDOWS} windows each, {LARGE_REFERENCES} references, on one core: "
        f"links from the sums of the windows {links_s:.0f} s, adjustment with u of every device {site_s:.0f} s, "
        f"tests of every device {tests_s:.0f} s; at most {peak_gb:.2f} GB."
    )


def main() -> None:
    """Run, print, and write into docs/site.md with --write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--large", action="store_true")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.large:
        name, text = "site-large", large()
    else:
        told = []
        for seed in range(options.runs):
            if seed % TOGETHER == 0:
                site, links = simulated(seed)
            told.append(one(seed, site, links))
            print(seed + 1, told[-1], flush=True)
        name = "site-runs"
        text = (
            f"{options.runs} runs, false-alarm probability stated as {FALSE_ALARM:.0%}. What the best test reaches is "
            f"of {DRAWS:,} draws.\n\n{summary(told)}"
        )
    text = f"{text}\n\nMeasured on {machine()}."
    if options.write:
        write_part(name, text)
    else:
        print(text)


if __name__ == "__main__":
    main()
