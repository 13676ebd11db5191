"""A vendor's library, imported only by those who name its driver."""

from __future__ import annotations

import importlib
from typing import Any

from hw.sensor import ConfigurationError


def vendor_library(module: str, driver: str, extra: str, besides: str) -> Any:
    """The module. Raises ConfigurationError with what to install: the extra, and what it needs besides."""
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:  # OSError: the package is there, the library in C is not
        package = module.partition(".")[0]
        raise ConfigurationError(
            f"driver {driver} needs {package} (pip install 'fieldcal[{extra}]') and {besides}: {error}"
        ) from error
