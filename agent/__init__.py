"""The gateway agent: configuration, pipeline, recording, store, publication and the command line."""

from calib import __version__

__all__ = ["__version__"]
