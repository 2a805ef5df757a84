"""Networks of the programs (paper, appendix A.1)."""
