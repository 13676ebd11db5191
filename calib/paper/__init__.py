"""Methods 1 to 3 exactly as in D'Emilia et al. (2018), and the statistics of the paper's Appendix A."""
