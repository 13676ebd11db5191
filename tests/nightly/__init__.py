"""The twins against Debian's own kernel: a virtual machine whose kernel drives an I2C adapter with the twins on it.

`python -m tests.nightly` (or `make nightly`) prints a table of what the kernel says and what fieldcal says, and ends
with 1 if they differ. docs/twins.md describes it.
"""
