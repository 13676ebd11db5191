"""The engine: all code that results depend on. It has a name, and it travels with the recordings."""
