"""Networks that the programs are made of (paper, appendix A.1)."""
