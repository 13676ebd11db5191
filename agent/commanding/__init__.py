"""Signed commands of operators: each is checked, then put among the pipeline's events, or refused and recorded."""
