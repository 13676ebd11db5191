"""The mathematics: model, geometry, clocks, excitation, sums and the estimators. Pure; no I/O, no threads, no clock."""
