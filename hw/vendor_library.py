"""Import of a vendor's library, only when its driver is used."""

from __future__ import annotations

import importlib
from typing import Any

from hw.sensor import ConfigurationError


def vendor_library(module: str, driver: str, extra: str, besides: str) -> Any:
    """Import and return `module`.

    Raises ConfigurationError that tells what to install: the `extra` of fieldcal, and `besides`.
    """
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:  # OSError: the Python package is installed, its C library is not
        package = module.partition(".")[0]
        raise ConfigurationError(
            f"driver {driver} needs {package} (fieldcal extras --install {extra}) and {besides}: {error}"
        ) from error
