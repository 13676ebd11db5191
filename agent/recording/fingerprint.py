"""The numeric fingerprint of a machine: what else than the data decides the last bits of a result.

numpy and OpenBLAS choose their computing kernels by the features of the CPU. Different kernels add in a different
order, and their sums differ in the last bit. Environment variables, read when the libraries load, make both choose as
on another CPU.
"""

from __future__ import annotations

import os
import platform
import sys
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

# Not public names of numpy; numpy.show_runtime reads the same ones.
from numpy._core._multiarray_umath import __cpu_dispatch__ as _dispatched  # type: ignore[import-not-found]
from numpy._core._multiarray_umath import __cpu_features__ as _features

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

CORE_TYPE = "OPENBLAS_CORETYPE"
DISABLED_FEATURES = "NPY_DISABLE_CPU_FEATURES"
_AGAIN = "FIELDCAL_KERNELS_CHOSEN"


def versions() -> dict[str, str]:
    """Versions of python, numpy and scipy, which do the computing."""
    from importlib.metadata import version

    return {"python": platform.python_version(), "numpy": np.__version__, "scipy": version("scipy")}


def fingerprint() -> dict[str, str]:
    """What must be equal for results equal in every bit: versions, machine, C library, BLAS, kernel, CPU features."""
    return versions() | {
        "machine": platform.machine(),
        "libc": " ".join(platform.libc_ver()),
        **_blas(),
        # The features that numpy was built to use and that this CPU has; a missing feature also changes the bits.
        "cpu_features": " ".join(name for name in _dispatched if _features[name]),
    }


def environment_for(recorded: dict[str, str]) -> dict[str, str] | None:
    """Environment variables with which a new process computes with the kernels of the fingerprint `recorded`.

    None where this machine cannot do so: the libraries must be the same, and this CPU must have all features of the
    recorded CPU, since a kernel that uses a missing feature ends the process.
    """
    here = fingerprint()
    choosable = {"blas_kernel", "cpu_features", "blas_threads"}
    if any(recorded.get(name) != here[name] for name in here.keys() - choosable):
        return None
    features, present = (set(f.get("cpu_features", "").split()) for f in (recorded, here))
    if not features <= present:
        return None
    kernel, threads = recorded.get("blas_kernel", ""), recorded.get("blas_threads", "")
    if not kernel.isalnum() or not threads.isdecimal():
        return None
    disabled = " ".join(sorted(present - features))
    return {CORE_TYPE: kernel, "OPENBLAS_NUM_THREADS": threads, DISABLED_FEATURES: disabled}


def compute_as(recorded: dict[str, str]) -> None:
    """Restart this process with the kernels of the fingerprint `recorded`, where they differ and this machine can.

    The process is restarted once at most.
    """
    if recorded == fingerprint() or _AGAIN in os.environ:
        return
    chosen = environment_for(recorded)
    if chosen is not None:
        sys.stdout.flush()
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | chosen | {_AGAIN: "1"})


def _blas() -> dict[str, str]:
    """Version, kernel and threads of the BLAS that numpy loaded.

    scipy's own BLAS chooses the same kernel, but is loaded later.
    """
    libraries = [info for info in _loaded().info() if info["user_api"] == "blas"]
    own = [info for info in libraries if "numpy" in info["filepath"]] or libraries
    return {
        "blas": " ".join(sorted(f"{info['internal_api']} {info['version']}" for info in own)),
        "blas_kernel": " ".join(sorted(str(info.get("architecture", "")) for info in own)),
        "blas_threads": " ".join(sorted(str(info["num_threads"]) for info in own)),
    }


@cache
def _loaded() -> ThreadpoolController:
    """The libraries of threads that were loaded at the first call: to find them takes milliseconds."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
