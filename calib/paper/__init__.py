"""Methods 1 to 3 as D'Emilia et al. (2018) print them, and the statistics of their Appendix A."""
