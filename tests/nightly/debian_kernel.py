"""A Debian kernel package, downloaded with apt and unpacked: nothing is installed, no rights are needed."""

from __future__ import annotations

import lzma
import os
import re
import shutil
import subprocess
from pathlib import Path

# Debian 13, Linux 6.12: the kernel of Debian 12 has no hrtimer trigger, which is needed to fill a buffer.
SOURCE = "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] http://deb.debian.org/debian trixie main\n"
PACKAGE = "linux-image-amd64"
GIVEN = "FIELDCAL_GUEST_KERNEL"
MORE_MODULES = "FIELDCAL_GUEST_MODULES"


def cache() -> Path:
    """Directory in which the package is kept between runs."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "fieldcal-nightly"


class DebianKernel:
    """An unpacked linux-image package, and modules built for it elsewhere. `release` is the output of `uname -r`."""

    def __init__(self, root: Path, more_modules: Path | None = None) -> None:
        (self.image,) = root.glob("boot/vmlinuz-*")
        self.release = self.image.name.removeprefix("vmlinuz-")
        directory = next(root.glob(f"**/lib/modules/{self.release}"))
        self._built_in = {_key(Path(line).name) for line in (directory / "modules.builtin").read_text().split()}
        self._modules = {_key(path.name): path for path in directory.glob("kernel/**/*.ko*")}
        if more_modules is not None:
            self._modules |= {_key(path.name): path for path in more_modules.glob("*.ko")}

    def has(self, module: str) -> bool:
        """Whether the module exists."""
        return _key(module) in self._modules

    def modules(self, wanted: list[str]) -> dict[str, bytes]:
        """The wanted modules and their dependencies, by name, in the order in which they must be loaded.

        Raises KeyError if there is no such module.
        """
        loaded: dict[str, bytes] = {}

        def load(name: str) -> None:
            if name in loaded or name in self._built_in:
                return
            path = self._modules[name]
            content = lzma.decompress(path.read_bytes()) if path.suffix == ".xz" else path.read_bytes()
            depends = re.search(rb"\0depends=([^\0]*)\0", content)
            for needed in depends[1].decode().split(",") if depends else ():
                if needed:
                    load(_key(needed))
            loaded[name] = content

        for name in wanted:
            load(_key(name))
        return loaded


def _key(name: str) -> str:
    return name.split(".")[0].replace("-", "_")


def fetched() -> DebianKernel:
    """Debian's kernel, from the cache if that is the newest one.

    The environment variable FIELDCAL_GUEST_KERNEL names a package to use instead, FIELDCAL_GUEST_MODULES a directory
    with further modules. Raises subprocess.CalledProcessError if apt cannot download it.
    """
    given = os.environ.get(GIVEN)
    package = Path(given) if given else _downloaded(cache())
    root = cache() / package.stem
    if not root.exists():
        half = root.with_suffix(".part")
        subprocess.run(["dpkg-deb", "--extract", package, half], check=True)
        half.rename(root)
    more = os.environ.get(MORE_MODULES)
    return DebianKernel(root, Path(more) if more else None)


def _downloaded(directory: Path) -> Path:
    """Download the newest package of SOURCE, with package lists and keys separate from the machine's."""
    apt = directory / "apt"
    (apt / "lists" / "partial").mkdir(parents=True, exist_ok=True)
    (apt / "sources.list").write_text(SOURCE)
    options = {
        "Dir::Etc::SourceList": apt / "sources.list",
        "Dir::Etc::SourceParts": "/dev/null",
        "Dir::State": apt,
        "Dir::State::Status": "/dev/null",
        "Dir::Cache": apt,
        "APT::Architecture": "amd64",
        "APT::Sandbox::User": "",
    }
    given = [argument for name, value in options.items() for argument in ("-o", f"{name}={value}")]
    subprocess.run(["apt-get", *given, "-qq", "update"], check=True)
    listed = subprocess.run(
        ["apt-cache", *given, "depends", PACKAGE], check=True, capture_output=True, text=True
    ).stdout
    (name,) = re.findall(r"Depends: (linux-image-\S+)", listed)
    uris = subprocess.run(
        ["apt-get", *given, "-qq", "--print-uris", "download", name], check=True, capture_output=True, text=True
    ).stdout
    package = directory / uris.split()[1]
    if not package.exists():
        for older in directory.glob("linux-image-*"):  # each has half a gigabyte
            shutil.rmtree(older) if older.is_dir() else older.unlink()
        subprocess.run(["apt-get", *given, "-qq", "download", name], check=True, cwd=directory)
    return package
