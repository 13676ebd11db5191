"""Attacks on whole files: removed, exchanged, renamed, cut, from elsewhere, or not files at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from agent.recording.files import recording_name
from agent.recording.head import HEAD_NAME
from benchmarks.attacks.site import Attack, Site, at, files
from tests.replay.forgery import Unpacked


def removed(data: Path, _: Site, place: int) -> None:
    """One; the first; the last ones; all but one; every second."""
    found = files(data)
    for path in [*([path] for path in found), found[:3], found[-3:], found[::2]][place]:
        path.unlink()


def replaced(data: Path, _: Site, place: int) -> None:
    found = files(data)
    shutil.copyfile(found[place % 7], found[(place + 1 + place // 7) % 7])


def swapped(data: Path, _: Site, place: int) -> None:
    found = files(data)
    a, b = found[place % 7], found[(place + 1 + place // 7) % 7]
    held = a.read_bytes()
    shutil.copyfile(b, a)
    b.write_bytes(held)


ARABIC = {ord("0") + digit: 0x660 + digit for digit in range(10)}


def renamed(data: Path, _: Site, place: int) -> None:
    """Another number, another number of digits, other digits, another suffix."""
    path = at(data, place)
    number = int(path.name[9:15])
    arabic = f"{number:06d}".translate(ARABIC)
    names = (
        f"fieldcal-{number:07d}.mcap", f"fieldcal-{number}.mcap", f"fieldcal-{arabic}.mcap",
        f"fieldcal-{number + 90:06d}.mcap", f"Fieldcal-{number:06d}.mcap", f"fieldcal-{number:06d}.MCAP",
        f"fieldcal-{number + 1:06d}.mcap.active",
        f"fieldcal-{number:06d}.mcap.bak", f"fieldcal--{number:05d}.mcap", f"fieldcal-{number - 4:06d}.mcap",
    )  # fmt: skip
    path.rename(path.with_name(names[place]))


def doubled(data: Path, _: Site, place: int) -> None:
    """The same recording also under another name, that of a deleted one or of one that never was."""
    names = (
        "000001", "000002", "000010", "000000", "000100", "0000005", "5", "999999999999", "000005".translate(ARABIC),
        "00000000003",
    )  # fmt: skip
    shutil.copyfile(at(data, place), data / f"fieldcal-{names[place]}.mcap")


def put_back(data: Path, site: Site, place: int) -> None:
    """Recordings that the gateway deleted, with one byte of them another; or one as it was before it was closed."""
    for number in ((1,), (2,), (1, 2), (1,), (2,), (1, 2), (1,), (2,), (4,), (4,))[place]:
        for path in site.earlier.glob(f"fieldcal-{number:06d}.mcap*"):
            shutil.copyfile(path, data / path.name)
    if place < 8:
        change_byte(max(data.glob("fieldcal-00000[12].mcap")), 40 + 3000 * place)
    elif place == 9:
        (data / recording_name(4)).unlink()


def change_byte(path: Path, offset: int) -> None:
    content = bytearray(path.read_bytes())
    content[offset] ^= 1
    path.write_bytes(content)


def truncated(data: Path, _: Site, place: int) -> None:
    path = at(data, place)
    ends = Unpacked.of(path).boundaries
    sizes = 0, 8, 9, ends[0], ends[len(ends) // 2], ends[-1], ends[-2], ends[-3] - 1, ends[-1] + 7, ends[1] + 1
    os.truncate(path, sizes[place])


def appended(data: Path, _: Site, place: int) -> None:
    """Bytes behind the footer, a second file behind the first, records between footer and magic, bytes before it."""
    path = at(data, place)
    content = path.read_bytes()
    extra = (b"\0", b"x" * 5000, content, content[:8], content[-8:], content[8:])
    if place < 6:
        path.write_bytes(content + extra[place])
    elif place < 8:
        path.write_bytes(content[:-8] + extra[place - 5] + content[-8:])
    else:
        path.write_bytes((b"\0" if place == 8 else content[:8]) + content)


def flipped(data: Path, _: Site, place: int) -> None:
    path = at(data, place)
    change_byte(path, (path.stat().st_size - 1) * place // 9)


def from_elsewhere(source: str) -> Attack:
    """Recordings of another directory in their places: one, all from one on, and all (with all that is beside them)."""

    def attack(data: Path, site: Site, place: int) -> None:
        other = getattr(site, source)
        if place == 9:
            shutil.rmtree(data)
            shutil.copytree(other, data)
            return
        for number in ((5,), (6,), (7,), (8,), (9,), (5, 6), (8, 9), (6, 7, 8, 9), (5, 6, 7, 8, 9))[place]:
            shutil.copyfile(other / recording_name(number), data / recording_name(number))
        if place > 5:
            shutil.copyfile(other / HEAD_NAME, data / HEAD_NAME)
            shutil.copyfile(other / "state.sqlite", data / "state.sqlite")

    return attack


def set_back(data: Path, site: Site, place: int) -> None:
    """The directory as it was earlier, whole or some of its files."""
    shutil.rmtree(data)
    shutil.copytree(site.earlier, data)
    for number in range(1, 10):
        if (number + place) % 3 == 0 and place and number > 4:
            shutil.copyfile(site.true / recording_name(number), data / recording_name(number))
    if place % 2:
        shutil.copyfile(site.true / HEAD_NAME, data / HEAD_NAME)


def no_file(data: Path, site: Site, place: int) -> None:
    """A directory, FIFO, link to a device, to itself, to nothing, to another recording, where a recording was."""
    path = at(data, place)
    whole = path.rename(path.with_name("kept"))
    makes: tuple[Callable[[], object], ...] = (
        path.mkdir, lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero"), lambda: path.symlink_to(path),
        lambda: path.symlink_to("nothing"), lambda: path.symlink_to(site.fork / path.name),
        lambda: path.symlink_to("/dev/stdin"), lambda: path.symlink_to("/proc/self/mem"), path.touch,
        lambda: path.write_bytes(bytes(whole.stat().st_size)),
    )  # fmt: skip
    makes[place]()


def beside(data: Path, site: Site, place: int) -> None:
    """The same under the name of a recording that was deleted, or that never was."""
    path = data / recording_name(10 if place % 2 else 2)
    newest, oldest = data / recording_name(9), data / recording_name(5)
    makes: tuple[Callable[[], object], ...] = (
        path.mkdir, lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero"), lambda: path.symlink_to(path),
        lambda: path.symlink_to(newest), lambda: path.symlink_to(site.fork / newest.name),
        path.touch, lambda: path.write_bytes(os.urandom(5000)), lambda: path.write_bytes(oldest.read_bytes()[:-100]),
        lambda: path.with_name(f"{path.name}.active").write_bytes(newest.read_bytes()[:9000]),
    )  # fmt: skip
    makes[place]()
