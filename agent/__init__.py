"""The gateway agent: configuration, pipeline, recording, store, publication and the command line."""

__version__ = "0.2.0"
