"""The gateway agent: configuration, pipeline, recording, store, publication and the command line."""
