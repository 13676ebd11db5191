"""The optional parts of the package: which there are, which are installed, and the command that installs one."""

from __future__ import annotations

import importlib.metadata as metadata
import re
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

# What each part is for.
PURPOSES = {
    "report": "figures of `fieldcal report`, the PDF of `fieldcal certificate`",
    "files": "Parquet and Feather files, and large CSV files read faster",
    "hdf5": "HDF5 and MATLAB 7.3 files",
    "seismic": "MiniSEED and StationXML files",
    "uff": "UFF files of `fieldcal export` (data set 58), for modal analysis",
    "tdms": "LabVIEW TDMS files",
    "endaq": "enDAQ and Slam Stick recordings (IDE)",
    "dcc": "check of digital calibration certificates against schemas (`fieldcal certificate --xsd`)",
    "monitor": "the page of `fieldcal monitor`",
    "fleet": "`fieldcal fleet` on many machines (Dask), and recordings in an object store",
    "sound": "driver sound-card (needs PortAudio besides)",
    "mcc": "drivers mcc172 and mcc-usb (need libdaqhats and libuldaq besides)",
    "mqtt": "driver mqtt, and results to an MQTT broker (needs a broker besides)",
    "ni": "driver ni (needs NI-DAQmx besides; x86_64 only)",
}
LOCKS = Path(__file__).with_name("locks")  # `make lock` writes them
WHEELS = Path(sys.prefix) / "wheels"  # where an installation without network keeps wheels of optional parts
_REQUIREMENT = re.compile(r"""(?P<name>[\w.-]+)(?P<versions>[^;]*);.*\bextra\s*==\s*["'](?P<extra>[\w-]+)["']""")


@dataclass(frozen=True, slots=True)
class Extra:
    """One optional part. `requirements`: names with their versions, as the metadata state them; `missing`: names that
    are not installed; `lock`: the file that names all packages that are installed for it, with their hashes."""

    name: str
    purpose: str
    requirements: tuple[str, ...]
    missing: tuple[str, ...]
    lock: str

    @property
    def installed(self) -> bool:
        """Whether all of it is installed."""
        return not self.missing


def extras() -> list[Extra]:
    """The optional parts, as the metadata of the installed package lists them."""
    found: dict[str, list[tuple[str, str]]] = {name: [] for name in PURPOSES}
    for line in metadata.requires("fieldcal") or []:
        match = _REQUIREMENT.match(line)
        if match and match["extra"] in found:
            found[match["extra"]].append((match["name"], match["name"] + match["versions"].strip()))
    return [
        Extra(
            name,
            PURPOSES[name],
            tuple(requirement for _, requirement in needed),
            tuple(package for package, _ in needed if not _is_installed(package)),
            str(LOCKS / f"{name}.lock"),
        )
        for name, needed in found.items()
        if needed
    ]


def install_command(chosen: Sequence[Extra], wheels: Path | None) -> list[str] | None:
    """The command that installs the parts by their lock files: from the wheels in a directory alone, or (None) from the
    package index. pip refuses a file whose hash is not in the lock file.

    Without a pip of its own, as in the Debian package, the one of the system is used. None where there is none.
    """
    if find_spec("pip") is not None:
        pip = [sys.executable, "-m", "pip"]
    elif shared := shutil.which("pip3"):
        pip = [shared, "--python", sys.executable]
    else:
        return None
    source = [] if wheels is None else ["--no-index", "--find-links", str(wheels)]
    locks = [word for extra in chosen for word in ("--requirement", extra.lock)]
    return [*pip, "install", "--disable-pip-version-check", "--require-hashes", *source, *locks]


def _is_installed(package: str) -> bool:
    try:
        metadata.version(package)
    except metadata.PackageNotFoundError:
        return False
    return True
