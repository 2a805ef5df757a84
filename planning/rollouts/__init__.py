"""Rollouts of candidates: segments, what ends and replaces them, and what they are worth."""
