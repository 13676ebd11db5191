"""The paper's experiment on the virtual bench: the parts of examples/paper.py."""
