"""Shows a run to a person: live on a terminal, or as lines of text."""
