"""Attacks on what stands beside the recordings: statements of deletion, the list of deletions, the head."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

from agent.recording.deleted_list import LIST_NAME
from agent.recording.head import HEAD_NAME
from agent.recording.pruned_ranges import Deleted
from agent.recording.results_chain import FILE_METADATA
from agent.recording.scan import metadata_of
from agent.recording.set_aside import set_aside
from agent.recording.signed_text import written
from agent.recording.signing import Signer
from benchmarks.attacks.site import OTHER, Attack, Site, files
from tests.attacks.chain_site import KEY
from tests.attacks.store_site import GATEWAY


def deletion(path: Path) -> Deleted:
    """What the gateway would say of this recording after its deletion."""
    origin, number = metadata_of(path)[FILE_METADATA], int(path.name[9:15])
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    return Deleted(number, number, origin["epoch"], origin["previous_sha256"], sha256)


def statements_of(source: str) -> Attack:
    """Recordings removed, with statements that the gateway rightly signed elsewhere: of one, of all up to one."""

    def attack(data: Path, site: Site, place: int) -> None:
        other = getattr(site, source)
        found = files(data)
        key = OTHER if source == "key" else KEY
        gateway = "site/other" if source == "gateway" else GATEWAY
        for path in [found[2 + place]] if place < 5 else found[2 : place - 2]:
            path.unlink()
            theirs = Path(shutil.copy(other / path.name, data))
            said = deletion(theirs)
            set_aside(data, said, gateway, Signer(key))

    return attack


def own_statements(data: Path, site: Site, place: int) -> None:
    """Statements about exactly these recordings, but of the wrong form: unsigned, of another key, of version 1, ..."""
    found = files(data)
    chosen = [found[place % 7]] if place % 2 else found[: place + 2 if place < 5 else 7]
    for path, said in [(path, deletion(path)) for path in chosen]:
        number = said.last
        if place in (0, 5):
            set_aside(data, said, GATEWAY, None)
        elif place in (1, 6):
            set_aside(data, said, GATEWAY, Signer(OTHER))
        elif place in (2, 7):
            path.unlink()
            text = written("fieldcal deletion, version 1", {"gateway": GATEWAY, "recording": str(number)})
            (data / f"fieldcal-{number:06d}.deleted").write_bytes(Signer(KEY).sign(text).json)
        elif place in (3, 8):  # the head as a statement
            path.unlink()
            (data / f"fieldcal-{number:06d}.deleted").write_bytes(site.heads[-1])
        else:  # that of another number under this name
            set_aside(data, said, "site/none", Signer(KEY))
            aside = data / f"fieldcal-{number:06d}.deleted"
            aside.rename(data / f"fieldcal-{number + place - 3:06d}.deleted")


def list_edited(data: Path, _: Site, place: int) -> None:
    """`deleted.list` changed, cut, removed, from elsewhere, no file; with recordings removed that it then names."""
    path = data / LIST_NAME
    lines = path.read_bytes().splitlines(keepends=True)
    found = files(data)
    more = "".join(f"{deletion(each).text}\n" for each in found[:2]).encode()
    if place in (0, 5, 6):
        for each in found[:2]:
            each.unlink()
    digits = lines[0].replace(b"1-1", b"1-4")
    contents: tuple[list[bytes], ...] = (
        [*lines, more], lines[:1], [], [lines[1], lines[0]], [digits, *lines[1:]], [more], [b"3-4 - - -\n", *lines],
        [b"\xff" * 300], [*lines[:-1], lines[-1][:-9] + b"0" * 8 + b"\n"], [b"x" * (1 << 24)],
    )  # fmt: skip
    path.write_bytes(b"".join(contents[place]))


def head_forged(data: Path, site: Site, place: int) -> None:
    """The newest recordings removed, with a head that fits: an older one, of elsewhere, two, none, of no form."""
    found = files(data)
    for path in found[-1 - place % 3 :]:
        path.unlink()
    path = data / HEAD_NAME
    old = site.heads[-3 - 2 * (place % 3)]
    if place < 3:
        path.write_bytes(old)
    elif place < 6:
        path.unlink()
        makes = path.mkdir, lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero")
        makes[place - 3]()
    elif place == 6:
        path.write_bytes(old + b"\n" + site.heads[-1])
    elif place == 7:
        shutil.copyfile(site.fork / HEAD_NAME, path)
    else:
        path.unlink()
    for store in data.glob("state.*") if place % 2 else ():
        store.unlink()
