"""The program attacked on purpose: what was hostile is refused, named or harmless."""
