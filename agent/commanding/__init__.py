"""Operators' commands: signed, checked one by one, then taken into the pipeline's events or refused for the record."""
