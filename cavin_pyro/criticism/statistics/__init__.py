"""Statistics of checks, without figures."""
