"""Whether the prior is right, given the state: tests and coverage of (s, c, z)."""
