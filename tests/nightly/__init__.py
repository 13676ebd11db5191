"""The twins compared with Debian's own kernel: a virtual machine whose kernel uses an I2C adapter with the twins on it.

`python -m tests.nightly` (or `make nightly`) prints a table with the values of the kernel and those of fieldcal. The
exit status is 1 if they differ. docs/twins.md describes it.
"""
