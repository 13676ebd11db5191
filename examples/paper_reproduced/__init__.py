"""The experiment of the paper on the virtual bench: what examples/paper.py is made of."""
