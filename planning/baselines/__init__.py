"""The planners that the paper compares with (section 4.1, appendix A.2), and links between them and CAVIN."""
