"""Rollouts of candidates: segments, termination, replacement and returns."""
